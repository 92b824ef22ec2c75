"""Level at which a plant rests under a force that depends on the response itself."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lcopa_bayes.arrays import Matrix, Vector
from lcopa_bayes.plant.effects.balance import RUNAWAY, TOLERANCE, RunawayError

_STEPS = 400


def resting(force: Callable[[Matrix], Matrix], start: Matrix, scale: Vector) -> Matrix:
    """Level at which ``force(y) = y``, (axes, 1), by the secant method from `start`; raises RunawayError."""
    y, small, size = start, TOLERANCE * scale[:, None], scale[:, None]
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        ahead = force(y) - y
        step = np.full(y.shape, 1e-6) * size
        for _ in range(_STEPS):
            done = np.abs(ahead) <= small
            if done.all():
                return y
            slope = (force(y + step) - (y + step) - ahead) / step
            move = np.where(done, 0.0, -ahead / slope)
            y, ahead = y + move, force(y + move) - (y + move)
            if not np.all(np.abs(y) < RUNAWAY * size):  # NaN too
                break
            step = np.where(done, 1e-6 * size, 1e-3 * move)
    raise RunawayError(0)
