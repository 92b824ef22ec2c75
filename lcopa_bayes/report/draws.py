"""What the draws are: a corner plot, traces, priors under them, a second method, the sampler's summary."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from itertools import cycle
from typing import Any

import corner
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lcopa_bayes.report.formatting import NONE, figures
from lcopa_bayes.report.page import Drawings
from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.theme import (
    BAND,
    CYCLE,
    HELD_OUT,
    Drawing,
    grid,
    label,
    legend_above,
    paged,
    plain,
    svg_of,
)

_IN_CORNER = 10
"""Parameters on one corner plot."""
_KINDS = ("time", "order", "delay", "gain")
"""Kinds of parameters that are shown first; of the rest, noise and offsets come last."""
_LAST = ("offset", "sigma", "rho", "nu")
_LABELS = 0.47
"""Distance of an axis label from its panel [in]."""
_MIDDLE = 0.995
"""Share of the draws that each axis of the corner plot spans [-]."""


def ranked(names: list[str]) -> list[str]:
    """Names by interest: times, orders, delays, gains, anything else, offsets, noise; ties in their order."""

    def rank(name: str) -> int:
        kind = name.split("_")[0]
        if kind in _KINDS:
            return _KINDS.index(kind)
        return len(_KINDS) + (1 + _LAST.index(kind) if kind in _LAST else 0)

    return sorted(names, key=rank)


def pairs(run: SavedRun) -> Drawings:
    """Corner plot of the most interesting free parameters that vary."""
    moving = ranked([name for name in run.units if np.ptp(run.draws[name]) > 0])
    shown, left_out = moving[:_IN_CORNER], moving[_IN_CORNER:]
    if not shown:
        return {"pairs": ()}
    caption = (
        "Contours, smoothed, hold about 50 and 90 % of the draws of a pair; dashed "
        f"lines mark the 5, 50 and 95 % quantiles; each axis spans {100 * _MIDDLE:g} % of the draws."
    )
    rest = f" Not shown for lack of space: {', '.join(left_out)}." if left_out else ""
    return {"pairs": [Drawing("corner", _corner(run, shown), caption + rest)]}


def _corner(run: SavedRun, names: list[str]) -> str:
    values = np.stack([run.draws[name].ravel() for name in names], axis=1)
    scales = ["log" if run.spans_decades(name) else "linear" for name in names]
    side = min(9.6, max(3.4, 1.15 * len(names) + 0.9))
    figure = Figure(figsize=(side, side))
    small = len(names) > 5
    corner.corner(
        values,
        fig=figure,
        range=[_MIDDLE] * len(names),
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
    return svg_of(figure)


_PER_FIGURE = 12
"""Parameters on one figure of traces, priors or marginals."""
_BINS = 30


def parameters(run: SavedRun) -> Drawings:
    """Traces of the draws, and prior densities over their histograms."""
    names, density = list(run.units), run.tables["prior_density"]
    sets, draws = run.draws[names[0]].shape
    trace = (
        f"{draws} draws of each of {sets} batches, in random order."
        if run.weighted
        else f"{draws} draws of each of {sets} ensembles, thinned evenly from the kept part of the run, "
        "walkers side by side within a step."
    )
    prior = (
        "Histogram: draws. Line: prior density, which may reach far beyond the axis. Where the axis is "
        "logarithmic, both are densities per natural logarithm of the parameter."
    )
    own = [name for name in dict.fromkeys(density["name"]) if name in run.draws]
    return {
        "traces": paged("trace", names, _PER_FIGURE, lambda part: _traces(run, part), trace),
        "priors": paged("priors", own, _PER_FIGURE, lambda part: marginals(run, part, _prior), prior),
        "prior_table": run.tables["priors"].to_dict("records"),
    }


def _traces(run: SavedRun, names: Sequence[str]) -> str:
    rhat = {row["name"]: row.get("rhat") for row in run.results["parameters"]}
    figure, panels = grid(len(names), columns=2, height=1.15)
    for panel, name in zip(panels, names, strict=True):
        for chain, colour in zip(run.draws[name], cycle(CYCLE), strict=False):
            panel.plot(np.arange(chain.size), chain, color=colour, lw=0.4, alpha=0.8)
        panel.set_rasterization_zorder(2.01)  # one picture of all lines
        if run.spans_decades(name):
            panel.set_yscale("log")
        shown = "not defined" if rhat[name] is None else f"{rhat[name]:.3f}"
        panel.set_title(f"{label(name, run.units[name])}   R-hat {shown}", fontsize=8)
        panel.margins(x=0.01)
    for panel in panels[-2:]:
        panel.set_xlabel("draw [-]")
    return svg_of(figure)


def marginals(run: SavedRun, names: Sequence[str], draw: Callable[[Axes, SavedRun, str], None]) -> str:
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
    return svg_of(figure)


def density_axis(panel: Axes, *, log: bool) -> None:
    """Scale and ticks of the axis of a density."""
    if log:
        panel.set_xscale("log")
    else:
        panel.locator_params(axis="x", nbins=4)


def _prior(panel: Axes, run: SavedRun, name: str) -> None:
    density = run.tables["prior_density"]
    own = density[density["name"] == name]
    x, height = own["x"].to_numpy(), own["density"].to_numpy()
    draws = run.draws[name].ravel()
    log = run.is_log(name)
    counts, edges = np.histogram(np.log(draws) if log else draws, bins=_BINS, density=True)
    panel.stairs(counts, np.exp(edges) if log else edges, fill=True, color=BAND, alpha=0.5, label="draws")
    panel.plot(x, height, color=HELD_OUT, label="prior")
    density_axis(panel, log=log)


_WORDS = {
    "batches": "independent batches of draws",
    "draws": "draws of the proposal",
    "pareto_k": "Pareto k of the weights [-]",
    "weights_ess": "effective sample size of the weights [draws]",
    "steps": "steps taken",
    "most_steps": "steps allowed",
    "thin": "thinning [steps per draw]",
    "acceptance": "mean acceptance [-]",
    "smallest_ess": "smallest effective sample size [draws]",
    "largest_rhat": "largest R-hat [-]",
    "target_ess": "effective sample size wanted [draws]",
}


def sampling(run: SavedRun) -> Drawings:
    """Marginals by both methods where a second one was run; the sampler's summary and the command."""
    checked: tuple[Drawing, ...] = ()
    if run.results["cross_check"] is not None:
        names = list(dict.fromkeys(run.tables["cross_check_density"]["name"]))
        caption = (
            "Marginals by both methods, over 99.8 % of their draws. Where the axis is logarithmic, densities "
            "are per natural logarithm of the parameter."
        )
        checked = paged("cross_check", names, _PER_FIGURE, lambda part: marginals(run, part, _panel), caption)
    sampler = {
        _WORDS.get(key, key.replace("_", " ")): _cell(key, v) for key, v in run.results["sampler"].items()
    }
    command = shlex.join(str(word) for word in run.provenance["command"])
    return {"cross_check": checked, "sampler": sampler, "command": command}


def _panel(panel: Axes, run: SavedRun, name: str) -> None:
    whole = run.tables["cross_check_density"]
    own = whole[whole["name"] == name]
    edges = np.append(own["left"].to_numpy(), own["right"].to_numpy()[-1])
    panel.stairs(own["ensembles"].to_numpy(), edges, fill=True, color=BAND, alpha=0.5, label="ensembles")
    panel.stairs(own["nested"].to_numpy(), edges, color=HELD_OUT, linewidth=1.1, label="nested sampling")
    density_axis(panel, log=bool(own["log_scale"].any()))


def _cell(key: str, value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3f}" if key == "largest_rhat" else figures(value)
    return NONE if value is None else str(value)
