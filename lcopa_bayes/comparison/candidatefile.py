"""Files of candidates: ``[compare]`` and ``[[candidates]]`` as in a study file, and nothing else."""

from __future__ import annotations

import tomllib
from pathlib import Path

from lcopa_bayes.candidatesettings import CandidateSettings, compare_settings
from lcopa_bayes.problems import InputError, nearest

_KNOWN = ("compare", "candidates")


def load_candidates(path: Path) -> tuple[tuple[str, ...] | None, tuple[CandidateSettings, ...]]:
    """Names picked, None for all, and candidates described in a TOML file.

    InputError with all that is wrong.
    """
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path}: cannot be read as TOML ({error}); give a file of candidates") from None
    problems = [
        f"{path}: unknown table [{key}]{nearest(key, _KNOWN)}" for key in document if key not in _KNOWN
    ]
    chosen, made = compare_settings(document, str(path), problems)
    if not document:
        problems.append(f"{path}: names no candidate; write [[candidates]] or [compare] pick")
    if problems:
        raise InputError(problems)
    return chosen.pick, made
