"""Every claim with its verdict, the number behind it and the calculation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from lcopa_bayes.paper.verdict import Judged, Kind
from lcopa_bayes.report.section import Column, Section, Table
from lcopa_bayes.report.wording import figures


def section(judged: Sequence[Judged]) -> Section:
    """The table of claims."""
    counts = Counter(each.verdict.kind for each in judged)
    said = ", ".join(f"{counts[kind]} {kind.value}" for kind in Kind)
    columns = (
        *(Column("id"), Column("claim", "prose"), Column("verdict")),
        *(Column("number", "number"), Column("unit"), Column("how", "prose")),
    )
    rows = tuple(
        (
            *(each.claim.id, f"{each.claim.text} ({each.claim.source})", each.verdict.kind.value),
            *(figures(each.verdict.number), each.verdict.unit, each.verdict.how),
        )
        for each in judged
    )
    return Section(
        "Verdicts",
        (
            f"{len(judged)} claims of Ta et al. 2026: {said}. A verdict follows from the printed numbers by "
            "the calculation beside it; undecided means that what decides it is not at hand.",
        ),
        tables=(Table(columns, rows),),
    )
