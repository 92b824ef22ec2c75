"""The page of a design, drawn from `design.json` of its run folder alone."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.report.page import Verdict, write_page
from lcopa_bayes.report.sections import designtables
from lcopa_bayes.report.theme import look

NAME = "design.html"
"""Name of the page inside the run folder."""
_NEEDS = (
    *("study", "verdict", "grade", "grade_reason", "time", "time_unit", "winner", "parameters", "table"),
    *("curve", "confirmed", "range", "repeats", "refresh", "draws", "structure", "template"),
)


def write_design(folder: Path) -> Path:
    """`design.html` with the table of drives, precision against bench time and its confirmation.

    InputError when the folder holds no design or it cannot be used.
    """
    path = folder / "design.json"
    try:
        told: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); run `design` to write it") from None
    absent = [key for key in _NEEDS if key not in told]
    if absent:
        raise InputError(f"{path}: lacks {', '.join(absent)}; run `design` again with --resume")
    with look():
        sections = designtables.sections(told)
    verdict = Verdict(str(told["grade"]), str(told["verdict"]), str(told["grade_reason"]))
    return write_page(folder, f"{told['study']}: what to measure next", sections, verdict, NAME)
