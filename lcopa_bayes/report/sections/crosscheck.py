"""Both methods side by side, where a run was checked by a second method."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from lcopa_bayes.report.formatting import NONE, figures, interval, sentence, to_spread
from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.section import Column, Section, Table, paged
from lcopa_bayes.report.sections.priors import density_axis, marginals
from lcopa_bayes.report.theme import BAND, HELD_OUT

_TITLE = "Second method"
_PER_FIGURE = 12
"""Parameters on one figure."""
_HOW = (
    "The ensembles and nested sampling share the posterior, but neither proposals nor tempering path. A "
    "p-value is the probability of a distance as large when both sample one posterior, adjusted for all "
    "comparisons; below {alarm} every grade of this run is lowered."
)
_WIDE = 1.645 * 2
"""Width of a normal distribution's 90 % interval in standard deviations [-]."""


def section(run: SavedRun) -> Section:
    """Verdict, marginals and evidences of both methods; a sentence where no second method was run."""
    check = run.results["cross_check"]
    if check is None:
        return Section(
            _TITLE,
            ("Not run: `fit --cross-check` also samples by an independent method and compares the results.",),
        )
    density = run.tables["cross_check_density"]
    names = list(dict.fromkeys(density["name"]))
    caption = (
        "Marginals by both methods, over 99.8 % of their draws. Where the axis is logarithmic, densities are "
        "per natural logarithm of the parameter."
    )
    return Section(
        _TITLE,
        (sentence(str(check["sentence"])), _HOW.format(alarm=figures(check["alarm"], 1))),
        paged("cross_check", names, _PER_FIGURE, lambda part: marginals(run, part, _panel), caption),
        (_marginals(check), _evidences(check)),
    )


def _marginals(check: Mapping[str, Any]) -> Table:
    columns = (
        *(Column("name", "code"), Column("unit"), Column("ensembles: median", "number")),
        *(Column("90 % interval", "interval"), Column("ESS", "number"), Column("nested: median", "number")),
        *(Column("90 % interval", "interval"), Column("ESS", "number"), Column("distance", "number")),
        *(Column("noticed from", "number"), Column("p", "number")),
    )
    rows = []
    for row in check["parameters"]:
        spread = max(row[entry]["upper"] - row[entry]["lower"] for entry in ("run", "nested")) / _WIDE
        cells = [str(row["name"]), str(row["unit"])]
        for estimate in (row["run"], row["nested"]):
            cells += [
                to_spread(estimate["value"], spread),
                interval(estimate["lower"], estimate["upper"], spread),
            ]
            cells.append(f"{estimate['ess']:.0f}")
        noticed = f"{row['resolution']:.3f}" if row["resolution"] < 1 else NONE
        rows.append((*cells, f"{row['distance']:.3f}", noticed, figures(row["p"], 2)))
    return Table(
        columns,
        tuple(rows),
        "Intervals are equal-tailed credible. ESS is the effective sample size. Distance is the largest "
        "difference of the two cumulative probabilities; the next column is the distance from which it "
        "counts as a disagreement.",
    )


def _evidences(check: Mapping[str, Any]) -> Table:
    p = check["evidence_p"]
    rows = [
        ("ensembles", _with_error(check["run_log_evidence"], check["run_log_evidence_sd"]), ""),
        (
            "nested sampling",
            _with_error(check["log_evidence"], check["log_evidence_sd"]),
            ", ".join(f"{entry:.2f}" for entry in check["run_log_evidences"]),
        ),
    ]
    caption = "± is the standard error. " + (
        "The ensembles of this run gave no evidence to compare."
        if p is None
        else f"Adjusted p-value of the difference: {figures(p, 2)}."
    )
    return Table(
        (Column("method"), Column("log evidence [nat]", "number"), Column("each run", "prose")),
        tuple(rows),
        caption,
    )


def _with_error(value: float | None, error: float | None) -> str:
    """`value ± error` to a hundredth."""
    return NONE if value is None or error is None else f"{value:.2f} ± {error:.2f}"


def _panel(panel: Axes, run: SavedRun, name: str) -> None:
    whole = run.tables["cross_check_density"]
    own = whole[whole["name"] == name]
    edges = np.append(own["left"].to_numpy(), own["right"].to_numpy()[-1])
    panel.stairs(own["ensembles"].to_numpy(), edges, fill=True, color=BAND, alpha=0.5, label="ensembles")
    panel.stairs(own["nested"].to_numpy(), edges, color=HELD_OUT, linewidth=1.1, label="nested sampling")
    density_axis(panel, float(edges[0]), float(edges[-1]), log=bool(own["log_scale"].any()))
