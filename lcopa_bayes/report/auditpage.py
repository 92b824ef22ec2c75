"""The page of an audit, drawn from `audit.json` and the draws of its run folder alone."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.report.page import Verdict, write_page
from lcopa_bayes.report.savedrun import load_run
from lcopa_bayes.report.sections import auditfigures, audittables
from lcopa_bayes.report.theme import look

NAME = "audit.html"
"""Name of the page inside the run folder."""
_NEEDS = (
    *(
        "study",
        "verdict",
        "grade",
        "grade_reason",
        "limitations",
        "parameters",
        "symmetries",
        "structure",
        "printed_form",
        "spectrum",
    ),
    *("local", "radial", "functions", "delays", "next_measurement"),
)


def write_audit(folder: Path) -> Path:
    """`audit.html` with verdicts, profiles, spectrum and pairs; returns its path.

    InputError when the folder holds no audit or it cannot be used.
    """
    path = folder / "audit.json"
    try:
        told: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); run `audit` to write it") from None
    absent = [key for key in _NEEDS if key not in told]
    if absent:
        raise InputError(f"{path}: lacks {', '.join(absent)}; run `audit` again with --resume")
    run = load_run(folder)
    with look():
        sections = [*audittables.sections(told), *auditfigures.sections(told, run)]
    verdict = Verdict(str(told["grade"]), str(told["verdict"]), str(told["grade_reason"]))
    return write_page(folder, f"{told['study']}: identifiability", sections, verdict, NAME)
