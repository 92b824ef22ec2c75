"""The page of a loop, drawn from `loop.json` and `loop_curves.json` of its run folder alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from lcopa_bayes.report.page import Verdict, write_graded
from lcopa_bayes.report.section import NONE, Drawing, Section, Table, figures, interval, percent, stopped
from lcopa_bayes.report.theme import BAND, HELD_OUT, NOISE, SEEN, blank, label, plain, svg_of
from lcopa_bayes.results.stored import stored_values

_MOST_CURVES = 12
_LONGEST = 20


def write_loop(folder: Path) -> Path:
    """`loop.html` with verdict, evidence, errors before and after and residuals side by side; returns its
    path.

    InputError when the folder holds no loop or it cannot be used.
    """
    shown = stored_values(folder, "loop", ("views", "curves"), file="loop_curves.json")
    return write_graded(
        folder,
        "loop",
        "what the model lacks",
        lambda values: [
            *(part(values) for part in (_effects, _errors, _noise, _evidence, _rounds, _moved, _bars)),
            _residuals(values, shown["curves"]),
            _views(shown["views"]),
        ],
        box=lambda values: Verdict(
            str(values["grade"]),
            f"{values['verdict']} ({values['confidence']}): {values['sentence']}",
            str(values["grade_reason"]),
        ),
    )


def _effects(results: Mapping[str, Any]) -> Section:
    text = [str(results["sentence"]), *(stopped(f"Caution: {caution}") for caution in results["cautions"])]
    if results.get("base_enlarged"):
        text.append(str(results["base_enlarged"]))
    for effect in results["effects"]:
        rest = effect["group"][1:]
        also = f" These records cannot distinguish it from {', '.join(rest)}." if rest else ""
        near = ", ".join(f"{entry['name']} {entry['cosine']:.2f}" for entry in effect["nearest"])
        also += (
            f" Most similar effects, by the cosine of the angle between their residual signatures: {near}."
            if near
            else ""
        )
        text.append(f"{effect['name']}: {effect['formula']} ({effect['source']}).{also}")
    if results["next_measurement"]:
        text.append(f"Next measurement: {results['next_measurement']}")
    constants = "; ".join(
        f"{effect['name']}: " + ", ".join(f"{key} {value}" for key, value in effect["constants"].items())
        for effect in results["effects"]
        if effect["constants"]
    )
    caption = "Coefficients of the effects; all vanish at zero." + (
        f" Constants: {constants}." if constants else ""
    )
    table = Table.of(
        [estimate for effect in results["effects"] for estimate in effect["parameters"]],
        ("parameter", "code", "name"),
        ("value", "number", "value"),
        ("90 % interval", "interval", lambda row: interval(row["lower"], row["upper"], row["sd"])),
        ("unit", "text", "unit"),
        ("prior sd", "number", lambda row: figures(row["prior_sd"], 2)),
        ("grade", "grade", "grade"),
        caption=caption,
    )
    return Section("What was missing", tuple(text), tables=(table,) if table.rows else ())


def _errors(results: Mapping[str, Any]) -> Section:
    before, after = results["before"], results["after"]
    text = (
        f"Unseen samples: {results['unseen_by']}. Pointwise 90 % bands hold "
        f"{percent(before['held_out_coverage_90'])} of them before and "
        f"{percent(after['held_out_coverage_90'])} after; log evidence "
        f"{figures(before['log_evidence'], 6)} before and {figures(after['log_evidence'], 6)} after "
        "(Laplace approximation, noise held at its estimate)."
    )
    caption = (
        "Root mean square of observed minus predicted, and the share of samples inside the pointwise band "
        "with noise. Where the level is estimated from the record itself, a constant error is not visible."
    )
    table = Table.of(
        [
            after | {"rmse_before": before["rmse"], "coverage_before": before["coverage_90"]}
            for before, after in zip(before["scores"], after["scores"], strict=True)
        ],
        ("record", "text", "record"),
        ("axis", "text", "axis"),
        ("held out", "text", lambda row: "yes" if row["held_out"] else ""),
        ("RMSE before", "number", "rmse_before"),
        ("RMSE after", "number", "rmse"),
        ("after / noise", "number", "rmse_over_noise"),
        ("90 % band before", "number", lambda row: percent(row["coverage_before"])),
        ("90 % band after", "number", lambda row: percent(row["coverage_90"])),
        ("unit", "text", "unit"),
        ("level from", "prose", "level_from"),
        caption=caption,
    )
    return Section("Errors before and after", (text,), tables=(table,))


def _noise(results: Mapping[str, Any]) -> Section:
    return Section("Noise, measured first", tuple(str(entry["sentence"]) for entry in results["noise"]))


def _evidence(results: Mapping[str, Any]) -> Section:
    evidence = results["evidence"]
    if not evidence["classes"]:
        return Section(
            "Evidence of every effect", ("No residual was analysed: the base fit cannot be used.",)
        )
    text = (
        f"Chance alone reaches {figures(evidence['threshold'])} nat once in a hundred times "
        f"({evidence['draws']} draws, "
        f"no less than 3); p-value of the largest {figures(evidence['p_value'], 2)}, whose floor is "
        f"{figures(1 / (evidence['draws'] + 1), 2)}. Probability that nothing is missing: "
        f"{figures(evidence['none'], 2)}."
    )
    caption = (
        "Survival is the share of an effect's signature that the base model cannot reproduce; it does "
        "not depend on the residual: below 0.1 these records do not show the effect."
    )
    table = Table.of(
        evidence["classes"],
        ("effect", "code", "name"),
        ("place", "text", "place"),
        ("log Bayes factor [nat]", "number", "log_bayes_factor"),
        ("probability", "number", lambda row: figures(row["probability"], 2)),
        ("survival", "number", lambda row: figures(row["survival"], 2)),
        ("shown by", "prose", "reveals"),
        ("else mistaken for", "prose", lambda row: str(row["mistaken_for"]) or NONE),
        caption=caption,
    )
    return Section("Evidence of every effect", (text,), tables=(table,))


def _rounds(results: Mapping[str, Any]) -> Section:
    table = Table.of(
        [
            refit | {"round": number, "kept": refit["added"] == one["chosen"]}
            for number, one in enumerate(results["rounds"], start=1)
            for refit in one["refits"]
        ],
        ("round", "number", "round"),
        ("refitted", "code", lambda row: ", ".join(row["added"])),
        ("log Bayes factor [nat]", "number", "log_bayes_factor"),
        ("held-out gain [nat]", "number", "left_out_gain"),
        ("beyond 3 sd", "text", lambda row: "yes" if row["significant"] else "no"),
        ("kept", "text", lambda row: "yes" if row["kept"] else ""),
        caption="Candidates refitted with everything free.",
    )
    if not table.rows:
        return Section("Refits", ("No candidate had to be refitted.",))
    failures = tuple(
        f"Could not be refitted: {failure}." for round_ in results["rounds"] for failure in round_["failures"]
    )
    return Section("Refits", failures, tables=(table,))


def _moved(results: Mapping[str, Any]) -> Section:
    if not results["moved"]:
        return Section(
            "Bias of the parameters without the effect", ("No parameter shifted by more than 2 sd.",)
        )
    table = Table.of(
        results["moved"],
        ("parameter", "code", "name"),
        ("before", "number", lambda row: figures(row["before"], 4)),
        ("after", "number", lambda row: figures(row["after"], 4)),
        ("shift [sd]", "number", lambda row: figures(row["shift_in_sd"], 2)),
        ("unit", "text", "unit"),
    )
    text = "Without the effect these parameters were biased by more than 2 sd of the fit with it."
    return Section("Bias of the parameters without the effect", (text,), tables=(table,))


def _bars(results: Mapping[str, Any]) -> Section:
    evidence = results["evidence"]
    listed = [
        effect_class for effect_class in evidence["classes"] if effect_class["log_bayes_factor"] is not None
    ][:_LONGEST]
    if not listed:
        return Section("Evidence")
    figure = blank(0.6 + 0.2 * len(listed))
    axes = figure.subplots()
    names = [plain(effect_class["name"]) for effect_class in listed]
    values = np.array([effect_class["log_bayes_factor"] for effect_class in listed])
    axes.barh(
        np.arange(len(names)), values, color=[BAND if v > evidence["threshold"] else NOISE for v in values]
    )
    axes.axvline(evidence["threshold"], color=HELD_OUT, lw=1.0, ls="--")
    axes.set_yticks(np.arange(len(names)), names)
    axes.invert_yaxis()
    axes.set_xscale("symlog", linthresh=10)
    axes.set_xlabel("log Bayes factor against nothing missing [nat]")
    top = listed[0]
    above = int((values > evidence["threshold"]).sum())
    caption = (
        f"Of {len(evidence['classes'])} effects {above} exceed the level that chance reaches (dashed); the "
        f"largest is {top['name']}. Linear below 10 nat, logarithmic above."
    )
    return Section("Evidence", (), (Drawing("loop_evidence", svg_of(figure), caption),))


def _residuals(results: Mapping[str, Any], curves: Sequence[Mapping[str, Any]]) -> Section:
    drawings = []
    held = [curve for curve in curves if curve["held_out"]]
    chosen = [*held[: _MOST_CURVES // 2], *[curve for curve in curves if not curve["held_out"]]][
        :_MOST_CURVES
    ]
    for number, curve in enumerate(chosen, start=1):
        figure = blank(1.9)
        panels = figure.subplots(1, 2, sharey=True)
        colour = HELD_OUT if curve["held_out"] else SEEN
        for axes, when in zip(panels, ("before", "after"), strict=True):
            _residual(axes, curve, when, colour, results["time_unit"])
        panels[0].set_ylabel(label("residual", curve["unit"]))
        before, after = (_rmse(results[when], curve) for when in ("before", "after"))
        caption = (
            f"{curve['record']}, {curve['axis']}: root mean square {before:.3g} before and {after:.3g} "
            "after, noise "
            f"{curve['noise_sd']:.3g} {curve['unit']}. Grey: 90 % band with noise."
        )
        stem = f"loop_residual_{number:02d}_{curve['record']}_{curve['axis']}"
        drawings.append(Drawing(stem, svg_of(figure), caption, mark="held out" if curve["held_out"] else ""))
    rest = len(curves) - len(chosen)
    text = (f"{rest} more residuals are in loop_curves.json.",) if rest else ()
    return Section("Residuals side by side", text, tuple(drawings))


def _rmse(side: Mapping[str, Any], curve: Mapping[str, Any]) -> float:
    """Of all samples, of which the curve shows some [response unit]."""
    keys = ("record", "axis", "held_out")
    wanted = [curve[key] for key in keys]
    return float(next(score["rmse"] for score in side["scores"] if [score[key] for key in keys] == wanted))


def _residual(axes: Axes, curve: Mapping[str, Any], when: str, colour: str, unit: str) -> None:
    time = np.array(curve["time"], dtype=float)
    width = np.array(curve[f"half_width_{when}"], dtype=float)
    axes.fill_between(time, -width, width, color=NOISE, alpha=0.25, lw=0)
    axes.plot(time, curve[when], ".", ms=1.6, mew=0, color=colour)
    axes.axhline(0.0, color=NOISE, lw=0.6)
    axes.set(title=plain(f"{curve['record']}, {curve['axis']}: {when}"), xlabel=label("time", unit))


def _views(views: Mapping[str, Sequence[Mapping[str, Any]]]) -> Section:
    drawings = []
    pairs = [*zip(views["before"], views["after"], strict=True)]
    for number, (before, after) in enumerate(pairs, start=1):
        if not before["x"]:
            continue
        figure = blank(1.9)
        panels = figure.subplots(1, 2, sharey=True)
        for axes, view, when in ((panels[0], before, "before"), (panels[1], after, "after")):
            x, y, error = (np.array(view[key], dtype=float) for key in ("x", "y", "error"))
            level = 0.0 if "mean" in view["along"] or "correlation" in view["along"] else 1.0
            axes.axhline(level, color=NOISE, lw=0.7)
            axes.errorbar(x, y, yerr=1.645 * error, fmt=".-", ms=3, lw=0.8, elinewidth=0.6, color=BAND)
            if view["name"] == "spectrum" and x.size:
                axes.set(xscale="log", yscale="log")
            axes.set(
                title=plain(f"{view['axis']}, {view['name']}: {when}"), xlabel=plain(str(view["across"]))[:70]
            )
        panels[0].set_ylabel(plain(str(before["along"])))
        caption = (
            f"Before: {before['sentence']}. After: {after['sentence']}. Bars: 90 % intervals of pure noise."
        )
        drawings.append(Drawing(f"loop_view_{number:02d}", svg_of(figure), caption))
    return Section("Views of the residual", (), tuple(drawings))
