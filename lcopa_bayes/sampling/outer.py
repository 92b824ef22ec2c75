"""The parameters that a search draws first, orders, noise, and delays under correlated noise; and the tasks
that find the rest given these."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Flags, Index, Matrix, Vector
from lcopa_bayes.inference.conditional import Conditional, screened
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.conditionaldraws import in_domain, kept
from lcopa_bayes.sampling.mixture import Mixture

_SCREENED, _DESCENT = 16, 12
"""Prior draws that give a start, and most steps of a descent: a draw of a point that is short of its optimum
has hardly any weight, and a narrow mode whose points are stays unseen."""


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
        out = in_domain(self.posterior, self.columns, values)
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


@final
@dataclass(frozen=True)
class Optima:
    """Task: optimum of the rest from `starts`, or from the best of prior draws where these are None."""

    pilot: bool = False
    """Whether delays are fitted in any case."""

    def __call__(
        self, posterior: Posterior, task: tuple[Matrix, Matrix | None, np.random.SeedSequence]
    ) -> tuple[Matrix, Vector, Matrix]:
        """Table values, objective and widths of the coordinates in their natural scale."""
        values, starts, seed = task
        conditional = Conditional(posterior, delays=True) if self.pilot else conditional_of(posterior)
        if starts is None:
            values = screened(conditional, values, _SCREENED, np.random.default_rng(seed))
        else:
            values = _begun(conditional, values, starts)
        at, objective = conditional.descended(values, _DESCENT)
        return at.values, objective, conditional.uncertainty(at)


@final
@dataclass(frozen=True)
class Draw:
    """Task: optimum of the rest from `starts`, and a draw of it."""

    tries: int
    """Draws of the rest of which one is kept."""

    def __call__(
        self, posterior: Posterior, task: tuple[Matrix, Matrix, np.random.SeedSequence]
    ) -> tuple[Matrix, Vector, Matrix, Vector, Vector, Vector]:
        """Table values and objective of the optimum; coordinates and log density of the draw, log of the
        marginal of prior times likelihood, permutations not counted, and efficiency."""
        values, starts, seed = task
        conditional = conditional_of(posterior)
        at, objective = conditional.descended(_begun(conditional, values, starts), _DESCENT)
        draw = kept(conditional, at, self.tries, np.random.default_rng(seed))
        exists = np.isfinite(draw.log_likelihood)
        density, marginal = np.full(len(values), -np.inf), np.full(len(values), -np.inf)
        z = draw.coordinates[exists]
        density[exists] = posterior.log_density(z)
        error = density[exists] - posterior.log_prior(z) - draw.log_likelihood[exists]
        marginal[exists] = error + draw.log_evidence[exists]
        return at.values, objective, draw.coordinates, density, marginal, draw.efficiency


def _begun(conditional: Conditional, values: Matrix, starts: Matrix) -> Matrix:
    """Table values with what is integrated out as in `starts`."""
    out = values.copy()
    out[:, conditional.columns] = starts[:, conditional.columns]
    return out
