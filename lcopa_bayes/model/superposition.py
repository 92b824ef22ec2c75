"""A record's response to a unit of drive: step responses superposed at the delayed changes of the drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from math import ceil
from typing import final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.model.blockpulses import Circle, Spectrum
from lcopa_bayes.model.changetrain import Train, plain_spectrum, superposed
from lcopa_bayes.model.grid import Lattice
from lcopa_bayes.model.stepresponse import Kind, StepResponse

SPARE = 5
"""Blocks beyond the last sample: what reading needs on either side, and one for rounding."""
_SAME_PHASE = 1e-7
"""Changes whose distance deviates from whole blocks by less than this share a phase [blocks]."""
_ROUNDED = 1e-4
"""The same where there are too many phases: time stamps may have been rounded [blocks]."""
_PHASES, _MANY = 24, 512
"""Phases of a drive that are kept apart, and those where samples are equidistant; further changes off the
lattice are shared out between the two blocks around them, as block means of the drive would be."""
_SHARED = 0.5
"""Share of all changes of a drive beyond which none are kept apart [-]."""
_PLACES = round(1.0 / _SAME_PHASE)
_TOGETHER = 1 << 17
"""Numbers of a step response times phases or changes that are read at once; more no longer fit the cache."""
_KEPT = 1 << 16
"""Blocks up to which the spectrum of a phase is kept: those of 24 phases are no more than 25 MB."""
_HELD = 1 << 19
"""Numbers read of the step response of a single plant that are kept for other commands: 4 MB."""
_APART = 6
"""Places of the samples in a block after phases of few changes up to which each is read by itself [-]; more
are convolved together. With 24 that takes a third of the time, with 3 a seventh more."""
_INTEGRATED: dict[Kind, Kind] = {"value": "integral", "slope": "value"}
"""What the mean over an exposure is a difference of."""
_ADDED = 10
"""Changes of one phase that are added one by one; more are convolved on the circle."""


@final
@dataclass(frozen=True, eq=False)
class Phase:
    """Changes of a drive that are whole blocks apart."""

    time: float
    """First of them [time unit]."""
    blocks: Index
    """Whole blocks from there to each, increasing."""
    jumps: Vector
    """Change of the drive at each [drive unit]."""
    spectra: dict[int, Spectrum] = field(default_factory=dict, repr=False)
    """Spectra of the jumps by the number of blocks, where these are few."""

    def spectrum(self, circle: Circle) -> Spectrum:
        """Spectrum of the jumps on the blocks of `circle`; those beyond its last block are left out."""
        if circle.n in self.spectra:
            return self.spectra[circle.n]
        train = np.zeros(circle.n)
        inside = self.blocks < circle.n
        np.add.at(train, self.blocks[inside], self.jumps[inside])  # two changes may share a block
        spectrum = circle.spectrum(train)
        if circle.n <= _KEPT:
            self.spectra[circle.n] = spectrum
        return spectrum


def phases(drive: AxisDrive, step: float, *, even: bool = False) -> tuple[Phase, ...]:
    """The changes of a drive by phase on blocks of width `step` [time unit], read at samples that are `even`
    where they are equidistant.

    Of more phases than are kept apart those of the largest changes are, and the rest are shared out: small
    changes that an effect adds to the commands leave the response to these as it is, or its derivative would
    be one of how they were read. Where most would be shared out all are, which is hardly less exact.
    """
    jumps = drive.jumps
    place = (drive.times - drive.times[0]) / step
    for tolerance in (_SAME_PHASE, _ROUNDED):
        sequence = np.argsort(-np.abs(jumps), kind="stable")
        groups, rest = _alike(place, sequence, tolerance, _MANY if even else _PHASES)
        if not rest.size:
            break
    if np.abs(jumps[rest]).sum() > _SHARED * np.abs(jumps).sum():
        groups, rest = [], np.arange(place.size)
    out = [
        Phase(
            float(drive.times[members[0]]),
            np.round(place[members] - place[members[0]]).astype(int),
            jumps[members],
        )
        for members in sorted(map(np.sort, groups), key=lambda members: int(members[0]))
    ]
    if rest.size:
        rest = np.sort(rest)
        begin = place[rest[0]]
        below = np.floor(place[rest] - begin).astype(int)
        share = place[rest] - begin - below
        at, where = np.unique(np.concatenate((below, below + 1)), return_inverse=True)
        weights = np.concatenate(((1 - share) * jumps[rest], share * jumps[rest]))
        shared = np.asarray(np.bincount(where, weights=weights), dtype=float)
        out.append(Phase(float(drive.times[rest[0]]), at, shared))
    return tuple(out)


def _alike(place: Vector, sequence: Index, tolerance: float, most: int) -> tuple[list[Index], Index]:
    """Positions by phase, at most so many of them, phases in the order of `sequence`, and what is left."""
    beyond = place - np.round(place)
    groups: list[Index] = []
    rest = sequence
    while rest.size and len(groups) < most:
        apart = np.abs(beyond[rest] - beyond[rest[0]])
        same = np.minimum(apart, 1.0 - apart) < tolerance
        groups.append(rest[same])
        rest = rest[~same]
    return groups, rest


def blocks_of(lattice: Lattice, begin: float) -> int:
    """Blocks that a step response needs from `begin` [time unit] to the last sample."""
    return ceil((float(lattice.times[-1]) - begin) / lattice.step) + SPARE if lattice.times.size else SPARE


@final
@dataclass(frozen=True, eq=False)
class Changes:
    """Changes of one drive of a record, and where its samples lie: all that does not depend on a plant."""

    phases: tuple[Phase, ...]
    lattice: Lattice

    @cached_property
    def dense(self) -> tuple[Phase, ...]:
        """Phases of many changes."""
        return tuple(phase for phase in self.phases if phase.blocks.size > _ADDED)

    @cached_property
    def sparse(self) -> tuple[Vector, Vector]:
        """Times [time unit] and sizes [drive unit] of all changes of the other phases, (changes,) each."""
        few = [phase for phase in self.phases if phase.blocks.size <= _ADDED]
        nothing = [np.empty(0)]
        times = nothing + [phase.time + self.lattice.step * phase.blocks for phase in few]
        return np.concatenate(times), np.concatenate(nothing + [phase.jumps for phase in few])

    @cached_property
    def places(self) -> frozenset[int]:
        """Places in a block that samples have after the latter, where they are equidistant."""
        if self.lattice.slots is None or not self.lattice.times.size:
            return frozenset()
        lags = (self.lattice.times[0] - self.sparse[0]) / self.lattice.step % 1.0
        return frozenset((np.round(lags / _SAME_PHASE).astype(int) % _PLACES).tolist())


@final
@dataclass(frozen=True, eq=False)
class _Read:
    """A step response on the lattice of a record."""

    origin: Vector
    """Position of the first sample, (batch,) [blocks after the onset]."""
    padded: Array
    """As many zeros, then readings at ``origin - floor(origin) + k``, (rows, batch, 2 n)."""

    @classmethod
    def of(cls, origin: Vector, readings: Array) -> _Read:
        """Readings from the onset on, (rows, batch, n)."""
        padded = np.zeros((*readings.shape[:2], 2 * readings.shape[2]))
        padded[:, :, readings.shape[2] :] = readings
        return cls(origin, padded)

    @property
    def size(self) -> int:
        """Readings from the onset on."""
        return int(self.padded.shape[2]) // 2

    def take(self, start: Index, slots: Index | slice, length: int) -> Array:
        """Readings at ``start + slot``, (rows, batch, slots); zero before the onset.

        Parameters: start (batch,); slots increasing from 0, the last of them length - 1.
        """
        last = self.padded.shape[2] - length
        if start.size == 1:
            begin = min(max(int(start[0]) + self.size, 0), last)
            return self.padded[:, :, begin : begin + length][:, :, slots]
        first = np.clip(start + self.size, 0, last)
        windows = sliding_window_view(self.padded, length, axis=2)
        return np.asarray(windows[:, np.arange(start.size), first][:, :, slots])


@final
@dataclass(frozen=True, eq=False)
class Superposition:
    """Responses of elements to drives, for one batch of plants; what records share is read once."""

    circle: Circle
    """Of the step responses' blocks."""
    kept: dict[tuple[object, ...], _Read] = field(default_factory=dict)
    """Readings by what they are of and by the place of the samples in a block."""
    spectra: dict[int, Spectrum] = field(default_factory=dict)
    """Transforms of block means by element."""

    def __call__(
        self,
        response: StepResponse,
        records: Sequence[Changes],
        delays: Vector,
        key: tuple[int, int],
        kind: Kind = "value",
    ) -> list[Array]:
        """Readings of `response` under the delayed changes of each record, (rows, batch, samples) [drive
        unit].

        Parameters: delays (batch,) [time unit]; key: element and delay slot, the same for the same
        `response` and `delays`; kind "slope" reads the derivative per block instead.
        """
        shape = response.coarse.shape[:2]
        out = [np.zeros((*shape, changes.lattice.times.size)) for changes in records]
        scattered: dict[float, list[tuple[Array, Changes]]] = {}
        apart = len(frozenset().union(*(changes.places for changes in records))) > _APART
        for target, changes in zip(out, records, strict=True):
            lattice, one_by_one = changes.lattice, changes.phases
            if not lattice.times.size:
                continue
            if lattice.slots is None:
                self._add_anywhere(target, response, changes, delays, kind)
                continue
            if apart:
                one_by_one = changes.dense
                if changes.places:
                    scattered.setdefault(lattice.exposure, []).append((target, changes))
            begins = np.array([phase.time for phase in one_by_one])
            origins = (lattice.times[0] - begins[:, None] - delays) / lattice.step
            for phase, origin, read in zip(
                one_by_one, origins, self._reads(response, origins, lattice, key, kind), strict=True
            ):
                self._add_on_lattice(target, phase, origin, read, lattice)
        together = max(1, _TOGETHER // (self.circle.n * shape[0] * shape[1]))
        for alike in scattered.values():
            for begin in range(0, len(alike), together):
                self._add_scattered(alike[begin : begin + together], response, delays, key[0], kind)
        return out

    def _add_scattered(
        self,
        records: Sequence[tuple[Array, Changes]],
        response: StepResponse,
        delays: Vector,
        element: int,
        kind: Kind,
    ) -> None:
        """Add the response to many phases of few changes at equidistant sample times of one exposure."""
        trains = []
        for _, changes in records:
            lattice, (times, jumps) = changes.lattice, changes.sparse
            assert lattice.slots is not None
            origins = (lattice.times[0] - times[:, None] - delays) / lattice.step
            trains.append(Train(origins, jumps, int(lattice.slots[-1]) + 1))
        rows = len(response.coarse)
        if element not in self.spectra or len(self.spectra[element]) < rows:
            self.spectra[element] = plain_spectrum(response.coarse, self.circle)
        read = partial(superposed, response, self.spectra[element][:rows], self.circle)
        width = lattice.exposure / lattice.step
        if width == 0.0:
            found = read(trains, kind)
        else:
            late = read(trains, _INTEGRATED[kind])
            early = read([train.earlier(width) for train in trains], _INTEGRATED[kind])
            found = [(one - other) / width for one, other in zip(late, early, strict=True)]
        for (target, changes), readings in zip(records, found, strict=True):
            target += readings[..., changes.lattice.chosen]

    def _add_anywhere(
        self,
        out: Array,
        response: StepResponse,
        changes: Changes,
        delays: Vector,
        kind: Kind,
    ) -> None:
        """Add the response to the changes at sample times of any spacing."""
        lattice, (every, jump) = changes.lattice, changes.sparse
        for phase in changes.dense:
            onset = phase.time + delays[:, None]
            out += _read_anywhere(self._convolved(response, phase), lattice, onset, kind)
        rows, batch, samples = out.shape
        together = max(1, _TOGETHER // out.size)
        for first in range(0, every.size, together):
            some = slice(first, first + together)
            onsets = every[some] + delays[:, None]
            reading = _read_anywhere(response, lattice, onsets, kind)
            out += np.matmul(jump[some], reading.reshape(rows, batch, -1, samples))

    def _convolved(self, response: StepResponse, phase: Phase) -> StepResponse:
        """Response to all changes of a phase as block means; its onsets are read as the blocks have them."""
        spectrum = self.circle.spectrum(response.coarse) * phase.spectrum(self.circle)
        return response.beyond(self.circle.coefficients(spectrum))

    def _add_on_lattice(
        self, out: Array, phase: Phase, origin: Vector, read: _Read, lattice: Lattice
    ) -> None:
        """Add the response to one phase at equidistant sample times, the first at `origin` of it."""
        # a reading of another record or phase may be a whole number of blocks away
        start = np.floor(read.origin).astype(int) + round(float(origin[0] - read.origin[0]))
        assert lattice.slots is not None
        length = int(lattice.slots[-1]) + 1
        if phase.blocks.size > _ADDED:
            missing = ((0, 0), (0, 0), (0, self.circle.n - read.size))
            spectrum = self.circle.spectrum(np.pad(read.padded[:, :, read.size :], missing))
            total = self.circle.coefficients(spectrum * phase.spectrum(self.circle))
            out += _Read.of(read.origin, total).take(start, lattice.chosen, length)
            return
        for shift, jump in zip(phase.blocks, phase.jumps, strict=True):
            out += jump * read.take(start - shift, lattice.chosen, length)

    def _reads(
        self, response: StepResponse, origins: Matrix, lattice: Lattice, key: tuple[int, int], kind: Kind
    ) -> list[_Read]:
        """The step response at the place that the samples have in a block, for each of (phases, batch)."""
        exposed, within = lattice.exposure / lattice.step, origins % 1.0
        places = [
            (*key, kind, lattice.step, exposed, round(float(place) / _SAME_PHASE) % _PLACES)
            for place in within[:, 0]
        ]
        exact = [(kind, exposed, float(place)) for place in within[:, 0]]
        absent = []
        for k, place in enumerate(places):
            if place in self.kept or place in places[:k]:
                continue
            if within.shape[1] == 1 and exact[k] in response.readings:
                self.kept[place] = _Read(origins[k], response.readings[exact[k]])
            else:
                absent.append(k)
        together = max(1, _TOGETHER // response.coarse.size)
        for first in range(0, len(absent), together):
            some = absent[first : first + together]
            readings = _readings(response, origins[some], lattice, kind)
            for k, reading in zip(some, readings.swapaxes(0, 1), strict=True):
                read = self.kept[places[k]] = _Read.of(origins[k], reading)
                held = (len(response.readings) + 1) * read.padded.size
                if within.shape[1] == 1 and held <= _HELD:
                    response.readings[exact[k]] = read.padded
        return [self.kept[place] for place in places]


def _read_anywhere(response: StepResponse, lattice: Lattice, onsets: Matrix, kind: Kind) -> Array:
    """Readings of a step response after each onset, (batch, changes) [time unit], at sample times of any
    spacing, (rows, batch, changes * samples)."""
    x = ((lattice.times - onsets[..., None]) / lattice.step).reshape(len(onsets), -1)
    if lattice.exposure == 0.0:
        return response.at(x, kind)
    width = lattice.exposure / lattice.step
    return (response.at(x, _INTEGRATED[kind]) - response.at(x - width, _INTEGRATED[kind])) / width


def _readings(response: StepResponse, origins: Matrix, lattice: Lattice, kind: Kind) -> Array:
    """Readings of a step response from its onset on, (rows, phases, batch, n), for samples at `origins`."""
    theta = origins - np.floor(origins)
    if lattice.exposure == 0.0:
        readings = response.on_lattice(theta, kind)
    else:
        width = lattice.exposure / lattice.step
        late = response.on_lattice(theta, _INTEGRATED[kind])
        opened = theta - width
        whole = np.floor(opened)
        early = response.on_lattice(opened - whole, _INTEGRATED[kind])
        # the shutter opens whole blocks before the block in which it closes
        for k, blocks in np.ndenumerate(np.minimum(-whole, early.shape[-1]).astype(int)):
            late[:, *k, blocks:] -= early[:, *k, : early.shape[-1] - blocks]
        readings = late / width
    return readings
