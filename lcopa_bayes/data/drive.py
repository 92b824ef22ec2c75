"""Drives: what every axis is commanded to, and when; and the changes of one axis for the model.

    Drive.steps(x=[(0, 1.57), (20, 0.0)])              # times and values; other axes stay at rest
    Drive.of_arrays(time, x=values, units="rad", time_unit="ms")

A value holds from its time to the next one, as in a record. Units may be left out in Python: they are then
those of the study the drive is used with.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np
from numpy.typing import ArrayLike

from lcopa_bayes.core.arrays import Matrix, Vector, frozen
from lcopa_bayes.core.errors import InputError, nearest
from lcopa_bayes.core.rules import rebuilt
from lcopa_bayes.core.units import TIME_UNITS, in_time_unit
from lcopa_bayes.data.record import Axis, Columns, Driven, Record


@final
@dataclass(frozen=True, eq=False)
class AxisDrive:
    """Deviation of a drive from its resting value, as a sequence of changes."""

    times: Vector
    """Instants of change [time unit], increasing, (changes,)."""
    values: Vector
    """Deviation from rest after each change [drive unit], (changes,)."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", frozen(self.times, name="times"))
        object.__setattr__(self, "values", frozen(self.values, name="values"))

    @classmethod
    def of_rows(cls, time: Vector, rows: Vector) -> AxisDrive:
        """From a record's rows: a value holds from its row to the next; rest is the first row's."""
        changed = np.flatnonzero(np.diff(rows) != 0) + 1
        return cls(time[changed], rows[changed] - rows[0])

    @classmethod
    def of_jumps(cls, times: Vector, jumps: Vector) -> AxisDrive:
        """From jumps at any times, in any order; those at one instant are added, those of 0 left out."""
        times, jumps = times[jumps != 0], jumps[jumps != 0]
        at, where = np.unique(times, return_inverse=True)
        return cls(at, np.cumsum(np.bincount(where, weights=jumps, minlength=at.size)))

    def later(self, by: Vector | float) -> AxisDrive:
        """With every change later by a time [time unit], one or (changes,); they may change places."""
        at = self.times + by
        if (np.diff(at) > 0).all():
            return AxisDrive(at, self.values)
        return AxisDrive.of_jumps(at, self.jumps)

    @cached_property
    def jumps(self) -> Vector:
        """Change of the drive at each instant [drive unit], (changes,)."""
        return frozen(np.diff(self.values, prepend=0.0), name="jumps")

    @property
    def moves(self) -> bool:
        """Whether the drive ever leaves its resting value."""
        return self.times.size > 0

    def over(self, other: AxisDrive) -> float | None:
        """Factor by which this drive is `other`, to 1e-12 of every value; None when it is no multiple."""
        if not (self.moves and np.array_equal(self.times, other.times)) or other.values[0] == 0.0:
            return None
        factor = float(self.values[0] / other.values[0])
        close = np.allclose(self.values, factor * other.values, rtol=1e-12, atol=0.0)
        return factor if close and factor != 0.0 else None

    @cached_property
    def _pieces(self) -> tuple[Vector, Vector, Vector]:
        """Start of, value on, and integral up to each piece; a resting piece comes first."""
        integral = np.cumsum(self.values[:-1] * np.diff(self.times))
        return (
            np.concatenate(([0.0], self.times)),
            np.concatenate(([0.0], self.values)),
            np.concatenate(([0.0, 0.0], integral))[: self.times.size + 1],
        )

    def block_means(self, edges: Vector, delays: Vector) -> tuple[Matrix, Matrix]:
        """Exact means over the blocks between `edges` of the drive delayed by `delays`, and their slope.

        Parameters: edges (n+1,) equidistant [time unit]; delays (batch,) [time unit].
        Returns: means (batch, n) [drive unit] and their derivative in the delay, which jumps where a
        delayed change crosses an edge (the limit from shorter delays is returned).
        """
        late = edges - delays[:, None]
        piece = np.searchsorted(self.times, late.ravel(), side="right").reshape(late.shape)
        start, value, integral = self._pieces
        area = integral[piece] + value[piece] * (late - start[piece])
        width = edges[1] - edges[0]
        return np.diff(area, axis=1) / width, -np.diff(value[piece], axis=1) / width


