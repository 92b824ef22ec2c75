"""Block widths of a record, where its samples lie on them, and reading from fixed blocks.

Responses are computed on blocks that begin at the delayed change of the drive, wherever it falls (`Lattice`
says how the samples lie on them). Effects that act between drive and reading are computed on blocks at fixed
times (`Grid`), and only the change they make is read from there (`Reading`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import ceil
from typing import final

import numpy as np
from scipy.sparse import csr_array

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector

FEWEST_BLOCKS = 200
"""At 250 blocks over the paper's record the discretisation moves a posterior by < 0.1 sd, at 128 by 0.26."""
MOST_BLOCKS = 4096
"""Most blocks chosen by default when samples are not equidistant, or as many as there are samples."""
_ALIGNED = 1e-4
"""Largest deviation from equidistance, in sampling periods, that still counts as equidistant; a time
this wrong moves a response by less than 1e-7 rad at the paper's rates."""


_STAMPED = 5e-4
"""Distance from the lattice of the samples up to which a change of a drive is on it [blocks]: both are read
off time stamps, which may be rounded."""


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
        return np.asarray(self.start + self.step * np.arange(self.n + 1), dtype=float)


@final
@dataclass(frozen=True, eq=False)
class Reading:
    """Block means -> response at sample times; samples before the first block read 0 (rest)."""

    samples: int
    first: int
    """Samples before this one are taken at rest."""
    blocks: slice | None
    """Block of each later sample when every sample sits at a block midpoint; it has neighbours."""
    matrix: csr_array | None
    """(samples - first, n) weights otherwise."""

    def __call__(self, means: Array) -> Array:
        """(batch, n) block means -> (batch, samples)."""
        if self.matrix is None:  # value at a midpoint of the parabola with these three means
            middle = means[:, self.blocks]
            read: Array = middle * (26 / 24) - (means[:, self._left] + means[:, self._right]) / 24
        else:
            read = (self.matrix @ means.T).T
        if self.first == 0:
            return np.ascontiguousarray(read)
        out = np.zeros((means.shape[0], self.samples))
        out[:, self.first :] = read
        return out

    @cached_property
    def _left(self) -> slice:
        return self._beside(-1)

    @cached_property
    def _right(self) -> slice:
        return self._beside(1)

    def _beside(self, shift: int) -> slice:
        assert self.blocks is not None
        return slice(self.blocks.start + shift, self.blocks.stop + shift, self.blocks.step)


@final
@dataclass(frozen=True, eq=False)
class Lattice:
    """Sample times in units of the block width."""

    step: float
    """Width of a block [time unit]."""
    times: Vector
    """Sample times after the first drive change, (n,) [time unit]."""
    slots: Index | None
    """Whole blocks from the first of them to each; None when they are not equidistant."""
    exposure: float
    """Time over which a sample is a mean [time unit]."""

    def aligned(self, times: Vector) -> Vector:
        """Changes of a drive at `times` [time unit], those that rounding alone keeps from the lattice on it.

        Else the changes of 2048 rows every 0.48828125 ms, written to six decimals, would have 23 phases of
        the blocks, each of which is simulated by itself.
        """
        if self.slots is None or not self.slots.size:
            return times
        place = (times - self.times[0]) / self.step
        whole = np.round(place)
        return np.where(np.abs(place - whole) < _STAMPED, self.times[0] + self.step * whole, times)

    @cached_property
    def chosen(self) -> Index | slice:
        """`slots`, as a slice where it is one."""
        assert self.slots is not None
        if self.slots.size < 2:
            return slice(0, 1)
        gaps = np.diff(self.slots)
        even = (gaps == gaps[0]).all()
        return slice(0, int(self.slots[-1]) + 1, int(gaps[0])) if even else self.slots


