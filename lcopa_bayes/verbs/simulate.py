"""`simulate`: records of a campaign, measured on the virtual bench."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
import pandas as pd

from lcopa_bayes.bench.campaignfile import load_plan, write_campaign
from lcopa_bayes.data.record import Record
from lcopa_bayes.data.study import Study
from lcopa_bayes.results.result import notebook_table


@final
@dataclass(frozen=True, eq=False)
class Simulation:
    """Records of a campaign, and the study of them."""

    name: str
    """Of the campaign and of its study."""
    seed: int
    """Seed of the noise."""
    records: tuple[Record, ...]
    """In the order of the campaign."""
    held_out: tuple[str, ...]
    """Names of the records that are not to be fitted."""
    settings: str = ""
    """Further tables of the study file (TOML)."""

    @property
    def study(self) -> Study:
        """The study of these records, with the settings of the campaign."""
        tables: dict[str, Any] = tomllib.loads(self.settings)
        return Study(
            self.name,
            seed=self.seed,
            fit=[record for record in self.records if record.name not in self.held_out],
            held_out=[record for record in self.records if record.name in self.held_out],
            model=tables.get("model"),
            priors=tables.get("priors"),
            noise=tables.get("noise"),
            sampler=tables.get("sampler"),
        )

    @property
    def verdict(self) -> str:
        """How many records there are."""
        return f"{len(self.records)} records of {self.name}, seed {self.seed}"

    def summary(self) -> pd.DataFrame:
        """One row per record: samples, first and last time [`time_unit`], axes, and whether it is held
        out."""
        return pd.DataFrame(
            [
                {
                    "record": record.name,
                    "samples": record.time.size,
                    "begin": record.time[0],
                    "end": record.time[-1],
                    "time_unit": record.time_unit,
                    "drives": ", ".join(axis.name for axis in record.drive_axes),
                    "responses": ", ".join(axis.name for axis in record.response_axes),
                    "held_out": record.name in self.held_out,
                }
                for record in self.records
            ]
        )

    def to_json(self) -> dict[str, Any]:
        """The summary as plain values."""
        return {"verdict": self.verdict, "records": self.summary().to_dict("records")}

    def save(self, folder: Path | str, *, overwrite: bool = False) -> tuple[Path, ...]:
        """Write one CSV per record and the study file; returns their paths, the study last.

        InputError when one is there already, unless `overwrite`, and when the folder cannot be written to.
        """
        return write_campaign(
            Path(folder),
            self.records,
            held_out=self.held_out,
            name=self.name,
            seed=self.seed,
            settings=self.settings,
            overwrite=overwrite,
        )

    def _repr_html_(self) -> str:
        return notebook_table(self.summary())


def simulate(campaign: Path | str, *, seed: int | None = None) -> Simulation:
    """Measure the campaign file `campaign` on the virtual bench, by numerics that share nothing with the
    forward model.

    `seed` replaces the campaign's. InputError with everything wrong in the file.
    """
    plan = load_plan(Path(campaign))
    chosen = plan.seed if seed is None else seed
    records = plan.run(np.random.default_rng(chosen))
    return Simulation(plan.name, chosen, records, tuple(plan.held_out), plan.settings)
