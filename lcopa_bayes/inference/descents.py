"""Descents from several points at once: Levenberg and Marquardt's, between bounds.

A response of one plant costs hardly less than those of several together, and descents are many where a
density may have several modes.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol, final

import numpy as np

from lcopa_bayes.core.arrays import Array, Flags, Matrix, Vector

_DAMPING = (1e-2, 1e-9, 1e6)
"""Damping at the start, least and most, relative to the curvature [-]."""
_AGREEING, _CLOSE = 0.25, 0.75
"""Gains over those promised above which damping stays, and above which it falls [-]."""
_LESS, _MORE = 0.1, 4.0
"""Factors on a damping that falls and on one that grows [-]."""
_AT_END = 1e-6
"""Room up to which a coordinate is at its end [standard deviation of the information of itself]."""
_FREE = 1.0
"""Largest damping at which a step that promises little shows an optimum [-]."""
_FASTER, _HOPELESS = 100.0, 50.0
"""How many times faster than a step promises a descent may go on, and how far below the best of its batch it
then stays where it cannot matter [-, nat]."""


@final
class Place(NamedTuple):
    """Points and what a descent knows there, (batch, ...)."""

    points: Matrix
    level: Vector
    """Log density, -inf where there is none [nat]."""
    gradient: Matrix
    """In coordinates that move, (batch, size)."""
    information: Array
    """(batch, size, size), positive semidefinite."""


class Landscape(Protocol):
    """What has optima."""

    def at(self, points: Matrix, /) -> Place:
        """What a descent knows at points."""

    def room(self, points: Matrix, /) -> tuple[Matrix, Matrix]:
        """Steps from points to the least and to the largest coordinates, (batch, size)."""

    def moved(self, points: Matrix, steps: Matrix, /) -> Matrix:
        """Points so many steps on, (batch, size)."""


def descended(landscape: Landscape, points: Matrix, *, steps: int, least: float) -> Place:
    """Where descents from points end: after so many `steps` at most, or where one gains less than `least`
    [nat], or those that remain promise too little to come near the best of the batch."""
    at = landscape.at(points.copy())
    damping, gained = np.full(len(points), _DAMPING[0]), np.full(len(points), np.inf)
    moving = np.arange(len(points))
    for remaining in range(steps, 0, -1):
        here = Place(*(part[moving] for part in at))
        step, unbound, clipped = _step(here, damping[moving], *landscape.room(here.points))
        bent = (here.information @ step[..., None])[..., 0]
        promised = (step * (here.gradient - 0.5 * bent)).sum(axis=1)
        likely = np.minimum(unbound, gained[moving])
        hopeless = here.level + _FASTER * remaining * likely + _HOPELESS < at.level.max()
        going = ~hopeless & ((unbound >= least) | (damping[moving] > _FREE)) & (gained[moving] >= least)
        moving, promised, clipped = moving[going], promised[going], clipped[going]
        if not moving.size:
            break
        new = landscape.at(landscape.moved(here.points[going], step[going]))
        gain = new.level - at.level[moving]
        better = gain > 0.0
        agreeing = better & (gain > _AGREEING * promised)
        for old, now in zip(at, new, strict=True):
            old[moving[better]] = now[better]
        gained[moving[agreeing]] = np.where(clipped, np.inf, gain)[agreeing]
        change = np.select([agreeing & (gain > _CLOSE * promised), agreeing], [_LESS, 1.0], _MORE)
        damping[moving] = np.clip(change * damping[moving], *_DAMPING[1:])
    return at


def _step(here: Place, damping: Vector, low: Matrix, high: Matrix) -> tuple[Matrix, Vector, Flags]:
    """Damped steps, (batch, size), from `low` to `high`; the gain that slopes promise to what no end holds
    back, (batch,) [nat]; and whether the step had to be cut, (batch,).

    What an end holds against its slope stays there (Bertsekas 1982, SIAM J. Control Optim. 20); what would
    leave the ends stops there, and the others follow.
    """
    scale = np.sqrt(np.maximum(np.diagonal(here.information, axis1=1, axis2=2), 1e-300))
    curved = here.information / scale[:, :, None] / scale[:, None, :]
    curved += damping[:, None, None] * np.eye(scale.shape[1])
    slope = here.gradient / scale
    still = ((low * scale >= -_AT_END) & (slope < 0.0)) | ((high * scale <= _AT_END) & (slope > 0.0))
    step = solve_with_held(curved, slope, still, np.zeros(slope.shape)) / scale
    promised = 0.5 * (step * here.gradient).sum(axis=1)
    leaving = (step < low) | (step > high)
    if leaving.any():
        ends = np.where(leaving, np.clip(step, low, high), 0.0)
        step = np.clip(solve_with_held(curved, slope, still | leaving, ends * scale) / scale, low, high)
    return step, promised, np.asarray(leaving.any(axis=1))


def solve_with_held(matrix: Array, right: Matrix, held: Flags, values: Matrix) -> Matrix:
    """Solutions of linear systems with the values of some of their unknowns held, (batch, size)."""
    free = ~held
    right = np.where(held, values, right - (matrix @ np.where(held, values, 0.0)[..., None])[..., 0])
    kept = matrix * (free[:, :, None] & free[:, None, :]) + np.eye(right.shape[1]) * held[:, :, None]
    return np.asarray(np.linalg.solve(kept, right[..., None])[..., 0])
