"""A drive that is constant between its changes, and its block means under a continuous delay."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector, frozen


@final
@dataclass(frozen=True, eq=False)
class Drive:
    """Deviation of a drive from its resting value, as a sequence of changes.

    Raises ValueError unless times and values are finite, as many, and the times increase.
    """

    times: Vector
    """Instants of change [time unit], increasing, (changes,)."""
    values: Vector
    """Deviation from rest after each change [drive unit], (changes,)."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", frozen(self.times, name="times"))
        object.__setattr__(self, "values", frozen(self.values, name="values"))
        if self.times.shape != self.values.shape:
            raise ValueError(f"one value per change; got {self.values.size} for {self.times.size} changes")
        if (np.diff(self.times) <= 0).any():
            raise ValueError("`times` of a drive must increase")

    @classmethod
    def of_rows(cls, time: Vector, rows: Vector) -> Drive:
        """From a record's rows: a value holds from its row to the next; rest is the first row's."""
        changed = np.flatnonzero(np.diff(rows) != 0) + 1
        return cls(time[changed], rows[changed] - rows[0])

    @property
    def moves(self) -> bool:
        """Whether the drive ever leaves its resting value."""
        return self.times.size > 0

    def over(self, other: Drive) -> float | None:
        """Factor by which this drive is `other`, to 1e-12 of every value; None when it is no multiple."""
        if not (self.moves and np.array_equal(self.times, other.times)) or other.values[0] == 0.0:
            return None
        factor = float(self.values[0] / other.values[0])
        close = np.allclose(self.values, factor * other.values, rtol=1e-12, atol=0.0)
        return factor if close and factor != 0.0 else None

    @cached_property
    def _pieces(self) -> tuple[Vector, Vector, Vector]:
        """Start of, value on, and integral up to each piece; a resting piece stands in front."""
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


def sorted_jumps(times: Vector, jumps: Vector) -> Drive:
    """Drive with these changes, in any order; changes at one instant are added, those of 0 left out."""
    times, jumps = times[jumps != 0], jumps[jumps != 0]
    at, where = np.unique(times, return_inverse=True)
    return Drive(at, np.cumsum(np.bincount(where, weights=jumps, minlength=at.size)))