def axis_drives(driven: Driven) -> tuple[AxisDrive, ...]:
    """Changes of every drive axis of a record or a drive, as deviations from its first row."""
    return tuple(AxisDrive.of_rows(driven.time, column) for column in driven.drive.T)


def first_change(driven: Driven) -> float:
    """Time of the first change of any drive axis; the first row's where none changes [time unit]."""
    starts = (float(one.times[0]) for one in axis_drives(driven) if one.moves)
    return min(starts, default=float(driven.time[0]))


_RESTING, _CLEAR, _LARGE, _WHOLE = 8, 4.0, 0.05, 0.4
"""Fewest samples before a change that show how a response scatters at rest [-], and what a sample has clearly
moved by: over their largest deviation, over the range of the response, and over what the next sample has, of
which a clock that errs by part of a row explains less [-]."""


def moved_with_drive(record: Record, axis: int) -> float:
    """How far a response has clearly moved in the very row in which a drive first changes; 0 where it has not
    [response unit].

    A drive holds from its row on, so that no plant has moved there yet: such a record has rows whose drive
    acted before the response was read.
    """
    moved = np.flatnonzero((record.drive != record.drive[0]).any(axis=1))
    seen = np.flatnonzero(np.isfinite(record.response[:, axis]))
    if not moved.size or moved[0] not in seen:
        return 0.0
    count = int(np.searchsorted(seen, moved[0]))
    if count < _RESTING or count + 1 == seen.size:
        return 0.0
    values = record.response[seen, axis]
    level = values[:count].mean()
    least = max(_CLEAR * float(np.abs(values[:count] - level).max()), _LARGE * float(np.ptp(values)))
    first, second = values[count : count + 2] - level
    clear = abs(first) > max(least, _WHOLE * abs(second)) and second * first > 0.0
    return float(first) if clear else 0.0


Units = str | Mapping[str, str] | None
"""One unit for all axes, one per axis by name, or none: those of the study."""


