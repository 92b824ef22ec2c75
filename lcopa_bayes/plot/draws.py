"""Draws of a posterior: pairs, intervals, traces, and marginals beside priors or a second method."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import cycle
from typing import Any

import corner
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.plot.rundata import RunData
from lcopa_bayes.plot.theme import (
    BAND,
    CYCLE,
    HELD_OUT,
    StyledFigure,
    blank,
    extremes,
    grid,
    label,
    legend_above,
    plain,
)

_KINDS = ("time", "order", "delay", "gain")
"""Kinds of parameters that are shown first; of the rest, noise and offsets come last."""
_LAST = ("offset", "sigma", "rho", "nu")
IN_CORNER = 8
"""Most parameters on one corner plot."""
_LABELS = 0.47
"""Distance of an axis label from its panel [in]."""
_NARROW = 1e-9
"""Range of values over their magnitude below which they are alike [-]."""
MIDDLE = 0.995
"""Share of the draws that each axis of the corner plot spans [-]."""


def ranked(names: Iterable[str]) -> list[str]:
    """Names by interest: times, orders, delays, gains, anything else, offsets, noise; ties in their order."""

    def rank(name: str) -> int:
        kind = name.split("_")[0]
        if kind in _KINDS:
            return _KINDS.index(kind)
        return len(_KINDS) + (1 + _LAST.index(kind) if kind in _LAST else 0)

    return sorted(names, key=rank)


def corner_figure(run: RunData, names: Sequence[str]) -> Figure:
    """Marginals and pairs of parameters."""
    values = np.stack([run.draws[name].ravel() for name in names], axis=1)
    scales = ["log" if run.spans_decades(name) else "linear" for name in names]
    side = min(9.6, max(3.4, 1.15 * len(names) + 0.9))
    figure = StyledFigure(figsize=(side, side))
    small = len(names) > 5
    corner.corner(
        values,
        fig=figure,
        range=[MIDDLE] * len(names),
        axes_scale=scales,
        bins=24,
        smooth=1.0,
        levels=(0.5, 0.9),
        quantiles=(0.05, 0.5, 0.95),
        color=BAND,
        labels=[f"{plain(name)}\n[{plain(run.units[name])}]" for name in names],
        label_kwargs={"fontsize": 7.5 if small else 8.5},
        labelpad=max(0.05, _LABELS * len(names) / (side - 1.0) - 0.3),
        max_n_ticks=3 if small else 4,
        plot_density=False,
        data_kwargs={"ms": 1.2, "alpha": 0.25},
        hist_kwargs={"lw": 0.9},
        contour_kwargs={"linewidths": 0.9},
    )
    for k, panel in enumerate(figure.axes):
        row, column = divmod(k, len(names))
        if column < row or row == column == len(names) - 1:
            panel.tick_params(labelrotation=45)
        panel.tick_params(labelsize=6.5 if small else 7.5, length=2)
        for line in panel.lines:
            line.set_linewidth(0.8)
    figure.align_labels()
    room = 0.95 / side
    figure.subplots_adjust(left=room, bottom=room, right=0.99, top=0.99)
    return figure


_BINS, _TRACE = 30, 300
"""Bins of a marginal, and points of a trace [-]."""


def traces_figure(run: RunData, names: Sequence[str]) -> Figure:
    """Draws in their order, with R-hat."""
    rhat = {row["name"]: row.get("rhat") for row in run.results["parameters"]}
    figure, panels = grid(len(names), columns=2, height=1.15)
    for panel, name in zip(panels, names, strict=True):
        for chain, colour in zip(run.draws[name], cycle(CYCLE), strict=False):
            at = extremes(chain, most=_TRACE)
            panel.plot(at, chain[at], color=colour, lw=0.4, alpha=0.8)
        if run.spans_decades(name):
            panel.set_yscale("log")
        shown = "not defined" if rhat[name] is None else f"{rhat[name]:.3f}"
        panel.set_title(f"{label(name, run.units[name])}   R-hat {shown}", fontsize=8)
        panel.margins(x=0.01)
    for panel in panels[-2:]:
        panel.set_xlabel("draw [-]")
    return figure


def marginals(run: RunData, names: Sequence[str], draw: Callable[[Axes, RunData, str], None]) -> Figure:
    """A figure of densities, one panel per parameter, each drawn by `draw`."""
    figure, panels = grid(len(names), columns=3, height=1.5)
    for panel, name in zip(panels, names, strict=True):
        draw(panel, run, name)
        panel.set_xlabel(label(name, run.units[name]), fontsize=8)
        panel.set_yticks([])
        panel.spines["left"].set_visible(False)
        panel.set_ylim(bottom=0.0)
        panel.margins(x=0.0)
    legend_above(figure, panels[0], 2)
    return figure


def _density_axis(panel: Axes, *, log: bool) -> None:
    """Scale and ticks of the axis of a density."""
    if log:
        panel.set_xscale("log")
    else:
        panel.locator_params(axis="x", nbins=4)


def draw_prior(panel: Axes, run: RunData, name: str) -> None:
    """The prior density of a parameter over the histogram of its draws."""
    density = run.tables["prior_density"]
    own = density[density["name"] == name]
    x, height = own["x"].to_numpy(), own["density"].to_numpy()
    draws = run.draws[name].ravel()
    log = run.is_log(name)
    draws = np.log(draws) if log else draws
    counts, edges = np.histogram(draws, bins=_BINS, range=_reach(draws), density=True)
    panel.stairs(counts, np.exp(edges) if log else edges, fill=True, color=BAND, alpha=0.5, label="draws")
    panel.plot(x, height, color=HELD_OUT, label="prior")
    _density_axis(panel, log=log)


def _reach(values: Vector) -> tuple[float, float]:
    """Ends of a histogram of values; of those that differ by rounding alone wide enough for bins."""
    low, high = float(values.min()), float(values.max())
    short = max(0.0, _NARROW * max(abs(low), abs(high)) - (high - low))
    return low - short / 2, high + short / 2


def draw_methods(panel: Axes, run: RunData, name: str) -> None:
    """The marginal of a parameter by ensembles and by nested sampling."""
    whole = run.tables["cross_check_density"]
    own = whole[whole["name"] == name]
    edges = np.append(own["left"].to_numpy(), own["right"].to_numpy()[-1])
    panel.stairs(own["ensembles"].to_numpy(), edges, fill=True, color=BAND, alpha=0.5, label="ensembles")
    panel.stairs(own["nested"].to_numpy(), edges, color=HELD_OUT, linewidth=1.1, label="nested sampling")
    _density_axis(panel, log=bool(own["log_scale"].any()))


def forest_figure(parameters: Sequence[Mapping[str, Any]]) -> Figure:
    """Median and 90 % interval of every parameter, each row by its own scale: rows of `parameters`.

    A panel for each unit, logarithmic where its numbers are positive and span more than a factor of 20.
    """
    units = list(dict.fromkeys(row["unit"] for row in parameters))
    groups = [[row for row in parameters if row["unit"] == unit] for unit in units]
    figure = blank(0.35 * len(units) + 0.22 * len(parameters) + 0.3)
    panels = figure.subplots(len(units), 1, squeeze=False, height_ratios=[len(one) + 0.6 for one in groups])
    for panel, unit, rows in zip(panels[:, 0], units, groups, strict=True):
        ends = np.array([[row[key] for key in ("value", "lower", "upper")] for row in rows], dtype=float)
        places = np.arange(len(rows))
        for place, (value, lower, upper), row in zip(places, ends, rows, strict=True):
            sure = row["grade"] == "reliable"
            panel.plot([lower, upper], [place, place], color=BAND, lw=1.6, solid_capstyle="butt")
            panel.plot([value], [place], "o", ms=4.5, color=BAND, mfc=BAND if sure else "white")
        if ends.min() > 0 and ends.max() > 20 * ends.min():
            panel.set_xscale("log")
        panel.set_yticks(places, [plain(row["name"]) for row in rows])
        panel.set(ylim=(len(rows) - 0.4, -0.6), xlabel=f"[{plain(unit)}]")
        panel.grid(axis="x", color="#b0b0b0", lw=0.3)
    return figure
