"""`new`: records and a study from tables as people save them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import pandas as pd

from lcopa_bayes.core.errors import gathered, refuse_if
from lcopa_bayes.data.averaging import averaged
from lcopa_bayes.data.cells import CellTable
from lcopa_bayes.data.conversion import Mapped, convert
from lcopa_bayes.data.requirements import unmet
from lcopa_bayes.data.spreadsheet import read_spreadsheet
from lcopa_bayes.data.study import Study
from lcopa_bayes.data.studywriter import write_folder
from lcopa_bayes.identifiability.averagingloss import averaging_losses

_SETTINGS = """\
[model]{means}
# terms = 1  # viscous terms of every element; without it the records choose
# share = "none"  # every path has an element of its own; "all": one for all
# delay = "path"  # every path has a delay of its own; "shared": one for all
# offset = "record"  # "shared" where all records rest at the same level

[priors]
# Parameters have default priors; `lcopa-bayes check` lists them. A number fixes a parameter:
# delay = 0.5

[noise]
# kind = "white+ar1"  # or "white", "ar1", "student"

[sampler]
# target_ess = 400  # effective draws of a reliable number
"""


@final
@dataclass(frozen=True, eq=False)
class NewStudy:
    """Records read from tables, and how these were read."""

    study: Study
    """The study, with default settings; of means of samples where these were asked for."""
    notes: tuple[str, ...]
    """What was taken for what, one sentence each."""
    warnings: tuple[str, ...]
    """What keeps a fit of these records from meaning anything."""

    def to_json(self) -> dict[str, Any]:
        """Notes, warnings and the records as plain values."""
        records = {"fit": self.study.fit, "held_out": self.study.held_out}
        return {
            "study": self.study.name,
            "notes": list(self.notes),
            "warnings": list(self.warnings),
            "records": {role: [record.name for record in own] for role, own in records.items()},
        }

    def summary(self) -> pd.DataFrame:
        """One row per record; see `Study.summary`."""
        return self.study.summary()

    def __str__(self) -> str:
        parts = [self.summary().to_string(index=False), "\n".join(self.notes)]
        parts += ["\n".join(f"warning: {one}" for one in self.warnings)] if self.warnings else []
        return "\n\n".join(parts)

    def save(self, folder: Path | str, *, overwrite: bool = False) -> tuple[Path, ...]:
        """Write the records and `study.toml` into a folder; returns the paths, the study file last.

        InputError when files of these names are there, unless `overwrite`, or one cannot be written.
        """
        notes = ["What was understood of the tables:", *(f"- {one}" for one in self.notes)]
        exposure = self.study.model.exposure_ms
        said = f"\nexposure_ms = {exposure!r}  # every sample is a mean" if exposure else ""
        settings = _SETTINGS.format(means=said)
        return write_folder(Path(folder), self.study, notes=notes, settings=settings, overwrite=overwrite)


def new(
    folder: Path | str,
    files: Path | str | Sequence[Path | str],
    *,
    held_out: Sequence[Path | str] = (),
    time: str = "",
    drives: Sequence[str] = (),
    responses: Sequence[str] = (),
    time_unit: str = "",
    decimal: str = "",
    time_format: str = "",
    drive_until: bool = False,
    sheet: str | None = None,
    average: int = 1,
    overwrite: bool = False,
) -> NewStudy:
    """Make a study of tables as spreadsheets and loggers save them.

    Parameters: `folder`, where records and `study.toml` are written; `files` and `held_out`, tables to fit
    and to predict alone: text of any separator, encoding and decimal sign, or workbooks, of which `sheet`
    names the sheet; `average`, samples in turn whose mean is written in their place, where records are too
    long to be fitted whole: the notes state what that loses; `overwrite`, replace files that are there.
    Tables share their headers. What is ambiguous
    in headers and data is stated: `time`, `drives` and `responses`, columns by header, by header without its
    unit or by number, each perhaps with a new name, as in "heater [%]=Column B"; `time_unit` of a numeric
    time column, `decimal`, the decimal sign, and `time_format` of time stamps, as of `datetime.strptime`;
    `drive_until`, the drive of a row acted until its response was read, and does not hold from then on.

    InputError with everything that cannot be read or is ambiguous; then nothing is written.
    """
    folder = Path(folder)
    fitted = [Path(files)] if isinstance(files, Path | str) else [Path(one) for one in files]
    paths = [*fitted, *(Path(one) for one in held_out)]
    problems: list[str] = []
    tables: list[CellTable] = []
    for path in paths:
        with gathered(problems):
            tables.append(read_spreadsheet(path, sheet=sheet))
    stems = [path.stem for path in paths]
    problems += [
        f"{path}: another table is called {path.stem!r} too; rename one"
        for k, path in enumerate(paths)
        if path.stem in stems[:k]
    ]
    if not paths:
        problems.append("no table: name one or more files")
    refuse_if(problems)
    stated = Mapped(time, tuple(drives), tuple(responses), time_unit, decimal, time_format, drive_until)
    records, notes = convert(tables, stated)
    tables.clear()  # cells of 1e6 rows take 600 MB
    own, apart = records[: len(fitted)], records[len(fitted) :]
    study = Study(folder.resolve().name, fit=own, held_out=apart)
    if average != 1:
        means = averaged(study, average)
        study, notes = means, [*notes, *_losses(study, average)]
    warnings = unmet(study) or map(str, study.disagreements)
    result = NewStudy(study, tuple(notes), tuple(warnings))
    result.save(folder, overwrite=overwrite)
    return result


def _losses(study: Study, count: int) -> list[str]:
    """What means of `count` samples lose, and of twice as many where records hold two of these."""
    said = [f"Every sample written is the mean of {count}."]
    if unmet(study):  # nothing to fit yet
        return said
    fewest = min(record.sampled.size for record in (*study.fit, *study.held_out))
    losses = averaging_losses(study, (count, 2 * count) if fewest >= 4 * count else (count,))
    return [*said, *map(str, losses), "These losses are those of a plant of the fewest viscous terms."]
