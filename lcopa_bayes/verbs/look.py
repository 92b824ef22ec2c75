"""`look`: least squares and residual of a study, within seconds and before any sampling."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import final

import pandas as pd

from lcopa_bayes.core.files import csv_of
from lcopa_bayes.core.parallel import on_one_thread
from lcopa_bayes.results.firstlook import FirstLook, first_look
from lcopa_bayes.results.runfolder import provenance
from lcopa_bayes.results.stored import StoredResult
from lcopa_bayes.results.structure import structure_of
from lcopa_bayes.verbs.sources import StudyLike, study_of


@final
@dataclass(frozen=True, eq=False)
class LookResult(StoredResult):
    """The best of a few least-squares searches, with draws about it."""

    verb, file, beside = "look", "look.json", ("tables/look_*.csv",)

    def summary(self) -> pd.DataFrame:
        """One row per free parameter: median and ends of the 90 % interval about the optimum [`unit`]."""
        keys = ("name", "value", "lower", "upper", "unit")
        rows = [{key: row[key] for key in keys} for row in self.values["parameters"]]
        return pd.DataFrame(rows).rename(columns={"name": "parameter"})


@on_one_thread
def look(study: StudyLike, *, folder: Path | str | None = None) -> LookResult:
    """Fit a study by least squares and show what is left, before the posterior is sampled.

    Parameters: `study`, or where it is described; `folder`, a run folder to write into. The plant is the best
    of a few searches, intervals and bands are of draws about it, which know of no other mode. InputError as
    `fit`, and where no search leads to a plant inside the priors.
    """
    wanted = study_of(study)
    structure = structure_of(wanted)
    return look_result(structure.look if structure else first_look(wanted)).kept(folder)


def look_result(seen: FirstLook) -> LookResult:
    """A first look as the result that is saved and shown."""
    texts = {f"tables/look_{name}.csv": csv_of(table) for name, table in seen.tables().items()}
    return LookResult(seen.to_json(), provenance(seen.problem.study, "look"), texts)
