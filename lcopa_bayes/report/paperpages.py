"""Pages about the paper: static optics, identification, claims."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from lcopa_bayes.data.study import Study
from lcopa_bayes.paper.figures import panels
from lcopa_bayes.paper.identify import Identification
from lcopa_bayes.paper.staticoptics import StaticOptics
from lcopa_bayes.paper.steptable import Row
from lcopa_bayes.paper.verdict import Judged, Kind
from lcopa_bayes.report.formatting import figures
from lcopa_bayes.report.page import write_page
from lcopa_bayes.report.section import Column, Section, Table
from lcopa_bayes.report.sections import claimfigures, director, farfields, identification
from lcopa_bayes.report.theme import look


def write_optics(folder: Path, calculated: StaticOptics) -> Path:
    """`report.html` with far fields, director, tilt law and chain; returns its path."""
    with look():
        sections = [*farfields.sections(calculated), *director.sections(calculated)]
    return write_page(folder, "Static optics of the array", sections)


def write_identification(
    folder: Path, study: Study, identified: Sequence[Identification], rows: Sequence[Row]
) -> Path:
    """`identify.html` with models, Table 1 and records; returns its path."""
    with look():
        sections = identification.sections(study.time_unit, identified, rows, panels(study, identified))
    return write_page(folder, f"{study.name}: identification", sections, name="identify.html")


def write_claims(folder: Path, judged: Sequence[Judged]) -> Path:
    """`report.html` with every claim, its verdict and the figures behind them; returns its path."""
    with look():
        sections = [_verdicts(judged), *claimfigures.sections()]
    return write_page(folder, "Claims of the paper", sections)


def _verdicts(judged: Sequence[Judged]) -> Section:
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
            "the calculation beside it; undecided means that data needed to decide it are missing.",
        ),
        tables=(Table(columns, rows),),
    )
