"""Effects on the deflection where it is read: static curves, mixing of axes, limits of the sensor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self, final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.model.effects.effect import Card, Coefficient, Ranges, ReadoutEffect, Scene, single
from lcopa_bayes.model.layout import Layout

_STEERING = "diffraction angle against tilt, see lcopa_bayes.optics"


@final
@dataclass(frozen=True)
class OddCurvature(ReadoutEffect):
    """Soft saturation, alike in both directions."""

    linear = True
    card: ClassVar[Card] = Card(
        name="odd_curvature",
        place="output",
        formula="y -> y + c y^3 / ymax^2",
        source=_STEERING,
        reveals="amplitude series",
        mistaken_for="gain; voltage_knee",
    )

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """c [-]."""
        return single("c", 0.03)

    def seen(self, y: Matrix, scene: Scene, psi: Vector) -> Matrix:
        """Pointwise."""
        return np.asarray(y + psi[0] * y * (y / scene.ranges.response) ** 2)


@final
@dataclass(frozen=True)
class EvenCurvature(ReadoutEffect):
    """Curvature that differs between the two directions."""

    linear = True
    card: ClassVar[Card] = Card(
        name="even_curvature",
        place="output",
        formula="y -> y + c y^2 / ymax",
        source=_STEERING,
        reveals="amplitude series with sign reversal",
        mistaken_for="gain",
    )

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """c [-]."""
        return single("c", 0.03)

    def seen(self, y: Matrix, scene: Scene, psi: Vector) -> Matrix:
        """Pointwise."""
        return np.asarray(y + psi[0] * y**2 / scene.ranges.response)


@final
@dataclass(frozen=True)
class BilinearCrosstalk(ReadoutEffect):
    """Each axis gains by the product of two axes."""

    linear = True
    card: ClassVar[Card] = Card(
        name="bilinear_crosstalk",
        place="output",
        formula="y_i -> y_i + c y_1 y_2 / ymax_i (axes in pairs)",
        source="second-order coupling of steering angles",
        reveals="both axes at once",
        mistaken_for="nothing when both axes move; cross gains in a single dual-axis record",
    )

    @classmethod
    def applies(cls, layout: Layout) -> bool:
        """Only with two response axes or more."""
        return len(layout.responses) > 1

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """c [-]."""
        return single("c", 0.03)

    def seen(self, y: Matrix, scene: Scene, psi: Vector) -> Matrix:
        """Products with the next axis, over its range."""
        part = y / scene.ranges.response
        others = np.roll(part, 1, axis=1) if part.shape[1] > 2 else part[:, ::-1]
        return np.asarray(y + psi[0] * scene.ranges.response * part * others)


@final
@dataclass(frozen=True)
class AxisRotation(ReadoutEffect):
    """Camera and device axes at an angle."""

    card: ClassVar[Card] = Card(
        name="axis_rotation",
        place="output",
        formula="(y_1, y_2) -> R(phi) (y_1, y_2)",
        source="mounting, 5 to 50 mrad",
        reveals="single-axis and dual-axis records together, direct and cross elements that differ",
        mistaken_for="cross gains; exactly so with free output-side coupling",
    )

    @classmethod
    def applies(cls, layout: Layout) -> bool:
        """Only with two response axes."""
        return len(layout.responses) == 2

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """phi [rad]."""
        return single("phi", 0.03)

    def seen(self, y: Matrix, scene: Scene, psi: Vector) -> Matrix:
        """An exact rotation."""
        c, s = np.cos(psi[0]), np.sin(psi[0])
        return np.asarray(y @ np.array([[c, s], [-s, c]]))


@final
@dataclass(frozen=True)
class Clipping(ReadoutEffect):
    """The reading stops at a limit."""

    level: float
    """Limit over the largest deflection [-]."""
    skew: float = 1.0
    """The same of each next axis over that of the one before [-]: what clips also bends the deflections that
    the limit is measured in."""

    linear = True
    card: ClassVar[Card] = Card(
        name="clipping",
        place="output",
        formula="|y| -> |y| - c max(0, |y| - level ymax); c = 1 clips",
        source="sensor or display range",
        reveals="amplitude series, overshoot",
        mistaken_for="odd_curvature; a lower order",
    )

    @classmethod
    def grid(cls, ranges: Ranges) -> tuple[Self, ...]:
        """From half the range to its end."""
        return tuple(cls(level) for level in (0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.94, 0.97, 0.985))

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """c [-]."""
        return single("c", 0.6, one_signed=True)

    def seen(self, y: Matrix, scene: Scene, psi: Vector) -> Matrix:
        """Pointwise."""
        limit = self.level * self.skew ** np.arange(scene.ranges.axes) * scene.ranges.response
        beyond = np.maximum(np.abs(y) - limit, 0.0)
        return np.asarray(y - psi[0] * np.sign(y) * beyond)


@final
@dataclass(frozen=True)
class CentroidLocking(ReadoutEffect):
    """A centroid drawn to the pixels of the camera."""

    cycles: float
    """Pixels within the largest deflection [-]."""

    linear = True
    card: ClassVar[Card] = Card(
        name="centroid_locking",
        place="output",
        formula="y -> y + a sin(2 pi cycles y / ymax)",
        source="pixel locking of centroids, below 1/20 pixel",
        reveals="slow ramps, staircases of many levels",
        mistaken_for="noise",
    )

    @classmethod
    def grid(cls, ranges: Ranges) -> tuple[Self, ...]:
        """Two to 30 pixels, in steps that shift the last by a third of a pixel."""
        return tuple(cls(float(cycles)) for cycles in np.arange(2.0, 30.0, 1 / 3))

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """a over the largest deflection [-]."""
        return single("a", 0.01)

    def seen(self, y: Matrix, scene: Scene, psi: Vector) -> Matrix:
        """Pointwise."""
        size = scene.ranges.response
        return np.asarray(y + psi[0] * size * np.sin(2 * np.pi * self.cycles * y / size))
