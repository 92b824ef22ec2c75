"""Responses beside those of the paths, each in closed form for a drive that is constant between changes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import accumulate
from math import ceil
from types import MappingProxyType
from typing import ClassVar, Self, final

import numpy as np
from scipy.signal import fftconvolve

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.model.effects.effect import (
    Card,
    Coefficient,
    Constant,
    ParallelEffect,
    Ranges,
    Scene,
    single,
)
from lcopa_bayes.model.layout import Layout

_MANY = 64
"""Changes and samples above which a convolution is worth while [-]."""
_ROUNDING = 1e-4
"""How far printed times may lie from an even grid [periods]."""

_SPARSE = 10
"""Places of a grid per sample, or per place of it of a finer one, above which it is not worth filling [-]."""


def summed(
    times: Vector, drive: AxisDrive, delay: float, jumps: Vector, shape: Callable[[Array], Array]
) -> Vector:
    """``sum_k jumps_k shape(t - t_k - delay)``, (samples,); shape is 0 before 0.

    Many changes under samples of an even grid, some of which may be missing, are one convolution: a change
    between two places of the grid is then shared by them, which is of second order in its period and exact
    for changes at samples. Under changes that follow each other faster the grid is as many times finer.
    Changes may begin long before the first sample, as where a transient was not read.
    """
    if min(drive.times.size, times.size) > _MANY and (grid := _grid(times)) is not None:
        places, period = grid
        finer = ceil(period * (1 - _ROUNDING) * (drive.times.size - 1) / np.ptp(drive.times))
        if finer <= _SPARSE:
            size = finer * int(places[-1]) + 1
            dense = _convolved(times[0], period / finer, size, drive.times, delay, jumps, shape)
            return np.asarray(dense[finer * places])
    out = np.zeros(times.size)
    for at, jump in zip(drive.times + delay, jumps, strict=True):
        if jump != 0.0:
            first = int(np.searchsorted(times, at))
            out[first:] += jump * shape(times[first:] - at)
    return out


def _grid(times: Vector) -> tuple[Index, float] | None:
    """Places of samples on an even grid that begins at the first, and its period; None where they lie on none
    or fill little of it."""
    places = np.round((times - times[0]) / np.median(np.diff(times))).astype(np.intp)
    period = (times[-1] - times[0]) / max(int(places[-1]), 1)
    even = np.abs(times - times[0] - period * places).max() < _ROUNDING * period
    return (places, float(period)) if even and places[-1] <= _SPARSE * times.size else None


def _convolved(
    start: float,
    period: float,
    size: int,
    changes: Vector,
    delay: float,
    jumps: Vector,
    shape: Callable[[Array], Array],
) -> Vector:
    """The sum at ``start + period (0, 1, ..., size - 1)``, (size,)."""
    place = (changes - start) / period
    place = np.where(np.abs(place - np.round(place)) < _ROUNDING, np.round(place), place)
    below = np.floor(place).astype(np.intp)
    begin = min(int(below[0]), 0)
    dense = np.zeros(max(int(below[-1]) + 2, size) - begin)
    np.add.at(dense, below - begin, jumps * (1 - (place - below)))
    np.add.at(dense, below + 1 - begin, jumps * (place - below))
    lags: Vector = np.arange(dense.size, dtype=float) * period - delay
    kernel = np.zeros(lags.size)
    kernel[lags >= 0] = shape(lags[lags >= 0])
    return np.asarray(fftconvolve(kernel, dense)[-begin : size - begin])


def relaxation(
    times: Vector, drive: AxisDrive, delay: float, jumps: Vector, rate: complex, weight: complex = 1.0
) -> Vector:
    """``sum_k jumps_k (1 - Re(weight exp(-rate (t - t_k - delay))))`` over the changes up to t, (samples,).

    What is lacking of the sum after a change is what was lacking after the one before, decayed, and the jump:
    one exponential for each sample, whatever the number of changes; exact.
    """
    at, out = drive.times + delay, np.zeros(times.size)
    if not at.size:
        return out
    kept = np.exp(-rate * np.diff(at))
    steps = zip([0.0, *kept.tolist()], jumps.tolist(), strict=True)
    lacking = np.array([*accumulate(steps, lambda left, step: left * step[0] + step[1], initial=0.0)][1:])
    last = np.searchsorted(at, times, side="right") - 1
    first = int(np.searchsorted(last, 0))
    last = last[first:]
    decayed = weight * lacking[last] * np.exp(-rate * (times[first:] - at[last]))
    out[first:] = np.cumsum(jumps)[last] - decayed.real
    return out


def falling(drive: AxisDrive, rest: float) -> Array:
    """Whether each change leads to a smaller magnitude."""
    levels = np.abs(rest + np.concatenate(([0.0], drive.values)))
    return np.asarray(levels[1:] < levels[:-1])


def relaxed(scene: Scene, response: int, drive: int, lag: float) -> Vector:
    """A drive after the delay of its path to a response and a lag [time unit], (samples,) [drive unit]."""
    own, delay = scene.drives[drive], float(scene.delays[response, drive])
    return np.asarray(scene.rest[drive] + relaxation(scene.times, own, delay, own.jumps, 1 / lag))


def own_responses(scene: Scene, size: float, rate: complex, weight: complex = 1.0) -> Matrix:
    """``size K (rest + relaxation)`` of every axis, (samples, axes).

    K is the gain of the path from the axis' own drive, which arrives after its delay.
    """
    out = np.zeros((scene.times.size, scene.ranges.axes))
    for axis in range(scene.ranges.axes):
        drive, rest, gain, delay = scene.direct(axis)
        if size * gain:  # a likelihood asks for one path after the other
            moved = relaxation(scene.times, drive, delay, drive.jumps, rate, weight)
            out[:, axis] = size * gain * (rest + moved)
    return out


@final
@dataclass(frozen=True)
class IonCreep(ParallelEffect):
    """A slow further deflection under a held drive."""

    time: float
    """Ti [time unit]."""

    units = MappingProxyType({"time": "time"})
    estimated = single("k", 0.03)
    card: ClassVar[Card] = Card(
        name="ion_creep",
        place="plant",
        formula="y += k K u / (1 + Ti s), K the gain of the path",
        source="ionic double layers, 0.5 to 2 %",
        reveals="long holds",
        mistaken_for="fractional tail of a low order (84 % of it)",
        linear=True,
        fields=("optical",),
    )

    @classmethod
    def grid(cls, ranges: Ranges) -> tuple[Self, ...]:
        """From a quarter of the longest record to ten times it."""
        return tuple(cls(float(time)) for time in np.geomspace(0.25 * ranges.span, 10 * ranges.span, 4))

    def added(self, scene: Scene, psi: Vector) -> Matrix:
        """One exponential per change."""
        return own_responses(scene, psi[0], 1 / self.time)


@final
@dataclass(frozen=True)
class Backflow(ParallelEffect):
    """A transient kick after changes to smaller (or larger) magnitude."""

    time: float
    """Tb [time unit]."""
    rising: bool
    """Whether it follows rising instead of falling changes."""

    units = MappingProxyType({"time": "time"})
    estimated = single("k", 0.1)
    card: ClassVar[Card] = Card(
        name="backflow",
        place="plant",
        formula="y += k K du s Tb / (1 + Tb s)^3 on falling (or rising) changes",
        source="Ruan and Sambles; Appl. Phys. Lett. 75:3491 and 80:3721 (bounce on rise, overshoot)",
        reveals="on/off",
        mistaken_for="ringing of an order above 1",
        fields=("optical",),
    )

    @classmethod
    def grid(cls, ranges: Ranges) -> tuple[Self, ...]:
        """From a tenth of the response time to the whole, on either change."""
        times = np.geomspace(0.1 * ranges.speed, ranges.speed, 6)
        return tuple(cls(float(time), rising) for rising in (False, True) for time in times)

    def added(self, scene: Scene, psi: Vector) -> Matrix:
        """``(x^2 / 2) e^(-x)``, x = t / Tb, per change."""
        out = np.zeros((scene.times.size, scene.ranges.axes))
        for axis in range(scene.ranges.axes):
            drive, rest, gain, delay = scene.direct(axis)
            if psi[0] * gain:
                chosen = np.where(falling(drive, rest) != self.rising, drive.jumps, 0.0)
                out[:, axis] = psi[0] * gain * summed(scene.times, drive, delay, chosen, self.kick)
        return out

    def kick(self, t: Array) -> Array:
        """Response to a unit change."""
        x = t / self.time
        return np.asarray(0.5 * x**2 * np.exp(-x))


@final
@dataclass(frozen=True)
class ExtraMode(ParallelEffect):
    """A lightly damped resonance beside the main response."""

    frequency: float
    """[cycles per time unit]."""
    damping: float
    """zeta [-], below 1."""

    units = MappingProxyType({"frequency": "1/time"})
    fractions = frozenset({"damping"})
    estimated = single("k", 0.05)
    card: ClassVar[Card] = Card(
        name="extra_mode",
        place="plant",
        formula="y += k K u / (1 + 2 zeta s / w + s^2 / w^2), w = 2 pi frequency",
        source="mechanical or elastic resonance",
        reveals="steps, pseudo-random drive",
        mistaken_for="ringing of an order above 1",
        linear=True,
        fields=("optical", "electrical", "mechanical"),
    )

    @classmethod
    def grid(cls, ranges: Ranges) -> tuple[Self, ...]:
        """From two cycles per record to a twelfth of the sampling rate, lightly and well damped."""
        low, high = 2 / ranges.span, 1 / (12 * ranges.period)
        count = max(2, int(np.ceil(12 * np.log2(max(high / low, 2.0)) / 2)))
        return tuple(
            cls(float(f), damping) for damping in (0.03, 0.15) for f in np.geomspace(low, high, count)
        )

    @classmethod
    def internal(cls, ranges: Ranges) -> tuple[Constant, ...]:
        """Any damping that leaves a resonance."""
        frequency, damping = super().internal(ranges)
        return frequency, replace(damping, low=0.003, high=0.5)

    def added(self, scene: Scene, psi: Vector) -> Matrix:
        """One damped oscillation per change."""
        w, root = 2 * np.pi * self.frequency, np.sqrt(1 - self.damping**2)
        return own_responses(scene, psi[0], w * complex(self.damping, root), complex(1, self.damping / root))


@final
@dataclass(frozen=True)
class MissingCrossPath(ParallelEffect):
    """A path from one axis to another with dynamics that the model's cross paths do not have."""

    time: float
    """T [time unit]."""

    units = MappingProxyType({"time": "time"})
    card: ClassVar[Card] = Card(
        name="missing_cross_path",
        place="plant",
        formula="y_i += k_ij (ymax_i / umax_j) u_j / (1 + T s) for every drive j of another axis",
        source="elastic or thermal coupling of the axes",
        reveals="single-axis records read on both axes",
        mistaken_for="cross gains; axis_rotation",
        linear=True,
    )

    @classmethod
    def applies(cls, layout: Layout) -> bool:
        """Only with two drives or more."""
        return len(layout.drives) > 1

    @classmethod
    def grid(cls, ranges: Ranges) -> tuple[Self, ...]:
        """From a third of the response time to ten times it, or half of the longest record."""
        low, high = 0.3 * ranges.speed, max(10 * ranges.speed, 0.5 * ranges.span)
        count = 1 + max(4, ceil(np.log(high / low) / np.log(2.5)))
        return tuple(cls(float(time)) for time in np.geomspace(low, high, count))

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """k_ij [-] by response axis and drive."""
        return tuple(
            Coefficient(f"k_{name}_{j + 1}", "-", 0.03)
            for name, own in zip(ranges.names, ranges.direct, strict=True)
            for j in range(ranges.drive.size)
            if j != own
        )

    def added(self, scene: Scene, psi: Vector) -> Matrix:
        """One exponential per change."""
        out = np.zeros((scene.times.size, scene.ranges.axes))
        pairs = ((i, j) for i in range(scene.ranges.axes) for j in range(scene.ranges.drive.size))
        other = ((i, j) for i, j in pairs if j != scene.ranges.direct[i])
        for k, (i, j) in zip(psi, other, strict=True):
            unit = scene.ranges.response[i] / scene.ranges.drive[j]
            out[:, i] += k * unit * relaxed(scene, i, j, self.time)
        return out
