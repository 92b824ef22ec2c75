"""Pages about the paper: static optics, identification, claims."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lcopa_bayes.paper.figures import panels
from lcopa_bayes.paper.identify import Identification
from lcopa_bayes.paper.staticoptics import StaticOptics
from lcopa_bayes.paper.steptable import Row
from lcopa_bayes.paper.verdict import Judged
from lcopa_bayes.report.canvas import look
from lcopa_bayes.report.page import write_page
from lcopa_bayes.report.sections import claimfigures, director, farfields, identified, verdicts
from lcopa_bayes.study import Study


def write_optics(folder: Path, made: StaticOptics) -> Path:
    """`report.html` with far fields, director, tilt law and chain; returns its path."""
    with look():
        sections = [*farfields.sections(made), *director.sections(made)]
    return write_page(folder, "Static optics of the array", sections)


def write_identification(
    folder: Path, study: Study, found: Sequence[Identification], rows: Sequence[Row]
) -> Path:
    """`identify.html` with models, Table 1 and records; returns its path."""
    with look():
        sections = identified.sections(study.time_unit, found, rows, panels(study, found))
    return write_page(folder, f"{study.name}: identification", sections, name="identify.html")


def write_claims(folder: Path, judged: Sequence[Judged]) -> Path:
    """`report.html` with every claim, its verdict and the figures behind them; returns its path."""
    with look():
        sections = [verdicts.section(judged), *claimfigures.sections()]
    return write_page(folder, "Claims of the paper", sections)
