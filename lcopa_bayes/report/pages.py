"""Which page shows the result of which verb."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from lcopa_bayes.report.audit import write_audit
from lcopa_bayes.report.calibrate import write_calibration
from lcopa_bayes.report.check import write_check
from lcopa_bayes.report.compare import write_comparison
from lcopa_bayes.report.design import write_design
from lcopa_bayes.report.look import write_look
from lcopa_bayes.report.loop import write_loop
from lcopa_bayes.report.page import write_report
from lcopa_bayes.report.paperpages import write_claims, write_identification, write_optics
from lcopa_bayes.report.predict import write_prediction

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


def write_page_of(verb: str, folder: Path, *, jobs: int = 1) -> Path:
    """Draw the page of a verb's result from the files of its run folder alone; returns its path.

    The figures of a fit, the most of any page, are drawn in `jobs` processes.
    InputError when a file is missing or cannot be used.
    """
    return write_report(folder, jobs=jobs) if verb == "fit" else _PAGES[verb](folder)
