"""`calibrate`: whether the whole inference of a study covers what it states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from lcopa_bayes.calibration.calibrate import calibrate as calibrated
from lcopa_bayes.calibration.replica import Engine
from lcopa_bayes.calibration.summary import results, tables
from lcopa_bayes.calibration.truths import Stated
from lcopa_bayes.core.estimate import plain
from lcopa_bayes.results.predictive import Predictive
from lcopa_bayes.results.provenance import provenance
from lcopa_bayes.results.runfolder import opened
from lcopa_bayes.results.stored import StoredResult
from lcopa_bayes.verbs.sources import StudyLike, study_of


@dataclass(frozen=True, eq=False)
class CalibrationResult(StoredResult):
    """Coverage and ranks of true values over simulated studies."""

    verb, file, beside = "calibrate", "results.json", ("tables/replicas.csv", "tables/ranks.csv")

    def summary(self) -> pd.DataFrame:
        """One row per quantity and level of its intervals: share of the truths inside, and the band [-] in
        which that share lies when the inference covers as stated."""
        return pd.DataFrame(self.values["coverage"])


def calibrate(
    study: StudyLike | Predictive,
    *,
    replicas: int = 100,
    around: Path | str | None = None,
    truth: Mapping[str, Stated] | None = None,
    engine: Engine = "importance",
    dask: str | None = None,
    jobs: int = 1,
    folder: Path | str | None = None,
    resume: bool = False,
    quick: bool = False,
    quiet: bool = True,
) -> CalibrationResult:
    """Draw truths, simulate the study's records from them, infer, and rank the truths (Talts et al. 2018).

    Parameters: `study`, or a fit of it; `replicas`, simulated studies; `around`, the run folder of a fit
    whose posterior truths are drawn from, in place of the prior; `truth`, values or ranges by parameter name
    [unit of the parameter]; `engine`, ``importance`` or ``sampling``; `dask`, address of a cluster that does
    the replicas; `jobs`, processes to use; `folder`, a run folder to write into, from which `resume` goes on;
    `quick`, a quarter of the steps; `quiet`, no progress bar.

    InputError for input that cannot be used, when a worker is lost, when not one replica could be done, and
    for a folder as `fit`.
    """
    wanted = study_of(study)
    origin = plain(provenance(wanted, "calibrate"))
    with opened(folder, origin) as place:
        calibration = calibrated(
            wanted,
            replicas=replicas,
            around=None if around is None else Path(around),
            truth=truth,
            engine=engine,
            jobs=jobs,
            dask=dask,
            folder=place,
            resume=resume,
            quick=quick,
            quiet=quiet,
        )
        texts = {
            f"tables/{name}.csv": table.to_csv(index=False) for name, table in tables(calibration).items()
        }
        result = CalibrationResult(results(calibration), origin, texts)
        if place is not None:
            result.save(place)
    return result
