"""The evidence of the model, and the held-out errors of its integer-order rival where one was fitted."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lcopa_bayes.report.formatting import figures
from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.section import Column, Section, Table

_TITLE = "Evidence"
_HOW = (
    "Log evidence {value:.2f} ± {sd:.2f} nat (standard error; grade {grade}), by bridge sampling between the "
    "draws of each ensemble and a mixture fitted to the others. It compares models of the same records only, "
    "and moves with the width of their priors."
)


def section(run: SavedRun) -> Section:
    """A sentence, and a table of both models' errors."""
    told = run.results
    if told["log_evidence"] is None:
        said = "A single ensemble cannot tell the error of an evidence; none is given."
    else:
        said = _HOW.format(
            value=told["log_evidence"], sd=told["log_evidence_sd"], grade=told["log_evidence_grade"]
        )
    rival = told["rival"]
    if rival is None:
        return Section(_TITLE, (said,))
    return Section(_TITLE, (said, str(rival["sentence"])), tables=(_errors(told, rival),))


def _errors(told: Mapping[str, Any], rival: Mapping[str, Any]) -> Table:
    columns = (
        *(Column("record", "code"), Column("axis", "code"), Column("role"), Column("unit")),
        *(Column("free orders: RMSE", "number"), Column("in 90 % band", "number")),
        *(Column("integer orders: RMSE", "number"), Column("in 90 % band", "number")),
    )
    rows = []
    for key, role in (("fit_scores", "fit"), ("held_out", "held out")):
        for own, other in zip(told[key], rival[key], strict=True):
            cells = [str(own["record"]), str(own["axis"]), role, str(own["unit"])]
            for one in (own, other):
                cells += [figures(one["rmse"], 3), f"{100 * one['coverage_90']:.0f} %"]
            rows.append(tuple(cells))
    weighed = rival["log_evidence"]
    caption = f"The rival's grade is {rival['grade']}: {rival['grade_reason']}." + (
        "" if weighed is None else f" Its log evidence is {weighed:.2f} ± {rival['log_evidence_sd']:.2f} nat."
    )
    return Table(columns, tuple(rows), caption)
