"""Records: time, drive and response of one experiment, and the tables that hold them.

A table is CSV or Parquet, one row per sample. A column is named ``role_axis_unit``: the role is all
before the first underscore, the unit all after the last one and the axis everything between, so
``drive_left_heater_pct`` is axis ``left_heater`` in ``pct``. The time column is ``time_<unit>``.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, TypeAlias, final

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from lcopa_bayes.core.arrays import Matrix, Vector, frozen
from lcopa_bayes.core.errors import InputError, gathered, nearest, refuse_if
from lcopa_bayes.core.files import write_whole
from lcopa_bayes.core.rules import rebuilt
from lcopa_bayes.core.units import TIME_UNITS, in_time_unit
from lcopa_bayes.data.cells import CHUNK, FORM, SUFFIXES, CellTable, frame_cells, read_cells, refuse

_ROLES = ("time", "drive", "response")


@final
@dataclass(frozen=True)
class Axis:
    """One column of drive or response: a free name, which may hold underscores, and a free unit."""

    name: str
    unit: str

    def __post_init__(self) -> None:
        for word in (self.name, self.unit):
            if not word or word != word.strip() or not word.isprintable():
                raise InputError(f"axis {self.name!r} in {self.unit!r}: both must be printable words")
        if "_" in self.unit:
            raise InputError(f"axis {self.name!r}: the unit {self.unit!r} must not hold an underscore")


class Driven(Protocol):
    """What a plant was, or is to be, driven with: a record, or a drive nobody has measured."""

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def time(self) -> Vector: ...  # noqa: D102
    @property
    def drive(self) -> Matrix: ...  # noqa: D102


@final
@dataclass(frozen=True, eq=False)
class Record:
    """One experiment, sampled uniformly or not; arrays are finite, checked and read-only.

    Raises InputError unless times increase strictly, there are two rows or more, one response sample
    or more, axes with distinct names in each role, and arrays that fit them.
    """

    name: str
    """Stem of the file."""
    time: Vector
    """(n,) sample times [time_unit]."""
    drive: Matrix
    """(n, n_drives) in the units of `drive_axes`; a value holds from its row to the next."""
    response: Matrix
    """(n, n_responses) in the units of `response_axes`; NaN is a sample that was not taken."""
    drive_axes: tuple[Axis, ...]
    """Name and unit of each column of `drive`."""
    response_axes: tuple[Axis, ...]
    """Name and unit of each column of `response`."""
    time_unit: str
    """One of `TIME_UNITS`."""

    def __post_init__(self) -> None:
        for key, ndim in (("time", 1), ("drive", 2), ("response", 2)):
            try:
                array = frozen(getattr(self, key), name=key, ndim=ndim, missing=key == "response")
            except ValueError as error:
                raise InputError(f"record {self.name!r}: {error}") from error
            object.__setattr__(self, key, array)
        names = [[axis.name for axis in axes] for axes in (self.drive_axes, self.response_axes)]
        got, fitting = (self.drive.shape, self.response.shape), tuple((self.time.size, len(k)) for k in names)
        wrong = (
            (self.time_unit not in TIME_UNITS, f"time unit {self.time_unit!r}; known: {[*TIME_UNITS]}"),
            (self.time.size < 2, "needs two or more rows"),
            ((self.time[1:] <= self.time[:-1]).any(), f"times must increase strictly [{self.time_unit}]"),
            (np.isnan(self.response).all(), "needs one or more response samples"),
            (any(len({*k}) < max(1, len(k)) for k in names), "needs axes with distinct names in each role"),
            (got != fitting, f"drive and response have shapes {got}; their axes and times need {fitting}"),
        )
        if any(is_so for is_so, _ in wrong):
            raise InputError([f"record {self.name!r}: {what}" for is_so, what in wrong if is_so])

    @property
    def sampled(self) -> Vector:
        """Times of rows in which some response was sampled, (n,) [time_unit]."""
        return self.time[np.isfinite(self.response).any(axis=1)]

    def begun(self, drive: Vector) -> Record:
        """The record after an early row with that `drive`, (drives,), and no response: what the plant rested
        under."""
        return replace(
            self,
            time=np.concatenate([[self._before], self.time]),
            drive=np.vstack([drive, self.drive]),
            response=np.vstack([np.full(self.response.shape[1], np.nan), self.response]),
        )

    @property
    def early_row(self) -> str:
        """How an early row with another drive is added, a clause."""
        at = f"{self._before:.6g} {self.time_unit}"
        return f"add a row before the first (time {at}, that drive, empty responses)"

    @property
    def _before(self) -> float:
        """Time of a row before the first [time_unit]."""
        return float(self.time[0] - np.median(np.diff(self.time)))

    def __repr__(self) -> str:
        """What it holds, without the numbers."""
        axes = ", ".join(
            f"{role} " + " ".join(f"{one.name} [{one.unit}]" for one in axes)
            for role, axes in (("drive", self.drive_axes), ("response", self.response_axes))
        )
        span = f"{self.time[0]:.6g} to {self.time[-1]:.6g} {self.time_unit}"
        return f"Record({self.name!r}, {axes}, {self.time.size} rows from {span})"

    __reduce__ = rebuilt  # a copy in another process is locked too


def _roles(table: CellTable, needed: Sequence[str] = _ROLES) -> tuple[str, dict[str, dict[int, Axis]]]:
    """Time unit, and the axis of every usable column by role; what is wrong joins `table.problems`."""
    result: dict[str, dict[int, Axis]] = {role: {} for role in _ROLES}
    for index, name in enumerate(table.names):
        role, _, rest = name.partition("_")
        axis, _, unit = ("time", "", rest) if role == "time" else rest.rpartition("_")
        if role not in _ROLES:
            problem = f"the role {role!r} is not known, columns are {FORM}{nearest(role, _ROLES)}"
        elif role == "time" and unit not in TIME_UNITS:
            problem = f"the time unit {unit!r} is not known{nearest(unit, TIME_UNITS)}"
        elif not (axis.strip() and unit.strip() and name.isprintable()):
            problem = f"expected {role}_<axis>_<unit>, as in {role}_x_rad"
        elif any(axis == other.name for other in result[role].values()):
            problem = f"the {role} of axis {axis!r}, or the time, has a column already; keep one"
        else:
            result[role][index] = Axis(axis.strip(), unit.strip())
            continue
        table.problems.append(f"{table.place(index)} (column {index + 1} of {len(table.names)}): {problem}")
    for role in needed:
        if not any(name.partition("_")[0] == role for name in table.names):
            table.problems.append(
                f"{table.path}: has no {role} column; columns are {FORM}; `lcopa-bayes new` converts others"
            )
    return next((axis.unit for axis in result["time"].values()), "s"), result


def _numbers(table: CellTable, column: int, *, missing: bool) -> Vector:
    """(n,) numbers of a column; a bad cell is NaN here and joins `table.problems`."""
    out, bad = np.full(len(table.rows), np.nan), []
    for row, cell in enumerate(table.columns[column]):
        text = cell.strip()
        try:
            value = float(text) if text and "_" not in text else math.nan  # float() takes 1_000
        except ValueError:
            value = math.inf
        if math.isfinite(value):
            out[row] = value
        elif not (missing and text.lower() in ("", "nan")):
            what = f"{text!r} is not a finite number" if text else "the cell is empty"
            needed = "a number, or nothing for a missing sample" if missing else "a number in every row"
            bad.append(f"{table.place(column, row)}: {what}; expected {needed}")
    table.add(bad, table.place(column))
    return out


@final
@dataclass(frozen=True, eq=False)
class Columns:
    """Columns of a record file by role."""

    name: str
    """Stem of the file."""
    time: Vector
    """(n,) [time_unit]."""
    drive: Matrix
    """(n, n_drives) in the units of `drive_axes`."""
    response: Matrix
    """(n, n_responses) in the units of `response_axes`; NaN is a sample that was not taken."""
    drive_axes: tuple[Axis, ...]
    response_axes: tuple[Axis, ...]
    time_unit: str

    @property
    def measured(self) -> bool:
        """Whether a response was sampled."""
        return bool(np.isfinite(self.response).any())


def load_columns(path: Path, time_unit: str | None = None, *, responses: bool = True) -> Columns:
    """Columns of a CSV or Parquet file; times come out in `time_unit`, by default the unit of the file.

    A file need not hold responses unless `responses`. Raises InputError with everything wrong in the file:
    place (file, line and column; in Parquet the row, counted from 1), what was found and what was expected,
    at most five per column and kind. Accuracy: numbers are read exactly; a converted time is off by half a
    unit in the last place.
    """
    if time_unit is not None and time_unit not in TIME_UNITS:
        raise InputError(f"unknown time unit {time_unit!r}{nearest(time_unit, TIME_UNITS)}")
    return _columns(read_cells(Path(path)), time_unit, responses=responses)


def _columns(table: CellTable, time_unit: str | None, *, responses: bool) -> Columns:
    """Columns of a table's cells; InputError with everything wrong in them."""
    n_rows = len(table.rows) if not table.problems else 2  # rows of another length are problems already
    given, axes = _roles(table, _ROLES if responses else _ROLES[:2])
    values = {role: [_numbers(table, j, missing=role == "response") for j in axes[role]] for role in _ROLES}
    for column, time in zip(axes["time"], values["time"], strict=True):
        late = [int(i) for i in np.flatnonzero(time[1:] <= time[:-1])]
        rule, advice = (
            "does not come after the time of the row before,",
            "sort the rows, keep one of two alike",
        )
        lines = [f"{table.place(column, i + 1)}: {time[i + 1]} {rule} {time[i]}; {advice}" for i in late]
        table.add(lines, table.place(column))
    if n_rows < 2:
        table.problems.append(f"{table.path}: has {n_rows} row(s) of data; a record needs two or more")
    if responses and not table.problems and np.isnan(values["response"]).all():
        table.problems.append(f"{table.path}: no response column holds a sample; a record needs one or more")
    refuse_if(table.problems)
    wanted = time_unit or given
    time = in_time_unit(values["time"][0], given, wanted)
    drive, response = (
        np.array(values[role]).reshape(-1, time.size).T.copy() for role in ("drive", "response")
    )
    both = tuple(axes["drive"].values()), tuple(axes["response"].values())
    return Columns(table.path.stem, time, drive, response, *both, wanted)


