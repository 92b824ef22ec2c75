"""The page of a loop, drawn from `loop.json` and `loop_curves.json` of its run folder alone."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.report.formatting import NONE, figures, interval, percent
from lcopa_bayes.report.page import Verdict, write_page
from lcopa_bayes.report.section import Column, Drawing, Section, Table
from lcopa_bayes.report.theme import BAND, HELD_OUT, NOISE, SEEN, blank, label, look, plain, svg_of

_MOST_CURVES = 12
_LONGEST = 20


NAME = "loop.html"
"""Name of the page inside the run folder."""
_NEEDS = {
    "loop.json": (
        *(
            "study",
            "verdict",
            "confidence",
            "sentence",
            "grade",
            "grade_reason",
            "noise",
            "effects",
            "before",
        ),
        *("after", "evidence", "rounds", "moved", "survival", "next_measurement", "residual", "cautions"),
    ),
    "loop_curves.json": ("views", "curves"),
}


def write_loop(folder: Path) -> Path:
    """`loop.html` with verdict, evidence, errors before and after and residuals side by side; returns its
    path.

    InputError when the folder holds no loop or it cannot be used.
    """
    told, shown = (_loaded(folder / name, keys) for name, keys in _NEEDS.items())
    with look():
        sections = [*_tables(told), *_figures(told, shown)]
    verdict = Verdict(
        str(told["grade"]),
        f"{told['verdict']} ({told['confidence']}): {told['sentence']}",
        str(told["grade_reason"]),
    )
    return write_page(folder, f"{told['study']}: what the model lacks", sections, verdict, NAME)


def _loaded(path: Path, keys: tuple[str, ...]) -> Mapping[str, Any]:
    try:
        told: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); run `loop` to write it") from None
    absent = [key for key in keys if key not in told]
    if absent:
        raise InputError(f"{path}: lacks {', '.join(absent)}; run `loop` again")
    return told


def _tables(told: Mapping[str, Any]) -> list[Section]:
    """Everything of a loop that is words and numbers."""
    return [_found(told), _errors(told), _noise(told), _evidence(told), _rounds(told), _moved(told)]


def _found(told: Mapping[str, Any]) -> Section:
    text = [str(told["sentence"]), *(f"Caution: {one}" for one in told["cautions"])]
    if told.get("base_enlarged"):
        text.append(str(told["base_enlarged"]))
    for effect in told["effects"]:
        rest = effect["group"][1:]
        also = f" These records cannot tell it from {', '.join(rest)}." if rest else ""
        near = ", ".join(f"{one['name']} {one['cosine']:.2f}" for one in effect["nearest"])
        also += (
            f" Nearest to it, by the cosine of the angle between what each leaves: {near}." if near else ""
        )
        text.append(f"{effect['name']}: {effect['formula']} ({effect['source']}).{also}")
    if told["next_measurement"]:
        text.append(f"Next measurement: {told['next_measurement']}")
    columns = (
        *(Column("parameter", "code"), Column("value", "number"), Column("90 % interval", "interval")),
        *(Column("unit"), Column("prior sd", "number"), Column("grade", "grade")),
    )
    rows = tuple(
        (
            str(one["name"]),
            figures(one["value"]),
            interval(one["lower"], one["upper"], one["sd"]),
            str(one["unit"]),
            figures(one["prior_sd"], 2),
            str(one["grade"]),
        )
        for effect in told["effects"]
        for one in effect["parameters"]
    )
    constants = "; ".join(
        f"{effect['name']}: " + ", ".join(f"{key} {value}" for key, value in effect["constants"].items())
        for effect in told["effects"]
        if effect["constants"]
    )
    caption = "Coefficients of the effects; all vanish at zero." + (
        f" Constants: {constants}." if constants else ""
    )
    return Section("What was missing", tuple(text), (), (Table(columns, rows, caption),) if rows else ())


def _errors(told: Mapping[str, Any]) -> Section:
    before, after = told["before"], told["after"]
    columns = (
        *(Column("record"), Column("axis"), Column("unseen"), Column("RMSE before", "number")),
        *(
            Column("RMSE after", "number"),
            Column("after / noise", "number"),
            Column("90 % band before", "number"),
        ),
        *(Column("90 % band after", "number"), Column("unit"), Column("level from", "prose")),
    )
    rows = tuple(
        (
            *(str(a["record"]), str(a["axis"]), "yes" if a["held_out"] else ""),
            *(figures(a["rmse"]), figures(b["rmse"]), figures(b["rmse_over_noise"])),
            *(percent(a["coverage_90"]), percent(b["coverage_90"]), str(a["unit"])),
            str(b["level_from"]),
        )
        for a, b in zip(before["scores"], after["scores"], strict=True)
    )
    text = (
        f"Unseen records were predicted by {told['unseen_by']}. Pointwise 90 % bands hold "
        f"{percent(before['held_out_coverage_90'])} of their samples before and "
        f"{percent(after['held_out_coverage_90'])} after; log evidence "
        f"{figures(before['log_evidence'], 6)} before and {figures(after['log_evidence'], 6)} after "
        "(Laplace approximation, noise held at its estimate)."
    )
    caption = (
        "Root mean square of observed minus predicted, and the share of samples inside the pointwise band "
        "with noise. Where the level comes from the record itself, a constant error of it cannot show."
    )
    return Section("Errors before and after", (text,), (), (Table(columns, rows, caption),))


def _noise(told: Mapping[str, Any]) -> Section:
    return Section("Noise, measured first", tuple(str(one["sentence"]) for one in told["noise"]))


def _evidence(told: Mapping[str, Any]) -> Section:
    found = told["evidence"]
    if not found["classes"]:
        return Section("Evidence of every effect", ("Nothing was traced: the base fit cannot be used.",))
    columns = (
        *(Column("effect", "code"), Column("place"), Column("log Bayes factor [nat]", "number")),
        *(Column("probability", "number"), Column("survival", "number"), Column("shown by", "prose")),
        Column("else mistaken for", "prose"),
    )
    rows = tuple(
        (
            *(str(one["name"]), str(one["place"]), figures(one["log_bayes_factor"])),
            *(figures(one["probability"], 2), figures(one["survival"], 2)),
            *(str(one["reveals"]), str(one["mistaken_for"]) or NONE),
        )
        for one in found["classes"]
    )
    text = (
        f"Chance alone reaches {figures(found['threshold'])} nat once in a hundred times "
        f"({found['draws']} draws, "
        f"no less than 3); p-value of the largest {figures(found['p_value'], 2)}, whose floor is "
        f"{figures(1 / (found['draws'] + 1), 2)}. Probability that nothing is missing: "
        f"{figures(found['none'], 2)}."
    )
    caption = (
        "Survival is the share of an effect's signature that the base model cannot imitate, known "
        "before looking "
        "at the residual: below 0.1 these records cannot see the effect."
    )
    return Section("Evidence of every effect", (text,), (), (Table(columns, rows, caption),))


def _rounds(told: Mapping[str, Any]) -> Section:
    columns = (
        *(Column("round", "number"), Column("refitted", "code"), Column("log Bayes factor [nat]", "number")),
        *(Column("left-out gain [nat]", "number"), Column("beyond 3 sd"), Column("kept")),
    )
    rows = tuple(
        (
            *(str(number), ", ".join(one["added"]), figures(one["log_bayes_factor"])),
            *(figures(one["left_out_gain"]), "yes" if one["significant"] else "no"),
            "yes" if one["added"] == made["chosen"] else "",
        )
        for number, made in enumerate(told["rounds"], start=1)
        for one in made["refits"]
    )
    if not rows:
        return Section("Refits", ("No candidate had to be refitted.",))
    failures = tuple(f"Could not be refitted: {one}." for made in told["rounds"] for one in made["failures"])
    return Section(
        "Refits", failures, (), (Table(columns, rows, "Candidates refitted with everything free."),)
    )


def _moved(told: Mapping[str, Any]) -> Section:
    if not told["moved"]:
        return Section("What it had done to the parameters", ("No parameter moved by more than 2 sd.",))
    columns = (
        *(Column("parameter", "code"), Column("before", "number"), Column("after", "number")),
        *(Column("shift [sd]", "number"), Column("unit")),
    )
    rows = tuple(
        (
            *(str(one["name"]), figures(one["before"], 4), figures(one["after"], 4)),
            *(figures(one["shift_in_sd"], 2), str(one["unit"])),
        )
        for one in told["moved"]
    )
    text = "Without the effect these parameters were biased by more than 2 sd of the fit with it."
    return Section("What it had done to the parameters", (text,), (), (Table(columns, rows),))


def _figures(told: Mapping[str, Any], shown: Mapping[str, Any]) -> list[Section]:
    """Every figure of a loop."""
    return [_bars(told), _residuals(told, shown["curves"]), _views(shown["views"])]


def _bars(told: Mapping[str, Any]) -> Section:
    found = told["evidence"]
    listed = [one for one in found["classes"] if one["log_bayes_factor"] is not None][:_LONGEST]
    if not listed:
        return Section("Evidence")
    figure = blank(0.6 + 0.2 * len(listed))
    axes = figure.subplots()
    names = [plain(one["name"]) for one in listed]
    values = np.array([one["log_bayes_factor"] for one in listed])
    axes.barh(
        np.arange(len(names)), values, color=[BAND if v > found["threshold"] else NOISE for v in values]
    )
    axes.axvline(found["threshold"], color=HELD_OUT, lw=1.0, ls="--")
    axes.set_yticks(np.arange(len(names)), names)
    axes.invert_yaxis()
    axes.set_xscale("symlog", linthresh=10)
    axes.set_xlabel("log Bayes factor against nothing missing [nat]")
    top = listed[0]
    above = int((values > found["threshold"]).sum())
    caption = (
        f"Of {len(found['classes'])} classes {above} stand above what chance reaches (dashed); the "
        "largest is "
        f"{top['name']}. Linear below 10 nat, logarithmic above."
    )
    return Section("Evidence", (), (Drawing("loop_evidence", svg_of(figure), caption),))


def _residuals(told: Mapping[str, Any], curves: Sequence[Mapping[str, Any]]) -> Section:
    drawings = []
    held = [one for one in curves if one["held_out"]]
    chosen = [*held[: _MOST_CURVES // 2], *[one for one in curves if not one["held_out"]]][:_MOST_CURVES]
    for number, one in enumerate(chosen, start=1):
        figure = blank(1.9)
        panels = figure.subplots(1, 2, sharey=True)
        colour = HELD_OUT if one["held_out"] else SEEN
        for axes, when in zip(panels, ("before", "after"), strict=True):
            _residual(axes, one, when, colour, told["time_unit"])
        panels[0].set_ylabel(label("residual", one["unit"]))
        before, after = (_rmse(told[when], one) for when in ("before", "after"))
        caption = (
            f"{one['record']}, {one['axis']}: root mean square {before:.3g} before and {after:.3g} "
            "after, noise "
            f"{one['noise_sd']:.3g} {one['unit']}. Grey: 90 % band with noise."
        )
        stem = f"loop_residual_{number:02d}_{one['record']}_{one['axis']}"
        drawings.append(Drawing(stem, svg_of(figure), caption, mark="held out" if one["held_out"] else ""))
    rest = len(curves) - len(chosen)
    text = (f"{rest} more residuals are in loop_curves.json.",) if rest else ()
    return Section("Residuals side by side", text, tuple(drawings))


def _rmse(side: Mapping[str, Any], curve: Mapping[str, Any]) -> float:
    """Of all samples, of which the curve shows some [response unit]."""
    keys = ("record", "axis", "held_out")
    wanted = [curve[key] for key in keys]
    return float(next(one["rmse"] for one in side["scores"] if [one[key] for key in keys] == wanted))


def _residual(axes: Axes, one: Mapping[str, Any], when: str, colour: str, unit: str) -> None:
    time = np.array(one["time"], dtype=float)
    width = np.array(one[f"half_width_{when}"], dtype=float)
    axes.fill_between(time, -width, width, color=NOISE, alpha=0.25, lw=0)
    axes.plot(time, one[when], ".", ms=1.6, mew=0, color=colour)
    axes.axhline(0.0, color=NOISE, lw=0.6)
    axes.set_title(plain(f"{one['record']}, {one['axis']}: {when}"), loc="left")
    axes.set_xlabel(label("time", unit))


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
                axes.set_xscale("log")
                axes.set_yscale("log")
            axes.set_title(plain(f"{view['axis']}, {view['name']}: {when}"), loc="left")
            axes.set_xlabel(plain(str(view["across"]))[:70])
        panels[0].set_ylabel(plain(str(before["along"])))
        caption = f"Before: {before['sentence']}. After: {after['sentence']}. Bars: 90 % if it were noise."
        drawings.append(Drawing(f"loop_view_{number:02d}", svg_of(figure), caption))
    return Section("The residual from every side", (), tuple(drawings))
