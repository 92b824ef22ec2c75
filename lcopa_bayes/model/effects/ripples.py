"""Ripples that the drive does not cause: the mount shakes, the modulator flickers."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Self, final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.model.effects.effect import (
    Card,
    Coefficient,
    ParallelEffect,
    Ranges,
    ReadoutEffect,
    Scene,
    per_axis,
    single,
)


def _frequencies(ranges: Ranges, fewest: float) -> Vector:
    """Half a cycle per record apart, from `fewest` cycles up to 40 or a quarter of the sampling rate."""
    highest = min(40.0, ranges.span / (4 * ranges.period))
    return np.arange(fewest, max(highest, fewest + 0.5), 0.5) / ranges.span


def _wave(scene: Scene, frequency: float) -> Matrix:
    """Cosine and sine, (2, samples)."""
    phase = 2 * np.pi * frequency * scene.times
    return np.stack((np.cos(phase), np.sin(phase)))


@final
@dataclass(frozen=True)
class Vibration(ParallelEffect):
    """A vibration of the mount, with a phase of its own in every record."""

    frequency: float
    """[cycles per time unit]."""

    additive = True
    units = MappingProxyType({"frequency": "1/time"})
    card: ClassVar[Card] = Card(
        name="vibration",
        place="noise",
        formula="y += a cos(2 pi f t) + b sin(2 pi f t), a and b per record and axis",
        source="optical tables, 20 to 300 Hz, 1e-5 to 2e-4 rad",
        reveals="quiet stretches, repeats",
        mistaken_for="pointing_drift at a low frequency; flicker",
        per_record=True,
        disturbance=True,
        resting=True,
    )

    @classmethod
    def grid(cls, ranges: Ranges) -> tuple[Self, ...]:
        """From two and a half cycles on: fewer are a drift, and imitate what follows the drive."""
        return tuple(cls(float(f)) for f in _frequencies(ranges, 2.5))

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """a and b [response unit] per axis."""
        return per_axis(ranges, ("a", "b"), 0.005)

    def added(self, scene: Scene, psi: Vector) -> Matrix:
        """Linear in a and b."""
        return np.asarray((psi.reshape(-1, 2) @ _wave(scene, self.frequency)).T)


@final
@dataclass(frozen=True)
class Flicker(ReadoutEffect):
    """A ripple in proportion to the deflection, with a phase of its own in every record."""

    frequency: float
    """[cycles per time unit]."""

    linear = True
    units = MappingProxyType({"frequency": "1/time"})
    card: ClassVar[Card] = Card(
        name="flicker",
        place="noise",
        formula="y += (a cos(2 pi f t) + b sin(2 pi f t)) |y|, a and b per record",
        source="Balondrade and Popoff: modulator fluctuation, usually 100 to 400 Hz",
        reveals="holds at several deflections",
        mistaken_for="vibration (which does not scale with the deflection)",
        per_record=True,
        disturbance=True,
    )

    @classmethod
    def grid(cls, ranges: Ranges) -> tuple[Self, ...]:
        """From six cycles on: fewer in a short record are a drift, and imitate what follows the drive."""
        return tuple(cls(float(f)) for f in _frequencies(ranges, 6.0))

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """a and b [-]."""
        return (*single("a", 0.005), *single("b", 0.005))

    def seen(self, y: Matrix, scene: Scene, psi: Vector) -> Matrix:
        """Pointwise."""
        return np.asarray(y + (psi @ _wave(scene, self.frequency))[:, None] * np.abs(y))
