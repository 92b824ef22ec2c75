"""The blocks a record is simulated on, and how its samples are read from them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import ceil
from typing import final

import numpy as np
from scipy.sparse import csr_array

from lcopa_bayes.arrays import Array, Vector

FEWEST_BLOCKS = 200
"""At 250 blocks over the paper's record the discretisation moves a posterior by < 0.1 sd, at 128 by 0.26."""
MOST_BLOCKS = 4096
"""Most blocks chosen by default when samples are not equidistant."""
_ALIGNED = 1e-6
"""Largest deviation from equidistance, in sampling periods, that still counts as equidistant."""


@final
@dataclass(frozen=True)
class Grid:
    """Equidistant blocks."""

    start: float
    """Left edge of the first block [time unit]."""
    step: float
    """Width of a block [time unit]."""
    n: int
    """Number of blocks."""

    @property
    def edges(self) -> Vector:
        """Block edges, (n+1,) [time unit]."""
        return self.start + self.step * np.arange(self.n + 1)


@final
@dataclass(frozen=True, eq=False)
class Reading:
    """Block means -> response at sample times; samples before the first block read 0 (rest)."""

    samples: int
    first: int
    """Samples before this one are taken at rest."""
    blocks: slice | None
    """Block of each later sample when every sample sits at a block midpoint."""
    matrix: csr_array | None
    """(samples - first, n) weights otherwise."""

    def __call__(self, means: Array) -> Array:
        """(batch, n) block means -> (batch, samples)."""
        read = means[:, self.blocks] if self.matrix is None else (self.matrix @ means.T).T
        if self.first == 0:
            return np.ascontiguousarray(read)
        out = np.zeros((means.shape[0], self.samples))
        out[:, self.first :] = read
        return out


@final
@dataclass(frozen=True, eq=False)
class Mesh:
    """Grid of a record with the reading of its sample times."""

    grid: Grid
    reading: Reading

    @classmethod
    def of_samples(
        cls, times: Vector, begin: float, *, blocks: int | None = None, exposure: float = 0.0
    ) -> Mesh:
        """For samples at `times`, when nothing moves before `begin` (the first drive change).

        Equidistant samples sit at block midpoints, where a block mean is second-order accurate
        (half a block off costs up to 0.9 posterior sd). Others are read by cubic interpolation of
        the running integral, which block means give exactly at the edges; so is an exposure, the
        mean over ``[t - exposure, t]``.

        Parameters: times (samples,) increasing [time unit]; blocks: at least so many blocks, or
        chosen from the samples; exposure [time unit] >= 0.
        """
        if times[-1] <= begin:
            begin = times[0]
        span = times[-1] - begin
        gaps = np.diff(times) if times.size > 1 else np.array([span])
        period = float(gaps.min())
        slots = (times - times[-1]) / period
        equidistant = np.abs(slots - np.round(slots)).max() < _ALIGNED * max(1.0, times.size)
        wanted = blocks or FEWEST_BLOCKS
        if equidistant and exposure == 0.0 and span / period < max(8 * MOST_BLOCKS, 2 * times.size):
            return cls._aligned(times, begin, period, max(1, ceil(wanted * period / span)))
        if blocks is None:
            wanted = int(np.clip(ceil(2 * span / period), FEWEST_BLOCKS, MOST_BLOCKS))
        step = span / wanted
        grid = Grid(begin, step, wanted + 2)  # two spare blocks so that the last sample is interior
        first = int(np.searchsorted(times, begin, side="right"))
        return cls(grid, Reading(times.size, first, None, _weights(grid, times[first:], exposure)))

    @classmethod
    def _aligned(cls, times: Vector, begin: float, period: float, split: int) -> Mesh:
        step = period / split
        slots = np.round((times - times[-1]) / period).astype(int) * split
        back = ceil((times[-1] - begin) / step - 0.5 + 1e-9)  # blocks from the one holding `begin` to the last
        first = int(np.searchsorted(times, begin, side="right"))
        kept = slots[first:] + back
        grid = Grid(times[-1] - (back + 0.5) * step, step, back + 1)
        if (np.diff(kept) == split).all():
            return cls(grid, Reading(times.size, first, slice(kept[0], None, split), None))
        picked = csr_array((np.ones(kept.size), (np.arange(kept.size), kept)), shape=(kept.size, grid.n))
        return cls(grid, Reading(times.size, first, None, picked))


def _weights(grid: Grid, times: Vector, exposure: float) -> csr_array:
    """Weights that read samples from block means through the running integral at the edges."""
    at = (times - grid.start) / grid.step
    if exposure > 0.0:
        width = exposure / grid.step
        nodes = np.floor(at - width).astype(int)[:, None] + np.arange(ceil(width) + 2)
        cover = np.minimum(at[:, None], nodes + 1) - np.maximum(at[:, None] - width, nodes)
        cover[(cover < 0) | (nodes < 0) | (nodes >= grid.n)] = 0.0  # at rest before the first block
        rows_index = np.repeat(np.arange(times.size), nodes.shape[1])
        nodes = np.clip(nodes, 0, grid.n - 1)
        shape = (times.size, grid.n)
        return csr_array(((cover / width).ravel(), (rows_index, nodes.ravel())), shape=shape)
    left = np.clip(np.floor(at).astype(int) - 1, 0, grid.n - 3)
    nodes = left[:, None] + np.arange(4)  # four edges around the sample
    slopes = _lagrange_slope(at[:, None] - nodes[:, :1], 4)
    # d/dt of the interpolated integral: sum_j slope_j A_j with A_j - A_{j-1} = means_{j-1}
    tail = np.cumsum(slopes[:, ::-1], axis=1)[:, ::-1][:, 1:]
    rows_index = np.repeat(np.arange(times.size), 3)
    return csr_array((tail.ravel(), (rows_index, nodes[:, :3].ravel())), shape=(times.size, grid.n))


def _lagrange_slope(x: Array, count: int) -> Array:
    """Derivative at x (samples, 1) of the Lagrange polynomials on nodes 0..count-1, (samples, count)."""
    nodes = np.arange(count, dtype=float)
    out = np.zeros((x.shape[0], count))
    for j in range(count):
        others = np.delete(nodes, j)
        for k in others:
            rest = others[others != k]
            out[:, j] += np.prod(x - rest, axis=1) / np.prod(nodes[j] - others)
    return out
