"""Parameters: table, corner plot, traces, priors and what decides each of them.

The answers that stand first on the page of a fit.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from itertools import cycle
from typing import Any

import corner
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from lcopa_bayes.inference import defaultpriors
from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.section import (
    NONE,
    Drawing,
    Section,
    Table,
    figures,
    interval,
    paged,
    percent,
    to_spread,
    with_error,
)
from lcopa_bayes.report.theme import (
    BAND,
    CYCLE,
    HELD_OUT,
    grid,
    label,
    legend_above,
    log_ticks,
    plain,
    svg_of,
)

_LINK = Markup(' <a href="#{anchor}">{title}</a>')
_ANSWER = Markup("<strong>{question}</strong> {answer}{link}")


def overview(run: SavedRun) -> Section:
    """The plant of highest density, and one sentence for each question a reader has."""
    values = run.results["overview"]
    answers = tuple(
        _ANSWER.format(
            question=one["question"],
            answer=one["answer"],
            link=_LINK.format(anchor=Section(one["section"]).anchor, title=one["section"])
            if one["section"]
            else "",
        )
        for one in values["answers"]
    )
    unit = f"At the draw of highest density; s in 1/{run.time_unit}, times and delays in {run.time_unit}."
    return Section("Summary", answers, listing="\n".join([*values["plant"], unit]))


_PER_FIGURE = 12
"""Parameters on one figure of traces or of priors."""
_IN_CORNER = 10
"""Parameters on one corner plot."""
_KINDS = ("time", "order", "delay", "gain")
"""Kinds of parameters that are shown first; of the rest, noise and offsets come last."""
_LAST = ("offset", "sigma", "rho", "nu")
_LABELS = 0.47
"""Distance of an axis label from its panel [in]."""
_MIDDLE = 0.995
"""Share of the draws that each axis of the corner plot spans [-]."""
_BINS = 30
_MOST_SENSITIVE = 20
"""Sensitivities shown; the others are in the table of the run folder."""
_SENSITIVITY = (
    "Sensitivity is how fast the posterior moves when the prior of all parameters, or the likelihood, is "
    "raised to a power near 1 (Kallioinen et al. 2024). It is notable from {threshold} on. Where both are "
    "notable there is a prior-data conflict, or a prior meant to be informative; where only that of the "
    "prior is, the record has little information about this parameter. Densities are on the scale of "
    "sampling: a uniform prior, and a log-uniform prior of a time constant, has no power to scale, so the "
    "influence of its bounds is not visible here."
)


def estimates(run: SavedRun) -> Section:
    """Free parameters with intervals and grades, parameters with several modes, and fixed parameters."""
    free = run.results["parameters"]
    kind = ", ".join(dict.fromkeys(f"{percent(row['level'])} {row['interval']}" for row in free))
    tables = [
        Table.of(
            free,
            ("name", "code", "name"),
            ("median", "number", lambda row: to_spread(row["value"], row["sd"])),
            ("unit", "text", "unit"),
            (
                "90 % interval" if all(row["level"] == 0.9 for row in free) else "interval",
                "number",
                lambda row: interval(row["lower"], row["upper"], row["sd"]),
            ),
            ("mean", "number", lambda row: to_spread(row["mean"], row["sd"])),
            ("sd", "number", lambda row: figures(row["sd"], 2)),
            ("ESS", "number", _ess),
            ("R-hat", "number", lambda row: NONE if row.get("rhat") is None else f"{row['rhat']:.3f}"),
            ("grade", "grade", "grade"),
            caption=f"Intervals are {kind}. Digits end at the second significant digit of the standard "
            "deviation. ESS is the smaller of the effective sample sizes of bulk and tails; R-hat compares "
            "independent sets of draws.",
        )
    ]
    if run.results["modes"]:
        tables.append(_modes(run.results["modes"]))
    if run.results["fixed"]:
        tables.append(fixed(run.results["fixed"]))
    text = () if run.results["fixed"] else ("No parameter was fixed.",)
    return Section("Parameters", text, tables=tuple(tables))


def fixed(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Values of fixed parameters."""
    return Table.of(
        rows,
        ("fixed parameter", "code", "name"),
        ("value", "number", lambda row: figures(row["value"], 6)),
        ("unit", "text", "unit"),
    )


