"""How far the prior and how far the data decide each parameter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lcopa_bayes.report.formatting import NONE, figures
from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.section import Section, Table

_MOST = 20
"""Parameters shown; the others are in the table of the run folder."""
_HOW = (
    "Sensitivity is how fast the posterior moves when the prior of all parameters, or the likelihood, is "
    "raised to a power near 1 (Kallioinen et al. 2024). It is notable from {threshold} on. Where both are "
    "notable there is a prior-data conflict, or a prior meant to be informative; where only that of the "
    "prior is, the record has little information about this parameter. Densities are on the scale of "
    "sampling: a uniform prior, and a log-uniform prior of a time constant, has no power to scale, so the "
    "influence of its bounds is not visible here."
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
    table = Table.of(
        rows[:_MOST],
        ("name", "code", "parameter"),
        ("prior", "number", lambda row: _with_error(row, "prior")),
        ("likelihood", "number", lambda row: _with_error(row, "likelihood")),
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


def _with_error(row: Mapping[str, Any], key: str) -> str:
    """`value ± error` to a thousandth."""
    value, error = row[key], row[f"{key}_mcse"]
    return NONE if value is None or error is None else f"{value:.3f} ± {error:.3f}"