def columns_of(
    frame: pd.DataFrame, name: str, time_unit: str | None = None, *, responses: bool = True
) -> Columns:
    """`load_columns` of a frame whose columns are named as those of a file, under the name `name`."""
    return replace(_columns(frame_cells(frame, Path(name)), time_unit, responses=responses), name=name)


def load_record(path: Path, time_unit: str | None = None) -> Record:
    """Read a record from the CSV or Parquet file at `path`; times come out in `time_unit`, by default its
    own.

    InputError with everything wrong in the file; see `load_columns` for that and for accuracy.
    """
    return record_of(load_columns(path, time_unit))


def record_of(columns: Columns) -> Record:
    """Record of a file's columns; InputError where these make none."""
    arrays = (columns.time, columns.drive, columns.response)
    return Record(columns.name, *arrays, columns.drive_axes, columns.response_axes, columns.time_unit)


RecordLike: TypeAlias = Record | Path | str | pd.DataFrame | Mapping[str, ArrayLike]
"""A record, a record file, or a frame or arrays whose columns are named as those of a file."""


def records_of(
    given: RecordLike | Iterable[RecordLike], time_unit: str | None = None, *, called: str = "record"
) -> tuple[Record, ...]:
    """Records of files, frames, arrays or records themselves, with times in `time_unit` or their own.

    Frames and arrays have columns ``time_<unit>``, ``drive_<axis>_<unit>`` and ``response_<axis>_<unit>``,
    each (n,), NaN where a response was not sampled; their name is the frame's ``attrs["name"]``, else
    `called` and a number from 1. InputError with everything wrong in all of them.
    """
    out: list[Record] = []
    problems: list[str] = []
    for number, one in enumerate(several(given), start=1):
        with gathered(problems):
            out.append(_record_of_any(one, time_unit, f"{called}-{number}"))
    refuse_if(problems)
    return tuple(out)


