"""The parameters that a search draws first, orders, noise, and delays under correlated noise; and the tasks
that find the rest given these."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import lgamma
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Flags, Index, Matrix, Vector
from lcopa_bayes.inference.conditional import Conditional, screened
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.conditionaldraws import in_domain, kept
from lcopa_bayes.sampling.ensemble import Ensemble, advance
from lcopa_bayes.sampling.mixture import Mixture

_SCREENED, _DESCENT = 16, 12
"""Prior draws that give a start, and most steps of a descent: a draw of a point that is short of its optimum
has hardly any weight, and a narrow mode whose points are stays unseen."""

_WALK = (20, 5)
"""Draws kept of each walker, and steps per draw."""


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


def unsearched(posterior: Posterior) -> bool:
    """Whether nothing of a plant without effects is searched: its orders and noise are stated, or all of its
    elements."""
    return posterior.simulation is None and posterior.dimension > 0 and not applies(posterior)


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

    @cached_property
    def groups(self) -> tuple[Index, ...]:
        """Columns that a posterior binds to each other more than to the rest: orders and delays of an
        element, noise of an axis, delays of several elements."""
        table, keys = self.posterior.table, list[tuple[str, int]]()
        users = {(unit.delay, unit.element) for unit in table.layout.units}
        for k in self.columns:
            row, first = table.rows[k], table.rows[k].place.first
            elements = [element for delay, element in users if delay == first]
            if row.kind == "delay" and len(elements) == 1:
                keys.append(("order", elements[0]))
            else:
                keys.append(("noise" if row.noise else row.kind, first))
        return tuple(np.flatnonzero([key == one for key in keys]) for one in dict.fromkeys(keys))

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
    """A proposal of a group: orders of its element from their prior, the rest from a mixture."""

    outer: Outer
    group: Index
    """Columns."""
    rest: Mixture | None
    """None where there are orders alone."""

    @cached_property
    def _orders(self) -> Flags:
        return self.outer.orders[self.group]

    def draw(self, count: int, rng: np.random.Generator) -> Matrix:
        """Points (count, size), exchangeable orders decreasing."""
        outer, out = self.outer, np.full((count, len(self.outer.columns)), np.nan)
        for column in self.group[self._orders]:
            row = outer.posterior.table.rows[outer.columns[column]]
            drawn = row.draw(count, rng)
            out[:, column] = np.log(drawn) if row.log_scale else drawn
        if self.rest is not None:
            out[:, self.group[~self._orders]] = self.rest.draw(count, rng)
        return np.asarray(outer.y(outer.values(out))[:, self.group])

    def log_density(self, y: Matrix) -> Vector:
        """Log density of points, exchangeable orders decreasing, (n,)."""
        outer, table, total = self.outer, self.outer.posterior.table, np.zeros(len(y))
        full = np.full((len(y), len(outer.columns)), np.nan)
        full[:, self.group] = y
        values = outer.values(full)
        for column in self.group[self._orders]:
            k = outer.columns[column]
            row = table.rows[k]
            total += row.log_prior(values[:, k]) + (np.log(values[:, k]) if row.log_scale else 0.0)
        if self._orders.any() and table.exchangeable[row.place.first]:
            total += lgamma(np.count_nonzero(self._orders) + 1)
        return total if self.rest is None else total + self.rest.log_density(y[:, ~self._orders])


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


@final
@dataclass(frozen=True)
class Walk:
    """Task: where walkers of emcee go from their positions (walkers, dimension), (points, dimension)."""

    mixture: Mixture
    """That moves follow."""

    def __call__(self, posterior: Posterior, task: tuple[Matrix, np.random.SeedSequence]) -> Matrix:
        """Points of the second half of the walk."""
        position, seed = task
        begin = Ensemble.started(position, posterior.log_density(position), position, seed)
        chain = advance(posterior, begin, *_WALK, self.mixture).chain
        return np.asarray(chain[len(chain) // 2 :].reshape(-1, position.shape[1]))


def _begun(conditional: Conditional, values: Matrix, starts: Matrix) -> Matrix:
    """Table values with what is integrated out as in `starts`."""
    out = values.copy()
    out[:, conditional.columns] = starts[:, conditional.columns]
    return out
