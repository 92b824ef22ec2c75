"""Response of linear paths under a force that depends on the response itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy import fft
from scipy.linalg import toeplitz
from scipy.linalg.lapack import dtrtrs

from lcopa_bayes.core.arrays import Index, Matrix, Vector

_STEPS = 400

Force: TypeAlias = Callable[[slice | Index, Matrix, Matrix, Matrix], Matrix]
"""(blocks, deviation of y, its values one and two blocks before) -> deviation of the force, each of
(axes, blocks); blocks by their positions may come several times."""

TOLERANCE = 1e-12
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
"""Steps of an iteration that would overshoot, over the distance to its target [-]."""
RUNAWAY = 1e6
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
    solved and its convolution added to the second; stretches of up to 128 blocks are solved by
    Newton's method, or halved further, down to two blocks, where the direct feed-through is small.
    Raises RunawayError. Accuracy: 1e-12 of the scale per iteration.
    """
    y, v = np.zeros(kernel.shape), np.zeros(kernel.shape)
    reach = min(kernel.shape[1], _DENSE)
    operators = [np.asfortranarray(toeplitz(row[:reach], np.zeros(reach))) for row in kernel]
    problem = _Balance(kernel, operators, force, scale[:, None], y, v)
    problem.solve(0, kernel.shape[1], kernel.shape[1], None)
    return y


@dataclass(frozen=True, eq=False)
class _Balance:
    """What is solved, and what of it is."""

    kernel: Matrix
    operators: list[Matrix]
    """Convolution with each row of the kernel, over the longest dense stretch; its leading part over less."""
    force: Force
    scale: Matrix
    """(axes, 1)."""
    y: Matrix
    v: Matrix

    def solve(self, a: int, b: int, limit: int, guess: Matrix | None) -> int:
        """Solve blocks a to b in place; `y` holds there what earlier forces leave, on return the response.

        A stretch longer than `limit` is halved untried. `guess` is the response of the whole as far as an
        iteration got. Returns the limit that experience suggests.
        """
        n, blocks = b - a, slice(a, b)
        if n <= max(limit, _LEAST):
            y = self.y
            before = np.concatenate((np.zeros((y.shape[0], 2)), y[:, max(a - 2, 0) : a]), axis=1)[:, -2:]
            problem = self.kernel[:, :n], self.force, y[:, a:b].copy(), before, self.scale, blocks
            if _LEAST < n <= _DENSE:
                solution = None if guess is None else _newton(self.operators, *problem[1:], guess[:, a:b])
                solution = _newton(self.operators, *problem[1:], problem[2]) if solution is None else solution
            else:
                solution, reached = _iterate(*problem)
                if a == 0 and b == y.shape[1]:
                    guess = reached
            if solution is None and n <= _LEAST:
                solution = _relaxed(*problem)
            if solution is not None:
                y[:, a:b], self.v[:, a:b] = solution
                return limit if limit > _DENSE else min(_DENSE, max(limit, 2 * n))
            if n <= _LEAST:
                raise RunawayError(a)
            limit = min(n // 2, _DENSE)
        middle = (a + b) // 2
        limit = self.solve(a, middle, limit, guess)
        self.y[:, middle:b] += convolved(self.kernel[:, :n], self.v[:, a:middle])[:, middle - a :]
        return self.solve(middle, b, limit, guess)


def _newton(
    operators: Sequence[Matrix],
    force: Force,
    history: Matrix,
    before: Matrix,
    scale: Matrix,
    blocks: slice,
    start: Matrix,
) -> tuple[Matrix, Matrix] | None:
    """Fixed point as in `_iterate`, by Newton's method from `start`.

    Slopes of the force, in y and in its two earlier values, are differences over 1e-6 of the scale; that
    of one axis in another is for the iteration.
    """
    axes, n = history.shape
    nudge = _NUDGE * scale[..., None] * np.eye(4)[1:].T  # (axes, 4 variants, 3 arguments)
    every = np.tile(np.arange(blocks.start, blocks.stop), 4)
    diagonal = np.arange(n)
    y = start
    for _ in range(_NEWTON):
        with np.errstate(over="ignore", invalid="ignore"):
            one, two = _earlier(before, y)
            varied = [
                (value[:, None, :] + nudge[:, :, k, None]).reshape(axes, -1)
                for k, value in enumerate((y, one, two))
            ]
            forces = force(every, *varied).reshape(axes, 4, n)
            v = forces[:, 0]
            slopes = (forces[:, 1:] - forces[:, :1]) / (_NUDGE * scale[..., None])
            residual = history - y
            for i, operator in enumerate(operators):
                residual[i] += operator[:n, :n] @ v[i]
        size = float(np.abs(residual / scale).max())
        if not (size < RUNAWAY and np.isfinite(slopes.sum())):  # NaN too
            return None
        if size < TOLERANCE:
            return y + residual, v
        step = np.empty_like(y)
        for i, operator in enumerate(operators):
            matrix = operator[:n, :n] * -slopes[i, 0]
            for back in (1, 2):
                if slopes[i, back].any():
                    matrix[:, : n - back] -= operator[:n, back:n] * slopes[i, back, back:]
            matrix[diagonal, diagonal] += 1.0
            if not np.all(np.abs(matrix[diagonal, diagonal]) > _SINGULAR):
                return None
            step[i] = dtrtrs(matrix, residual[i], lower=1)[0]
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
) -> tuple[tuple[Matrix, Matrix] | None, Matrix | None]:
    """Fixed point of ``y = history + kernel * force(y)``, or None, and the y that came nearest."""
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
    nearest: Matrix | None = None
    for sweep in range(_LONG_SWEEPS if short else _SWEEPS):
        with np.errstate(over="ignore", invalid="ignore"):
            target, v = swept(y)
            change = (target - y) / scale
        size = float(np.abs(change).max())
        if not size < RUNAWAY:  # NaN too
            return None, nearest
        if size < TOLERANCE:
            return (target, v), target
        if size < min(sizes, default=1.0):
            nearest = target
        sizes.append(size)
        if sweep >= 8 and not short:  # give up early where the pace of the last sweeps would not do
            pace = np.log(size / sizes[-6]) / 5
            if pace >= 0 or np.log(TOLERANCE / size) / pace > _PATIENCE * (_SWEEPS - sweep):
                return None, nearest
        steps.append(change.ravel())
        points.append((target / scale).ravel())
        del steps[: -_DEPTH - 1], points[: -_DEPTH - 1]
        if sweep < 1:
            y = target
            continue
        last = steps[-1]
        differences = np.stack([last - step for step in steps[:-1]])
        gram = differences @ differences.T
        weights = np.linalg.lstsq(gram, differences @ last, rcond=1e-14)[0]
        mixed = points[-1] - weights @ np.stack([points[-1] - p for p in points[:-1]])
        y = mixed.reshape(y.shape) * scale
    return None, nearest


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
            if not size < RUNAWAY:  # NaN too
                break
            if size < TOLERANCE:
                return target, v
            y = y + share * (target - y)
    return None


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
