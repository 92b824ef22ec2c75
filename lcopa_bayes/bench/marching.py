"""Time marching of a path whose force depends on its own deflection, by the exact step response."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from lcopa_bayes.bench.inversion import unit_step
from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.model.path import TransferPath

Balance: TypeAlias = Callable[[Vector, Vector, Vector, int], Vector]
"""(force, deflection, its rate, each (axes,); number of the step) -> force that acts, (axes,)."""

_SWEEPS = 40
_CLOSE = 1e-13
"""Change of a deflection that ends the iteration of a step, over the largest force [-]."""


class MarchError(ArithmeticError):
    """The deflection is unbounded; holds the `time` reached."""

    def __init__(self, time: float) -> None:
        self.time = time
        super().__init__(f"the deflection runs away at {time:.6g}")


def step_means(edges: Vector, times: Vector, levels: Vector) -> Vector:
    """Mean, between successive edges, of a signal that has ``levels[i]`` from ``times[i]`` on, 0 before."""
    rise = np.maximum(edges[:, None] - times, 0.0)  # the integral of a unit step is a ramp
    area = rise @ np.diff(levels, prepend=0.0) if times.size else np.zeros(edges.size)
    return np.asarray(np.diff(area) / np.diff(edges))


def marched(
    paths: tuple[TransferPath, ...], force: Matrix, balance: Balance, level: Vector, step: float
) -> Matrix:
    """Deflections at the end of every step, (axes, n), of paths that rest at `level` before the first.

    ``y(t) = level + int S'(t - s) (v(s) - level) ds``, S the step response of stiffness 1, with v constant
    over each step and taken at its middle, ``v = balance(mean force, middle of y, rate of y)``; an implicit
    step is iterated. Parameters: force (axes, n), means over the steps. Accuracy: second order in `step`
    where v is smooth in y. Raises MarchError.
    """
    axes, n = force.shape
    lags = step * np.arange(n + 1)
    kernel = np.stack([np.diff(unit_step(path, lags)) for path in paths])
    backward = kernel[:, ::-1].copy()
    acting, y = np.zeros((axes, n)), np.zeros((axes, n))
    before = np.zeros(axes)
    bound = 1e6 * float(np.abs(force).max() + np.abs(level).max() + 1e-300)
    close = _CLOSE * bound / 1e6
    for k in range(n):
        history = np.einsum("ij,ij->i", acting[:, :k], backward[:, n - k - 1 : n - 1])
        now = history + kernel[:, 0] * (acting[:, k - 1] if k else 0.0)
        with np.errstate(over="ignore", invalid="ignore"):  # divergence raises below
            for _ in range(_SWEEPS):
                v = balance(force[:, k], level + 0.5 * (now + before), (now - before) / step, k) - level
                new = history + kernel[:, 0] * v
                moved = np.abs(new - now).max()
                now = new
                if moved <= close:
                    break
        if not np.abs(now).max() < bound:
            raise MarchError(step * k)
        acting[:, k], y[:, k], before = v, now, now
    return y + level[:, None]