def _modes(rows: list[Mapping[str, Any]]) -> Table:
    """Shares of the modes of parameters whose marginal has several."""
    return Table.of(
        rows,
        ("several modes in", "code", "parameter"),
        ("split at", "number", lambda row: ", ".join(figures(end) for end in row["boundaries"])),
        ("unit", "text", "unit"),
        ("shares of all draws", "interval", _shares),
        (
            "range over sets of draws",
            "interval",
            lambda row: ", ".join(f"{min(s):.2f} to {max(s):.2f}" for s in zip(*row["shares"], strict=True)),
        ),
        ("grade", "grade", "grade"),
        ("statement", "prose", "sentence"),
        caption="The draws of these parameters lie in separate modes; medians and intervals mix them. "
        "± is the Monte Carlo standard error.",
    )


def _shares(row: Mapping[str, Any]) -> str:
    return ", ".join(map(with_error, row["pooled"], row["pooled_mcse"]))


def _ess(row: Mapping[str, Any]) -> str:
    return figures(row["ess"]) if (row["ess"] or 0) < 100 else f"{row['ess']:.0f}"


def ranked(names: list[str]) -> list[str]:
    """Names by interest: times, orders, delays, gains, anything else, offsets, noise; ties in their order."""

    def rank(name: str) -> int:
        kind = name.split("_")[0]
        if kind in _KINDS:
            return _KINDS.index(kind)
        return len(_KINDS) + (1 + _LAST.index(kind) if kind in _LAST else 0)

    return sorted(names, key=rank)


def pairs(run: SavedRun) -> Section:
    """Corner plot of the most interesting free parameters."""
    moving = [name for name in run.units if np.ptp(run.draws[name]) > 0]
    shown, left_out = ranked(moving)[:_IN_CORNER], ranked(moving)[_IN_CORNER:]
    if not shown:
        return Section("Pairs of parameters", ("No free parameter has draws that vary.",))
    caption = (
        "Contours, smoothed, hold about 50 and 90 % of the draws of a pair; dashed "
        f"lines mark the 5, 50 and 95 % quantiles; each axis spans {100 * _MIDDLE:g} % of the draws."
    )
    rest = f" Not shown for lack of space: {', '.join(left_out)}." if left_out else ""
    return Section("Pairs of parameters", drawings=(Drawing("corner", _corner(run, shown), caption + rest),))


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
        if row == len(names) - 1 and panel.get_xscale() == "log":
            log_ticks(panel.xaxis, *panel.get_xlim())
        if 0 == column < row and panel.get_yscale() == "log":
            log_ticks(panel.yaxis, *panel.get_ylim())
        if column < row or row == column == len(names) - 1:
            panel.tick_params(labelrotation=45)
        panel.tick_params(labelsize=6.5 if small else 7.5, length=2)
        for line in panel.lines:
            line.set_linewidth(0.8)
    figure.align_labels()
    room = 0.95 / side
    figure.subplots_adjust(left=room, bottom=room, right=0.99, top=0.99)
    return svg_of(figure)


def traces(run: SavedRun) -> Section:
    """Draws in their order, with ensembles, or batches, in colours and R-hat in the titles."""
    names = list(run.units)
    sets, draws = run.draws[names[0]].shape
    caption = (
        f"{draws} draws of each of {sets} batches, in random order."
        if run.weighted
        else f"{draws} draws of each of {sets} ensembles, thinned evenly from the kept part of the run, "
        "walkers side by side within a step."
    )
    kind = "batch of importance draws" if run.weighted else "ensemble"
    text = f"Each colour is an independent {kind}. Draws whose colours separate or drift have not converged."
    return Section(
        "Traces", (text,), paged("trace", names, _PER_FIGURE, lambda part: _traces(run, part), caption)
    )


def _traces(run: SavedRun, names: Sequence[str]) -> str:
    rhat = {row["name"]: row.get("rhat") for row in run.results["parameters"]}
    figure, panels = grid(len(names), columns=2, height=1.15)
    for panel, name in zip(panels, names, strict=True):
        for chain, colour in zip(run.draws[name], cycle(CYCLE), strict=False):
            panel.plot(np.arange(chain.size), chain, color=colour, lw=0.4, alpha=0.8, rasterized=True)
        if run.spans_decades(name):
            panel.set_yscale("log")
            log_ticks(panel.yaxis, *panel.get_ylim())
        shown = "not defined" if rhat[name] is None else f"{rhat[name]:.3f}"
        panel.set_title(f"{label(name, run.units[name])}   R-hat {shown}", fontsize=8)
        panel.margins(x=0.01)
    for panel in panels[-2:]:
        panel.set_xlabel("draw [-]")
    return svg_of(figure)


