"""Effects on the commands before they act."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self, final

import numpy as np

from lcopa_bayes.arrays import Vector
from lcopa_bayes.plant.drive import Drive
from lcopa_bayes.plant.effects.effect import (
    Card,
    Coefficient,
    DriveEffect,
    Ranges,
    Scene,
    single,
    sorted_jumps,
)


@final
@dataclass(frozen=True)
class OverdrivePulse(DriveEffect):
    """A frame of exaggerated drive after every change, as display electronics apply it."""

    frame: float
    """Length of the pulse [time unit]."""

    card: ClassVar[Card] = Card(
        name="overdrive_pulse",
        place="drive",
        formula="u -> u + k (u_new - u_old) during one frame after each change",
        source="Thalhammer et al. 2013, Opt. Express 21:1779 (overdrive, about 1 ms)",
        reveals="on/off, staircase",
        mistaken_for="a faster element, overshoot of an order above 1",
    )

    @classmethod
    def grid(cls, ranges: Ranges) -> tuple[Self, ...]:
        """Frames from two samples to twice the response time."""
        return tuple(
            cls(float(f))
            for f in np.geomspace(2 * ranges.period, max(2 * ranges.speed, 8 * ranges.period), 6)
        )

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """k [-]."""
        return single("k", 0.2)

    def commands(
        self, drive: Drive, rest: float, axis: int, scene: Scene, psi: Vector
    ) -> tuple[Drive, float]:
        """One more pair of changes per change."""
        jumps = np.diff(drive.values, prepend=0.0)
        times = np.concatenate((drive.times, drive.times + self.frame))
        return sorted_jumps(times, np.concatenate(((1 + psi[0]) * jumps, -psi[0] * jumps))), rest
