"""Response of linear paths under a force that depends on the response itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
from scipy import fft

from lcopa_bayes.core.arrays import Array, Flags, Index, Matrix

Force: TypeAlias = Callable[[slice | Index, Matrix, Matrix, Matrix], Matrix]
"""(blocks, deviation of y, its values one and two blocks before) -> deviation of the force, each of
(rows, blocks); blocks by their positions may come several times."""

TOLERANCE = 1e-12
"""Change of y in the last iteration over the largest y [-]."""
RUNAWAY = 1e6
"""A response this many times its scale has run away [-]."""
_DEPTH = 4
"""Earlier iterates that the acceleration combines (Anderson 1965, J. ACM 12)."""
_LEVELS = 400
"""Most steps towards the level at rest [-]."""
_STRETCH = 16
"""Blocks that Newton's method solves at once [-]: each takes as many times longer as there are others, and
calls cost as much as that only for fewer."""
_NEWTON = 12
_NUDGE = 1e-6
_JUMP = 1e-9
"""Width of a bracket over the scale in which a force is taken to jump [-]."""
_WIDENED, _HALVED = 60, 120
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
    swept: Callable[[Index, Array], Array],
    start: Array,
    scale: Array,
    most: int,
    *,
    tolerance: float = TOLERANCE,
) -> tuple[Array, Flags]:
    """Fixed points of `swept` for many plants, (plants, axes, n), by at most so many accelerated sweeps, and
    which plants have reached theirs; the others are as far as the iteration got.

    Parameters: swept, from plants by number and their y, as `start`, to their next y; scale (plants, axes,
    1), typical size of y. Accuracy: `tolerance` of the scale.
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
        done = size < tolerance
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


def marched(
    kernel: Matrix,
    force: Force,
    scale: Matrix,
    plants: int,
    *,
    near: Matrix | None = None,
    tolerance: float = TOLERANCE,
) -> tuple[Array, Flags]:
    """``y = kernel * force(y)``, causal convolution, stretch by stretch where `iterated` fails on the whole:
    (plants, axes, n), and which plants have no bounded solution, (plants,).

    Parameters: kernel (rows, n), the impulse response in block means, of every axis of every plant; scale
    (rows, 1), typical size of y; `near` (rows, n), where Newton's method starts, by default from what the
    past leaves. A stretch is solved by Newton's method, for rows where that fails block by
    block, each one equation. Accuracy: `tolerance` of the scale, block by block 1e-12.
    """
    rows, n = kernel.shape
    window = min(n, _STRETCH)
    lags = np.subtract.outer(np.arange(window), np.arange(window))
    operator = np.where(lags >= 0, kernel[:, np.maximum(lags, 0)], 0.0)
    y, history, lost = np.zeros((rows, n + 2)), np.zeros((rows, n)), np.zeros(rows, dtype=bool)
    pushes, spectra = np.zeros((rows, n)), dict[int, Any]()
    for first in range(0, n, window):
        own = slice(first, min(first + window, n))
        size = own.stop - first
        before, past = y[:, first : first + 2], history[:, own]
        begin = past if near is None else near[:, own]
        now, v, solved = _newton(operator[:, :size, :size], past, before, force, own, begin, scale, tolerance)
        if not (solved | lost).all():
            known = solved | lost
            slow, pushed = _blockwise(operator[:, :size, :size], past, before, force, own, scale, known)
            now, v = (np.where(solved[:, None], *pair) for pair in ((now, slow), (v, pushed)))
        with np.errstate(invalid="ignore"):
            lost |= ~(np.abs(now) < RUNAWAY * scale).all(axis=1)
        y[:, first + 2 : own.stop + 2] = np.where(lost[:, None], 0.0, now)
        pushes[:, own] = np.where(lost[:, None], 0.0, v)
        # as many stretches ahead as divide those that are done: each pair of stretches meets once, in one of
        # few long transforms (van der Hoeven 2002, J. Symb. Comput. 34)
        done = own.stop // window
        reach = window * (done & -done)
        if own.stop < n:
            if reach not in spectra:
                spectra[reach] = fft.rfft(kernel[:, : 2 * reach], 2 * reach)
            acted = spectra[reach] * fft.rfft(pushes[:, own.stop - reach : own.stop], 2 * reach)
            ahead = history[:, own.stop : own.stop + reach]
            ahead += fft.irfft(acted, 2 * reach)[:, reach : reach + ahead.shape[1]]
    away: Flags = np.asarray(lost.reshape(plants, -1).any(axis=1))
    return y[:, 2:].reshape(plants, -1, n), away