@final
@dataclass(frozen=True, eq=False)
class Drive:
    """Values of every drive axis over time; InputError with all that is wrong with them.

    Times must increase strictly, every number be finite, axes be distinct and units be known words.
    """

    name: str
    """What the prediction is called."""
    time: Vector
    """(n,) times from which the values hold [time_unit]."""
    values: Matrix
    """(n, axes) values [unit of the axis]; NaN, in a partial drive: the resting value."""
    axes: tuple[str, ...]
    """Name of each column of `values`."""
    units: tuple[str | None, ...]
    """Unit of each axis; None: the study's."""
    time_unit: str | None = None
    """One of `TIME_UNITS`; None: the study's."""
    rest: tuple[float | None, ...] = ()
    """Value of each axis before the first time [unit of the axis]; None: the resting value of the study. Left
    out, the first row is what the plant rests under, as in a record."""
    until: float | None = None
    """End of a prediction [time_unit]; None: as long after the last row as the study's longest record follows
    its first change."""
    partial: bool = False
    """Whether axes of the study that are not named here stay at rest; otherwise all must be named."""

    def __post_init__(self) -> None:
        problems = [f"the axis {a!r} is given twice" for a in sorted({*self.axes}) if self.axes.count(a) > 1]
        try:
            object.__setattr__(self, "time", frozen(self.time, name="time"))
            values = frozen(self.values, name="values", ndim=2, missing=self.partial)
            object.__setattr__(self, "values", values)
        except ValueError as error:
            raise _refused(self.name, [*problems, str(error)]) from None
        if self.values.shape != (self.time.size, len(self.axes)) or not self.values.size:
            problems.append(
                f"needs one or more times and one column per axis; got values of shape {self.values.shape} "
                f"for {self.time.size} times and {len(self.axes)} axes"
            )
        for k in np.flatnonzero(np.diff(self.time) <= 0)[:1]:
            problems.append(f"times must increase; {self.time[k + 1]:.6g} comes after {self.time[k]:.6g}")
        if self.time_unit is not None and self.time_unit not in TIME_UNITS:
            known = nearest(str(self.time_unit), TIME_UNITS)
            problems.append(f"unknown time unit {self.time_unit!r}{known}")
        if self.until is not None and self.time.size and not self.until >= self.time[-1]:
            problems.append(f"`until` must not be before the last row; got {self.until!r}")
        if not self.rest and not problems:
            object.__setattr__(self, "rest", tuple(float(value) for value in self.values[0]))
        wrong = [value for value in self.rest if value is not None and not np.isfinite(value)]
        if wrong or len(self.rest) != len(self.axes) or len(self.units) != len(self.axes):
            problems.append("give one finite resting value and one unit per axis")
        if problems:
            raise _refused(self.name, problems)

    @classmethod
    def steps(
        cls,
        changes: Mapping[str, Sequence[tuple[float, float]]] | None = None,
        /,
        *,
        units: Units = None,
        time_unit: str | None = None,
        rest: Mapping[str, float] | None = None,
        until: float | None = None,
        name: str = "drive",
        **axes: Sequence[tuple[float, float]],
    ) -> Drive:
        """Steps of each axis as pairs of time [time_unit] and the value from then on [unit of the axis].

        Axes are given by keyword, or by name in `changes` where a name is no keyword. Before its first change
        an axis is at rest: at the value in `rest`, else at the study's. `until` [time_unit] is the end of the
        prediction; without it, as long after the last change as the study's longest record follows its first.
        InputError as for the class, for an axis without changes, and for `rest` or `units` of an axis that is
        not given.
        """
        given = {**(changes or {}), **axes}
        problems = [f"axis {axis!r} has no (time, value)" for axis, change in given.items() if not change]
        problems += _unknown("rest", rest, given) + _unknown("units", units, given)
        if not given:
            problems.append("names no axis; give one, as in Drive.steps(x=[(0, 1.57)])")
        try:
            pairs = {axis: np.array(list(change), dtype=float) for axis, change in given.items()}
        except (TypeError, ValueError):
            pairs, problems = {}, [*problems, "steps are pairs of numbers (time, value)"]
        for axis, pair in pairs.items():
            if pair.size and (pair.ndim != 2 or pair.shape[1] != 2 or not np.isfinite(pair).all()):
                problems.append(f"axis {axis!r} needs pairs of finite numbers (time, value)")
            elif pair.size and (np.diff(pair[:, 0]) <= 0).any():
                problems.append(f"the times of axis {axis!r} must increase")
        if problems:
            raise _refused(name, problems)
        times = np.unique(np.concatenate([pair[:, 0] for pair in pairs.values()]))
        resting = tuple((rest or {}).get(axis) for axis in pairs)
        values = np.column_stack([_held(pair, times) for pair in pairs.values()])
        names = tuple(pairs)
        return cls(name, times, values, names, _units(units, names), time_unit, resting, until, partial=True)

    @classmethod
    def of_arrays(
        cls,
        time: ArrayLike,
        columns: Mapping[str, ArrayLike] | None = None,
        /,
        *,
        units: Units = None,
        time_unit: str | None = None,
        name: str = "drive",
        **axes: ArrayLike,
    ) -> Drive:
        """From times (n,) [time_unit] and one array (n,) per axis [unit of the axis].

        The plant rests under the first row; all axes of the study must be given. InputError as for the class.
        """
        given = {**(columns or {}), **axes}
        if problems := _unknown("units", units, given):
            raise _refused(name, problems)
        try:
            values = np.column_stack([np.asarray(column, dtype=float) for column in given.values()])
        except ValueError as error:
            raise _refused(name, [f"one number per time and axis is needed ({error})"]) from None
        names = tuple(given)
        at = np.asarray(time, dtype=float)
        last = float(at[-1]) if at.ndim == 1 and at.size else None
        return cls(name, at, values, names, _units(units, names), time_unit, until=last)

    @property
    def drive(self) -> Matrix:
        """`values` under the name that records give them."""
        return self.values

    def fitted_to(self, axes: Sequence[Axis], time_unit: str, rest: Sequence[float], period: float) -> Drive:
        """The drive with the axes of a study, in their order, and its time unit.

        Parameters: `rest` of each axis of the study [drive unit], taken where the drive states none; `period`
        [time unit], how long before its first change its row at rest is put. InputError for axes and
        units that are not the study's.
        """
        known = {axis.name: axis for axis in axes}
        problems = [
            f"the study has no drive axis {name!r}{nearest(name, known)}"
            for name in self.axes
            if name not in known
        ]
        problems += [
            f"axis {name!r} is in {unit}, in the study it is in {known[name].unit}; convert its values"
            for name, unit in zip(self.axes, self.units, strict=True)
            if name in known and unit not in (None, known[name].unit)
        ]
        absent = [axis for axis in axes if axis.name not in self.axes]
        if absent and not self.partial:
            which = ", ".join(f"{axis.name!r} [{axis.unit}]" for axis in absent)
            problems.append(f"the study's drive axis {which} is absent; add a column")
        if problems:
            raise _refused(self.name, problems)
        given = self.time_unit or time_unit
        time = in_time_unit(self.time, given, time_unit)
        until = None if self.until is None else float(in_time_unit(self.until, given, time_unit))
        resting = np.array(rest, dtype=float)
        values = np.tile(resting, (time.size, 1))
        for k, name in enumerate(self.axes):
            place = [axis.name for axis in axes].index(name)
            stated = self.rest[k]
            resting[place] = resting[place] if stated is None else stated
            values[:, place] = np.where(np.isnan(self.values[:, k]), resting[place], self.values[:, k])
        if (values[0] != resting).any():
            time, values = np.append(time[0] - period, time), np.vstack([resting, values])
        names, units = tuple(axis.name for axis in axes), tuple(axis.unit for axis in axes)
        return replace(
            self,
            time=time,
            values=values,
            axes=names,
            units=units,
            time_unit=time_unit,
            rest=tuple(float(value) for value in resting),
            until=until,
            partial=False,
        )

    def __repr__(self) -> str:
        """What it holds, without the numbers."""
        pairs = zip(self.axes, self.units, strict=True)
        axes = ", ".join(axis if unit is None else f"{axis} [{unit}]" for axis, unit in pairs)
        span = f"{self.time[0]:.6g} to {self.time[-1]:.6g} {self.time_unit or ''}".rstrip()
        return f"Drive({self.name!r}, {axes}, {self.time.size} rows from {span})"

    __reduce__ = rebuilt  # a copy in another process is locked too


