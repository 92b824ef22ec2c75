"""The centroid between diffraction orders while the director turns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, final

import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.model.effects.effect import Card, Coefficient, Ranges, ReadoutEffect, Scene, single


@final
@dataclass(frozen=True)
class CrossFade(ReadoutEffect):
    """The far field passes from one diffraction order to the next: the centroid waits, then hurries.

    Homogeneous of degree 1, so that an amplitude series does not show it. A transition that is
    interrupted starts anew from the director's deflection; what the centroid lacks then fades with it.
    """

    per_command: ClassVar[bool] = True
    card: ClassVar[Card] = Card(
        name="cross_fade",
        place="output",
        formula="y = y0 + (y1 - y0) q / (q + q'), q = sinc^2(1 - a), q' = sinc^2(a), "
        "a = progress from y0 to y1",
        source="efficiencies of a re-written blaze, scalar diffraction",
        reveals="interrupted steps; not an amplitude series",
        mistaken_for="delay and order together",
    )

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """Strength [-]: 1 is the formula, 0 the centroid that follows the director."""
        return single("strength", 0.6, one_signed=True)

    def seen(self, y: Matrix, scene: Scene, psi: Vector) -> Matrix:
        """Segment by segment between commands."""
        out = y.copy()
        changes = np.unique(np.concatenate([drive.times for drive in scene.drives]))
        if not changes.size:  # no drive moves: there is no transition
            return out
        for axis in range(y.shape[1]):
            starts = changes + scene.direct(axis)[3]
            origins = np.interp(starts, scene.times, y[:, axis])
            firsts = np.searchsorted(scene.times, starts)
            lasts = np.append(firsts[1:], scene.times.size)
            left = 0.0  # what the centroid still lacks of the director's deflection when a segment begins
            for start, origin, change, first, last in zip(
                starts, origins, changes, firsts, lasts, strict=True
            ):
                way = _target(scene, axis, float(change)) - origin
                out[first:last, axis] += _lack(y[first:last, axis] - origin, way, left, float(psi[0]))
                later = starts[starts > start]
                if later.size:
                    there = np.interp(later[:1], scene.times, y[:, axis]) - origin
                    left = float(_lack(there, way, left, float(psi[0]))[0])
        return out


def _target(scene: Scene, axis: int, change: float) -> float:
    """Deflection that the commands from `change` on lead to."""
    total = 0.0
    for j, drive in enumerate(scene.drives):
        held = int(np.searchsorted(drive.times, change, side="right"))
        level = scene.rest[j] + (drive.values[held - 1] if held else 0.0)
        total += float(scene.gains[axis, j] * level)
    return total


def _lack(moved: Array, way: float, left: float, strength: float) -> Array:
    """Centroid minus director after `moved` of a `way`; `left` at its begin."""
    a = moved / way if way != 0.0 else np.ones(moved.shape)
    inside = (a > 0) & (a < 1)
    q, other = np.sinc(1 - a[inside]) ** 2, np.sinc(a[inside]) ** 2
    out = left * (1 - np.clip(a, 0.0, 1.0))
    out[inside] += strength * way * (q / (q + other) - a[inside])
    return np.asarray(out)
