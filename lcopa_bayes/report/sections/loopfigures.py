"""What a loop found, as figures: evidence bars, residuals before and after side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from lcopa_bayes.report.section import Drawing, Section
from lcopa_bayes.report.theme import BAND, HELD_OUT, NOISE, SEEN, blank, label, plain, svg_of

_MOST_CURVES = 12
_LONGEST = 20


def sections(told: Mapping[str, Any], shown: Mapping[str, Any]) -> list[Section]:
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
