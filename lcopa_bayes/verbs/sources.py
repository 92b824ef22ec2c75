"""What a public function is given: a study, where one is described, or a finished fit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

from lcopa_bayes.core.errors import InputError, gathered
from lcopa_bayes.data.requirements import unmet_apart_from_rest
from lcopa_bayes.data.study import Study
from lcopa_bayes.data.studyfile import BrokenStudyError, load_study
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.results.predictive import Predictive
from lcopa_bayes.results.savedfit import NAME, load_fit
from lcopa_bayes.results.structure import with_least_terms

StudyLike: TypeAlias = Study | Path | str | Sequence[Path | str]
"""A study, its folder or file, or record files to make one of."""
FitLike: TypeAlias = StudyLike | Predictive
"""A fit, or what `StudyLike` is; a path may be the run folder of a finished fit."""


def study_of(source: FitLike, *, held_out: Sequence[Path] = ()) -> Study:
    """The study, read where it is named by paths, with `held_out` records added there.

    InputError with all that is wrong in its file, and in what of it can still be fitted together.
    """
    result = finished(source)
    if result is not None:
        return result.study
    if isinstance(source, Study):
        return source
    try:
        return load_study(source, held_out=held_out)  # type: ignore[arg-type]
    except BrokenStudyError as broken:
        problems = [*broken.problems, *unmet_apart_from_rest(broken.study)]
        with gathered(problems):
            problem_of(with_least_terms(broken.study))
        raise InputError(problems) from None


def several(source: FitLike | Sequence[FitLike]) -> tuple[FitLike, ...]:
    """The studies or fits of a sequence of two or more; none where it is one study, as of record files."""
    if isinstance(source, str) or not isinstance(source, Sequence) or len(source) < 2:
        return ()
    whole = (
        isinstance(one, Study | Predictive)
        or (isinstance(one, Path | str) and (Path(one).is_dir() or Path(one).suffix == ".toml"))
        for one in source
    )
    return tuple(source) if all(whole) else ()


def finished(source: FitLike) -> Predictive | None:
    """The finished fit that is given or kept in the run folder that is named; None for a study."""
    if isinstance(source, Predictive):
        return source
    if isinstance(source, Study):
        return None
    paths = [Path(source)] if isinstance(source, Path | str) else [Path(one) for one in source]
    if len(paths) == 1 and (paths[0] / NAME).is_file():
        return load_fit(paths[0])
    return None
