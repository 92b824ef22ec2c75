"""The evidence of the model, and the held-out errors of its integer-order rival where one was fitted."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lcopa_bayes.report.formatting import figures, percent
from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.section import Section, Table

_TITLE = "Evidence"
_HOW = (
    "Log evidence {value:.2f} ± {sd:.2f} nat (standard error; grade {grade}), {method}. It compares models "
    "of the same records only, and depends on the width of their priors."
)

_WEIGHTED = "the mean weight of the importance draws"
_BRIDGED = "by bridge sampling between the draws of each ensemble and a mixture fitted to the others"


def section(run: SavedRun) -> Section:
    """A sentence, and a table of both models' errors."""
    results = run.results
    if results["log_evidence"] is None:
        said = "The error of an evidence needs several ensembles; with a single one none is given."
    else:
        said = _HOW.format(
            value=results["log_evidence"],
            sd=results["log_evidence_sd"],
            grade=results["log_evidence_grade"],
            method=_WEIGHTED if run.weighted else _BRIDGED,
        )
    rival = results["rival"]
    if rival is None:
        return Section(_TITLE, (said,))
    return Section(_TITLE, (said, str(rival["sentence"])), tables=(_errors(results, rival),))


def _errors(results: Mapping[str, Any], rival: Mapping[str, Any]) -> Table:
    weighed = rival["log_evidence"]
    caption = f"The rival's grade is {rival['grade']}: {rival['grade_reason']}." + (
        "" if weighed is None else f" Its log evidence is {weighed:.2f} ± {rival['log_evidence_sd']:.2f} nat."
    )
    pairs = [
        own | {"role": role, "rival": other}
        for key, role in (("fit_scores", "fit"), ("held_out", "held out"))
        for own, other in zip(results[key], rival[key], strict=True)
    ]
    return Table.of(
        pairs,
        ("record", "code", "record"),
        ("axis", "code", "axis"),
        ("role", "text", "role"),
        ("unit", "text", "unit"),
        ("free orders: RMSE", "number", "rmse"),
        ("in 90 % band", "number", lambda row: percent(row["coverage_90"])),
        ("integer orders: RMSE", "number", lambda row: figures(row["rival"]["rmse"])),
        ("in 90 % band", "number", lambda row: percent(row["rival"]["coverage_90"])),
        caption=caption,
    )
