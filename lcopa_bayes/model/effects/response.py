"""Effects on the deflection where it is read: static curves, mixing of axes, limits, waiting centroid."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Self, final

import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.model.effects.effect import Card, Ranges, ReadoutEffect, Scene, single
from lcopa_bayes.model.layout import Layout

_STEERING = "diffraction angle against tilt, see lcopa_bayes.optics"
RATIO = MappingProxyType({"skew": (0.8, 1.25)})
"""A limit or a pixel of an axis over that of the one before, in deflections, which a plant without the effect
gets wrong by a tenth [-]."""


@final
class OddCurvature(ReadoutEffect):
    """Soft saturation, alike in both directions."""

    linear = True
    per_device = True
    estimated = single("c", 0.03)
    card: ClassVar[Card] = Card(
        name="odd_curvature",
        place="output",
        formula="y -> y + c y^3 / ymax^2",
        source=_STEERING,
        reveals="amplitude series",
        mistaken_for="gain; voltage_knee",
    )

    def seen(self, y: Matrix, scene: Scene, psi: Vector) -> Matrix:
        """Pointwise."""
        return np.asarray(y + psi[scene.ranges.devices] * y * (y / scene.ranges.response) ** 2)


@final
class EvenCurvature(ReadoutEffect):
    """Curvature that differs between the two directions."""

    linear = True
    per_device = True
    estimated = single("c", 0.03)
    card: ClassVar[Card] = Card(
        name="even_curvature",
        place="output",
        formula="y -> y + c y^2 / ymax",
        source=_STEERING,
        reveals="amplitude series with sign reversal",
        mistaken_for="gain",
    )

    def seen(self, y: Matrix, scene: Scene, psi: Vector) -> Matrix:
        """Pointwise."""
        return np.asarray(y + psi[scene.ranges.devices] * y**2 / scene.ranges.response)


@final
class BilinearCrosstalk(ReadoutEffect):
    """Each axis gains by the product of two axes."""

    linear = True
    estimated = single("c", 0.03)
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

    def seen(self, y: Matrix, scene: Scene, psi: Vector) -> Matrix:
        """Products with the next axis, over its range."""
        part = y / scene.ranges.response
        others = np.roll(part, 1, axis=1) if part.shape[1] > 2 else part[:, ::-1]
        return np.asarray(y + psi[0] * scene.ranges.response * part * others)


@final
class AxisRotation(ReadoutEffect):
    """Camera and device axes at an angle."""

    estimated = single("phi", 0.03)
    card: ClassVar[Card] = Card(
        name="axis_rotation",
        place="output",
        formula="(y_1, y_2) -> R(phi) (y_1, y_2)",
        source="mounting, 5 to 50 mrad",
        reveals="single-axis and dual-axis records together, direct and cross elements that differ",
        mistaken_for="cross gains; exactly so with free output-side coupling",
        linear=True,
        fields=("optical", "mechanical"),
    )

    @classmethod
    def applies(cls, layout: Layout) -> bool:
        """Only with two response axes."""
        return len(layout.responses) == 2

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

    ratios = RATIO
    linear = True
    per_device = True
    estimated = single("c", 0.6, share=True)
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

    def seen(self, y: Matrix, scene: Scene, psi: Vector) -> Matrix:
        """Pointwise."""
        limit = self.level * self.skew ** np.arange(scene.ranges.axes) * scene.ranges.response
        beyond = np.maximum(np.abs(y) - limit, 0.0)
        return np.asarray(y - psi[scene.ranges.devices] * np.sign(y) * beyond)


@final
@dataclass(frozen=True)
class CentroidLocking(ReadoutEffect):
    """A centroid drawn to the pixels of the camera."""

    cycles: float
    """Pixels within the largest deflection [-]."""
    skew: float = 1.0
    """The same of each next axis over that of the one before [-]."""

    ratios = RATIO
    linear = True
    estimated = single("a", 0.01)
    card: ClassVar[Card] = Card(
        name="centroid_locking",
        place="output",
        formula="y -> y + a sin(2 pi cycles y / ymax)",
        source="pixel locking of centroids, below 1/20 pixel",
        reveals="slow ramps, staircases of many levels",
        mistaken_for="noise",
        fields=("optical",),
    )

    @classmethod
    def grid(cls, ranges: Ranges) -> tuple[Self, ...]:
        """Two to 30 pixels, in steps that shift the last by a third of a pixel."""
        return tuple(cls(float(cycles)) for cycles in np.arange(2.0, 30.0, 1 / 3))

    def seen(self, y: Matrix, scene: Scene, psi: Vector) -> Matrix:
        """Pointwise."""
        size = scene.ranges.response
        cycles = self.cycles * self.skew ** np.arange(scene.ranges.axes)
        return np.asarray(y + psi[0] * size * np.sin(2 * np.pi * cycles * y / size))


@final
class CrossFade(ReadoutEffect):
    """The far field passes from one diffraction order to the next: the centroid waits, then hurries.

    Homogeneous of degree 1, so that an amplitude series does not show it. A transition that is
    interrupted starts anew from the director's deflection; its distance from the director then fades with it.
    """

    per_command: ClassVar[bool] = True
    estimated = single("strength", 0.6, one_signed=True)
    card: ClassVar[Card] = Card(
        name="cross_fade",
        place="output",
        formula="y = y0 + (y1 - y0) q / (q + q'), q = sinc^2(1 - a), q' = sinc^2(a), "
        "a = progress from y0 to y1",
        source="efficiencies of a re-written blaze, scalar diffraction",
        reveals="interrupted steps; not an amplitude series",
        mistaken_for="delay and order together",
        fields=("optical",),
        delays=True,
    )

    def seen(self, y: Matrix, scene: Scene, psi: Vector) -> Matrix:
        """Segment by segment between commands."""
        out = y.copy()
        changes = np.unique(np.concatenate([drive.times for drive in scene.drives]))
        if not changes.size:  # no drive moves: there is no transition
            return out
        for axis in range(y.shape[1]):
            starts = changes + scene.direct(axis)[3]
            reached = _reached(scene.times, y[:, axis], starts)
            firsts = np.searchsorted(scene.times, starts)
            lasts = np.append(firsts[1:], scene.times.size)
            distance = 0.0  # distance of the centroid from the director as a segment begins
            for origin, end, change, first, last in zip(
                reached, np.append(reached[1:], np.nan), changes, firsts, lasts, strict=True
            ):
                travel = _target(scene, axis, float(change)) - origin
                moved = np.append(y[first:last, axis], end) - origin
                *late, distance = _distance(moved, travel, distance, float(psi[0]))
                out[first:last, axis] += late
        return out


def _reached(times: Vector, y: Vector, starts: Vector) -> Vector:
    """Deflection at the begin of each transition, (starts,), from the samples of the one before.

    A parabola through the last three of them goes on to the start: the response turns there, so that a
    sample after it says little. Where a transition has fewer, a line between the samples on both sides has
    half the error of any extrapolation. Accuracy: 3e-4 of the range where ten samples follow a time constant,
    against 2e-2 by such lines throughout.
    """
    out = np.interp(starts, times, y)
    ends = np.searchsorted(times, starts, side="right")
    begins = np.append(0, ends[:-1])
    for k, (start, begin, end) in enumerate(zip(starts, begins, ends, strict=True)):
        own = slice(max(int(begin), int(end) - 3), int(end))
        if end - begin >= (3 if k else 1):  # one is enough where the plant rests
            out[k] = _extrapolated(times[own], y[own], float(start))
    return out


def _extrapolated(at: Vector, values: Vector, to: float) -> float:
    """Value at `to` of the polynomial through all points (Lagrange's form)."""
    away = to - at
    others = ~np.eye(at.size, dtype=bool)
    gaps = np.where(others, at[:, None] - at, 1.0)
    return float(np.prod(np.where(others, away, 1.0) / gaps, axis=1) @ values)


def _target(scene: Scene, axis: int, change: float) -> float:
    """Deflection that the commands from `change` on lead to."""
    total = 0.0
    for j, drive in enumerate(scene.drives):
        held = int(np.searchsorted(drive.times, change, side="right"))
        level = scene.rest[j] + (drive.values[held - 1] if held else 0.0)
        total += float(scene.gains[axis, j] * level)
    return total


def _distance(moved: Array, travel: float, distance: float, strength: float) -> Array:
    """Centroid minus director after `moved` of a `travel`; `distance` is that at its begin."""
    a = moved / travel if travel != 0.0 else np.ones(moved.shape)
    inside = (a > 0) & (a < 1)
    q, other = np.sinc(1 - a[inside]) ** 2, np.sinc(a[inside]) ** 2
    out = distance * (1 - np.clip(a, 0.0, 1.0))
    out[inside] += strength * travel * (q / (q + other) - a[inside])
    return np.asarray(out)
