"""Which page shows the result of which verb, and the page of a fit."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeAlias

from lcopa_bayes.core.parallel import workers
from lcopa_bayes.inference import defaultpriors
from lcopa_bayes.report import draws, records, responses
from lcopa_bayes.report.audit import write_audit
from lcopa_bayes.report.calibrate import write_calibration
from lcopa_bayes.report.check import write_check, write_look
from lcopa_bayes.report.claims import write_claims
from lcopa_bayes.report.compare import write_comparison
from lcopa_bayes.report.design import write_design
from lcopa_bayes.report.identify import write_identification
from lcopa_bayes.report.loop import write_loop
from lcopa_bayes.report.optics import write_optics
from lcopa_bayes.report.page import Drawings, write_graded
from lcopa_bayes.report.predict import write_prediction
from lcopa_bayes.report.savedrun import SavedRun, load_run
from lcopa_bayes.report.theme import look

Part: TypeAlias = Callable[[SavedRun], Drawings]
_PARTS: tuple[Part, ...] = (
    draws.pairs,
    draws.parameters,
    records.drawn,
    responses.drawn,
    draws.sampling,
)
"""What draws the page of a fit."""


def write_report(folder: Path, *, jobs: int = 1) -> Path:
    """Draw the report of a run folder: `figures/*.svg` and `report.html`, whose path is returned.

    Reads only the folder and calculates nothing; the same folder gives the same bytes, whatever `jobs`
    [processes]. InputError when a file of the folder is missing or cannot be used.
    """
    run = load_run(folder)
    with workers(run, jobs=jobs) as crew:
        parts = list(crew.each(_drawn, _PARTS))

    rules = inspect.cleandoc(defaultpriors.__doc__ or "")
    return write_graded(
        folder,
        "fit",
        "",
        lambda _: {key: one for part in parts for key, one in part.items()},
        file="results.json",
        name="report.html",
        run=run,
        default_priors=rules,
    )


def _drawn(run: SavedRun, part: Part) -> Drawings:
    """A part of the report."""
    with look():
        return part(run)


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
