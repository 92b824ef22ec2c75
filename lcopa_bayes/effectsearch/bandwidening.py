"""Bands of a model known to lack something: wider by the power its residual has beyond noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Flags, Vector
from lcopa_bayes.effectsearch.noiselaw import Law
from lcopa_bayes.effectsearch.whitening import parts
from lcopa_bayes.inference.observations import Samples

_BINS = 12
_INFLATION = 1.5
"""Factor on the excess power for records not fitted, as a prototype measured it [-]."""


def since_command(record: Samples) -> Vector:
    """Time of each sample since the last change of any drive, (samples,) [time unit]; NaN before the
    first."""
    drive, time = record.record.drive, record.record.time
    changed = time[1:][(np.diff(drive, axis=0) != 0).any(axis=1)]
    last = np.searchsorted(changed, record.times, side="right") - 1
    out = np.full(record.times.size, np.nan)
    out[last >= 0] = record.times[last >= 0] - changed[last[last >= 0]]
    return out


@final
@dataclass(frozen=True, eq=False)
class Widening:
    """Excess variance of the residual by time since the last command, per axis, and where it is known."""

    edges: Vector
    """Bin edges of the time since the last command, (bins + 1,) [time unit]."""
    excess: tuple[Vector, ...]
    """Per axis, mean square residual less noise, times 1.5, (bins,) [response unit^2]."""
    reach: Vector
    """Smallest and largest value of every drive on the fit records, (drives, 2) [drive unit]."""

    @classmethod
    def of(cls, samples: Sequence[Samples], residual: Vector, noise: Sequence[Law]) -> Widening:
        """From the stacked residual of the fit records [response unit]."""
        times = [since_command(record) for record in samples]
        pooled = np.concatenate([t[np.isfinite(t)] for t in times])
        shares = np.linspace(0, 1, _BINS + 1)
        edges = np.unique(np.quantile(pooled, shares)) if pooled.size else np.zeros(1)
        if edges.size < 2:  # a drive that changes with every sample: one bin for all
            edges = np.array([edges[0], edges[0] + max(abs(edges[0]), 1e-9)])
        excess = []
        for axis, process in enumerate(noise):
            own = parts(samples, axis)
            at = np.concatenate([times[part.record][part.observed.index] for part in own])
            squares = np.concatenate([residual[part.rows] ** 2 for part in own])
            known = np.isfinite(at)
            bins = np.clip(np.searchsorted(edges, at[known], side="right") - 1, 0, edges.size - 2)
            total, count = (np.bincount(bins, one, edges.size - 1) for one in (squares[known], None))
            mean = np.divide(total, count, out=np.zeros_like(total), where=count > 0)
            beyond = mean - process.sd**2
            excess.append(_INFLATION * np.where(beyond > 0, beyond, 0.0))
        drive = np.concatenate([record.record.drive for record in samples])
        return cls(edges, tuple(excess), np.stack([drive.min(axis=0), drive.max(axis=0)], axis=1))

    def variance(self, record: Samples, axis: int) -> Vector:
        """Excess variance at an axis' samples, (n,) [response unit^2]; NaN outside the excited range."""
        at = since_command(record)[record.axes[axis].index]
        out = np.zeros(at.size)
        known = np.isfinite(at)
        bins = np.searchsorted(self.edges, at[known], side="right") - 1
        out[known] = self.excess[axis][np.clip(bins, 0, self.edges.size - 2)]
        out[self.outside(record)[record.axes[axis].index]] = np.nan
        return out

    def outside(self, record: Samples) -> Flags:
        """Samples at or after a drive beyond those of the fit, or longer after a command than any of it."""
        drive = record.record.drive
        tolerance = 1e-9 * np.maximum(np.abs(self.reach).max(axis=1), 1e-300)
        beyond = ((drive < self.reach[:, 0] - tolerance) | (drive > self.reach[:, 1] + tolerance)).any(axis=1)
        reached = np.flatnonzero(beyond)
        late = since_command(record) > self.edges[-1]
        after = record.times >= (record.record.time[reached[0]] if reached.size else np.inf)
        return np.asarray(after | late)
