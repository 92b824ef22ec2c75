"""Effects in the balance of forces of the plant; each acts on the direct paths."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self, final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.model.effects.effect import (
    Card,
    ElementEffect,
    ForceEffect,
    Motion,
    Ranges,
    Scene,
    single,
)

_SHARP = 1e-5
"""Width of the switch between rise and fall, of ``ymax^2 / speed`` [-]: a jump would not converge, and late
after a step a response moves no faster than a thousandth of that for long."""


@final
class CubicStiffness(ForceEffect):
    """Restoring force that hardens (c > 0) or softens with the deflection."""

    batched = True
    estimated = single("c", 0.1)
    card: ClassVar[Card] = Card(
        name="cubic_stiffness",
        place="plant",
        formula="y + viscous(y) + c y^3 / ymax^2 = f",
        source="Duffing 1918; elastic torque beyond small tilt",
        reveals="amplitude series, staircase",
        mistaken_for="gain, time constants",
    )

    def force(self, f: Matrix, motion: Motion, scene: Scene, psi: Vector) -> Matrix:
        """Pointwise."""
        return np.asarray(f - psi[0] * motion.y * (motion.y / scene.ranges.column) ** 2)


@final
class RiseFallAsymmetry(ForceEffect):
    """Viscosity that differs between motion away from rest and back."""

    batched = True
    estimated = single("e", 0.3)
    card: ClassVar[Card] = Card(
        name="rise_fall_asymmetry",
        place="plant",
        formula="viscous(y) -> (1 + e [y dy/dt < 0]) viscous(y)",
        source="field-driven rise against free relaxation, Thalhammer et al. 2013, Opt. Express 21:1779",
        reveals="on/off, staircase",
        mistaken_for="time constants and orders when every step is an on-step; exactly so without a fall",
    )

    def force(self, f: Matrix, motion: Motion, scene: Scene, psi: Vector) -> Matrix:
        """The viscous part of the force so far is ``f - y``.

        The switch, ``x / sqrt(1 + x^2)`` of ``x = y rate / width``, is averaged over a block, along which x
        moves evenly: taken at the middle alone, a turn would count as a whole block or none.
        """
        width = _SHARP * scene.ranges.column**2 / scene.ranges.speed
        (y, rate), (late, faster) = motion.ends(scene.grid.step)
        one, two = y * rate / width, late * faster / width
        rising = (one + two) / (np.sqrt(1.0 + one**2) + np.sqrt(1.0 + two**2))
        return np.asarray(f - (f - motion.y) * (0.5 - 0.5 * rising) * psi[0] / (1.0 + psi[0]))


@final
class LevelDependentSpeed(ForceEffect):
    """Viscosity that falls (e > 0) with the deflection."""

    batched = True
    estimated = single("e", 0.2)
    card: ClassVar[Card] = Card(
        name="level_dependent_speed",
        place="plant",
        formula="viscous(y) -> (1 + e (1 - 2 |y| / ymax)) viscous(y)",
        source="switching time as 1 / ((U/U0)^2 - 1)",
        reveals="amplitude series",
        mistaken_for="time constants and orders",
    )

    def force(self, f: Matrix, motion: Motion, scene: Scene, psi: Vector) -> Matrix:
        """The viscous part of the force so far is ``f - y``."""
        y = motion.y
        return np.asarray(y + (f - y) / (1.0 + psi[0] * (1.0 - 2.0 * np.abs(y) / scene.ranges.column)))


@final
@dataclass(frozen=True)
class Overflow(ForceEffect):
    """A loss that saturates as a square root, and a further loss above a level."""

    level: float
    """Where the further loss begins, over the largest deflection [-]."""

    batched = True
    estimated = (*single("s", 0.3, one_signed=True), *single("k", 3.0, one_signed=True))
    card: ClassVar[Card] = Card(
        name="overflow",
        place="plant",
        formula="y -> ymax (sqrt(1 + 2 s |y|/ymax) - 1) / s sign(y) + k max(0, |y| - level ymax) sign(y)",
        source="Torricelli 1644; Schoukens et al. 2016, cascaded tanks benchmark",
        reveals="amplitude series",
        mistaken_for="gain, time constants; cubic_stiffness with c < 0, clipping",
    )

    @classmethod
    def grid(cls, ranges: Ranges) -> tuple[Self, ...]:
        """From half the range to near its end."""
        return tuple(cls(level) for level in (0.5, 0.7, 0.8, 0.9, 0.95))

    def force(self, f: Matrix, motion: Motion, scene: Scene, psi: Vector) -> Matrix:
        """Pointwise."""
        y = motion.y
        part = np.abs(y) / scene.ranges.column
        loss = 2.0 * y / (1.0 + np.sqrt(1.0 + 2.0 * psi[0] * part))
        beyond = scene.ranges.column * np.maximum(part - self.level, 0.0) * np.sign(y)
        return np.asarray(f + y - loss - psi[1] * beyond)


@final
class ViscosityDrift(ElementEffect):
    """Time constants that change through the campaign, as viscosity does with temperature."""

    estimated = single("d", 0.1)
    card: ClassVar[Card] = Card(
        name="viscosity_drift",
        place="plant",
        formula="T -> T (1 + d epoch), epoch -1/2 for the first and 1/2 for the last record",
        source="rotational viscosity exp(Ea / kT), Ea 0.3 to 0.6 eV: 4 to 8 % per kelvin",
        reveals="repeats over time",
        mistaken_for="trigger_jitter",
    )

    def stretch(self, scene: Scene, psi: Vector) -> float:
        """Linear in the epoch."""
        return float(1.0 + psi[0] * scene.epoch)
