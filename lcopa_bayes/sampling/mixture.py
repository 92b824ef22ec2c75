"""A mixture of ellipsoids fitted to draws: a density that can be drawn from and evaluated anywhere."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import gammaln
from sklearn.exceptions import ConvergenceWarning
from sklearn.mixture import GaussianMixture

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector

_COMPONENTS = 20
"""Most components of a mixture."""
_FITTED = 6_000
"""Most points a mixture is fitted to."""
FREEDOM = 5
"""Degrees of freedom of the components, a whole number: tails heavy enough to cover what the fit does not
include [-]."""
_ROUNDS, _GAIN = 60, 1e-3
"""Most rounds of expectation maximisation, and gain per point below which they end [nat]: a good cover is
wanted, not the maximum."""
_TOGETHER = 1 << 16
"""Numbers of whitened points that are calculated at once; more no longer fit the cache."""
_RIDGE = 1e-6
"""Added to the variance of every direction, relative to the draws' own [-]."""


@final
@dataclass(frozen=True, eq=False)
class Mixture:
    """Multivariate Student components with common degrees of freedom."""

    weights: Vector
    """(components,) [-]."""
    means: Matrix
    """(components, dimension)."""
    factors: Array
    """Lower Cholesky factors of the scale matrices, (components, dimension, dimension)."""

    @classmethod
    def fitted(cls, points: Matrix, seed: int, components: int = _COMPONENTS, gain: float = _GAIN) -> Mixture:
        """Fit to points (n, dimension) by expectation maximisation of Gaussians, at most `components`,
        until a round gains less for each point [nat].

        Deterministic given `seed`. Fewer components are used when there are not ten points per
        dimension for each of them.
        """
        points = spread_evenly(points, _FITTED)
        count, dimension = points.shape
        components = max(1, min(components, count // (10 * dimension)))
        shift, spread = points.mean(axis=0), points.std(axis=0)
        spread = np.where(spread > 0, spread, 1.0)
        random = np.random.RandomState(np.random.MT19937(np.random.SeedSequence(seed)))
        fit = GaussianMixture(components, tol=gain, max_iter=_ROUNDS, reg_covar=_RIDGE, random_state=random)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            fit.fit((points - shift) / spread)
        factors = spread[:, None] * np.linalg.cholesky(fit.covariances_)
        return cls(np.asarray(fit.weights_), shift + spread * fit.means_, factors)

    def levelled(self) -> Mixture:
        """The same components with equal weights, so that a small mode is proposed as often as a large
        one."""
        return Mixture(np.full(self.weights.size, 1 / self.weights.size), self.means, self.factors)

    def blended(self, other: Mixture, share: float) -> Mixture:
        """A mixture of both, `share` of it the other."""
        return Mixture(
            np.concatenate([(1 - share) * self.weights, share * other.weights]),
            np.concatenate([self.means, other.means]),
            np.concatenate([self.factors, other.factors]),
        )

    def of(self, columns: Index) -> Mixture:
        """Of some columns alone, those of a diagonal mixture."""
        return Mixture(self.weights, self.means[:, columns], self.factors[:, columns[:, None], columns])

    def marginal(self, columns: Index) -> Mixture:
        """Of some columns alone."""
        rows = self.factors[:, columns]
        factors = np.linalg.cholesky(rows @ rows.swapaxes(1, 2)).astype(float)
        return Mixture(self.weights, self.means[:, columns], factors)

    @property
    def dimension(self) -> int:
        """Number of coordinates."""
        return int(self.means.shape[1])

    def draw(self, count: int, random: Any) -> Matrix:
        """Independent draws, (count, dimension), from a generator of either kind of numpy's."""
        component = random.choice(self.weights.size, size=count, p=self.weights / self.weights.sum())
        normal = random.standard_normal((count, self.dimension))
        stretch = np.sqrt(FREEDOM / random.chisquare(FREEDOM, size=count))
        steps = np.einsum("nij,nj->ni", self.factors[component], normal)
        return np.asarray(self.means[component] + stretch[:, None] * steps)

    def log_density(self, points: Matrix) -> Vector:
        """Log density, (n,)."""
        parts, level = self._parts(self.distances(points))
        return np.asarray(np.log(parts.sum(axis=0)) + level)

    def shares(self, distances: Matrix) -> Matrix:
        """Probability of each component given points at these `distances`, (components, n) [-]."""
        parts, _ = self._parts(distances)
        parts /= parts.sum(axis=0)
        return parts

    def _parts(self, distances: Matrix) -> tuple[Matrix, Vector]:
        """Density of each component times its weight, (components, n), over a level whose logarithm is (n,).

        That level is of the component that is nearest, so that hardly a sum underflows. By products:
        logarithms and powers of every entry would take longer than the distances.
        """
        here = distances if self.weights.all() else distances[self.weights > 0.0]
        nearest = here.min(axis=0)
        exponent, highest = FREEDOM + self.dimension, self._levels.max()
        ratio = (FREEDOM + nearest) / (FREEDOM + distances)
        parts = np.sqrt(ratio) if exponent % 2 else np.ones_like(ratio)
        remaining = exponent // 2
        while remaining:
            if remaining % 2:
                parts *= ratio
            ratio *= ratio
            remaining //= 2
        relative = np.exp(self._levels - highest)
        parts *= relative[:, None]
        level = highest - 0.5 * exponent * np.log1p(nearest / FREEDOM)
        if not relative[self.weights > 0.0].all():  # beside one so narrow that it is e^700 times as dense
            lost = ~parts.any(axis=0)
            logarithms = self._log_parts(distances[:, lost])
            level[lost] = logarithms.max(axis=0)
            parts[:, lost] = np.exp(logarithms - level[lost])
        return parts, level

    def log_parts(self, points: Matrix) -> Matrix:
        """Log density of each component times its weight, (components, n)."""
        return self._log_parts(self.distances(points))

    def _log_parts(self, distances: Matrix) -> Matrix:
        parts = np.log1p(distances / FREEDOM)
        parts *= -0.5 * (FREEDOM + self.dimension)
        parts += self._levels[:, None]
        return parts

    @cached_property
    def _levels(self) -> Vector:
        """Log density of each component at its mean times its weight, (components,)."""
        constant = gammaln((FREEDOM + self.dimension) / 2) - gammaln(FREEDOM / 2)
        constant -= 0.5 * self.dimension * np.log(FREEDOM * np.pi)
        scale = np.log(np.diagonal(self.factors, axis1=1, axis2=2)).sum(axis=1)
        with np.errstate(divide="ignore"):
            return np.asarray(constant - scale + np.log(self.weights))

    def distances(self, points: Matrix) -> Matrix:
        """Squared Mahalanobis distance from every component, (components, n) [-]."""
        size = self.weights.size, self.dimension
        out = np.empty((size[0], len(points)))
        whitener, centre = self._whitener
        together = max(1, _TOGETHER // centre.size)
        for first in range(0, len(points), together):
            some = slice(first, first + together)
            white = (points[some] @ whitener - centre).reshape(-1, *size)
            np.einsum("nkd,nkd->kn", white, white, out=out[:, some])
        return out

    def log_shares(self, points: Matrix) -> Matrix:
        """Log probability of each component given a point, (components, n)."""
        parts = self.log_parts(points)
        return np.asarray(parts - np.logaddexp.reduce(parts, axis=0))

    @cached_property
    def _whitener(self) -> tuple[Matrix, Vector]:
        """Transposed inverses of the factors beside each other, (dimension, components * dimension), and the
        means times these."""
        unit = np.eye(self.dimension)
        each = [solve_triangular(factor, unit, lower=True).T for factor in self.factors]
        means = [mean @ own for mean, own in zip(self.means, each, strict=True)]
        return np.concatenate(each, axis=1), np.concatenate(means)


def spread_evenly(points: Matrix, most: int) -> Matrix:
    """At most `most` of the points (n, dimension), evenly spread over them."""
    return np.asarray(points[np.linspace(0, len(points) - 1, min(most, len(points))).astype(int)])
