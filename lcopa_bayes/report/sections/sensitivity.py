"""How far the prior and how far the data decide each parameter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lcopa_bayes.report.formatting import NONE, figures
from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.section import Column, Section, Table

_MOST = 20
"""Parameters shown; the others are in the table of the run folder."""
_HOW = (
    "Sensitivity says how fast the posterior moves when the prior of all parameters, or the likelihood, is "
    "raised to a power near 1 (Kallioinen et al. 2024). From {threshold} on it counts. Both counting is a "
    "prior-data conflict, or a prior that was meant to be informative; the prior alone counting means that "
    "the record says little about this parameter. Densities are on the scale a parameter is sampled on: "
    "a uniform prior, and a log-uniform one of a time constant, has no power to scale, so what its bounds "
    "do is not seen here."
)


def section(run: SavedRun) -> Section:
    """Sensitivities with their Monte Carlo errors, the most affected parameters first."""
    rows = run.results["sensitivity"]
    struck = [str(row["parameter"]) for row in rows if row["diagnosis"] not in ("-", "not trusted")]
    doubtful = [str(row["parameter"]) for row in rows if row["diagnosis"] == "not trusted"]
    text = [_HOW.format(threshold=figures(rows[0]["threshold"], 1))] if rows else []
    if struck:
        text.append(f"The prior matters for {len(struck)} of {len(rows)} parameters: {', '.join(struck)}.")
    elif rows and not doubtful:
        text.append("No parameter depends noticeably on its prior density.")
    if doubtful:
        text.append(
            f"Not trusted for {len(doubtful)} parameter(s), {', '.join(doubtful)}: the draws are too few or "
            "their importance weights too uneven; sample more steps."
        )
    if len(rows) > _MOST:
        text.append(
            f"The {_MOST} most affected of {len(rows)} are shown; tables/sensitivity.csv has them all."
        )
    columns = (
        *(Column("name", "code"), Column("prior", "number"), Column("likelihood", "number")),
        *(Column("diagnosis", "prose"), Column("Pareto k", "number"), Column("grade", "grade")),
        Column("note", "prose"),
    )
    caption = (
        "± is the Monte Carlo standard error; Pareto k is the larger of those of the weights that scale the "
        "prior and the likelihood; the grade is that of the parameter's draws."
    )
    table = Table(columns, tuple(_row(row) for row in rows[:_MOST]), caption)
    return Section("Prior sensitivity", tuple(text), tables=(table,) if rows else ())


def _row(row: Mapping[str, Any]) -> tuple[str, ...]:
    ks = [row[key] for key in ("prior_k", "likelihood_k") if row[key] is not None]
    return (
        str(row["parameter"]),
        _with_error(row["prior"], row["prior_mcse"]),
        _with_error(row["likelihood"], row["likelihood_mcse"]),
        str(row["diagnosis"]),
        figures(max(ks), 2) if ks else NONE,
        str(row["grade"]),
        str(row["note"]),
    )


def _with_error(value: float | None, error: float | None) -> str:
    """`value ± error` to a thousandth."""
    return NONE if value is None or error is None else f"{value:.3f} ± {error:.3f}"