def _refused(name: str, problems: Sequence[str]) -> InputError:
    """The error that names the drive in each of its problems."""
    return InputError([f"drive {name!r}: {problem}" for problem in problems])


def drive_of(columns: Columns) -> Drive:
    """Drive of a record file's columns."""
    names = tuple(axis.name for axis in columns.drive_axes)
    units = tuple(axis.unit for axis in columns.drive_axes)
    until = float(columns.time[-1])
    return Drive(columns.name, columns.time, columns.drive, names, units, columns.time_unit, until=until)


def _held(pair: Matrix, times: Vector) -> Vector:
    """Value of an axis at `times`; NaN before its first change, where it is at rest."""
    place = np.searchsorted(pair[:, 0], times, side="right")
    return np.asarray(np.append(np.nan, pair[:, 1])[place])


def _unknown(key: str, given: object, axes: Mapping[str, object]) -> list[str]:
    """Problems of a mapping that names axes the drive does not have."""
    named = given if isinstance(given, Mapping) else ()
    return [
        f"`{key}` names the axis {axis!r}, which is not given{nearest(axis, axes)}"
        for axis in named
        if axis not in axes
    ]


def _units(units: Units, axes: tuple[str, ...]) -> tuple[str | None, ...]:
    if isinstance(units, Mapping):
        return tuple(units.get(axis) for axis in axes)
    return (units,) * len(axes)
