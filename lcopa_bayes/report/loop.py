"""The page of a loop, drawn from `loop.json` and `loop_curves.json` of its run folder alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from lcopa_bayes.report.page import Drawings, Verdict
from lcopa_bayes.report.theme import BAND, HELD_OUT, NOISE, SEEN, Drawing, blank, label, plain, svg_of
from lcopa_bayes.results.stored import stored_values

_MOST_CURVES = 12
_LONGEST = 20


def drawn(folder: Path, values: Mapping[str, Any]) -> Drawings:
    """Evidence, residuals side by side and views of a loop; InputError when its curves cannot be used."""
    shown = stored_values(folder, "loop", ("views", "curves"), file="loop_curves.json")
    residuals = _residuals(values, shown["curves"])
    sentence = f"{values['verdict']} ({values['confidence']}): {values['sentence']}"
    return {
        "verdict": Verdict(str(values["grade"]), sentence, str(values["grade_reason"])),
        "evidence": _bars(values),
        "residuals": residuals,
        "views": _views(shown["views"]),
        "curves_left": len(shown["curves"]) - len(residuals),
    }


def _bars(results: Mapping[str, Any]) -> tuple[Drawing, ...]:
    evidence = results["evidence"]
    listed = [
        effect_class for effect_class in evidence["classes"] if effect_class["log_bayes_factor"] is not None
    ][:_LONGEST]
    if not listed:
        return ()
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
    return (Drawing("loop_evidence", svg_of(figure), caption),)


def _residuals(results: Mapping[str, Any], curves: Sequence[Mapping[str, Any]]) -> list[Drawing]:
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
    return drawings


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


def _views(views: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[Drawing]:
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
    return drawings
