"""`check`: what was understood of a study, in words and pictures, without fitting it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from lcopa_bayes.data.record import Record
from lcopa_bayes.results.inventory import inventory
from lcopa_bayes.results.provenance import provenance
from lcopa_bayes.results.stored import StoredResult
from lcopa_bayes.verbs.sources import StudyLike, study_of


@dataclass(frozen=True, eq=False)
class CheckResult(StoredResult):
    """Axes, drives, sampling, noise at rest, onsets and priors of a study."""

    verb, file, beside = "check", "check.json", ("tables/check_records.csv",)

    def summary(self) -> pd.DataFrame:
        """One row per parameter: ends of the central 90 % of its prior [`unit`], or its fixed value."""
        keys = ("name", "lower", "upper", "value", "unit", "from")
        rows = [{key: row.get(key) for key in keys} for row in self.values["parameters"]]
        return pd.DataFrame(rows).rename(columns={"name": "parameter"})

    def __str__(self) -> str:
        lines = list(self.values["sentences"])
        for one in self.values["records"]:
            role = "held out" if one["held_out"] else "fit"
            lines += ["", f"{one['record']} ({role})", *(f"  {said}" for said in one["sentences"])]
        priors = [f"  {row['name']} [{row['unit']}]: {row['words']}" for row in self.values["parameters"]]
        return "\n".join([*lines, "", "priors", *priors, "", self.verdict])


def check(study: StudyLike, *, folder: Path | str | None = None) -> CheckResult:
    """Say what was understood of a study, without fitting it.

    Parameters: `study`, or where it is described; `folder`, a run folder to write into. Obstacles to a fit
    are part of the result. InputError when the study cannot be read.
    """
    wanted = study_of(study)
    records = pd.concat(
        [
            *(_table(one, held_out=False) for one in wanted.fit),
            *(_table(one, held_out=True) for one in wanted.held_out),
        ],
        ignore_index=True,
    )
    texts = {"tables/check_records.csv": records.to_csv(index=False)}
    result = CheckResult(inventory(wanted), provenance(wanted, "check"), texts)
    if folder is not None:
        result.save(folder)
    return result


def _table(record: Record, *, held_out: bool) -> pd.DataFrame:
    """One row per time and axis."""
    frames = [
        pd.DataFrame(
            {"role": role, "axis": axis.name, "unit": axis.unit, "time": record.time, "value": values}
        )
        for role, axes, columns in (
            ("drive", record.drive_axes, record.drive.T),
            ("response", record.response_axes, record.response.T),
        )
        for axis, values in zip(axes, columns, strict=True)
    ]
    whole = pd.concat(frames, ignore_index=True)
    whole.insert(0, "record", record.name)
    return whole.assign(held_out=held_out)
