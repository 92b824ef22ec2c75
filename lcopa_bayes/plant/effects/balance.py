"""Response of linear paths under a force that depends on the response itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from scipy import fft
from scipy.linalg import solve_triangular, toeplitz

from lcopa_bayes.arrays import Matrix, Vector

Force: TypeAlias = Callable[[slice, Matrix, Matrix, Matrix], Matrix]
"""(blocks, deviation of y, its values one and two blocks before) -> deviation of the force, each of
(axes, blocks)."""

_TOLERANCE = 1e-12
"""Change of y in the last iteration over the largest y [-]."""
_SWEEPS = 32
_PATIENCE = 2.5
"""How far the pace of the last sweeps may fall short: acceleration grows [-]."""
_DEPTH = 4
"""Earlier iterates that the acceleration combines (Anderson 1965, J. ACM 12)."""
_DENSE = 128
"""Longest stretch for a dense matrix [blocks]."""
_NEWTON = 12
_NUDGE = 1e-6
_SINGULAR = 1e-3
"""Below this a block's own feed-through leaves Newton's step undetermined [-]."""
_LEAST = 2
"""Windows this short are iterated to the end."""
_LONG_SWEEPS = 400
_SHARES = (0.5, 0.2, 0.05)
"""Steps of an iteration that would overshoot, over the way to its target [-]."""
_RUNAWAY = 1e6
"""A response this many times its scale has run away [-]."""


class RunawayError(ArithmeticError):
    """No bounded solution; carries the `block` where it was lost."""

    def __init__(self, block: int) -> None:
        self.block = block
        super().__init__(f"the response runs away at block {block}")


def balanced(kernel: Matrix, force: Force, scale: Vector) -> Matrix:
    """``y = kernel * force(y)``, causal convolution, (axes, n).

    Parameters: kernel (axes, n), the impulse response in block means; scale (axes,), typical size of y.
    The whole is iterated with acceleration. When that does not converge it is halved, the first half
    solved and its convolution carried into the second; stretches of up to 128 blocks are solved by
    Newton's method, or halved further, down to two blocks, where the direct feed-through is small.
    Raises RunawayError. Accuracy: 1e-12 of the scale per iteration.
    """
    y, v = np.zeros(kernel.shape), np.zeros(kernel.shape)
    _solve(kernel, force, y, v, scale[:, None], 0, kernel.shape[1], kernel.shape[1])
    return y


def _solve(
    kernel: Matrix, force: Force, y: Matrix, v: Matrix, scale: Matrix, a: int, b: int, limit: int
) -> int:
    """Solve blocks a to b in place; `y` holds there what earlier forces leave, on return the response.

    A stretch longer than `limit` is halved untried. Returns the limit that experience suggests.
    """
    n = b - a
    if n <= max(limit, _LEAST):
        before = np.concatenate((np.zeros((y.shape[0], 2)), y[:, max(a - 2, 0) : a]), axis=1)[:, -2:]
        method = _newton if _LEAST < n <= _DENSE else _iterate
        found = method(kernel[:, :n], force, y[:, a:b].copy(), before, scale, slice(a, b))
        if found is None and n <= _LEAST:
            found = _relaxed(kernel[:, :n], force, y[:, a:b].copy(), before, scale, slice(a, b))
        if found is not None:
            y[:, a:b], v[:, a:b] = found
            return limit if limit > _DENSE else min(_DENSE, max(limit, 2 * n))
        if n <= _LEAST:
            raise RunawayError(a)
        limit = min(n // 2, _DENSE)
    middle = (a + b) // 2
    limit = _solve(kernel, force, y, v, scale, a, middle, limit)
    y[:, middle:b] += convolved(kernel[:, :n], v[:, a:middle])[:, middle - a :]
    return _solve(kernel, force, y, v, scale, middle, b, limit)


def _newton(
    kernel: Matrix, force: Force, history: Matrix, before: Matrix, scale: Matrix, blocks: slice
) -> tuple[Matrix, Matrix] | None:
    """Fixed point as in `_iterate`, by Newton's method.

    Slopes of the force, in y and in its two earlier values, are differences over 1e-6 of the scale; that
    of one axis in another is left to the iteration.
    """
    n = kernel.shape[1]
    operators = [toeplitz(row, np.zeros(n)) for row in kernel]
    y = history
    for _ in range(_NEWTON):
        with np.errstate(over="ignore", invalid="ignore"):
            one, two = _earlier(before, y)
            v = force(blocks, y, one, two)
            nudge = _NUDGE * scale
            slopes = [
                (force(blocks, y + nudge, one, two) - v) / nudge,
                (force(blocks, y, one + nudge, two) - v) / nudge,
                (force(blocks, y, one, two + nudge) - v) / nudge,
            ]
            left = history + np.stack([k @ row for k, row in zip(operators, v, strict=True)]) - y
        size = float(np.abs(left / scale).max())
        if not (size < _RUNAWAY and np.isfinite(sum(slopes)).all()):  # NaN too
            return None
        if size < _TOLERANCE:
            return y + left, v
        step = np.empty_like(y)
        for i, operator in enumerate(operators):
            matrix = np.eye(n)
            for back, slope in enumerate(slopes):
                matrix[:, : n - back] -= operator[:, back:] * slope[i, back:]
            if not np.all(np.abs(np.diag(matrix)) > _SINGULAR):
                return None
            step[i] = solve_triangular(matrix, left[i], lower=True, check_finite=False)
        y = y + step
    return None


def _earlier(before: Matrix, y: Matrix) -> tuple[Matrix, Matrix]:
    """Values one and two blocks before those of `y`, from the two blocks before its first."""
    joined = np.concatenate((before, y), axis=1)
    return joined[:, 1:-1], joined[:, :-2]


def convolved(kernel: Matrix, v: Matrix) -> Matrix:
    """Causal convolution along the last axis, as long as the kernel."""
    n, m = kernel.shape[1], v.shape[1]
    if n <= 32:
        out = np.zeros(kernel.shape)
        for k in range(m):
            out[:, k:] += v[:, k : k + 1] * kernel[:, : n - k]
        return out
    length = fft.next_fast_len(n + m - 1, real=True)
    product = fft.rfft(kernel, length) * fft.rfft(v, length)
    return np.asarray(fft.irfft(product, length)[:, :n])


def _iterate(
    kernel: Matrix, force: Force, history: Matrix, before: Matrix, scale: Matrix, blocks: slice
) -> tuple[Matrix, Matrix] | None:
    """Fixed point of ``y = history + kernel * force(y)``, or None."""
    n = kernel.shape[1]
    short = n <= _LEAST
    length = fft.next_fast_len(2 * n - 1, real=True)
    spectrum = None if n <= 32 else fft.rfft(kernel, length)

    def swept(y: Matrix) -> tuple[Matrix, Matrix]:
        v = force(blocks, y, *_earlier(before, y))
        if spectrum is None:
            return history + convolved(kernel, v), v
        return history + fft.irfft(spectrum * fft.rfft(v, length), length)[:, :n], v

    y = history
    steps: list[Vector] = []
    points: list[Vector] = []
    sizes: list[float] = []
    for sweep in range(_LONG_SWEEPS if short else _SWEEPS):
        with np.errstate(over="ignore", invalid="ignore"):
            target, v = swept(y)
            change = (target - y) / scale
        size = float(np.abs(change).max())
        if not size < _RUNAWAY:  # NaN too
            return None
        if size < _TOLERANCE:
            return target, v
        sizes.append(size)
        if sweep >= 8 and not short:  # give up early where the pace of the last sweeps would not do
            pace = np.log(size / sizes[-6]) / 5
            if pace >= 0 or np.log(_TOLERANCE / size) / pace > _PATIENCE * (_SWEEPS - sweep):
                return None
        steps.append(change.ravel())
        points.append((target / scale).ravel())
        del steps[: -_DEPTH - 1], points[: -_DEPTH - 1]
        if sweep < 1:
            y = target
            continue
        last = steps[-1]
        differences = np.stack([last - step for step in steps[:-1]], axis=1)
        weights = np.linalg.lstsq(differences, last, rcond=1e-12)[0]
        mixed = points[-1] - np.stack([points[-1] - p for p in points[:-1]], axis=1) @ weights
        y = mixed.reshape(y.shape) * scale
    return None


def _relaxed(
    kernel: Matrix, force: Force, history: Matrix, before: Matrix, scale: Matrix, blocks: slice
) -> tuple[Matrix, Matrix] | None:
    """The same for a few blocks where the force turns too steeply for `_iterate`, by shorter steps."""
    for share in _SHARES:
        y = history
        for _ in range(_LONG_SWEEPS):
            with np.errstate(over="ignore", invalid="ignore"):
                v = force(blocks, y, *_earlier(before, y))
                target = history + convolved(kernel, v)
                size = float(np.abs((target - y) / scale).max())
            if not size < _RUNAWAY:  # NaN too
                break
            if size < _TOLERANCE:
                return target, v
            y = y + share * (target - y)
    return None


def resting(force: Callable[[Matrix], Matrix], start: Matrix, scale: Vector) -> Matrix:
    """Level at which ``force(y) = y``, (axes, 1), by the secant method from `start`; raises RunawayError."""
    y, small, size = start, _TOLERANCE * scale[:, None], scale[:, None]
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        ahead = force(y) - y
        step = np.full(y.shape, 1e-6) * size
        for _ in range(_LONG_SWEEPS):
            done = np.abs(ahead) <= small
            if done.all():
                return y
            slope = (force(y + step) - (y + step) - ahead) / step
            move = np.where(done, 0.0, -ahead / slope)
            y, ahead = y + move, force(y + move) - (y + move)
            if not np.all(np.abs(y) < _RUNAWAY * size):  # NaN too
                break
            step = np.where(done, 1e-6 * size, 1e-3 * move)
    raise RunawayError(0)
