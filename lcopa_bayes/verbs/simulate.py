"""`simulate`: records of a campaign, measured on the virtual bench."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
import pandas as pd

from lcopa_bayes.bench.campaignfile import load_plan
from lcopa_bayes.data.record import Record
from lcopa_bayes.data.study import Study
from lcopa_bayes.data.studywriter import write_folder
from lcopa_bayes.results.result import notebook_table


@final
@dataclass(frozen=True, eq=False)
class Simulation:
    """Records of a campaign, and the study of them."""

    study: Study
    """With the seed of the noise and the settings of the campaign."""
    settings: str = ""
    """These settings as tables of a study file (TOML)."""

    @property
    def records(self) -> tuple[Record, ...]:
        """The fitted ones first."""
        return (*self.study.fit, *self.study.held_out)

    @property
    def verdict(self) -> str:
        """How many records there are."""
        return f"{len(self.records)} records of {self.study.name}, seed {self.study.seed}"

    def summary(self) -> pd.DataFrame:
        """One row per record; see `Study.summary`."""
        return self.study.summary()

    def to_json(self) -> dict[str, Any]:
        """The summary as plain values."""
        return {"verdict": self.verdict, "records": self.summary().to_dict("records")}

    def save(self, folder: Path | str, *, overwrite: bool = False) -> tuple[Path, ...]:
        """Write one CSV per record and the study file; returns their paths, the study last.

        InputError when one is there already, unless `overwrite`, and when the folder cannot be written to.
        """
        return write_folder(Path(folder), self.study, settings=self.settings, overwrite=overwrite)

    def _repr_html_(self) -> str:
        return notebook_table(self.summary())


def simulate(campaign: Path | str, *, seed: int | None = None) -> Simulation:
    """Measure the campaign file `campaign` on the virtual bench, by numerics that share nothing with the
    forward model.

    `seed` replaces the campaign's. InputError with everything wrong in the file.
    """
    plan = load_plan(Path(campaign))
    chosen = plan.seed if seed is None else seed
    roles: dict[bool, list[Record]] = {False: [], True: []}
    for record in plan.run(np.random.default_rng(chosen)):
        roles[record.name in plan.held_out].append(record)
    settings: dict[str, Any] = tomllib.loads(plan.settings)
    study = Study(plan.name, seed=chosen, fit=roles[False], held_out=roles[True], **settings)
    return Simulation(study, plan.settings)
