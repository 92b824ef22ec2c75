"""Random walk of many points in the prior, confined to likelihoods above a level.

Metropolis steps that leave the prior unchanged where the likelihood exceeds the level. Five proposals:
the difference of two members of a population in the sampled coordinates (ter Braak 2006, Statistics and
Computing 16) or in the response of elements at a few real frequencies (`follow`), new orders while that
response stays (`slide`; `roam` far away), and the times of two neighbouring terms exchanged (`swap`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.sampling.homography import Element, elements
from lcopa_bayes.sampling.unitcube import UnitCube

_JITTER = 1e-3
"""Relative perturbation of a difference, so that no point is confined to a lattice [-]."""
_WHOLE = 0.1
"""Share of differences of full length, which lead from mode to mode [-]."""
_KINDS = {"difference": 0.10, "follow": 0.60, "slide": 0.15, "roam": 0.10, "swap": 0.05}
"""Share of each proposal [-]: of six mixtures tried on the paper's step at four levels of the likelihood,
the mixture after which 512 points had the lowest correlation with their start."""
_NEAR, _FAR = 0.01, 1.5
"""Shortest and longest slide of the orders, in differences [-]."""
_WANDER = 0.02
"""Deviation added to the differences that slides consist of [-]."""


@final
@dataclass(frozen=True, eq=False)
class Walk:
    """Moves of points within the constraint."""

    cube: UnitCube
    steps: int
    """Proposals per point."""

    def travelled(
        self, start: Matrix, level: float, population: Matrix, rng: np.random.Generator
    ) -> tuple[Matrix, Vector, int]:
        """Final positions, their log likelihood (-inf of a point that never moved), evaluations.

        `start` (batch, dimension) must have a log likelihood above `level`; `population`
        (members, dimension), at least two, gives the differences and should be spread like `start`.
        """
        z, prior = start.copy(), self.cube.log_prior(start)
        height, evaluations = np.full(z.shape[0], -np.inf), 0
        for kind in rng.choice(list(_KINDS), p=list(_KINDS.values()), size=self.steps):
            proposed, log_jacobian = self._proposal(str(kind), z, population, rng)
            new = self.cube.log_prior(proposed)
            taken = np.log(rng.random(z.shape[0])) < new - prior + log_jacobian
            chosen = np.flatnonzero(taken & (proposed != z).any(axis=1))
            if chosen.size:
                proposed_height = self.cube.log_likelihood_inside(proposed[chosen])
                evaluations += chosen.size
                above = proposed_height > level
                moved = chosen[above]
                z[moved], prior[moved], height[moved] = proposed[moved], new[moved], proposed_height[above]
        return z, height, evaluations

    @cached_property
    def _elements(self) -> tuple[Element, ...]:
        return elements(self.cube.posterior)

    @cached_property
    def _range(self) -> tuple[float, float]:
        """Log of the lowest and of the highest frequency the records resolve [log 1 / time unit]."""
        grids = [experiment.mesh.grid for experiment in self.cube.posterior.model.experiments]
        span, step = max(grid.n * grid.step for grid in grids), min(grid.step for grid in grids)
        return float(np.log(0.5 / span)), float(np.log(0.5 / step))

    def _proposal(
        self, kind: str, z: Matrix, population: Matrix, rng: np.random.Generator
    ) -> tuple[Matrix, Vector]:
        """Proposed coordinates and the log of the Jacobian; each as likely as its reverse."""
        batch, dimension = z.shape
        a, b = _pairs(batch, population, rng)
        if kind == "difference" or not self._elements:
            share = rng.choice([0.2, 0.5, 1.0], size=(batch, 1))
            moved = rng.random((batch, dimension)) < share
            scale = _scales(batch, share[:, 0] * dimension, rng)
            return z + np.where(moved, scale * _jittered(a - b, rng), 0.0), np.zeros(batch)
        element = self._elements[rng.integers(len(self._elements))]
        if kind == "swap":
            return _swapped(element, z, rng), np.zeros(batch)
        if kind == "follow":
            return self._follow(z, a, b, element if rng.random() < 0.5 else None, rng)
        proposed, terms = z.copy(), element.times.size
        if element.orders.size and kind == "slide":
            reach = np.exp(rng.uniform(np.log(_NEAR), np.log(_FAR), (batch, 1)))
            shift = (a - b)[:, element.orders] + _WANDER * rng.standard_normal((batch, terms))
            some = rng.random((batch, terms)) < 0.6
            proposed[:, element.orders] += np.where(some, reach * shift, 0.0)
        elif element.orders.size:
            chosen = element.orders[rng.integers(terms, size=batch)]
            proposed[np.arange(batch), chosen] = rng.uniform(0.0, 2.0, batch)
        frequencies = self._frequencies(batch, terms, rng)
        return element.followed(z, proposed, frequencies, np.zeros((batch, terms + 1)))

    def _follow(
        self, z: Matrix, a: Matrix, b: Matrix, only: Element | None, rng: np.random.Generator
    ) -> tuple[Matrix, Vector]:
        """The difference in the response of one element, or of all, and in all that belongs to none."""
        moving = self._elements if only is None else (only,)
        still = [element.columns for element in self._elements if element not in moving]
        batch, dimension = z.shape
        scale = _scales(batch, dimension - sum(columns.size for columns in still), rng)
        proposed = z + scale * _jittered(a - b, rng)
        for columns in still:
            proposed[:, columns] = z[:, columns]
        total = np.zeros(batch)
        for element in moving:
            for column, by_logarithm in element.gains:
                if not by_logarithm:
                    proposed[:, column] = z[:, column]
            frequencies = self._frequencies(batch, element.times.size, rng)
            step = scale * (element.log_level(a, frequencies) - element.log_level(b, frequencies))
            proposed, log_jacobian = element.followed(z, proposed, frequencies, step)
            total = total + log_jacobian
        return proposed, total

    def _frequencies(self, batch: int, terms: int, rng: np.random.Generator) -> Matrix:
        """Log of a random frequency from each of terms + 1 equal parts of the range, (batch, terms + 1)."""
        edges = np.linspace(*self._range, terms + 2)
        return np.asarray(edges[:-1] + rng.random((batch, terms + 1)) * np.diff(edges))


def _pairs(batch: int, population: Matrix, rng: np.random.Generator) -> tuple[Matrix, Matrix]:
    """Ordered pairs of different members."""
    first = rng.integers(len(population), size=batch)
    second = (first + rng.integers(1, len(population), size=batch)) % len(population)
    return population[first], population[second]


def _jittered(difference: Matrix, rng: np.random.Generator) -> Matrix:
    return np.asarray(difference * (1 + _JITTER * rng.standard_normal(difference.shape)))


def _scales(batch: int, moving: Vector | int, rng: np.random.Generator) -> Matrix:
    """Shares of a difference to take, (batch, 1): over a decade below the Gaussian optimum, or whole."""
    optimum = 2.38 / np.sqrt(2 * np.asarray(moving))
    partly = optimum * np.exp(rng.uniform(-2.5, 0.3, batch))
    return np.where(rng.random(batch) < _WHOLE, 1.0, partly)[:, None]


def _swapped(element: Element, z: Matrix, rng: np.random.Generator) -> Matrix:
    """The times of two neighbouring terms exchanged: where their orders are equal, this is a small change."""
    out, rows = z.copy(), np.arange(z.shape[0])
    if element.times.size > 1:
        index = rng.integers(element.times.size - 1, size=z.shape[0])
        first, second = element.times[index], element.times[index + 1]
        out[rows, first], out[rows, second] = z[rows, second], z[rows, first]
    return out
