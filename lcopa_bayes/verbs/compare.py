"""`compare`: which of several models of the same records is warranted."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import final

import pandas as pd

from lcopa_bayes.comparison.candidatefit import CARD
from lcopa_bayes.comparison.candidates import candidates_of, of_studies
from lcopa_bayes.comparison.compare import compare as compared
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.estimate import plain
from lcopa_bayes.core.parallel import on_one_thread
from lcopa_bayes.data.settings import CandidateSettings
from lcopa_bayes.data.studyfile import load_candidates
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.results.runfolder import opened, provenance
from lcopa_bayes.results.stored import StoredResult
from lcopa_bayes.results.structure import settled
from lcopa_bayes.verbs.sources import FitLike, finished, several, study_of


@final
@dataclass(frozen=True, eq=False)
class Comparison(StoredResult):
    """Candidates fitted to the same records, scored and decided."""

    verb, file = "compare", "compare.json"
    beside = ("candidates/*/tables/*.csv", f"candidates/*/{CARD}")

    @property
    def verdict(self) -> str:
        """Which candidate is preferred, why, and whether fractional orders are warranted."""
        return f"{self.values['why']} {self.values['fractional']['sentence']}"

    @property
    def preferred(self) -> str | None:
        """Name of the preferred candidate; None when none is."""
        name: str | None = self.values["preferred"]
        return name

    @property
    def averaged(self) -> pd.DataFrame:
        """One row per number that every candidate has: median and ends of its 90 % interval over candidates
        [`unit`], and standard deviations by noise and by structure [`unit`]; see `comparison.averaging`."""
        keys = ("name", "value", "lower", "upper", "unit", "sd_noise", "sd_structure", "grade")
        return pd.DataFrame([{key: row[key] for key in keys} for row in self.values["averaged"]])

    def summary(self) -> pd.DataFrame:
        """One row per candidate, in the order given: sampled parameters, log evidence with its standard
        deviation [nat], None where undefined, probability [-], and grade."""
        keys = ("name", "about", "parameters", "log_evidence", "log_evidence_sd", "probability", "grade")
        rows = [{key: row.get(key) for key in keys} for row in self.values["models"]]
        return pd.DataFrame(rows).assign(preferred=lambda table: table["name"] == self.preferred)


@on_one_thread
def compare(
    study: FitLike | Sequence[FitLike],
    candidates: Sequence[str] | None = None,
    *,
    described: Path | str | Sequence[CandidateSettings] = (),
    jobs: int = 1,
    folder: Path | str | None = None,
    resume: bool = False,
    quick: bool = False,
    quiet: bool = True,
) -> Comparison:
    """Fit several models of the same records, score them by evidence and by prediction, and decide.

    Parameters: `study`, from which candidates are derived (of a fit, its study), or several studies, fits or
    run folders of the same records: these are the candidates, and finished fits are not made anew;
    `candidates`, names such as ``fractional-2`` or ``second-order``, by default those of the study or a short
    list; `described`, further candidates, or a file of them; `jobs`, processes to use; `folder`, a run folder
    to write into, from which `resume` goes on; `quick`, a quarter of the steps; `quiet`, no progress bar.

    InputError for fewer than two different candidates, unknown names, different records, and as `fit`.
    """
    sources = several(study)
    if sources:
        if candidates or described:
            raise InputError("several studies are the candidates; `--pick` and `--candidates` are of one")
        fits = [finished(source) for source in sources]
        models = of_studies([settled(study_of(source), jobs=jobs) for source in sources], fits)
    else:
        named = isinstance(described, Path | str)
        picked, more = load_candidates(Path(described)) if named else (None, described)  # type: ignore[arg-type]
        asked = study_of(study)  # type: ignore[arg-type]
        single = settled(asked, jobs=jobs)
        if single.effects.use:  # its candidates have them or not, but never without their priors
            problem_of(single)
        models = candidates_of(
            single,
            more,  # type: ignore[arg-type]
            candidates or picked,
            chosen=single is not asked,
            jobs=jobs,
        )
    origin = plain(provenance(models[0].study, "compare"))
    with (
        TemporaryDirectory() if folder is None else nullcontext(str(folder)) as place,
        opened(place, origin) as path,
    ):
        values = compared(models, jobs=jobs, folder=path, resume=resume, quick=quick, quiet=quiet)
        outcome = sorted(one for pattern in Comparison.beside for one in path.glob(pattern))
        texts = {str(one.relative_to(path)): one.read_text(encoding="utf-8") for one in outcome}
        return Comparison(values, origin, texts).kept(folder)
