"""Effects that differ from record to record, ripples, and the distribution of the noise."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Self, final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.model.effects.effect import (
    Acting,
    Card,
    Coefficient,
    DriveEffect,
    ParallelEffect,
    Ranges,
    ReadoutEffect,
    ScatterEffect,
    Scene,
    per_axis,
    single,
)
from lcopa_bayes.model.layout import Layout


@final
class GainDrift(ReadoutEffect):
    """Deflection that changes in size through the campaign."""

    linear = True
    affine = True
    per_device = True
    estimated = single("d", 0.03)
    card: ClassVar[Card] = Card(
        name="gain_drift",
        place="noise",
        formula="y -> (1 + d epoch) y, epoch -1/2 for the first and 1/2 for the last record",
        source="birefringence against temperature, 0.2 to 0.5 % per kelvin",
        reveals="repeats over time",
        mistaken_for="pointing_offset",
    )

    def seen(self, y: Matrix, scene: Scene, psi: Vector) -> Matrix:
        """Pointwise."""
        return np.asarray((1 + psi[scene.ranges.devices] * scene.epoch) * y)


@final
class ClockSkew(DriveEffect):
    """Driver and camera clocks that run at different speeds."""

    card: ClassVar[Card] = Card(
        name="clock_skew",
        place="noise",
        formula="command times t -> t0 + (1 + e) (t - t0), t0 the first sample",
        source="free-running oscillators, up to 1e-3 between unlocked devices",
        reveals="commands late in long records",
        mistaken_for="time constants, delay",
    )

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """e [-]."""
        return single("e", 2 * ranges.period / ranges.span)

    def commands(self, drive: AxisDrive, rest: float, axis: int, scene: Scene, psi: Vector) -> Acting:
        """All changes are stretched."""
        return drive.later(psi[0] * (drive.times - scene.times[0])), rest


@final
class TriggerJitter(DriveEffect):
    """A record whose drive starts late or early as a whole."""

    card: ClassVar[Card] = Card(
        name="trigger_jitter",
        place="noise",
        formula="command times t -> t + dt, dt one per record",
        source="software trigger, up to one refresh",
        reveals="repeats",
        mistaken_for="viscosity_drift; noise at the edges",
        per_record=True,
        disturbance=True,
    )

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """dt [time unit]."""
        return single("dt", 2 * ranges.period, "time")

    def commands(self, drive: AxisDrive, rest: float, axis: int, scene: Scene, psi: Vector) -> Acting:
        """All changes are shifted alike."""
        return drive.later(psi[0]), rest


@final
class LateLogging(DriveEffect):
    """Changes that happen between two rows and are written with the second one."""

    card: ClassVar[Card] = Card(
        name="late_logging",
        place="noise",
        formula="t -> t - f (t - previous row) for each change, f one per record and drive",
        source="loggers that write a change with the next row; up to one interval between rows",
        reveals="repeats with changes at other instants between rows, rows that follow faster",
        mistaken_for="refresh_hold, clock_skew; delay where rows are regular",
        per_record=True,
        disturbance=True,
    )

    @classmethod
    def applies(cls, layout: Layout) -> bool:
        """Of one drive `trigger_jitter` says the same."""
        return len(layout.drives) > 1

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """f of every drive [-]."""
        numbers = range(1, ranges.drive.size + 1)
        return tuple(Coefficient(f"f_{n}", "-", 0.6, one_signed=True, share=True) for n in numbers)

    def commands(self, drive: AxisDrive, rest: float, axis: int, scene: Scene, psi: Vector) -> Acting:
        """All changes of a drive by the same part of the interval before each."""
        before = np.searchsorted(scene.times, drive.times) - 1
        interval = np.where(before < 0, 0.0, drive.times - scene.times[before])
        return drive.later(-psi[axis] * interval), rest


@final
class PointingOffset(ParallelEffect):
    """A record whose response is shifted as a whole."""

    additive = True
    card: ClassVar[Card] = Card(
        name="pointing_offset",
        place="noise",
        formula="y += a, one per record and axis",
        source="laser pointing, 1e-5 to 1e-4 rad on an open bench",
        reveals="quiet stretches, repeats",
        mistaken_for="gain; the model's own offset when that is one per record",
        per_record=True,
        disturbance=True,
    )

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """a [response unit]."""
        return per_axis(ranges, ("a",), 0.01)

    def added(self, scene: Scene, psi: Vector) -> Matrix:
        """A constant."""
        return np.tile(psi, (scene.times.size, 1))


@final
class PointingDrift(ParallelEffect):
    """A record whose response drifts."""

    additive = True
    card: ClassVar[Card] = Card(
        name="pointing_drift",
        place="noise",
        formula="y += d (t - middle) / span, one per record and axis",
        source="air turbulence, thermal drift of mounts",
        reveals="quiet stretches",
        mistaken_for="ion_creep, fractional tail",
        per_record=True,
        disturbance=True,
        resting=True,
    )

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """d [response unit]."""
        return per_axis(ranges, ("d",), 0.01)

    def added(self, scene: Scene, psi: Vector) -> Matrix:
        """A straight line."""
        middle = 0.5 * (scene.times[0] + scene.times[-1])
        return np.outer((scene.times - middle) / scene.ranges.span, psi)


@final
class Outliers(ScatterEffect):
    """Noise with heavy tails: Student's t instead of the normal distribution."""

    noise = "student"
    estimated = single("inverse_nu", 0.2, one_signed=True)
    card: ClassVar[Card] = Card(
        name="outliers",
        place="noise",
        formula="noise ~ sigma t_nu, psi = 1 / nu",
        source="lost centroids, cosmic hits; Juarez and Steel 2010",
        reveals="any record",
        mistaken_for="nothing",
        disturbance=True,
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
    estimated = (*single("a", 0.005), *single("b", 0.005))
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

    def seen(self, y: Matrix, scene: Scene, psi: Vector) -> Matrix:
        """Pointwise."""
        return np.asarray(y + (psi @ _wave(scene, self.frequency))[:, None] * np.abs(y))
