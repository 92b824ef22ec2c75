"""Observed samples of a set of records, arranged for the likelihood."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Flags, Index, Matrix, Vector
from lcopa_bayes.data.record import Record

_ROUNDED = 1e-4
"""Deviation from whole sampling periods that rounded time stamps explain [sampling periods]."""
BEFORE_DRIVE = "samples before the drive acts"
_FEWEST = 8
"""Fewer samples before the drive moves, or changes of it, do not show whether a record begins at rest [-]."""
"""Source of an offset."""


@final
@dataclass(frozen=True, eq=False)
class Observed:
    """Samples of one response axis in one record."""

    index: Index
    """Position of each sample among the record's sample times."""
    values: Vector
    """[response unit]."""
    gaps: Vector
    """Time since the previous sample, in sampling periods; 1 for the first."""

    @cached_property
    def chosen(self) -> Index | slice:
        """`index`, as a slice where it is one: taking a slice copies nothing."""
        if not self.index.size:
            return self.index
        first, last = int(self.index[0]), int(self.index[-1]) + 1
        return slice(first, last) if last - first == self.index.size else self.index


@final
@dataclass(frozen=True, eq=False)
class Samples:
    """All samples of one record."""

    record: Record
    times: Vector
    """Times at which any axis was sampled [time unit]."""
    axes: tuple[Observed, ...]
    """One per response axis."""

    @classmethod
    def of(cls, record: Record, period: float) -> Samples:
        """Samples of a record; gaps are counted in `period` [time unit], and whole periods where they are as
        good as whole: time stamps are rounded."""
        taken = ~np.isnan(record.response)
        rows = np.flatnonzero(taken.any(axis=1))
        times = record.time[rows]
        axes = []
        for axis in range(record.response.shape[1]):
            index = np.flatnonzero(taken[rows, axis])
            at = times[index]
            gaps = np.concatenate(([1.0], np.diff(at) / period))[: at.size]
            gaps = np.where(np.abs(gaps - np.round(gaps)) < _ROUNDED, np.round(gaps), gaps)
            axes.append(Observed(index, record.response[rows[index], axis], gaps))
        return cls(record, times, tuple(axes))

    @cached_property
    def first_change(self) -> float:
        """Time of the first drive change, infinite when there is none [time unit]."""
        drive = self.record.drive
        moved = np.flatnonzero((drive != drive[0]).any(axis=1))
        return float(self.record.time[moved[0]]) if moved.size else np.inf

    def quiet(self, axis: int) -> Observed:
        """Samples of an axis taken before any drive change can have acted, that at the change included."""
        observed = self.axes[axis]
        n = int(np.searchsorted(self.times[observed.index], self.first_change, side="right"))
        return Observed(observed.index[:n], observed.values[:n], observed.gaps[:n])

    def level_samples(self, axis: int) -> tuple[Flags, str]:
        """Samples of an axis that give the offset of a record that was not fitted, and what they are."""
        quiet = self.times[self.axes[axis].index] <= self.first_change
        if quiet.all():
            return (
                quiet,
                "all samples of the held-out record, whose drive does not change before the last of them",
            )
        if not quiet.any():
            return ~quiet, "all samples of the held-out record, none of which is before the drive acts"
        if np.count_nonzero(quiet) < _FEWEST and self._moving:
            return np.ones_like(quiet), "all samples of the held-out record, whose drive moves from the start"
        return quiet, BEFORE_DRIVE

    @property
    def _moving(self) -> bool:
        """Whether the drive changes again and again, first before it has held for twice its usual time.

        Then it may have moved before the record too, unless an early row without a response states what the
        plant rested under.
        """
        drive, response = self.record.drive, self.record.response
        changes = self.record.time[1:][(np.diff(drive, axis=0) != 0).any(axis=1)]
        stated = bool(np.isnan(response[0]).all())
        still = self.first_change - self.record.time[0]
        return not stated and changes.size >= _FEWEST and bool(still < 2 * np.median(np.diff(changes)))

    def matrix(self) -> Matrix:
        """Responses at `times`, (samples, axes), NaN where missing [response unit]."""
        out = np.full((self.times.size, len(self.axes)), np.nan)
        for axis, observed in enumerate(self.axes):
            out[observed.index, axis] = observed.values
        return out


def sampling_period(records: Sequence[Record]) -> float:
    """Median time between samples over the records [time unit]; the unit in which noise correlates."""
    steps = [np.diff(record.time[~np.isnan(record.response).all(axis=1)]) for record in records]
    return float(np.median(np.concatenate(steps)))
