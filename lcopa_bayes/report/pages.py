"""Which page shows the result of which verb.

Pages about the paper, drawn from their run folders: static optics, identification, claims.
"""

from __future__ import annotations

import inspect
from collections import ChainMap
from collections.abc import Callable, Mapping
from math import log10
from pathlib import Path
from typing import Any

import pandas as pd

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.parallel import workers
from lcopa_bayes.inference import defaultpriors
from lcopa_bayes.model.path import Normalisation
from lcopa_bayes.paper.staticoptics import OpticsPlan, static_optics
from lcopa_bayes.paper.steptable import KINDS, PRINTED
from lcopa_bayes.report.audit import write_audit
from lcopa_bayes.report.calibrate import write_calibration
from lcopa_bayes.report.check import write_check, write_look
from lcopa_bayes.report.compare import write_comparison
from lcopa_bayes.report.design import write_design
from lcopa_bayes.report.formatting import interval
from lcopa_bayes.report.loop import write_loop
from lcopa_bayes.report.page import Drawings, write_graded
from lcopa_bayes.report.predict import write_prediction
from lcopa_bayes.report.savedrun import SavedRun, load_run
from lcopa_bayes.report.sections import (
    claimfigures,
    identification,
    optics,
    pairs,
    parameters,
    records,
    responses,
    sampling,
)
from lcopa_bayes.report.theme import look
from lcopa_bayes.results.stored import stored_values

_PARTS = (pairs, parameters, records, responses, sampling)
"""What draws the report of a fit."""


def write_report(folder: Path, *, jobs: int = 1) -> Path:
    """Draw the report of a run folder: `figures/*.svg` and `report.html`, whose path is returned.

    Reads only the folder and calculates nothing; the same folder gives the same bytes, whatever `jobs`
    [processes]. InputError when a file of the folder is missing or cannot be used.
    """
    run = load_run(folder)
    with workers(run, jobs=jobs) as crew:
        parts = list(crew.each(_drawn, range(len(_PARTS))))

    rules = inspect.cleandoc(defaultpriors.__doc__ or "")
    return write_graded(
        folder,
        "fit",
        "",
        lambda _: dict(ChainMap(*parts)),
        file="results.json",
        name="report.html",
        run=run,
        default_priors=rules,
    )


def _drawn(run: SavedRun, number: int) -> dict[str, Any]:
    """A part of the report."""
    with look():
        return dict(_PARTS[number].drawn(run))


def write_optics(folder: Path) -> Path:
    """`optics.html` with far fields, director, tilt law and chain; returns its path.

    All is solved again for the plan in `optics.json`; InputError when that file cannot be used.
    """
    plan = stored_values(folder, "optics", ("plan",))["plan"]
    try:
        calculated = static_optics(OpticsPlan(**plan))
    except TypeError as error:
        raise InputError(f"{folder / 'optics.json'}: holds no plan ({error}); run `optics` again") from None
    return write_graded(
        folder,
        "optics",
        "Static optics of the array",
        lambda values: optics.drawn(calculated),
        box=None,
        calculated=calculated,
        decibel=lambda intensity: 10 * log10(intensity),
    )


def write_identification(folder: Path) -> Path:
    """`identify.html` with models, Table 1 and records; returns its path.

    InputError when `identify.json` or a table of samples cannot be used.
    """
    values = stored_values(folder, "identify", ("study", "time_unit", "paths", "step_metrics", "records"))
    try:
        samples = [pd.read_csv(folder / entry["samples"]) for entry in values["records"]]
    except (OSError, ValueError) as error:
        raise InputError(f"{folder}: samples cannot be read ({error}); run `identify` again") from None

    def drawn(values: Mapping[str, Any]) -> Drawings:
        both = zip(values["records"], samples, strict=True)
        return {"records": [identification.drawing(*one, values["time_unit"]) for one in both]}

    def credible(one: Mapping[str, Any]) -> str:
        lower, upper = one["lower"], one["upper"]
        return interval(lower, upper, None if None in (lower, upper) else abs(upper - lower) / 4)

    return write_graded(
        folder,
        "identify",
        "identification",
        drawn,
        box=None,
        normalisations=[one.value for one in Normalisation],
        kinds=KINDS,
        columns=PRINTED,
        credible_interval=credible,
    )


def write_claims(folder: Path) -> Path:
    """`claims.html` with every claim, its verdict and the figures behind them; returns its path.

    InputError when `claims.json` cannot be used.
    """
    return write_graded(
        folder, "claims", "Claims of the paper", lambda values: {"claims": claimfigures.drawn()}, box=None
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


def write_page_of(verb: str, folder: Path, *, jobs: int = 1) -> Path:
    """Draw the page of a verb's result from the files of its run folder alone; returns its path.

    The figures of a fit, the most of any page, are drawn in `jobs` processes.
    InputError when a file is missing or cannot be used.
    """
    return write_report(folder, jobs=jobs) if verb == "fit" else _PAGES[verb](folder)
