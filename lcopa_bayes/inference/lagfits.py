"""Least squares of sums of lags: the best time constants and delays with each number of lags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from scipy.optimize import least_squares
from scipy.stats.qmc import Halton

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.covariance import covariance_of
from lcopa_bayes.inference.lagsum import LagTable

MOST = 4
"""Most lags of a path."""
_APART = 0.7
"""Least distance of the time constants a search starts from [-, natural logarithm]."""
_STARTS = 3
"""Places where a further lag is tried."""
_TRIED, _AGAIN, _LOWER = 1_000, 3, 0.5
"""Places that a path is begun again from, most times that this is done, and least fall of the square
for which it is done once more [-]."""
_STEP = 1e-7
"""Step of a difference quotient, over the range of its coordinate [-]."""


@final
@dataclass(frozen=True, eq=False)
class LagFit:
    """Least squares with so many lags in every path."""

    lags: int
    coordinates: Vector
    """Log times path by path, then delays, (dimension,)."""
    jacobian: Matrix
    square: float
    """Whitened residual and weights, squared [-]."""
    size: int

    @property
    def parameters(self) -> int:
        """Time constants, weights and delays [-]."""
        paths = self.coordinates.size // (self.lags + 1)
        return paths * (2 * self.lags + 1)

    @property
    def bic(self) -> float:
        """Up to what all fits of one record have in common [-]."""
        return float(self.square + self.parameters * np.log(self.size))

    @cached_property
    def covariance(self) -> Matrix:
        """Of the coordinates near the optimum, (dimension, dimension)."""
        return covariance_of(self.jacobian.T @ self.jacobian)


def lag_fits(table: LagTable) -> tuple[LagFit, ...]:
    """The best of a few searches for each number of lags, 1 to `MOST`: a further lag begins where it alone
    explains most of what the others leave, and the best begins again with lags and delays of each path from
    everywhere."""
    fits: list[LagFit] = []
    for lags in range(1, MOST + 1):
        tried = [_descended(table, lags, start) for start in _starts(table, fits[-1] if fits else None)]
        best = min(tried, key=lambda one: one.square)
        for _ in range(_AGAIN):
            again = _descended(table, lags, _exchanged(table, best.coordinates))
            if again.square > best.square - _LOWER:
                break
            best = again
        fits.append(best)
    return tuple(fits)


def _exchanged(table: LagTable, coordinates: Vector) -> Vector:
    """Coordinates with lags and delay of one path after the other exchanged for those, of many, that explain
    most beside the others: a few starts for all paths alike miss what each of them needs."""
    low, high = table.ends((coordinates.size - table.paths) // table.paths)
    places = np.arange(coordinates.size - table.paths).reshape(table.paths, -1)
    anywhere = Halton(places.shape[1] + 1, scramble=False).random(_TRIED + 1)[1:]
    for path in range(table.paths):
        own = np.append(places[path], places.size + path)
        tried = np.tile(coordinates, (_TRIED, 1))
        tried[:, own] = low[own] + (high[own] - low[own]) * anywhere
        coordinates = tried[int(table.conditional(tried).log_marginal.argmax())]
    return coordinates


def best_of(fits: Sequence[LagFit]) -> LagFit:
    """The one of the least BIC."""
    return min(fits, key=lambda one: one.bic)


def _starts(table: LagTable, fewer: LagFit | None) -> list[Vector]:
    nodes = table.log_times[table.log_times >= table.shortest][2:-2]
    if fewer is None:
        low, high = table.delays[:, 0], table.delays[:, -1]
        places = np.quantile(nodes, (0.25, 0.5, 0.75))
        return [
            np.concatenate([np.full(table.paths, place), low + share * (high - low)])
            for place in places
            for share in (0.1, 0.5, 0.9)
        ]
    log_times, delays = table.parts(fewer.coordinates[None])
    further = np.broadcast_to(nodes[:, None, None], (nodes.size, table.paths, 1))
    every = np.concatenate([np.repeat(log_times, nodes.size, axis=0), further], axis=2)
    flat = every.reshape(nodes.size, -1)
    starts = np.concatenate([flat, np.repeat(delays, nodes.size, axis=0)], axis=1)
    chosen: list[int] = []
    for k in np.argsort(-table.conditional(starts).log_marginal):
        if all(abs(nodes[k] - nodes[other]) > _APART for other in chosen):
            chosen.append(int(k))
    return list(starts[chosen[:_STARTS]])


def _descended(table: LagTable, lags: int, start: Vector) -> LagFit:
    low, high = table.ends(lags)
    steps = _STEP * (high - low)

    def residual(x: Vector) -> Vector:
        return np.asarray(table.residuals(x[None])[0])

    def slopes(x: Vector) -> Matrix:
        own = np.where(x + steps > high, -steps, steps)
        values = table.residuals(np.concatenate([x[None], x + np.diag(own)]))
        return np.asarray((values[1:] - values[0]).T / own)

    optimum = least_squares(
        residual,
        np.clip(start, low, high),
        slopes,
        bounds=(low, high),
        x_scale=high - low,
        max_nfev=40,
    )
    square = 2 * float(optimum.cost) + table.remainder
    return LagFit(lags, optimum.x, np.asarray(optimum.jac), square, table.size)
