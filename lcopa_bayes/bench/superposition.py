"""Sums of delayed step responses, from the response itself or from a table of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial, chebyshev
from scipy.interpolate import PPoly

from lcopa_bayes.core.arrays import Array, Vector

Response: TypeAlias = Callable[[Array], Array]
"""A causal function of time [ms], zero up to time 0, elementwise."""

_DEGREE = 12
_DISTINCT = 4096
"""Up to this many different lags the response is evaluated at each of them."""
_PANELS, _HALVINGS = 1 << 16, 24
_PAIRS = 1 << 18
"""Pairs of sample and change treated at once."""
_RESOLUTION = 1e-12
"""Lags closer than this part of their span are one: a sample and a change at one instant in different
rounding must not see the steep onset of a low order."""


class TableError(ArithmeticError):
    """A response too rough to tabulate; carries the `time` reached and the remaining `error`."""

    def __init__(self, time: float, error: float) -> None:
        self.time, self.error = time, error
        super().__init__(
            f"interpolation error still {error:.3g} near time {time:.6g}; is the response noisy?"
        )


def tabulated(response: Response, first: float, last: float, *, tolerance: float) -> Response:
    """Interpolant of `response` on ``[first, last]`` [ms], ``0 < first``; zero up to time 0.

    Polynomials of degree 12 in log time, on which a fractional onset ``t^order`` is smooth; panels
    are halved until the error at 5 points between the nodes is below `tolerance` [response unit].
    Times must be at most 0 or within the interval. Raises TableError after 24 halvings, or when more
    than 65536 panels at once are not good enough.
    """
    nodes, between = chebyshev.chebpts1(_DEGREE + 1), np.array([-0.97, -0.5, 0.05, 0.6, 0.95])
    to_series = np.linalg.inv(chebyshev.chebvander(nodes, _DEGREE))
    low, high = np.log(first) - 1e-9, np.log(last) + 1e-9
    edges = np.linspace(low, high, 2 + int(high - low))
    left, right = edges[:-1], edges[1:]
    done: list[tuple[Vector, Array]] = []
    for halvings in range(_HALVINGS + 1):
        middle, half = (left + right)[:, None] / 2, (right - left)[:, None] / 2
        values = response(np.exp(middle + half * np.concatenate([nodes, between])))
        series = values[:, : nodes.size] @ to_series.T
        error = np.abs(series @ chebyshev.chebvander(between, _DEGREE).T - values[:, nodes.size :]).max(
            axis=1
        )
        rough = ~(error <= tolerance)
        done.append((left[~rough], series[~rough]))
        if not rough.any():
            break
        if rough.sum() > _PANELS or halvings == _HALVINGS:
            worst = int(np.argmax(error))
            raise TableError(float(np.exp(middle[worst, 0])), float(error[worst]))
        left, right, middle = left[rough], right[rough], middle[rough, 0]
        left, right = np.concatenate([left, middle]), np.concatenate([middle, right])
    starts, panels = np.concatenate([start for start, _ in done]), np.vstack([series for _, series in done])
    rank = np.argsort(starts)
    edges = np.append(starts[rank], high)
    to_powers = np.zeros((_DEGREE + 1, _DEGREE + 1))  # of the part of the panel passed
    for k in range(_DEGREE + 1):
        to_powers[k, : k + 1] = Chebyshev.basis(k, domain=[0, 1]).convert(kind=Polynomial).coef
    powers = panels[rank] @ to_powers / np.diff(edges)[:, None] ** np.arange(_DEGREE + 1)
    table = PPoly(powers.T[::-1], edges)

    def interpolant(time: Array) -> Array:
        out = np.zeros(np.shape(time))
        later = time > 0
        out[later] = table(np.log(time[later]))
        return out

    return interpolant


def superposed(
    response: Response, time: Vector, changes: Vector, jumps: Vector, *, tolerance: float
) -> Vector:
    """``sum_j jumps[j] response(time - changes[j])``, (n,).

    Parameters: `time` (n,) and `changes` (m,) [ms]; `jumps` (m,); `tolerance` [response unit per unit
    jump]: the error of the table used when the lags that differ are more than 4096.
    """
    out = np.zeros(time.size)
    if time.size == 0 or changes.size == 0:
        return out
    span = float(max(time.max() - changes.min(), 0.0))
    resolution = _RESOLUTION * max(span, float(np.abs(changes).max()), float(np.abs(time).max()))
    if span <= resolution:
        return out
    rows = max(1, _PAIRS // changes.size)
    blocks = [time[i : i + rows] for i in range(0, time.size, rows)]

    def lags(block: Vector) -> Array:
        return np.asarray(resolution * np.round((block[:, None] - changes) / resolution))

    if len(blocks) == 1:
        distinct, which = np.unique(lags(time), return_inverse=True)
        if distinct.size <= _DISTINCT:
            return response(distinct)[which.reshape(time.size, changes.size)] @ jumps
    table = tabulated(response, resolution, span, tolerance=tolerance)
    return np.concatenate([table(lags(block)) @ jumps for block in blocks])
