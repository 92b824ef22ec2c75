"""The prior of the sampled coordinates as the unit cube."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Flags, Index, Matrix, Vector
from lcopa_bayes.inference.posterior import Posterior


@final
@dataclass(frozen=True, eq=False)
class UnitCube:
    """Points of the cube are prior probabilities, one per sampled parameter in its own prior.

    Uniform points give the prior of the parameters before their orders are compared. Where the terms of
    an element are exchangeable, each point represents the plant with its terms by decreasing order;
    elsewhere points whose orders do not decrease are outside (`inside`). Uniform points inside are
    draws of the normalised prior that `Posterior.log_prior` is the density of.
    """

    posterior: Posterior

    @property
    def dimension(self) -> int:
        """Number of sampled coordinates."""
        return self.posterior.dimension

    @cached_property
    def _ends(self) -> list[tuple[float, float]]:
        """Of each sampled parameter: mass of its prior below its domain, and inside it."""
        out = []
        for k in self.posterior.sampled:
            row = self.posterior.table.rows[k]
            assert row.prior is not None
            low, high = (float(row.prior.frozen.cdf(end)) for end in row.domain)
            out.append((low, high - low))
        return out

    @cached_property
    def _orders(self) -> list[Index]:
        """Columns of the orders of each exchangeable element: all of them are sampled."""
        table, sampled = self.posterior.table, self.posterior.sampled
        return [
            np.array([sampled.index(table.at("order", e, k)) for k in range(slot.terms)])
            for e, slot in enumerate(table.layout.elements)
            if table.exchangeable[e]
        ]

    def coordinates(self, points: Matrix) -> Matrix:
        """Sampled coordinates of points, (batch, dimension), exchangeable terms by decreasing order."""
        posterior = self.posterior
        values = np.array([row.value for row in posterior.table.rows]) * np.ones((points.shape[0], 1))
        for column, (k, (below, mass)) in enumerate(zip(posterior.sampled, self._ends, strict=True)):
            prior = posterior.table.rows[k].prior
            assert prior is not None
            values[:, k] = prior.frozen.ppf(below + mass * points[:, column])
        return posterior.coordinates(posterior.table.canonical(values))

    def points(self, coordinates: Matrix) -> Matrix:
        """Points of coordinates: the inverse of `coordinates` where those have their terms in order."""
        values, out = self.posterior.values(coordinates), np.empty(coordinates.shape)
        for column, (k, (below, mass)) in enumerate(zip(self.posterior.sampled, self._ends, strict=True)):
            prior = self.posterior.table.rows[k].prior
            assert prior is not None
            out[:, column] = (prior.frozen.cdf(values[:, k]) - below) / mass
        return out

    def log_prior(self, coordinates: Matrix) -> Vector:
        """Log prior density up to a constant, (batch,); -inf also where exchangeable terms are not in order.

        One point per plant instead of one per permutation of its terms: `coordinates` has no others.
        """
        total = self.posterior.log_prior(coordinates)
        for orders in self._orders:
            in_order: Flags = np.all(np.diff(coordinates[:, orders], axis=1) <= 0, axis=1)
            total = np.where(in_order, total, -np.inf)
        return total

    def inside(self, coordinates: Matrix) -> Flags:
        """Whether coordinates have positive prior density, (batch,)."""
        inside: Flags = self.log_prior(coordinates) > -np.inf
        return inside

    def log_likelihood(self, coordinates: Matrix) -> Vector:
        """Log likelihood, linear parameters integrated out, (batch,); -inf outside the prior."""
        out = np.full(coordinates.shape[0], -np.inf)
        inside = self.inside(coordinates)
        if inside.any():
            out[inside] = self.log_likelihood_inside(coordinates[inside])
        return out

    def log_likelihood_inside(self, coordinates: Matrix) -> Vector:
        """The same where all coordinates are known to be inside; FloatingPointError where it is NaN."""
        out = self.posterior.log_likelihood(self.posterior.values(coordinates))
        if np.isnan(out).any():
            self.posterior.log_density(coordinates[np.isnan(out)])  # raises with the position
        return out

    def draw(self, size: int, rng: np.random.Generator) -> Matrix:
        """Uniform points inside, (size, dimension)."""
        out = np.empty((0, self.dimension))
        while out.shape[0] < size:
            points = rng.random((size, self.dimension))
            out = np.concatenate([out, points[self.inside(self.coordinates(points))]])
        return out[:size]