def several(given: RecordLike | Iterable[RecordLike]) -> list[RecordLike]:
    """One or several records, always as a list."""
    return [given] if isinstance(given, Record | Path | str | pd.DataFrame | Mapping) else list(given)


def _record_of_any(one: RecordLike, time_unit: str | None, name: str) -> Record:
    if isinstance(one, Record):
        if time_unit in (None, one.time_unit):
            return one
        return replace(
            one, time=in_time_unit(one.time, one.time_unit, str(time_unit)), time_unit=str(time_unit)
        )
    if isinstance(one, Path | str):
        return load_record(Path(one), time_unit)
    try:
        frame = one if isinstance(one, pd.DataFrame) else pd.DataFrame(dict(one))
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{name}: expected a record, a path, a frame or a mapping of arrays of one length, such as "
            f"{{'time_ms': ..., 'drive_x_rad': ..., 'response_x_rad': ...}} ({error})"
        ) from None
    stated = str(frame.attrs.get("name", name))
    return record_of(columns_of(frame, stated, time_unit))


def save_record(record: Record, path: Path) -> None:
    """Write a record as CSV or Parquet, by suffix; every number reads back exactly, NaN is an empty cell.

    The file appears whole or not at all. Raises InputError when it cannot be written there.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        refuse(path, f"expected a name ending in {' or '.join(SUFFIXES)}")
    columns = {f"time_{record.time_unit}": record.time}
    columns |= {f"drive_{a.name}_{a.unit}": v for a, v in zip(record.drive_axes, record.drive.T, strict=True)}
    responses = zip(record.response_axes, record.response.T, strict=True)
    columns |= {f"response_{axis.name}_{axis.unit}": values for axis, values in responses}

    def write(beside: Path) -> None:
        if path.suffix.lower() != ".csv":
            return pd.DataFrame(columns).to_parquet(beside, index=False)
        with beside.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(columns)
            for first in range(0, record.time.size, CHUNK):
                rows = zip(*(v[first : first + CHUNK].tolist() for v in columns.values()), strict=True)
                writer.writerows(["" if math.isnan(v) else repr(v) for v in row] for row in rows)

    write_whole(path, write)
