"""Least squares of sums of lags: the best time constants and delays with each number of lags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from scipy.stats.qmc import Halton

from lcopa_bayes.core.arrays import Index, Matrix, Vector
from lcopa_bayes.core.covariance import covariance_of
from lcopa_bayes.inference.descents import Place, descended
from lcopa_bayes.inference.lagsum import LagTable

MOST = 4
"""Most lags of a path."""
_APART = 0.7
"""Least distance of the time constants a search starts from [-, natural logarithm]."""
_STARTS = 5
"""Places where a further lag is tried."""
_TRIED, _AGAIN, _LOWER = 1_000, 3, 0.5
"""Places that a path is begun again from, most times that this is done, and least fall of the square
for which it is done once more [-]."""
_DESCENT, _GAIN = 40, 1e-3
"""Most steps of a descent [-], and gain below which it ends [nat]."""
_STEP = 1e-7
"""Step of a difference quotient, over the range of its coordinate [-]."""


@final
@dataclass(frozen=True, eq=False)
class LagFit:
    """Least squares with so many lags in every path."""

    lags: int
    coordinates: Vector
    """Log times path by path, then delays, (dimension,)."""
    information: Matrix
    """Of the coordinates, (dimension, dimension)."""
    square: float
    """Whitened residual and weights, squared [-]."""
    weights: float
    """Of that, the weights, in standard deviations of their prior."""
    size: int

    @property
    def parameters(self) -> int:
        """Time constants, weights and delays [-]."""
        paths = self.coordinates.size // (self.lags + 1)
        return paths * (2 * self.lags + 1)

    @property
    def misfit(self) -> float:
        """Whitened residual, squared [-]."""
        return self.square - self.weights

    @property
    def aic(self) -> float:
        """Akaike's criterion, up to what all models of one record have in common [-]: weights of lags that
        are hardly apart are large and of either sign, and their prior says nothing against such a plant."""
        return self.misfit + 2 * self.parameters

    @property
    def bic(self) -> float:
        """Up to what all fits of one record have in common [-]."""
        return float(self.square + self.parameters * np.log(self.size))

    @cached_property
    def covariance(self) -> Matrix:
        """Of the coordinates near the optimum, (dimension, dimension)."""
        return np.asarray(covariance_of(self.information))


@final
@dataclass(frozen=True, eq=False)
class LagDescents:
    """Descents of sums of lags, weights eliminated. Points are coordinates, (batch, dimension)."""

    table: LagTable
    moving: Index
    """Coordinates that change."""

    def at(self, points: Matrix) -> Place:
        """What a descent knows at points, by differences; what is tabulated goes on beyond its ends."""
        low, high = self.room(points)
        own = _STEP * (high - low)
        shifted = np.repeat(points[:, None], 1 + self.moving.size, axis=1)
        shifted[:, 1 + np.arange(self.moving.size), self.moving] += own
        values = self.table.residuals(shifted.reshape(-1, points.shape[1]))
        values = values.reshape(*shifted.shape[:2], -1)
        residual, slopes = values[:, 0], (values[:, 1:] - values[:, :1]) / own[..., None]
        return Place(
            points,
            -0.5 * (residual**2).sum(axis=1),
            -(slopes @ residual[..., None])[..., 0],
            slopes @ slopes.swapaxes(1, 2),
        )

    def room(self, points: Matrix) -> tuple[Matrix, Matrix]:
        """Steps to the ends of the table, (batch, moving)."""
        paths = self.table.paths
        low, high = self.table.ends((points.shape[1] - paths) // paths)
        return (low - points)[:, self.moving], (high - points)[:, self.moving]

    def moved(self, points: Matrix, steps: Matrix) -> Matrix:
        """Coordinates so many steps on."""
        out = points.copy()
        out[:, self.moving] += steps
        return out


def lag_fits(table: LagTable) -> tuple[LagFit, ...]:
    """The best of a few searches for each number of lags, 1 to `MOST`: a further lag begins where it alone
    explains most of what the others leave, and the best begins again with lags and delays of each path from
    everywhere."""
    fits: list[LagFit] = []
    for lags in range(1, MOST + 1):
        best = _best_from(table, lags, _starts(table, fits[-1] if fits else None))
        for _ in range(_AGAIN):
            again = _best_from(table, lags, _exchanged(table, best.coordinates)[None])
            if again.square > best.square - _LOWER:
                break
            best = again
        fits.append(best)
    return tuple(fits)


def _best_from(table: LagTable, lags: int, starts: Matrix) -> LagFit:
    """The best of descents from starts, (batch, dimension)."""
    every = LagDescents(table, np.arange(starts.shape[1]))
    ends = descended(every, np.clip(starts, *table.ends(lags)), steps=_DESCENT, least=_GAIN)
    best = int(ends.level.argmax())
    point, square = ends.points[best], table.remainder - 2 * float(ends.level[best])
    weights = table.residuals(point[None])[0, table.target.size :]
    return LagFit(lags, point, ends.information[best], square, float(weights @ weights), table.size)


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


def _starts(table: LagTable, fewer: LagFit | None) -> Matrix:
    nodes = table.log_times[table.log_times >= table.shortest][2:-2]
    if fewer is None:
        low, high = table.delays[:, 0], table.delays[:, -1]
        places = np.quantile(nodes, (0.25, 0.5, 0.75))
        return np.array(
            [
                np.concatenate([np.full(table.paths, place), low + share * (high - low)])
                for place in places
                for share in (0.1, 0.5, 0.9)
            ]
        )
    log_times, delays = table.parts(fewer.coordinates[None])
    further = np.broadcast_to(nodes[:, None, None], (nodes.size, table.paths, 1))
    every = np.concatenate([np.repeat(log_times, nodes.size, axis=0), further], axis=2)
    flat = every.reshape(nodes.size, -1)
    starts = np.concatenate([flat, np.repeat(delays, nodes.size, axis=0)], axis=1)
    chosen: list[int] = []
    for k in np.argsort(-table.conditional(starts).log_marginal):
        if all(abs(nodes[k] - nodes[other]) > _APART for other in chosen):
            chosen.append(int(k))
    return starts[chosen[:_STARTS]]
