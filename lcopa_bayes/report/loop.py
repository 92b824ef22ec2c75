"""The page of a loop, drawn from `loop.json` and `loop_curves.json` of its run folder alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lcopa_bayes.core.units import measured
from lcopa_bayes.plot.loop import before_after_figure, effects_figure, view_figure
from lcopa_bayes.report.formatting import figures
from lcopa_bayes.report.page import Drawings, Verdict
from lcopa_bayes.report.svg import Drawing, drawing
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
    top = listed[0]
    above = sum(one["log_bayes_factor"] > evidence["threshold"] for one in listed)
    caption = (
        f"Of {len(evidence['classes'])} effects {above} exceed the level that chance reaches (dashed); the "
        f"largest is {top['name']}. Linear below 10 nat, logarithmic above."
    )
    figure = effects_figure(listed, evidence["threshold"])
    return (drawing("loop_evidence", figure, caption, data="loop.json"),)


def _residuals(results: Mapping[str, Any], curves: Sequence[Mapping[str, Any]]) -> list[Drawing]:
    drawings = []
    worst = sorted(curves, key=lambda curve: -_rmse(results["after"], curve) / (curve["noise_sd"] or 1.0))
    held, fitted = ([curve for curve in worst if curve["held_out"] == kind] for kind in (True, False))
    chosen = [*held[: _MOST_CURVES // 2], *fitted][:_MOST_CURVES]
    for number, curve in enumerate(chosen, start=1):
        before, after = (_rmse(results[when], curve) for when in ("before", "after"))
        caption = (
            f"{curve['record']}, {curve['axis']}: root mean square {figures(before)} before and "
            f"{figures(after)} after, noise {measured(figures(curve['noise_sd']), curve['unit'])}. "
            "Grey: 90 % band with noise."
        )
        figure = before_after_figure(curve, results["time_unit"])
        stem = f"loop_residual_{number:02d}_{curve['record']}_{curve['axis']}"
        drawings.append(drawing(stem, figure, caption, "held out" * curve["held_out"], "loop_curves.json"))
    return drawings


def _rmse(side: Mapping[str, Any], curve: Mapping[str, Any]) -> float:
    """Of all samples, of which the curve shows some [response unit]."""
    keys = ("record", "axis", "held_out")
    wanted = [curve[key] for key in keys]
    return float(next(score["rmse"] for score in side["scores"] if [score[key] for key in keys] == wanted))


def _views(views: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[Drawing]:
    drawings = []
    pairs = [*zip(views["before"], views["after"], strict=True)]
    for number, (before, after) in enumerate(pairs, start=1):
        if not before["x"]:
            continue
        caption = (
            f"Before: {before['sentence']}. After: {after['sentence']}. Bars: 90 % intervals of pure noise."
        )
        figure = view_figure(before, after)
        drawings.append(drawing(f"loop_view_{number:02d}", figure, caption, data="loop_curves.json"))
    return drawings