def _newton(
    operator: Array,
    past: Matrix,
    before: Matrix,
    force: Force,
    own: slice,
    start: Matrix,
    scale: Matrix,
    tolerance: float,
) -> tuple[Matrix, Matrix, Flags]:
    """``y = past + operator @ force(y)`` on a stretch, the force, both (rows, blocks), and what is solved,
    (rows,). Slopes of the force, in y and in its two earlier values, are differences over 1e-6 of the scale.
    """
    rows, n = past.shape
    nudge = _NUDGE * scale[..., None] * np.eye(4)[1:].T  # (rows, 4 variants, 3 arguments)
    every = np.tile(np.arange(own.start, own.stop), 4)
    y, solved = start, np.zeros(rows, dtype=bool)
    out, pushed = past.copy(), np.zeros(past.shape)
    for _ in range(_NEWTON):
        with np.errstate(over="ignore", invalid="ignore"):
            values = (y, *earlier(before, y))
            varied = [(v[:, None] + nudge[:, :, k, None]).reshape(rows, -1) for k, v in enumerate(values)]
            forces = force(every, *varied).reshape(rows, 4, n)
            slopes = (forces[:, 1:] - forces[:, :1]) / (_NUDGE * scale[..., None])
            residual = past - y + (operator @ forces[:, 0, :, None])[..., 0]
            done = np.abs(residual / scale).max(axis=1) < tolerance
        new = done & ~solved
        out[new], pushed[new] = (y + residual)[new], forces[new, 0]
        solved |= done
        usable = np.isfinite(slopes).all(axis=(1, 2)) & np.isfinite(residual).all(axis=1)
        if solved.all() or not (usable & ~solved).any():
            break
        matrix = np.eye(n) - operator * slopes[:, :1]
        for back in (back for back in (1, 2) if slopes[:, back].any()):
            matrix[:, :, :-back] -= operator[:, :, back:] * slopes[:, back, None, back:]
        matrix[~usable], residual[~usable] = np.eye(n), 0.0
        try:
            y = y + np.linalg.solve(matrix, residual[..., None])[..., 0]
        except np.linalg.LinAlgError:
            break
    return out, pushed, solved


def _blockwise(
    operator: Array, past: Matrix, before: Matrix, force: Force, own: slice, scale: Matrix, known: Flags
) -> tuple[Matrix, Matrix]:
    """The same block by block, by regula falsi (Dowell and Jarratt 1971, BIT 11) with bisections between: a
    force that all but jumps is met at the jump."""
    y, v = np.concatenate((before, past), axis=1), np.zeros(past.shape)
    for k in range(past.shape[1]):
        before_it = past[:, k, None] + np.vecdot(operator[:, k, :k], v[:, :k])[:, None]
        one, two, place = y[:, k + 1, None], y[:, k, None], slice(own.start + k, own.start + k + 1)

        def excess(
            at: Matrix, place: slice = place, one: Matrix = one, two: Matrix = two, past: Matrix = before_it
        ) -> Matrix:
            with np.errstate(over="ignore", invalid="ignore"):
                return np.asarray(at - past - operator[:, :1, 0] * force(place, at, one, two))

        now = _root(excess, 2 * one - two, scale, known[:, None])
        y[:, k + 2, None] = np.where(np.isfinite(now), now, RUNAWAY * scale)
        v[:, k, None] = force(place, y[:, k + 2, None], one, two)
    return y[:, 2:], v


def _root(excess: Callable[[Matrix], Matrix], start: Matrix, scale: Matrix, known: Flags) -> Matrix:
    """Where an excess that rises in the end is 0, (rows, 1); NaN where it is so nowhere near, or not asked
    for because it is known, (rows, 1)."""
    a, low = start, excess(start)
    step = -low
    b, high = a + step, excess(a + step)
    for _ in range(_WIDENED):
        outside = (np.sign(high) == np.sign(low)) & (np.abs(b) < RUNAWAY * scale) & ~known
        if not outside.any():
            break
        step = np.where(outside, 2.0 * step, step)
        a, low = np.where(outside, b, a), np.where(outside, high, low)
        b = np.where(outside, b + step, b)
        high = np.where(outside, excess(b), high)
    found, done = np.where(low == 0.0, a, np.nan), ~(np.sign(high) * np.sign(low) < 0) | known
    for count in range(_HALVED):
        if done.all():
            break
        with np.errstate(divide="ignore", invalid="ignore"):
            c = (a * high - b * low) / (high - low)
        c = np.where(np.isfinite(c) & (count % 3 < 2), c, 0.5 * (a + b))
        value = excess(c)
        found = np.where(done, found, c)
        beyond = np.sign(value) == np.sign(high)
        a, b = np.where(beyond, a, c), np.where(beyond, c, b)
        low, high = np.where(beyond, 0.5 * low, value), np.where(beyond, value, 0.5 * high)
        done |= np.isnan(value) | (np.abs(value) <= TOLERANCE * scale) | (np.abs(b - a) <= _JUMP * scale)
    return found


def earlier(before: Matrix, y: Matrix) -> tuple[Matrix, Matrix]:
    """Values one and two blocks before those of `y`, from the two blocks before its first."""
    joined = np.concatenate((before, y), axis=1)
    return joined[:, 1:-1], joined[:, :-2]
