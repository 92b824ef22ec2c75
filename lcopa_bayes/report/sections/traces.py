"""The draws of each parameter in their order."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle

import numpy as np

from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.section import Section, paged
from lcopa_bayes.report.theme import CYCLE, grid, label, log_ticks, svg_of

_PER_FIGURE = 12
"""Parameters on one figure."""


def section(run: SavedRun) -> Section:
    """Traces with ensembles, or batches, in colours and R-hat in the titles."""
    names = list(run.units)
    sets, draws = run.draws[names[0]].shape
    caption = (
        f"{draws} draws of each of {sets} batches, in random order."
        if run.weighted
        else f"{draws} draws of each of {sets} ensembles, thinned evenly from the kept part of the run, "
        "walkers side by side within a step."
    )
    kind = "batch of importance draws" if run.weighted else "ensemble"
    return Section(
        "Traces",
        (f"Each colour is an independent {kind}. Draws whose colours separate or drift have not converged.",),
        paged("trace", names, _PER_FIGURE, lambda part: _drawn(run, part), caption),
    )


def _drawn(run: SavedRun, names: Sequence[str]) -> str:
    rhat = {row["name"]: row.get("rhat") for row in run.results["parameters"]}
    figure, panels = grid(len(names), columns=2, height=1.15)
    for panel, name in zip(panels, names, strict=True):
        for chain, colour in zip(run.draws[name], cycle(CYCLE), strict=False):
            panel.plot(np.arange(chain.size), chain, color=colour, lw=0.4, alpha=0.8, rasterized=True)
        if run.spans_decades(name):
            panel.set_yscale("log")
            log_ticks(panel.yaxis, *panel.get_ylim())
        shown = "not defined" if rhat[name] is None else f"{rhat[name]:.3f}"
        panel.set_title(f"{label(name, run.units[name])}   R-hat {shown}", loc="left", fontsize=8)
        panel.margins(x=0.01)
    for panel in panels[-2:]:
        panel.set_xlabel("draw [-]")
    return svg_of(figure)
