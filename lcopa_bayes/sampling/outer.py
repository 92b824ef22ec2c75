"""The parameters that a search draws first: orders, noise, and delays under correlated noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Flags, Index, Matrix, Vector
from lcopa_bayes.inference.conditional import Conditional
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.mixture import Mixture


def conditional_of(posterior: Posterior) -> Conditional:
    """What is integrated out: delays too, unless noise is correlated. Judged by such noise, changes from
    sample to sample count most, and a likelihood has a mode in the delay between any two samples."""
    return Conditional(posterior, delays=posterior.noise.memory == 0)


def applies(posterior: Posterior) -> bool:
    """Whether a posterior divides into parameters that are searched and others given these: not that of a
    plant with effects, whose response is no ratio of powers."""
    if posterior.simulation is not None:
        return False
    conditional = conditional_of(posterior)
    return bool(conditional.given and conditional.elements and conditional.columns)


@final
@dataclass(frozen=True, eq=False)
class Outer:
    """The parameters that are searched, in their sampled coordinates y."""

    posterior: Posterior

    @cached_property
    def columns(self) -> tuple[int, ...]:
        """Table rows."""
        return conditional_of(self.posterior).given

    @cached_property
    def places(self) -> Index:
        """Positions among the sampled coordinates."""
        return np.array([self.posterior.sampled.index(k) for k in self.columns])

    @cached_property
    def orders(self) -> Flags:
        """Which of them are orders."""
        rows = self.posterior.table.rows
        return np.array([rows[k].kind == "order" for k in self.columns], dtype=bool)

    def values(self, y: Matrix) -> Matrix:
        """Table values, (batch, rows), exchangeable orders decreasing; NaN for what is not searched."""
        z = np.full((len(y), self.posterior.dimension), np.nan)
        z[:, self.places] = y
        return self.posterior.values(z)

    def y(self, values: Matrix) -> Matrix:
        """Coordinates of table values."""
        return np.asarray(self.posterior.coordinates(values)[:, self.places])

    def inside(self, values: Matrix) -> Flags:
        """Whether table values lie inside the prior, orders decreasing."""
        out: Flags = np.ones(len(values), dtype=bool)
        for k in self.columns:
            low, high = self.posterior.table.rows[k].domain
            out &= (values[:, k] > low) & (values[:, k] < high)
        for element in conditional_of(self.posterior).elements:
            out &= (np.diff(values[:, element.orders], axis=1) <= 0).all(axis=1)
        return out


@final
@dataclass(frozen=True, eq=False)
class PriorOrders:
    """A proposal: orders from their prior, the rest from a mixture, None where there is no rest."""

    outer: Outer
    rest: Mixture | None

    def draw(self, count: int, rng: np.random.Generator) -> Matrix:
        """Points (count, size), exchangeable orders decreasing."""
        outer, out = self.outer, np.empty((count, len(self.outer.columns)))
        for column, k in enumerate(outer.columns):
            if outer.orders[column]:
                row = outer.posterior.table.rows[k]
                drawn = row.draw(count, rng)
                out[:, column] = np.log(drawn) if row.log_scale else drawn
        if self.rest is not None:
            out[:, ~outer.orders] = self.rest.draw(count, rng)
        return outer.y(outer.values(out))

    def log_density(self, y: Matrix) -> Vector:
        """Log density of points, exchangeable orders decreasing, (n,)."""
        outer, table = self.outer, self.outer.posterior.table
        values, total = outer.values(y), np.zeros(len(y))
        for k, order in zip(outer.columns, outer.orders, strict=True):
            if order:
                row = table.rows[k]
                total += row.log_prior(values[:, k]) + (np.log(values[:, k]) if row.log_scale else 0.0)
        total += table.log_permutations
        return total if self.rest is None else total + self.rest.log_density(y[:, ~outer.orders])
