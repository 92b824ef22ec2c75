"""`design`: which drive to measure next, and for how long."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import pandas as pd

from lcopa_bayes.core.parallel import on_one_thread
from lcopa_bayes.data.drive import Drive, drive_of
from lcopa_bayes.data.record import columns_of
from lcopa_bayes.experiments.candidates import template
from lcopa_bayes.experiments.confirmation import REPLICAS, confirmed
from lcopa_bayes.experiments.design import DRAWS, checked
from lcopa_bayes.experiments.design import design as designed
from lcopa_bayes.experiments.summary import as_json
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.results.stored import StoredResult, origin_of
from lcopa_bayes.results.structure import with_least_terms
from lcopa_bayes.verbs.fit import basis
from lcopa_bayes.verbs.sources import FitLike, study_of

_QUICK = 4
"""How many times fewer draws a quick design takes."""
TEMPLATE = "design/next.csv"
"""File of the winning drive, a record table whose responses are to be filled in."""


@final
@dataclass(frozen=True, eq=False)
class DesignResult(StoredResult):
    """Drives compared by the precision they promise, and the one to play next."""

    verb, file, beside = "design", "design.json", (TEMPLATE,)
    rests_on_fit = True

    @property
    def verdict(self) -> str:
        """The winning drive, and whether simulated records confirm it."""
        return f"{self.values['verdict']}. {self.values['confirmed']['sentence']}"

    @property
    def drive(self) -> Drive | None:
        """The drive to play next, row by row, in the study's axes and units; None when no drive determines
        any parameter."""
        text = self.texts.get(TEMPLATE)
        if text is None:
            return None
        table = pd.read_csv(io.StringIO(text), dtype=str, keep_default_na=False)
        return drive_of(columns_of(table, "next", responses=False))

    def summary(self) -> pd.DataFrame:
        """One row per plant parameter: best drive, expected relative standard deviation [-] after it, after
        the winner and after the plain step, and the bench time that 10 % takes."""
        keys = {"relative_sd": "best", "relative_sd_winner": "winner", "relative_sd_step": "plain_step"}
        return pd.DataFrame(
            [
                {
                    "parameter": row["name"],
                    "best_drive": row["best_drive"],
                    **{f"relative_sd_{to}": row[key] and row[key]["value"] for key, to in keys.items()},
                    "time_for_10_percent": row["time_words"],
                    "reason": row["reason"],
                }
                for row in self.values["parameters"]
            ]
        )


@on_one_thread
def design(
    source: FitLike,
    *,
    bench_time: float | None = None,
    repeats: int = 1,
    amplitude: float | None = None,
    refresh: float | None = None,
    with_prior: bool = False,
    jobs: int = 1,
    folder: Path | str | None = None,
    resume: bool = False,
    quick: bool = False,
    quiet: bool = True,
) -> DesignResult:
    """Compare drives by how precise they promise to make the parameters, and confirm the best by simulation.

    Parameters: `source`, a fit, the run folder of one, or a study, which is fitted first, with `resume`,
    `quick` and `quiet` as in `fit`; `bench_time`, what the drive is chosen for [time unit of the study], by
    default 40 spans of the records; `repeats`, records to take; `amplitude`, largest deviation from rest
    [drive unit], by default that of the records; `refresh`, time between changes of the drive [time unit], by
    default 10 samples; `with_prior`, count the priors as information; `jobs`, processes to use; `folder`, a
    run folder to write into.

    InputError as `fit`, for limits or a bench time that cannot be used, and when no parameter of the plant is
    free.
    """
    wanted: dict[str, Any] = {"time": bench_time, "repeats": repeats}
    wanted |= {"amplitude": amplitude, "refresh": refresh}
    checked(problem_of(with_least_terms(study_of(source))), **wanted)  # before a long fit
    fit = basis(source, jobs=jobs, folder=folder, resume=resume, quick=quick, quiet=quiet)
    draws = DRAWS // _QUICK if quick else DRAWS
    planned = designed(fit, **wanted, with_prior=with_prior, draws=draws, jobs=jobs)
    trials = confirmed(planned, jobs=jobs, replicas=REPLICAS // 2 if quick else REPLICAS)
    values, texts = as_json(planned) | trials | {"template": None}, {}
    if values["winner"] is not None:
        texts[TEMPLATE] = template(fit.study, planned.limits, planned.winner.candidate.command, planned.time)
        values["template"] = TEMPLATE
    return DesignResult(values, origin_of(fit, "design"), texts, fit).kept(folder)