@final
@dataclass(frozen=True, eq=False)
class Mesh:
    """Blocks of a record and the reading of its sample times."""

    grid: Grid
    reading: Reading
    lattice: Lattice

    def reads_like(self, other: Mesh) -> bool:
        """Whether both simulate the same blocks and read the same samples from block midpoints."""
        mine, its = self.reading, other.reading
        whole = mine.blocks is not None and mine.matrix is None and its.matrix is None
        return (
            whole
            and self.grid == other.grid
            and self.lattice.exposure == other.lattice.exposure
            and (mine.samples, mine.first, mine.blocks) == (its.samples, its.first, its.blocks)
        )

    @classmethod
    def of_samples(
        cls,
        times: Vector,
        begin: float,
        *,
        blocks: int | None = None,
        exposure: float = 0.0,
        refinement: int = 1,
        widest: float = np.inf,
    ) -> Mesh:
        """For samples at `times`, when nothing moves before `begin` (the first drive change).

        Equidistant samples sit at block midpoints (half a block off costs up to 0.9 posterior sd) and
        are read from the parabola with the means of three blocks. Others are read by cubic interpolation of
        the running integral, which block means give exactly at the edges; so is an exposure, the
        mean over ``[t - exposure, t]``.

        Parameters: times (samples,) increasing [time unit]; blocks: at least so many blocks, or
        chosen from the samples; exposure [time unit] >= 0; refinement: blocks are narrower by this factor,
        and by a further one where they would be wider than the `widest` [time unit].
        """
        mesh = cls._of_samples(times, begin, blocks, exposure, refinement)
        if not mesh.lattice.step > widest or times[-1] <= times[0]:
            return mesh
        further = ceil(mesh.lattice.step / widest)
        return cls._of_samples(times, begin, blocks, exposure, refinement * further)

    @classmethod
    def _of_samples(
        cls, times: Vector, begin: float, blocks: int | None, exposure: float, refinement: int
    ) -> Mesh:
        if times[-1] <= begin:
            begin = times[0]
        span = float(times[-1] - begin)
        first = int(np.searchsorted(times, begin, side="right"))
        if span == 0.0:  # a single sample, at rest
            nothing = Lattice(1.0, times[:0], times[:0].astype(int), exposure)
            return cls(Grid(begin, 1.0, 1), Reading(1, 1, slice(1, 1), None), nothing)
        reach = float(times[-1] - times[0]) or span
        closest = float(np.diff(times).min()) if times.size > 1 else span
        period = reach / round(reach / closest)  # of the lattice the samples may lie on
        slots = (times - times[-1]) / period
        equidistant = np.abs(slots - np.round(slots)).max() < _ALIGNED
        wanted = blocks or FEWEST_BLOCKS
        later = times[first:]
        if equidistant and span / period < max(8 * MOST_BLOCKS, 2 * times.size):
            split = refinement * max(1, ceil(wanted * period / span))
            places = np.round((later - later[0]) / period).astype(int) * split
            lattice = Lattice(_rounded(period / split), later, places, exposure)
            if exposure == 0.0:
                return cls._aligned(times, begin, period / split, lattice, first)
        else:
            if blocks is None:
                typical = float(np.median(np.diff(later))) if later.size > 1 else span
                wanted = int(np.clip(ceil(span / typical), FEWEST_BLOCKS, max(MOST_BLOCKS, times.size)))
            wanted *= refinement
            lattice = Lattice(_rounded(span / wanted), later, None, exposure)
        step = span / ceil(span / lattice.step - 1e-6)
        grid = Grid(begin, step, round(span / step) + 2)  # two spare blocks: the last sample is interior
        return cls(grid, Reading(times.size, first, None, _weights(grid, later, exposure)), lattice)

    @classmethod
    def _aligned(cls, times: Vector, begin: float, step: float, lattice: Lattice, first: int) -> Mesh:
        slots = lattice.slots
        assert slots is not None
        # blocks from the block of `begin` to that of the last sample
        back = ceil((times[-1] - begin) / step - 0.5 + 1e-9)
        kept = slots - slots[-1] + back + 1  # a spare block on either side: every sample has neighbours
        grid = Grid(times[-1] - (back + 1.5) * step, step, back + 3)
        gaps = np.diff(kept)
        if (gaps == gaps[:1]).all():
            blocks = slice(int(kept[0]), int(kept[-1]) + 1, int(gaps[0]) if gaps.size else 1)
            return cls(grid, Reading(times.size, first, blocks, None), lattice)
        row = np.repeat(np.arange(kept.size), 3)
        column = (kept[:, None] + np.arange(-1, 2)).ravel()
        weight = np.tile([-1 / 24, 26 / 24, -1 / 24], kept.size)
        weights = csr_array((weight, (row, column)), shape=(kept.size, grid.n))
        return cls(grid, Reading(times.size, first, None, weights), lattice)


def _rounded(step: float) -> float:
    """The same width for records whose sample times differ by rounding alone: they share step responses."""
    return float(f"{step:.11g}")


CUBIC = np.linalg.inv(np.vander(np.arange(4.0), increasing=True))
"""Coefficients, in rising powers, of the Lagrange polynomials on 0, 1, 2, 3, one per column."""


def _weights(grid: Grid, times: Vector, exposure: float) -> csr_array:
    """Weights that read samples from block means through the running integral at the edges."""
    at = (times - grid.start) / grid.step
    first, slopes = _through_integral(grid, at, derivative=True)
    parts = [(np.arange(3) + first[:, None], slopes)]
    if exposure > 0.0:
        width = exposure / grid.step
        first, late = _through_integral(grid, at, derivative=False)
        start, early = _through_integral(grid, np.maximum(at - width, 0.0), derivative=False)
        early[at < width] = 0.0  # at rest before the first block
        between = start[:, None] + np.arange(int((first - start).max()) + 1)
        whole = (between < first[:, None]).astype(float)
        parts = [
            (np.arange(3) + first[:, None], late / width),
            (np.arange(3) + start[:, None], -early / width),
            (np.minimum(between, grid.n - 1), whole / width),
        ]
    column, value = (np.concatenate(each, axis=1) for each in zip(*parts, strict=True))
    row = np.repeat(np.arange(times.size), column.shape[1])
    return csr_array((value.ravel(), (row, column.ravel())), shape=(times.size, grid.n))


def _through_integral(grid: Grid, at: Vector, *, derivative: bool) -> tuple[Index, Matrix]:
    """Running integral at positions `at` [blocks] beyond an edge, or the response there.

    Returns: the edge (positions,), and the weights of the three block means after it (positions, 3).
    """
    first = np.clip(np.floor(at).astype(int) - 1, 0, grid.n - 3)
    powers = np.vander(at - first, 4, increasing=True)
    if derivative:
        powers = np.arange(4) * np.concatenate((np.zeros((at.size, 1)), powers[:, :-1]), axis=1)
    nodes = powers @ CUBIC
    # sum_j nodes_j A_j, A_j = sum of the means before edge j: a mean counts at all edges after it
    return first, np.cumsum(nodes[:, :0:-1], axis=1)[:, ::-1]
