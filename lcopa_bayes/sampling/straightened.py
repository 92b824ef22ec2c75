"""A proposal for posteriors that are curved along the orders of a plant.

Along an order everything else follows on a curve: delays, times and gains bend by many times their own width,
and ellipsoids that cover such a posterior are many and thin. What is left of the rest once its mean given the
orders, a cubic polynomial of them, is taken away is nearly straight: a few components cover it, and what they
do not meet yet of a long arm their tails reach.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Index, Matrix, Vector
from lcopa_bayes.sampling.importanceweights import effective, tempered
from lcopa_bayes.sampling.mixture import Mixture

_DEGREE, _LEAST_DEGREE, _FEW = 3, 2, 2
"""Degree of the polynomial, of one in more than so many orders, and that number [-]."""
_FAR = 6.0
"""Distance from the mean order beyond which the polynomial goes no further [posterior sd]."""
_SMOOTH = 1e-6
"""Precision of a coefficient's prior, over that of the draws [-]."""
_EFFECTIVE, _RESAMPLED = 40.0, 3_000
"""Effective draws for each dimension that a fit asks for, and draws of equal weight that it takes [-]."""
_GAIN = 1e-2
"""Gain per point that ends a fit [nat]: the next one follows at once."""
_COMPONENTS, _PER_COMPONENT = 20, 12
"""Most components, and effective draws per dimension for each [-]."""
_LEVELLED, _WIDER, _WIDE = 0.3, 1.7, 0.2
"""Share of components of equal weight; widening, and share, of such that reach further [-]."""


@final
@dataclass(frozen=True, eq=False)
class Straightened:
    """Points whose coordinates beside the orders are a mixture's plus a polynomial of the orders."""

    mixture: Mixture
    orders: Index
    rest: Index
    centre: Vector
    """Mean of the orders' coordinates, (orders,)."""
    spread: Vector
    """Their standard deviations, (orders,)."""
    coefficients: Matrix
    """Of the polynomial's terms, (terms, rest)."""

    @classmethod
    def fitted(cls, y: Matrix, log_weights: Vector, orders: Index, rng: np.random.Generator) -> Straightened:
        """Fit to weighted points (n, dimension), the columns `orders` of which are orders."""
        dimension = y.shape[1]
        weights = tempered(log_weights, min(_EFFECTIVE * dimension, 0.25 * log_weights.size))
        rest = np.setdiff1d(np.arange(dimension), orders)
        own = weights > 0
        centre = weights[own] @ y[own][:, orders]
        variance = weights[own] @ (y[own][:, orders] - centre) ** 2
        spread = np.asarray(np.sqrt(variance) + 1e-300, dtype=float)
        terms = _terms(y[own][:, orders], centre, spread)
        weighted = terms * weights[own, None]
        system = terms.T @ weighted + _SMOOTH * np.eye(terms.shape[1])
        coefficients = np.asarray(np.linalg.solve(system, weighted.T @ y[own][:, rest]), dtype=float)
        straight = y.copy()
        straight[:, rest] -= _terms(y[:, orders], centre, spread) @ coefficients
        chosen = straight[rng.choice(len(y), _RESAMPLED, p=weights)]
        worth = effective(np.log(weights[own]))
        count = int(np.clip(worth / (_PER_COMPONENT * dimension), 1, _COMPONENTS))
        core = Mixture.fitted(chosen, int(rng.integers(2**31)), count, _GAIN)
        level = core.levelled()
        wide = replace(level, factors=_WIDER * level.factors)
        mixture = core.blended(level, _LEVELLED).blended(wide, _WIDE)
        return cls(mixture, orders, rest, centre, spread, coefficients)

    def draw(self, count: int, rng: np.random.Generator) -> Matrix:
        """Independent draws, (count, dimension)."""
        out = self.mixture.draw(count, rng)
        out[:, self.rest] += self._mean(out)
        return out

    def log_density(self, points: Matrix) -> Vector:
        """Log density, (n,): a shift by what does not change keeps volumes."""
        straight = points.copy()
        straight[:, self.rest] -= self._mean(points)
        return self.mixture.log_density(straight)

    def _mean(self, y: Matrix) -> Matrix:
        return np.asarray(_terms(y[:, self.orders], self.centre, self.spread) @ self.coefficients)


def _terms(orders: Matrix, centre: Vector, spread: Vector) -> Matrix:
    """Terms of the polynomial, (n, terms)."""
    x = np.clip((orders - centre) / spread, -_FAR, _FAR)
    degree = _DEGREE if x.shape[1] <= _FEW else _LEAST_DEGREE
    products = [
        x[:, list(chosen)].prod(axis=1)
        for power in range(degree + 1)
        for chosen in combinations_with_replacement(range(x.shape[1]), power)
    ]
    return np.column_stack(products)
