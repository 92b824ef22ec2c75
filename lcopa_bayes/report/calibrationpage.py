"""The page of a calibration, drawn from its `results.json` alone."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.report.page import Verdict, write_page
from lcopa_bayes.report.sections import calibration
from lcopa_bayes.report.theme import look

_NEEDS = (
    *("study", "verdict", "grade", "grade_reason", "seed", "asked", "replicas", "coverage", "simultaneous"),
    *("p_value", "p_value_of", "ranks", "rank_bins", "rank_corridor", "reliable", "grades", "not_reliable"),
    *("failures", "truths", "model_gap", "seconds", "sampler", "engine", "discretisation"),
)


def is_calibration(folder: Path) -> bool:
    """Whether a run folder is that of a calibration."""
    try:
        return "rank_corridor" in json.loads((folder / "results.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, TypeError):
        return False


def write_calibration(folder: Path) -> Path:
    """`report.html` with coverage, ranks and grades; returns its path. InputError when keys are missing."""
    told: Mapping[str, Any] = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    absent = [key for key in _NEEDS if key not in told]
    if absent:
        raise InputError(
            f"{folder / 'results.json'}: lacks {', '.join(absent)}; run `calibrate` again with --resume"
        )
    with look():
        sections = calibration.sections(told)
    verdict = Verdict(told["grade"], told["verdict"], told["grade_reason"])
    return write_page(folder, f"{told['study']}: calibration", sections, verdict)
