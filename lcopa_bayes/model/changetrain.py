"""Step responses superposed at changes of drives anywhere between equidistant samples, by convolution.

A reading is a sum over the five block means around it, so that those after a change are a convolution of
the block means with five weights, and those after many changes with one train of weights. Only right after
an onset, where readings are of finer blocks, the difference to these is added for each change by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import fft

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector
from lcopa_bayes.model.blockpulses import Circle, Spectrum
from lcopa_bayes.model.stepresponse import NEAR, SIDE, Kind, StepResponse, taps

_TOUCHED = SIDE + NEAR
"""Samples from the first that the weights of a change touch to the last that is read from finer blocks."""


@final
@dataclass(frozen=True, eq=False)
class Train:
    """Changes of the drive of a record."""

    origins: Matrix
    """Position of the first sample after each of them, (changes, batch) [blocks]."""
    jumps: Vector
    """Their sizes, (changes,) [drive unit]."""
    samples: int
    """Blocks that are read, one sample each [-]."""

    def earlier(self, width: float) -> Train:
        """The same read earlier by a time [blocks]."""
        return Train(self.origins - width, self.jumps, self.samples)


def plain_spectrum(means: Array, circle: Circle) -> Spectrum:
    """Transform of block means, (..., n), at the length of a circle but of radius one: a product of two
    finite series does not wrap around there, and is exact to rounding."""
    return np.asarray(fft.rfft(means, circle.length))


def superposed(
    response: StepResponse,
    spectrum: Spectrum,
    circle: Circle,
    trains: Sequence[Train],
    kind: Kind = "value",
) -> list[Array]:
    """Readings of `response` after the changes of each train, (rows, batch, samples) [drive unit].

    `spectrum` is the `plain_spectrum` of the block means. Zero before the first onset. Accuracy: that of
    `StepResponse.on_lattice`, and rounding of the largest reading.
    """
    placed = _Placed.of(trains, circle.n)
    around = taps(placed.theta, kind)
    weights = placed.weights(around, kind)
    total = fft.irfft(spectrum[:, None] * plain_spectrum(weights, circle), circle.length)[..., : placed.n]
    placed.correct(total, response, around, kind)
    out = []
    for number, train in enumerate(trains):
        read = np.zeros((*response.coarse.shape[:2], train.samples))
        ahead, unseen = placed.ahead(number)
        length = max(0, train.samples - unseen)
        read[..., unseen:] = total[:, number, :, ahead : ahead + length]
        out.append(read)
    return out


@final
@dataclass(frozen=True, eq=False)
class _Placed:
    """The changes of several trains on a lattice of their own, which begins SIDE samples before the first
    onset."""

    first: Index
    """First sample that is not before an onset, of each train, (trains,)."""
    place: Index
    """Samples from there to the first that is not before the onset of a change, (changes, batch)."""
    theta: Matrix
    """Position of that after the onset, (changes, batch) [blocks]."""
    jumps: Vector
    series: Index
    """Number of the train and plant, (changes, batch)."""
    begins: Index
    """First change of each train, (trains,)."""
    n: int
    """Samples of the lattice."""

    @classmethod
    def of(cls, trains: Sequence[Train], most: int) -> _Placed:
        """On `most` samples or fewer."""
        origins = np.concatenate([train.origins for train in trains])
        sizes = np.array([train.jumps.size for train in trains])
        start, begins = -np.floor(origins).astype(int), np.cumsum(sizes) - sizes
        first, batch = np.minimum.reduceat(start.min(axis=1), begins), origins.shape[1]
        number = np.repeat(np.arange(len(trains)), sizes)
        needed = [train.samples - int(at) + SIDE for train, at in zip(trains, first, strict=True)]
        return cls(
            first,
            start - first[number][:, None],
            origins + start,
            np.concatenate([train.jumps for train in trains]),
            number[:, None] * batch + np.arange(batch),
            begins,
            int(np.clip(max(needed), 1, most)),
        )

    def ahead(self, train: int) -> tuple[int, int]:
        """Samples of the lattice before the first of a train, and samples of that before the lattice."""
        first = int(self.first[train])
        return max(0, SIDE - first), max(0, first - SIDE)

    def weights(self, around: Array, kind: Kind) -> Array:
        """Weights of the block means in the readings, (trains, batch, n), from those of the means `around` a
        reading, (5, changes, batch)."""
        shifts = np.arange(2 * SIDE, -1, -1)[:, None, None]
        train = self._sums(self.place + shifts, self.jumps[:, None] * around)
        if kind == "integral":
            whole = np.broadcast_to(self.jumps[:, None], self.place.shape)
            train += np.cumsum(self._sums(self.place + SIDE + 1, whole), axis=-1)
        return train

    def correct(self, total: Array, response: StepResponse, around: Array, kind: Kind) -> None:
        """Add to readings by block means alone, (rows, trains, batch, n), what those right after each onset
        differ by, and make those before the first one zero; `around` as in `weights`."""
        rows, batch = len(total), self.place.shape[1]
        head = np.zeros((rows, batch, 2 * SIDE + _TOUCHED))
        means = response.coarse[:, :, :_TOUCHED]
        head[:, :, 2 * SIDE : 2 * SIDE + means.shape[2]] = means
        windows = sliding_window_view(head, 2 * SIDE + 1, axis=2)[:, None]
        beyond = -np.matmul(windows, np.moveaxis(around, 0, -1)[..., None])[..., 0]
        if kind == "integral":
            beyond[..., SIDE:] -= np.cumsum(head[:, None, :, 2 * SIDE - 1 : -SIDE - 1], axis=-1)
        beyond[..., SIDE:] += response.near(self.theta[..., None] + np.arange(NEAR), kind)
        beyond *= self.jumps[:, None, None]
        at = self.place + np.arange(_TOUCHED)[:, None, None]
        for row, change in zip(total, np.moveaxis(beyond, 3, 1), strict=True):
            row += self._sums(at, change)
        onset = np.minimum.reduceat(self.place, self.begins, axis=0) + SIDE
        total[:, np.arange(self.n) < onset[..., None]] = 0.0

    def _sums(self, at: Index, weights: Array) -> Array:
        """Sums of weights at places below n, (trains, batch, n), of both as (..., changes, batch)."""
        batch, inside = self.place.shape[1], at < self.n
        count = self.begins.size * batch * self.n
        sums = np.bincount((at + self.n * self.series)[inside], weights[inside], count)
        return np.asarray(sums.reshape(self.begins.size, batch, self.n), dtype=float)
