"""Prior of each parameter against its posterior."""

from __future__ import annotations

import inspect
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from lcopa_bayes.inference import defaultpriors
from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.section import Column, Drawing, Section, Table
from lcopa_bayes.report.theme import BAND, HELD_OUT, grid, label, log_ticks, svg_of

_PER_FIGURE = 12
"""Parameters on one figure."""
_BINS = 30


def section(run: SavedRun) -> Section:
    """Prior densities over histograms of the draws, the table of priors and how defaults are derived."""
    density = run.tables["prior_density"]
    names = [name for name in dict.fromkeys(density["name"]) if name in run.draws]
    pages = [names[k : k + _PER_FIGURE] for k in range(0, len(names), _PER_FIGURE)]
    caption = (
        "Histogram: draws. Line: prior density, which may reach far beyond the axis. Where the axis is "
        "logarithmic, both are densities per natural logarithm of the parameter."
    )
    drawings = tuple(
        Drawing(f"priors_{number:02d}", _drawn(run, page), caption)
        for number, page in enumerate(pages, start=1)
    )
    return Section(
        "Priors and posteriors",
        (
            "Where the histogram follows the line the data have not changed the prior.",
            f"Times, those in priors included, are in {run.time_unit}: the `time_unit` of the study, by "
            "default the unit of the first fit record.",
        ),
        drawings,
        (_table(run),),
        inspect.cleandoc(defaultpriors.__doc__ or ""),
    )


def _drawn(run: SavedRun, names: Sequence[str]) -> str:
    figure, panels = grid(len(names), columns=3, height=1.5)
    for panel, name in zip(panels, names, strict=True):
        _panel(panel, run, name)
        panel.set_xlabel(label(name, run.units[name]), fontsize=8)
        panel.set_yticks([])
        panel.spines["left"].set_visible(False)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return svg_of(figure)


def _panel(panel: Axes, run: SavedRun, name: str) -> None:
    density = run.tables["prior_density"]
    own = density[density["name"] == name]
    x, height = own["x"].to_numpy(), own["density"].to_numpy()
    draws = run.draws[name].ravel()
    log = run.is_log(name)
    counts, edges = np.histogram(np.log(draws) if log else draws, bins=_BINS, density=True)
    panel.stairs(counts, np.exp(edges) if log else edges, fill=True, color=BAND, alpha=0.5, label="draws")
    panel.plot(x, height, color=HELD_OUT, label="prior")
    if log:
        panel.set_xscale("log")
        log_ticks(panel.xaxis, float(x.min()), float(x.max()))
    else:
        panel.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
    panel.set_ylim(bottom=0.0)
    panel.margins(x=0.0)


def _table(run: SavedRun) -> Table:
    rows = tuple(
        (
            *(str(row["name"]), str(row["unit"]), str(row["prior"]), str(row["from"])),
            "integrated out exactly" if row["integrated_out"] else "sampled",
        )
        for row in run.tables["priors"].to_dict("records")
    )
    return Table(
        (
            *(Column("name", "code"), Column("unit"), Column("prior", "code"), Column("from")),
            Column("treated"),
        ),
        rows,
        "Where a prior is a default, the rule below derived it from the fit records.",
    )
