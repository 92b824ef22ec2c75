"""Response of linear paths under a force that depends on the response itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from lcopa_bayes.core.arrays import Array, Flags, Index, Matrix

Force: TypeAlias = Callable[[slice, Matrix, Matrix, Matrix], Matrix]
"""(blocks, deviation of y, its values one and two blocks before) -> deviation of the force, each of
(rows, blocks)."""

TOLERANCE = 1e-12
"""Change of y in the last iteration over the largest y [-]."""
RUNAWAY = 1e6
"""A response this many times its scale has run away [-]."""
_DEPTH = 4
"""Earlier iterates that the acceleration combines (Anderson 1965, J. ACM 12)."""
_LEVELS = 400
"""Most steps towards the level at rest [-]."""
_WIDENED, _HALVED = 60, 60
"""Most steps towards a bracket of a root, and within it [-]."""


def resting(force: Callable[[Matrix], Matrix], start: Matrix, scale: Matrix) -> tuple[Matrix, Flags]:
    """Level at which ``force(y) = y``, (rows, 1), by the secant method from `start`, and where it is known,
    (rows,); `scale` (rows, 1)."""
    y = start
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        ahead, step = force(y) - y, 1e-6 * scale
        for _ in range(_LEVELS):
            done, bound = np.abs(ahead) <= TOLERANCE * scale, np.abs(y) < RUNAWAY * scale
            if (done | ~bound).all():  # NaN is not bound
                break
            slope = (force(y + step) - (y + step) - ahead) / step
            move = np.where(done, 0.0, -ahead / slope)
            y, ahead = y + move, force(y + move) - (y + move)
            step = np.where(done, 1e-6 * scale, 1e-3 * move)
        known: Flags = (np.abs(ahead) <= TOLERANCE * scale) & (np.abs(y) < RUNAWAY * scale)
    return y, known[:, 0]


def iterated(
    swept: Callable[[Index, Array], Array], start: Array, scale: Array, most: int
) -> tuple[Array, Flags]:
    """Fixed points of `swept` for many plants, (plants, axes, n), by at most so many accelerated sweeps, and
    which plants have reached theirs; the others are as far as the iteration got.

    Parameters: swept, from plants by number and their y, as `start`, to their next y; scale (plants, axes,
    1), typical size of y. Accuracy: 1e-12 of the scale.
    """
    y, out = start, start.copy()
    plants, solved = np.arange(len(start)), np.zeros(len(start), dtype=bool)
    steps: list[Matrix] = []
    points: list[Matrix] = []
    for _ in range(most):
        if not plants.size:
            break
        with np.errstate(over="ignore", invalid="ignore"):
            target = swept(plants, y)
            change = (target - y) / scale[plants]
            size = np.abs(change).max(axis=(1, 2))
        done = size < TOLERANCE
        out[plants[done]], solved[plants[done]] = target[done], True
        kept = ~done & (size < RUNAWAY)  # NaN is not kept
        steps.append(change.reshape(plants.size, -1))
        points.append((target / scale[plants]).reshape(plants.size, -1))
        del steps[: -_DEPTH - 1], points[: -_DEPTH - 1]
        if not kept.all():
            plants, target = plants[kept], target[kept]
            steps, points = [one[kept] for one in steps], [one[kept] for one in points]
        out[plants] = target
        y = target if len(steps) == 1 else _mixed(steps, points).reshape(target.shape) * scale[plants]
    return out, solved


def _mixed(steps: Sequence[Matrix], points: Sequence[Matrix]) -> Matrix:
    """The combination of iterates whose steps add up to least, plant by plant."""
    last = steps[-1]
    differences = np.stack([last - step for step in steps[:-1]], axis=1)
    gram = differences @ differences.swapaxes(1, 2)
    weights = np.linalg.pinv(gram, rcond=1e-14, hermitian=True) @ (differences @ last[..., None])
    apart = np.stack([points[-1] - point for point in points[:-1]], axis=1)
    return np.asarray(points[-1] - (weights.swapaxes(1, 2) @ apart)[:, 0])


def marched(kernel: Matrix, force: Force, scale: Matrix, plants: int) -> tuple[Array, Flags]:
    """``y = kernel * force(y)``, causal convolution, block by block where `iterated` fails on the whole:
    (plants, axes, n), and which plants have no bounded solution, (plants,).

    Parameters: kernel (rows, n), the impulse response in block means, of every axis of every plant; scale
    (rows, 1), typical size of y. Each block is one equation per row, solved by regula falsi with weights of
    Anderson and Bjoerck (1973, BIT 13) to 1e-12 of the scale; a force that jumps is met at the jump.
    """
    rows, n = kernel.shape
    y, v = np.zeros((rows, n + 2)), np.zeros((rows, n))
    lost: Flags = np.zeros((rows, 1), dtype=bool)
    for k in range(n):
        history = np.einsum("rk,rk->r", kernel[:, k:0:-1], v[:, :k])[:, None]
        one, two, own = y[:, k + 1, None], y[:, k, None], slice(k, k + 1)

        def excess(
            at: Matrix, own: slice = own, one: Matrix = one, two: Matrix = two, history: Matrix = history
        ) -> Matrix:
            with np.errstate(over="ignore", invalid="ignore"):
                return np.asarray(at - history - kernel[:, :1] * force(own, at, one, two))

        y[:, k + 2, None] = now = _root(excess, 2 * one - two, scale)
        lost |= ~(np.abs(now) < RUNAWAY * scale)
        y[lost[:, 0], : k + 3] = 0.0
        v[:, own] = force(own, y[:, k + 2, None], one, two)
    away: Flags = np.asarray(lost.reshape(plants, -1).any(axis=1))
    return y[:, 2:].reshape(plants, -1, n), away


def _root(excess: Callable[[Matrix], Matrix], start: Matrix, scale: Matrix) -> Matrix:
    """Where an excess that rises in the end is 0, (rows, 1); NaN where it is so nowhere near."""
    a, low = start, excess(start)
    step = -low
    b, high = a + step, excess(a + step)
    for _ in range(_WIDENED):
        outside = np.sign(high) == np.sign(low)
        if not outside.any():
            break
        step = np.where(outside, 2.0 * step, step)
        a, low = np.where(outside, b, a), np.where(outside, high, low)
        b = np.where(outside, b + step, b)
        high = np.where(outside, excess(b), high)
    found = np.where(np.sign(high) == np.sign(low), np.nan, b)
    found = np.where(low == 0.0, a, found)
    tolerance = TOLERANCE * scale
    for _ in range(_HALVED):
        with np.errstate(divide="ignore", invalid="ignore"):
            c = (a * high - b * low) / (high - low)
            c = np.where(np.isfinite(c), c, 0.5 * (a + b))
            value = excess(c)
            within = np.sign(value) == np.sign(high)
            share = 1.0 - value / np.where(within, high, 1.0)
        low = np.where(within, np.where(share > 0, share, 0.5) * low, high)
        a = np.where(within, a, b)
        b, high = c, value
        if ((np.abs(high) <= tolerance) | (np.abs(b - a) <= tolerance) | np.isnan(found)).all():
            break
    return np.where(np.isnan(found), np.nan, b)


def earlier(before: Matrix, y: Matrix) -> tuple[Matrix, Matrix]:
    """Values one and two blocks before those of `y`, from the two blocks before its first."""
    joined = np.concatenate((before, y), axis=1)
    return joined[:, 1:-1], joined[:, :-2]
