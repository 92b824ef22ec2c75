"""Least squares of a plant without effects from several starts at once.

Descents (`descents`) with the slopes of `expansion`, in the coordinates of `LeastSquares`, linear parameters
eliminated at every step (Kaufman 1975, BIT 15).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Matrix
from lcopa_bayes.inference.descents import Place, descended
from lcopa_bayes.inference.expansion import expanded
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.posterior import Posterior


@final
@dataclass(frozen=True, eq=False)
class PlantDescents:
    """Descents of a posterior's plant parameters at fixed noise parameters. Points are table values."""

    posterior: Posterior

    def solve(self, values: Matrix, *, steps: int, enough: float) -> Matrix:
        """Table values where descents from others end, (batch, rows), after so many `steps` at most, or where
        one gains less than `enough` of the sum of squares of the noise."""
        return descended(self, values, steps=steps, least=enough * 0.5 * self.posterior.size).points

    @cached_property
    def _problem(self) -> LeastSquares:
        return LeastSquares(self.posterior)

    @cached_property
    def _columns(self) -> list[int]:
        """Table positions of the sampled plant parameters."""
        return [k for k in self._problem.columns if k in self.posterior.sampled]

    @cached_property
    def _chosen(self) -> list[int]:
        """Places of these among the search coordinates."""
        return [self._problem.columns.index(k) for k in self._columns]

    def at(self, points: Matrix) -> Place:
        """What a descent knows at canonical table values: log likelihood and normal priors."""
        rows, columns = self.posterior.table.rows, self._columns
        expansion = expanded(self.posterior, points, columns)
        steepness = np.ones((len(points), len(columns)))
        for position, k in enumerate(columns):
            if rows[k].log_scale and rows[k].kind != "time":  # slopes of times are in their logarithms
                steepness[:, position] = points[:, k]
        level = expansion.log_likelihood.copy()
        gradient = steepness * expansion.gradient
        information = steepness[:, :, None] * expansion.information * steepness[:, None, :]
        for k, mean, sd in self._problem.normal:
            if k in columns:
                position, apart = columns.index(k), (points[:, k] - mean) / sd
                level -= 0.5 * apart**2
                gradient[:, position] -= apart / sd
                information[:, position, position] += 1 / sd**2
        level[~np.isfinite(gradient).all(axis=1) | ~np.isfinite(information).all(axis=(1, 2))] = -np.inf
        return Place(points, level, gradient, information)

    def room(self, points: Matrix) -> tuple[Matrix, Matrix]:
        """Steps to the ends of the search around table values, (batch, size)."""
        ends = np.array([self._problem.bounds_around(one) for one in points])[:, :, self._chosen]
        x = self._coordinates(points)
        return ends[:, 0] - x, ends[:, 1] - x

    def moved(self, points: Matrix, steps: Matrix) -> Matrix:
        """Canonical table values so many steps on."""
        out, x = points.copy(), self._coordinates(points) + steps
        for position, k in enumerate(self._columns):
            out[:, k] = self.posterior.table.rows[k].value_at(x[:, position])
        return self.posterior.table.canonical(out)

    def _coordinates(self, points: Matrix) -> Matrix:
        places = [self.posterior.sampled.index(k) for k in self._columns]
        return self.posterior.coordinates(points)[:, places]