def priors(run: SavedRun) -> Section:
    """Prior densities over histograms of the draws, the table of priors and how defaults are derived."""
    density = run.tables["prior_density"]
    names = [name for name in dict.fromkeys(density["name"]) if name in run.draws]
    caption = (
        "Histogram: draws. Line: prior density, which may reach far beyond the axis. Where the axis is "
        "logarithmic, both are densities per natural logarithm of the parameter."
    )
    held = {row["name"] for row in run.results["fixed"]}
    table = Table.of(
        run.tables["priors"].to_dict("records"),  # type: ignore[arg-type]
        ("name", "code", "name"),
        ("unit", "text", "unit"),
        ("prior", "code", "prior"),
        ("from", "text", "from"),
        ("treated", "text", lambda row: _treated(row, held)),
        caption="Where a prior is a default, the rule below derived it from the fit records.",
    )
    return Section(
        "Priors and posteriors",
        (
            "Where the histogram follows the line the data have not changed the prior.",
            f"Times, those in priors included, are in {run.time_unit}: the `time_unit` of the study, by "
            "default the unit of the first fit record.",
        ),
        paged("priors", names, _PER_FIGURE, lambda part: marginals(run, part, _prior), caption),
        (table,),
        inspect.cleandoc(defaultpriors.__doc__ or ""),
    )


def _treated(row: Mapping[str, Any], held: set[str]) -> str:
    if row["name"] in held:
        return "fixed"
    return "integrated out exactly" if row["integrated_out"] else "sampled"


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


def density_axis(panel: Axes, low: float, high: float, *, log: bool) -> None:
    """Scale and ticks of the axis of a density."""
    if log:
        panel.set_xscale("log")
        log_ticks(panel.xaxis, low, high)
    else:
        panel.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))


def _prior(panel: Axes, run: SavedRun, name: str) -> None:
    density = run.tables["prior_density"]
    own = density[density["name"] == name]
    x, height = own["x"].to_numpy(), own["density"].to_numpy()
    draws = run.draws[name].ravel()
    log = run.is_log(name)
    counts, edges = np.histogram(np.log(draws) if log else draws, bins=_BINS, density=True)
    panel.stairs(counts, np.exp(edges) if log else edges, fill=True, color=BAND, alpha=0.5, label="draws")
    panel.plot(x, height, color=HELD_OUT, label="prior")
    density_axis(panel, float(x.min()), float(x.max()), log=log)


def sensitivity(run: SavedRun) -> Section:
    """How far prior and data decide each parameter, with Monte Carlo errors, the most affected first."""
    rows = run.results["sensitivity"]
    struck = [str(row["parameter"]) for row in rows if row["diagnosis"] not in ("-", "not trusted")]
    doubtful = [str(row["parameter"]) for row in rows if row["diagnosis"] == "not trusted"]
    text = [_SENSITIVITY.format(threshold=figures(rows[0]["threshold"], 1))] if rows else []
    if struck:
        text.append(f"The prior matters for {len(struck)} of {len(rows)} parameters: {', '.join(struck)}.")
    elif rows and not doubtful:
        text.append("No parameter depends noticeably on its prior density.")
    if doubtful:
        text.append(
            f"Not trusted for {len(doubtful)} parameter(s), {', '.join(doubtful)}: the draws are too few or "
            "their importance weights too uneven; sample more steps."
        )
    if len(rows) > _MOST_SENSITIVE:
        text.append(
            f"The {_MOST_SENSITIVE} most affected of {len(rows)} are shown; tables/sensitivity.csv has them "
            "all."
        )
    table = Table.of(
        rows[:_MOST_SENSITIVE],
        ("name", "code", "parameter"),
        ("prior", "number", lambda row: with_error(row["prior"], row["prior_mcse"], 3, bare=False)),
        (
            "likelihood",
            "number",
            lambda row: with_error(row["likelihood"], row["likelihood_mcse"], 3, bare=False),
        ),
        ("diagnosis", "prose", "diagnosis"),
        ("Pareto k", "number", _pareto_k),
        ("grade", "grade", "grade"),
        ("note", "prose", "note"),
        caption="± is the Monte Carlo standard error; Pareto k is the larger of those of the weights that "
        "scale the prior and the likelihood; the grade is that of the parameter's draws.",
    )
    return Section("Prior sensitivity", tuple(text), tables=(table,) if rows else ())


def _pareto_k(row: Mapping[str, Any]) -> str:
    ks = [row[key] for key in ("prior_k", "likelihood_k") if row[key] is not None]
    return figures(max(ks), 2) if ks else NONE
