"""Which page shows the result of which verb.

Pages about the paper, drawn from their run folders: static optics, identification, claims.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.paper.staticoptics import OpticsPlan, static_optics
from lcopa_bayes.report.audit import write_audit
from lcopa_bayes.report.calibrate import write_calibration
from lcopa_bayes.report.check import write_check, write_look
from lcopa_bayes.report.compare import write_comparison
from lcopa_bayes.report.design import write_design
from lcopa_bayes.report.loop import write_loop
from lcopa_bayes.report.page import write_page, write_report
from lcopa_bayes.report.predict import write_prediction
from lcopa_bayes.report.section import Section, Table
from lcopa_bayes.report.sections import claimfigures, identification, optics
from lcopa_bayes.report.theme import look
from lcopa_bayes.results.stored import stored_values


def write_optics(folder: Path) -> Path:
    """`optics.html` with far fields, director, tilt law and chain; returns its path.

    All is solved again for the plan in `optics.json`; InputError when that file cannot be used.
    """
    plan = stored_values(folder, "optics", ("plan",))["plan"]
    try:
        calculated = static_optics(OpticsPlan(**plan))
    except TypeError as error:
        raise InputError(f"{folder / 'optics.json'}: holds no plan ({error}); run `optics` again") from None
    with look():
        sections = optics.sections(calculated)
    return write_page(folder, "Static optics of the array", sections, name="optics.html")


def write_identification(folder: Path) -> Path:
    """`identify.html` with models, Table 1 and records; returns its path.

    InputError when `identify.json` or a table of samples cannot be used.
    """
    values = stored_values(folder, "identify", ("study", "time_unit", "paths", "step_metrics", "records"))
    try:
        samples = [pd.read_csv(folder / entry["samples"]) for entry in values["records"]]
    except (OSError, ValueError) as error:
        raise InputError(f"{folder}: samples cannot be read ({error}); run `identify` again") from None
    with look():
        sections = identification.sections(values, samples)
    return write_page(folder, f"{values['study']}: identification", sections, name="identify.html")


def write_claims(folder: Path) -> Path:
    """`claims.html` with every claim, its verdict and the figures behind them; returns its path.

    InputError when `claims.json` cannot be used.
    """
    values = stored_values(folder, "claims", ("verdict", "claims"))
    with look():
        sections = [_verdicts(values), *claimfigures.sections()]
    return write_page(folder, "Claims of the paper", sections, name="claims.html")


def _verdicts(values: Mapping[str, Any]) -> Section:
    """The table of claims."""
    table = Table.of(
        values["claims"],
        ("id", "text", "id"),
        ("claim", "prose", lambda row: f"{row['text']} ({row['source']})"),
        ("verdict", "text", "verdict"),
        ("number", "number", "number"),
        ("unit", "text", "unit"),
        ("how", "prose", "how"),
    )
    return Section(
        "Verdicts",
        (
            f"{values['verdict']} A verdict follows from the printed numbers by the calculation beside it; "
            "undecided means that data needed to decide it are missing.",
        ),
        tables=(table,),
    )


_PAGES: Mapping[str, Callable[[Path], Path]] = {
    "check": write_check,
    "look": write_look,
    "fit": write_report,
    "audit": write_audit,
    "design": write_design,
    "compare": write_comparison,
    "loop": write_loop,
    "calibrate": write_calibration,
    "predict": write_prediction,
    "optics": write_optics,
    "identify": write_identification,
    "claims": write_claims,
}


def write_page_of(verb: str, folder: Path) -> Path:
    """Draw the page of a verb's result from the files of its run folder alone; returns its path.

    InputError when a file is missing or cannot be used.
    """
    return _PAGES[verb](folder)
