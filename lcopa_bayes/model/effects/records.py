"""Effects that differ from record to record, and the distribution of the noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.model.effects.effect import (
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


@final
@dataclass(frozen=True)
class GainDrift(ReadoutEffect):
    """Deflection that changes in size through the campaign."""

    linear = True
    affine = True
    card: ClassVar[Card] = Card(
        name="gain_drift",
        place="noise",
        formula="y -> (1 + d epoch) y, epoch -1/2 for the first and 1/2 for the last record",
        source="birefringence against temperature, 0.2 to 0.5 % per kelvin",
        reveals="repeats over time",
        mistaken_for="pointing_offset",
    )

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """d [-]."""
        return single("d", 0.03)

    def seen(self, y: Matrix, scene: Scene, psi: Vector) -> Matrix:
        """Pointwise."""
        return np.asarray((1 + psi[0] * scene.epoch) * y)


@final
@dataclass(frozen=True)
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

    def commands(
        self, drive: AxisDrive, rest: float, axis: int, scene: Scene, psi: Vector
    ) -> tuple[AxisDrive, float]:
        """All changes are stretched."""
        start = scene.times[0]
        return AxisDrive(drive.times + psi[0] * (drive.times - start), drive.values), rest


@final
@dataclass(frozen=True)
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

    def commands(
        self, drive: AxisDrive, rest: float, axis: int, scene: Scene, psi: Vector
    ) -> tuple[AxisDrive, float]:
        """All changes are shifted alike."""
        return AxisDrive(drive.times + psi[0], drive.values), rest


@final
@dataclass(frozen=True)
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
@dataclass(frozen=True)
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
@dataclass(frozen=True)
class Outliers(ScatterEffect):
    """Noise with heavy tails: Student's t instead of the normal distribution."""

    noise = "student"
    card: ClassVar[Card] = Card(
        name="outliers",
        place="noise",
        formula="noise ~ sigma t_nu, psi = 1 / nu",
        source="lost centroids, cosmic hits; Juarez and Steel 2010",
        reveals="any record",
        mistaken_for="nothing",
        disturbance=True,
    )

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """1 / nu [-]."""
        return single("inverse_nu", 0.2, one_signed=True)
