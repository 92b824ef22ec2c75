"""Prior of each parameter against its posterior."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from lcopa_bayes.inference import defaultpriors
from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.section import Section, Table, paged
from lcopa_bayes.report.theme import BAND, HELD_OUT, grid, label, log_ticks, svg_of

_PER_FIGURE = 12
"""Parameters on one figure."""
_BINS = 30


def section(run: SavedRun) -> Section:
    """Prior densities over histograms of the draws, the table of priors and how defaults are derived."""
    density = run.tables["prior_density"]
    names = [name for name in dict.fromkeys(density["name"]) if name in run.draws]
    caption = (
        "Histogram: draws. Line: prior density, which may reach far beyond the axis. Where the axis is "
        "logarithmic, both are densities per natural logarithm of the parameter."
    )
    drawings = paged("priors", names, _PER_FIGURE, lambda part: marginals(run, part, _panel), caption)
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
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return svg_of(figure)


def density_axis(panel: Axes, low: float, high: float, *, log: bool) -> None:
    """Scale and ticks of the axis of a density."""
    if log:
        panel.set_xscale("log")
        log_ticks(panel.xaxis, low, high)
    else:
        panel.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))


def _panel(panel: Axes, run: SavedRun, name: str) -> None:
    density = run.tables["prior_density"]
    own = density[density["name"] == name]
    x, height = own["x"].to_numpy(), own["density"].to_numpy()
    draws = run.draws[name].ravel()
    log = run.is_log(name)
    counts, edges = np.histogram(np.log(draws) if log else draws, bins=_BINS, density=True)
    panel.stairs(counts, np.exp(edges) if log else edges, fill=True, color=BAND, alpha=0.5, label="draws")
    panel.plot(x, height, color=HELD_OUT, label="prior")
    density_axis(panel, float(x.min()), float(x.max()), log=log)


def _table(run: SavedRun) -> Table:
    fixed = {row["name"] for row in run.results["fixed"]}
    return Table.of(
        run.tables["priors"].to_dict("records"),  # type: ignore[arg-type]
        ("name", "code", "name"),
        ("unit", "text", "unit"),
        ("prior", "code", "prior"),
        ("from", "text", "from"),
        (
            "treated",
            "text",
            lambda row: (
                "fixed"
                if row["name"] in fixed
                else "integrated out exactly"
                if row["integrated_out"]
                else "sampled"
            ),
        ),
        caption="Where a prior is a default, the rule below derived it from the fit records.",
    )
