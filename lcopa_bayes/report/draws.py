"""What the draws are: a corner plot, traces, priors under them, a second method, the sampler's summary."""

from __future__ import annotations

import shlex
from typing import Any

from lcopa_bayes.plot.draws import (
    draw_methods,
    draw_prior,
    forest_figure,
    marginals,
    ranked,
    traces_figure,
)
from lcopa_bayes.plot.pairs import IN_CORNER, MIDDLE, corner_figure
from lcopa_bayes.plot.rundata import RunData
from lcopa_bayes.report.formatting import NONE, figures
from lcopa_bayes.report.page import Drawings
from lcopa_bayes.report.svg import Drawing, drawing, paged


def pairs(run: RunData) -> Drawings:
    """Corner plot of the most interesting free parameters that vary."""
    moving = ranked(run.varying)
    shown, left_out = moving[:IN_CORNER], moving[IN_CORNER:]
    if not shown:
        return {"pairs": ()}
    caption = (
        "Contours, smoothed, hold about 50 and 90 % of the draws of a pair; dashed "
        f"lines mark the 5, 50 and 95 % quantiles; each axis spans {100 * MIDDLE:g} % of the draws."
    )
    rest = f" Not shown for lack of space: {', '.join(left_out)}." if left_out else ""
    return {"pairs": [drawing("corner", corner_figure(run, shown), caption + rest, data="posterior.nc")]}


_PER_FIGURE = 12
"""Parameters on one figure of traces, priors or marginals."""


def parameters(run: RunData) -> Drawings:
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
    forest = (
        "Median and 90 % interval of every free parameter, a panel for each unit; hollow where not graded "
        "reliable."
    )
    shown = forest_figure(run.results["parameters"])
    return {
        "forest": [drawing("forest", shown, forest, data="tables/parameters.csv")],
        "traces": paged(
            "trace", names, _PER_FIGURE, lambda part: traces_figure(run, part), trace, "posterior.nc"
        ),
        "priors": paged(
            "priors",
            own,
            _PER_FIGURE,
            lambda part: marginals(run, part, draw_prior),
            prior,
            "tables/prior_density.csv",
        ),
        "prior_table": run.tables["priors"].to_dict("records"),
    }


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


def sampling(run: RunData) -> Drawings:
    """Marginals by both methods where a second one was run; the sampler's summary and the command."""
    checked: tuple[Drawing, ...] = ()
    if run.results["cross_check"] is not None:
        names = list(dict.fromkeys(run.tables["cross_check_density"]["name"]))
        caption = (
            "Marginals by both methods, over 99.8 % of their draws. Where the axis is logarithmic, densities "
            "are per natural logarithm of the parameter."
        )
        checked = paged(
            "cross_check", names, _PER_FIGURE, lambda part: marginals(run, part, draw_methods), caption
        )
    sampler = {
        _WORDS.get(key, key.replace("_", " ")): _cell(key, v) for key, v in run.results["sampler"].items()
    }
    command = shlex.join(str(word) for word in run.provenance["command"])
    return {"cross_check": checked, "sampler": sampler, "command": command}


def _cell(key: str, value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3f}" if key == "largest_rhat" else figures(value)
    return NONE if value is None else str(value)
