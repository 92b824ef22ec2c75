"""Effects on the commands before they act."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import ClassVar, Self, final

import numpy as np

from lcopa_bayes.core.arrays import Array, Vector
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.model.effects.effect import Acting, Card, Constant, DriveEffect, Ranges, Scene, single


@final
@dataclass(frozen=True)
class OverdrivePulse(DriveEffect):
    """A frame of exaggerated drive after every change, as display electronics apply it."""

    frame: float
    """Length of the pulse [time unit]."""

    linear = True
    units = MappingProxyType({"frame": "time"})
    estimated = single("k", 0.2)
    card: ClassVar[Card] = Card(
        name="overdrive_pulse",
        place="drive",
        formula="u -> u + k (u_new - u_old) during one frame after each change",
        source="Thalhammer et al. 2013, Opt. Express 21:1779 (about 1 ms with overdrive)",
        reveals="on/off, staircase",
        mistaken_for="a faster element, overshoot of an order above 1",
        linear=True,
        fields=("optical",),
    )

    @classmethod
    def grid(cls, ranges: Ranges) -> tuple[Self, ...]:
        """Frames from two samples to six times the response time, which the pulse may have shortened."""
        longest = max(6 * ranges.speed, 8 * ranges.period)
        return tuple(cls(float(frame)) for frame in np.geomspace(2 * ranges.period, longest, 16))

    def commands(self, drive: AxisDrive, rest: float, axis: int, scene: Scene, psi: Vector) -> Acting:
        """One more pair of changes per change."""
        jumps = drive.jumps
        times = np.concatenate((drive.times, drive.times + self.frame))
        return AxisDrive.of_jumps(times, np.concatenate(((1 + psi[0]) * jumps, -psi[0] * jumps))), rest


@final
@dataclass(frozen=True)
class RefreshHold(DriveEffect):
    """Commands that wait for the next refresh of the drive."""

    refresh: float
    """Period of the refresh [time unit]."""
    phase: float
    """First refresh after time 0 over the period [-]."""

    units = MappingProxyType({"refresh": "time"})
    fractions = frozenset({"phase"})
    estimated = single("w", 0.6, share=True)
    card: ClassVar[Card] = Card(
        name="refresh_hold",
        place="drive",
        formula="t -> t + w (next refresh - t); w = 1 holds",
        source="frame clock of the driver, 1 kHz",
        reveals="commands off the refresh grid",
        mistaken_for="delay, exactly so when all commands share a phase of the refresh",
    )

    @classmethod
    def grid(cls, ranges: Ranges) -> tuple[Self, ...]:
        """Refreshes of 5, 10 and 20 samples in four phases."""
        return tuple(
            cls(count * ranges.period, phase) for count in (5, 10, 20) for phase in (0.0, 0.25, 0.5, 0.75)
        )

    @classmethod
    def internal(cls, ranges: Ranges) -> tuple[Constant, ...]:
        """Any phase."""
        refresh, phase = super().internal(ranges)
        return refresh, replace(phase, high=1.0)

    def commands(self, drive: AxisDrive, rest: float, axis: int, scene: Scene, psi: Vector) -> Acting:
        """Of several changes that fall to one refresh the sum acts."""
        ticks = np.ceil(drive.times / self.refresh - self.phase - 1e-9) + self.phase
        return drive.later(psi[0] * (self.refresh * ticks - drive.times)), rest


def _mapped(drive: AxisDrive, levels: Vector) -> Acting:
    """The drive with other levels: that at rest, then one per change."""
    return AxisDrive.of_jumps(drive.times, np.diff(levels)), float(levels[0])


def _levels(drive: AxisDrive, rest: float) -> Vector:
    """Drive at rest and after every change, (1 + changes,)."""
    return rest + np.concatenate(([0.0], drive.values))


_HALVES = 9
"""Digits of a command in grey levels [-]: half way between two, rounding errors do not decide."""


@final
@dataclass(frozen=True)
class GreyQuantisation(DriveEffect):
    """Drive in grey levels."""

    levels: float
    """Steps within the largest drive [-]."""

    linear = True
    estimated = single("w", 0.6, share=True)
    card: ClassVar[Card] = Card(
        name="grey_quantisation",
        place="drive",
        formula="u -> u + w (q round(u / q) - u), q = umax / levels; w = 1 quantises",
        source="8 bit per 2 pi: 24.5 mrad per grey level",
        reveals="many different levels, small steps",
        mistaken_for="gain, noise of the gain",
        fields=("optical",),
    )

    @classmethod
    def grid(cls, ranges: Ranges) -> tuple[Self, ...]:
        """Usual depths of a driver, and every depth up to 64: records need not reach its full scale.

        Another depth is another pattern of errors, with no slope from one to the next: neighbours differ by
        1.5 %, the width of a pattern at 16 levels.
        """
        usual = (15, 16, 31, 32, 63, 64, 127, 128, 255)
        return tuple(cls(float(levels)) for levels in (*usual, *np.geomspace(6.0, 62.0, 156)))

    def commands(self, drive: AxisDrive, rest: float, axis: int, scene: Scene, psi: Vector) -> Acting:
        """Level by level."""
        step, levels = scene.ranges.drive[axis] / self.levels, _levels(drive, rest)
        grey = np.round(np.round(levels / step, _HALVES))
        return _mapped(drive, levels + psi[0] * (step * grey - levels))


@final
@dataclass(frozen=True)
class Hysteresis(DriveEffect):
    """A part of the drive that lags behind its reversals by a fixed width (play)."""

    width: float
    """Half-width of the play over the largest drive [-]."""

    linear = True
    estimated = single("h", 0.1)
    card: ClassVar[Card] = Card(
        name="hysteresis",
        place="drive",
        formula="u -> u + h (p - u), p_k = max(u - r, min(u + r, p_(k-1))), r = width umax",
        source="play operator of Prandtl and Ishlinskii; ions, surface memory",
        reveals="sign reversal, staircases up and down",
        mistaken_for="gain; invisible when every record goes in one direction",
    )

    @classmethod
    def grid(cls, ranges: Ranges) -> tuple[Self, ...]:
        """Widths from 2 to 50 % of the range."""
        return tuple(cls(width) for width in (0.02, 0.05, 0.1, 0.2, 0.35, 0.5))

    def commands(self, drive: AxisDrive, rest: float, axis: int, scene: Scene, psi: Vector) -> Acting:
        """The play starts where the drive rests."""
        radius, levels = self.width * scene.ranges.drive[axis], _levels(drive, rest)
        played = levels.copy()
        for k in range(1, levels.size):
            played[k] = max(levels[k] - radius, min(levels[k] + radius, played[k - 1]))
        return _mapped(drive, levels + psi[0] * (played - levels))


@final
class VoltageKnee(DriveEffect):
    """Curve from drive to force after the calibration table."""

    linear = True
    estimated = single("k", 0.05)
    card: ClassVar[Card] = Card(
        name="voltage_knee",
        place="drive",
        formula="u -> u (1 + k (1 - |u| / umax))",
        source="knee of the voltage-tilt curve, see optics.tiltlaw; 1 to 5 % after a look-up table",
        reveals="amplitude series",
        mistaken_for="gain; odd_curvature",
    )

    def commands(self, drive: AxisDrive, rest: float, axis: int, scene: Scene, psi: Vector) -> Acting:
        """Level by level."""
        levels = _levels(drive, rest)
        return _mapped(drive, levels * (1 + psi[0] * (1 - np.abs(levels) / scene.ranges.drive[axis])))


@final
class FieldDependentDelay(DriveEffect):
    """Delay that falls (e > 0) with the drive that is switched on."""

    estimated = single("e", 0.15)
    card: ClassVar[Card] = Card(
        name="field_dependent_delay",
        place="drive",
        formula="tau -> tau (1 + e (1/2 - |u_new| / umax)) for each change",
        source="Yang and Sambles: delay at the start of switch-on against field",
        reveals="amplitude series",
        mistaken_for="delay, exactly so with one amplitude",
    )

    def commands(self, drive: AxisDrive, rest: float, axis: int, scene: Scene, psi: Vector) -> Acting:
        """Every change is shifted by its own part of the delay of the drive's own path."""
        own = np.flatnonzero(scene.ranges.direct == axis)
        delay = float(scene.delays[own[0] if own.size else 0, axis])
        levels = np.abs(_levels(drive, rest)[1:]) / scene.ranges.drive[axis]
        return drive.later(psi[0] * delay * (0.5 - levels)), rest


@final
class SampledDrive(DriveEffect):
    """A drive that was sampled while it moved, not commanded and held: it changes half a period earlier."""

    estimated = single("w", 0.6, one_signed=True)
    card: ClassVar[Card] = Card(
        name="sampled_drive",
        place="drive",
        formula="t -> t - w period / 2 for each change; w = 1 is a drive sampled at the middle of its holds",
        source="midpoint rule for a band-limited drive; Ljung 1999, System Identification, ch. 13",
        reveals="a drive that changes with every sample (with a delay near 0)",
        mistaken_for="a shorter delay, exactly so where the delay can shrink",
        linear=True,
    )

    lags = True

    def lag(self, ranges: Ranges, psi: Array) -> Array:
        """Half a period earlier where w is 1."""
        return np.asarray(-0.5 * psi[0] * ranges.period)

    def commands(self, drive: AxisDrive, rest: float, axis: int, scene: Scene, psi: Vector) -> Acting:
        """All changes by the same time."""
        return drive.later(float(self.lag(scene.ranges, psi))), rest
