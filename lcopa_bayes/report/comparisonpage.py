"""The page of a comparison, drawn from `compare.json` and the candidates' tables alone."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from lcopa_bayes.compare.compare import folder_name
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.report.page import Verdict, write_page
from lcopa_bayes.report.sections import comparisonfigures, comparisontables
from lcopa_bayes.report.theme import look

NAME = "compare.html"
"""Name of the page inside the run folder."""
_NEEDS = ("study", "models", "preferred", "why", "agreement", "fractional", "order_is_integer", "flags")


def write_comparison(folder: Path) -> Path:
    """`compare.html` with scores, orders, fits and residuals; returns its path.

    InputError when the folder holds no comparison or it cannot be used.
    """
    path = folder / "compare.json"
    try:
        told: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); run `compare` to write it") from None
    absent = [key for key in _NEEDS if key not in told]
    if absent:
        raise InputError(f"{path}: lacks {', '.join(absent)}; run `compare` again with --resume")
    if any("containment" not in row for row in told["models"]):
        raise InputError(f"{path}: written by an earlier version; run `compare` again")
    with look():
        scores, *rest = comparisontables.sections(told)
        sections = [scores, *comparisonfigures.sections(told, _curves(folder, told)), *rest]
    graded = {row["name"]: row for row in told["models"]}
    own = graded.get(told["preferred"])
    grade, reason = (own["grade"], own["grade_reason"]) if own else ("unusable", told["why"])
    verdict = Verdict(str(grade), f"{told['why']} {told['fractional']['sentence']}", str(reason))
    return write_page(folder, f"{told['study']}: comparison", sections, verdict, NAME)


def _curves(folder: Path, told: Mapping[str, Any]) -> dict[str, pd.DataFrame]:
    """Curves of every candidate that has any; InputError when a table cannot be read."""
    out, problems = {}, []
    for row in told["models"]:
        path = folder / "candidates" / folder_name(str(row["name"])) / "tables" / "curves.csv"
        try:
            out[str(row["name"])] = pd.read_csv(path, dtype={"record": str, "axis": str, "unit": str})
        except (OSError, ValueError) as error:
            problems.append(f"{path}: cannot be read ({error}); run `compare` again with --resume")
    if problems:
        raise InputError(problems)
    return out
