"""The page of a loop, drawn from `loop.json` and `loop_curves.json` of its run folder alone."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.report.page import Verdict, write_page
from lcopa_bayes.report.sections import loopfigures, looptables
from lcopa_bayes.report.theme import look

NAME = "loop.html"
"""Name of the page inside the run folder."""
_NEEDS = {
    "loop.json": (
        *(
            "study",
            "verdict",
            "confidence",
            "sentence",
            "grade",
            "grade_reason",
            "noise",
            "effects",
            "before",
        ),
        *("after", "evidence", "rounds", "moved", "survival", "next_measurement", "residual", "cautions"),
    ),
    "loop_curves.json": ("views", "curves"),
}


def write_loop(folder: Path) -> Path:
    """`loop.html` with verdict, evidence, errors before and after and residuals side by side; returns its
    path.

    InputError when the folder holds no loop or it cannot be used.
    """
    told, shown = (_loaded(folder / name, keys) for name, keys in _NEEDS.items())
    with look():
        sections = [*looptables.sections(told), *loopfigures.sections(told, shown)]
    verdict = Verdict(
        str(told["grade"]),
        f"{told['verdict']} ({told['confidence']}): {told['sentence']}",
        str(told["grade_reason"]),
    )
    return write_page(folder, f"{told['study']}: what the model lacks", sections, verdict, NAME)


def _loaded(path: Path, keys: tuple[str, ...]) -> Mapping[str, Any]:
    try:
        told: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); run `loop` to write it") from None
    absent = [key for key in keys if key not in told]
    if absent:
        raise InputError(f"{path}: lacks {', '.join(absent)}; run `loop` again")
    return told
