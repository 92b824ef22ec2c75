"""Results of earlier verbs that claims are judged by."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lcopa_bayes.problems import InputError


def earlier(folder: Path, verb: str, needs: Sequence[str]) -> Mapping[str, Any]:
    """What `verb` wrote to a run folder; InputError when it cannot be read or lacks any of `needs`."""
    path = folder / f"{verb}.json"
    try:
        told: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: cannot be read ({error}); give the run folder that `{verb}` wrote"
        ) from None
    absent = [key for key in needs if key not in told] if isinstance(told, dict) else list(needs)
    if absent:
        raise InputError(f"{path}: lacks {', '.join(absent)}; run `{verb}` again with --resume")
    return told
