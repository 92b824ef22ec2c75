"""Effects in the balance of forces of the plant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, final

import numpy as np

from lcopa_bayes.arrays import Matrix, Vector
from lcopa_bayes.plant.effects.effect import Card, Coefficient, ForceEffect, Ranges, Scene, single


@final
@dataclass(frozen=True)
class CubicStiffness(ForceEffect):
    """Restoring force that hardens (c > 0) or softens with the deflection."""

    card: ClassVar[Card] = Card(
        name="cubic_stiffness",
        place="plant",
        formula="y + viscous(y) + c y^3 / ymax^2 = f",
        source="Duffing 1918; elastic torque beyond small tilt",
        reveals="amplitude series, staircase",
        mistaken_for="gain, time constants",
    )

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """c [-]."""
        return single("c", 0.1)

    def force(self, f: Matrix, y: Matrix, rate: Matrix, scene: Scene, psi: Vector) -> Matrix:
        """Pointwise."""
        return np.asarray(f - psi[0] * y * (y / scene.ranges.response[:, None]) ** 2)
