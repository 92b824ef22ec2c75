"""Effects of how the drive was recorded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, final

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.model.effects.effect import (
    Card,
    Coefficient,
    DriveEffect,
    Ranges,
    Scene,
    single,
)


@final
@dataclass(frozen=True)
class SampledDrive(DriveEffect):
    """A drive that was sampled while it moved, not commanded and held: it changes half a period earlier."""

    card: ClassVar[Card] = Card(
        name="sampled_drive",
        place="drive",
        formula="t -> t - w period / 2 for each change; w = 1 is a drive sampled at the middle of its holds",
        source="midpoint rule for a band-limited drive; Ljung 1999, System Identification, ch. 13",
        reveals="a drive that changes with every sample, a delay near 0",
        mistaken_for="a shorter delay, exactly so where the delay can shrink",
    )

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """w [-]."""
        return single("w", 0.6, one_signed=True)

    def commands(
        self, drive: AxisDrive, rest: float, axis: int, scene: Scene, psi: Vector
    ) -> tuple[AxisDrive, float]:
        """All changes by the same time."""
        times = drive.times - 0.5 * psi[0] * scene.ranges.period
        return AxisDrive.of_jumps(times, np.diff(drive.values, prepend=0.0)), rest
