"""Response of linear paths under a force that depends on the response itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias, final

import numpy as np
from scipy import fft
from scipy.linalg import toeplitz
from scipy.linalg.lapack import dtrtrs

from lcopa_bayes.core.arrays import Array, Flags, Index, Matrix

Force: TypeAlias = Callable[[slice | Index, Matrix, Matrix, Matrix], Matrix]
"""(blocks, deviation of y, its values one and two blocks before) -> deviation of the force, each of
(axes, blocks); blocks by their positions may come several times."""

TOLERANCE = 1e-12
"""Change of y in the last iteration over the largest y [-]."""
RUNAWAY = 1e6
"""A response this many times its scale has run away [-]."""
_DEPTH = 4
"""Earlier iterates that the acceleration combines (Anderson 1965, J. ACM 12)."""
_LEVELS = 400
"""Most steps towards the level at rest [-]."""
_DENSE = 128
"""Longest stretch for a dense matrix [blocks]."""
_NEWTON = 12
_NUDGE = 1e-6
_SINGULAR = 1e-3
"""Below this a block's own feed-through leaves Newton's step undetermined [-]."""
_LEAST = 2
"""Stretches this short are iterated to the end."""
_LONG_SWEEPS = 400
_SHARES = (0.5, 0.2, 0.05)
"""Steps of an iteration that would overshoot, over the distance to its target [-]."""


@final
class RunawayError(ArithmeticError):
    """No bounded solution; carries the `block` where it was lost."""

    def __init__(self, block: int) -> None:
        self.block = block
        super().__init__(f"the response runs away at block {block}")


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


def balanced(kernel: Matrix, force: Force, scale: Matrix, guess: Matrix) -> Matrix:
    """``y = kernel * force(y)``, causal convolution, (axes, n), where `iterated` fails on the whole.

    Parameters: kernel (axes, n), the impulse response in block means; scale (axes, 1), typical size of y;
    guess (axes, n), y as far as an iteration got. The record is halved, the first half solved and its
    convolution added to the second; stretches of up to 128 blocks are solved by Newton's method, or halved
    further, down to two blocks, where the direct feed-through is small.
    Raises RunawayError. Accuracy: 1e-12 of the scale per iteration.
    """
    y, v = np.zeros(kernel.shape), np.zeros(kernel.shape)
    reach = min(kernel.shape[1], _DENSE)
    operators = [np.asfortranarray(toeplitz(row[:reach], np.zeros(reach))) for row in kernel]
    _Balance(kernel, operators, force, scale, guess, y, v).solve(0, kernel.shape[1], _DENSE)
    return y


@final
@dataclass(frozen=True, eq=False)
class _Balance:
    """What is solved, and what of it is."""

    kernel: Matrix
    operators: list[Matrix]
    """Convolution with each row of the kernel, over the longest dense stretch; its leading part over less."""
    force: Force
    scale: Matrix
    """(axes, 1)."""
    guess: Matrix
    y: Matrix
    v: Matrix

    def solve(self, a: int, b: int, limit: int) -> int:
        """Solve blocks a to b in place; `y` holds there what earlier forces leave, on return the response.

        A stretch longer than `limit` is halved untried. Returns the limit that experience suggests.
        """
        n = b - a
        if n <= max(limit, _LEAST):
            history = self.y[:, a:b].copy()
            before = np.concatenate((np.zeros((len(history), 2)), self.y[:, max(a - 2, 0) : a]), axis=1)[
                :, -2:
            ]
            problem = history, before, slice(a, b)
            if n > _LEAST:
                solution = self._newton(*problem, self.guess[:, a:b])
                solution = self._newton(*problem, history) if solution is None else solution
            else:
                solution = self._iterated(*problem)
            if solution is not None:
                self.y[:, a:b], self.v[:, a:b] = solution
                return min(_DENSE, max(limit, 2 * n))
            if n <= _LEAST:
                raise RunawayError(a)
            limit = n // 2
        middle = (a + b) // 2
        limit = self.solve(a, middle, limit)
        self.y[:, middle:b] += convolved(self.kernel[:, :n], self.v[:, a:middle])[:, middle - a :]
        return self.solve(middle, b, limit)

    def _newton(
        self, history: Matrix, before: Matrix, blocks: slice, start: Matrix
    ) -> tuple[Matrix, Matrix] | None:
        """Fixed point ``y = history + kernel * force(y)`` with its force, by Newton's method from `start`.

        Slopes of the force, in y and in its two earlier values, are differences over 1e-6 of the scale; that
        of one axis in another is for the iteration.
        """
        axes, n = history.shape
        scale, operators = self.scale, self.operators
        nudge = _NUDGE * scale[..., None] * np.eye(4)[1:].T  # (axes, 4 variants, 3 arguments)
        every = np.tile(np.arange(blocks.start, blocks.stop), 4)
        diagonal = np.arange(n)
        y = start
        for _ in range(_NEWTON):
            with np.errstate(over="ignore", invalid="ignore"):
                one, two = earlier(before, y)
                varied = [
                    (value[:, None, :] + nudge[:, :, k, None]).reshape(axes, -1)
                    for k, value in enumerate((y, one, two))
                ]
                forces = self.force(every, *varied).reshape(axes, 4, n)
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

    def _iterated(self, history: Matrix, before: Matrix, blocks: slice) -> tuple[Matrix, Matrix] | None:
        """The same for a few blocks by iteration, where the force turns too steeply for that by shorter
        steps."""
        kernel = self.kernel[:, : history.shape[1]]

        def force(y: Matrix) -> Matrix:
            return self.force(blocks, y, *earlier(before, y))

        def swept(plants: Index, y: Array) -> Array:
            return (history + convolved(kernel, force(y[0])))[None]

        found, solved = iterated(swept, history[None], self.scale[None], _LONG_SWEEPS)
        if solved[0]:
            return found[0], force(found[0])
        for share in _SHARES:
            y = history
            for _ in range(_LONG_SWEEPS):
                with np.errstate(over="ignore", invalid="ignore"):
                    v = force(y)
                    target = history + convolved(kernel, v)
                    size = float(np.abs((target - y) / self.scale).max())
                if not size < RUNAWAY:  # NaN too
                    break
                if size < TOLERANCE:
                    return target, v
                y = y + share * (target - y)
        return None


def earlier(before: Matrix, y: Matrix) -> tuple[Matrix, Matrix]:
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
