"""Parameters: table, corner plot, traces, priors and what decides each of them.

The answers that stand first on the page of a fit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import cycle

import numpy as np
from matplotlib.axes import Axes

from lcopa_bayes.report.page import Drawings
from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.theme import BAND, CYCLE, HELD_OUT, grid, label, legend_above, paged, svg_of

_PER_FIGURE = 12
"""Parameters on one figure of traces or of priors."""
_BINS = 30


def drawn(run: SavedRun) -> Drawings:
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
