"""`fit`: the posterior of a study, what it predicts, and how far both can be trusted."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path

from lcopa_bayes.core.parallel import meanwhile, on_one_thread
from lcopa_bayes.results.alternatives import with_alternatives
from lcopa_bayes.results.firstlook import first_look
from lcopa_bayes.results.fit import Fit
from lcopa_bayes.results.fit import fit as sampled
from lcopa_bayes.results.integerfit import integer_fit
from lcopa_bayes.results.integerrival import integer_rival
from lcopa_bayes.results.predictive import Predictive
from lcopa_bayes.results.result import write_page
from lcopa_bayes.results.runfolder import opened, provenance
from lcopa_bayes.results.structure import structure_of
from lcopa_bayes.verbs.look import look_result
from lcopa_bayes.verbs.sources import FitLike, StudyLike, finished, study_of


@on_one_thread
def fit(
    study: StudyLike,
    *,
    jobs: int = 1,
    folder: Path | str | None = None,
    resume: bool = False,
    quick: bool = False,
    cross_check: bool = False,
    rival: bool = False,
    compact: bool = False,
    page: bool = False,
    quiet: bool = True,
) -> Fit:
    """Sample the posterior of a study and derive what it predicts.

    Parameters: `study`, or where it is described; `jobs`, processes to use, which change no number; `folder`,
    a run folder in which draws are kept while they are made, so that `resume` goes on from them, and the
    result afterwards; `quick`, a quarter of the steps; `cross_check`, sample by nested sampling too; `rival`,
    fit the study with integer orders too and compare what both predict of the held-out records; `compact`,
    keep what has one number for each sample for fewer draws in the folder, and no draws of the prior; `page`,
    draw the page there too, at the same time as the rest is written; `quiet`, no progress bar, and no first
    look (`look`) in the folder meanwhile.

    The same study gives the same draws. InputError when the study cannot be used, or the folder cannot be
    written to, holds another study's results, or is being written by another run; then nothing is written.
    """
    wanted = study_of(study)
    structure = structure_of(wanted, jobs=jobs, quiet=quiet)
    wanted = structure.chosen.study if structure else wanted
    searched = (structure.chosen.problem, structure.chosen.optima) if structure else None
    with opened(folder, provenance(wanted, "fit")) as place:
        drawn: AbstractContextManager[None] = nullcontext()
        if place is not None and not (quiet or resume or wanted.effects.use):
            seen = structure.look if structure else first_look(wanted)
            searched = seen.problem, seen.optima
            look_result(seen).save(place)
            drawn = meanwhile(write_page, ("look", place), _announced, jobs=jobs)
        with drawn:
            fitted = sampled(
                wanted,
                jobs=jobs,
                folder=place,
                resume=resume,
                quick=quick,
                cross_check=cross_check,
                quiet=quiet,
                searched=searched,
            )
        if rival:
            fitted = replace(fitted, rival=integer_rival(fitted, jobs=jobs, quick=quick, quiet=quiet))
        if structure:
            fitted = replace(fitted, structure=structure)
            integer = integer_fit(fitted, jobs=jobs, folder=place, resume=resume, quick=quick, quiet=quiet)
            fitted = with_alternatives(fitted, integer, jobs=jobs)
        if place is not None:
            fitted.save(place, compact=compact, jobs=jobs, page=page)
    return fitted


def _announced(page: Path) -> None:
    print(f"first look: {page}", file=sys.stderr)


def basis(
    source: FitLike, *, jobs: int, folder: Path | str | None, resume: bool, quick: bool, quiet: bool
) -> Predictive:
    """The finished fit that is given or named, else the fit of the study that is; parameters as `fit`."""
    result = finished(source)
    if result is not None:
        return result
    return fit(study_of(source), jobs=jobs, folder=folder, resume=resume, quick=quick, quiet=quiet)
