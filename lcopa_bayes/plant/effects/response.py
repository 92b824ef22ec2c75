"""Effects on the deflection where it is read: static curves, mixing of axes, limits of the sensor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, final

from lcopa_bayes.arrays import Matrix, Vector
from lcopa_bayes.plant.effects.effect import Card, Coefficient, Ranges, ReadoutEffect, Scene, single


@final
@dataclass(frozen=True)
class OddCurvature(ReadoutEffect):
    """Soft saturation, alike in both directions."""

    card: ClassVar[Card] = Card(
        name="odd_curvature",
        place="output",
        formula="y -> y + c y^3 / ymax^2",
        source="sine of the diffraction angle and saturating tilt law, see optics.tiltlaw; 1 to 3 %",
        reveals="amplitude series",
        mistaken_for="gain",
    )

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """c [-]."""
        return single("c", 0.03)

    def seen(self, y: Matrix, scene: Scene, psi: Vector) -> Matrix:
        """Pointwise."""
        return np.asarray(y + psi[0] * y * (y / scene.ranges.response) ** 2)
