"""A proposal that covers a posterior: Student components around its optima, fitted to weighted draws."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol, final

import numpy as np
from scipy.special import logsumexp
from sklearn.cluster import KMeans
from sklearn.exceptions import ConvergenceWarning

from lcopa_bayes.core.arrays import Index, Matrix, Vector
from lcopa_bayes.core.covariance import root_of
from lcopa_bayes.inference.optimum import Optimum
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.coordinates import Chart
from lcopa_bayes.sampling.importanceweights import tempered
from lcopa_bayes.sampling.mixture import FREEDOM, Mixture

_NEGLIGIBLE = 20.0
"""Optima whose Gaussian mass lies this far below that of the best are omitted [nat]."""
_GROUP = 3
"""Components that start around one optimum: a curved or skewed posterior needs more than one [-]."""
_AROUND = 400
"""Gaussian draws around an optimum that give its components their place and size in the chart."""
_MORE = 20
"""Most times that so many are drawn again where too few are inside the prior."""
_SMALL = 0.02
"""Scale of such draws, over the linearised standard deviation, at which the chart is straight [-]."""
_BENT = 3.0
"""A chart that is this much steeper at an optimum than around it has no linear part there [-]."""
_DEFENSIVE = 0.2
"""Share of the proposal that is wider than the fit: half of it every component, half all draws as one [-]."""
_WIDER = 2.0
"""Factor by which it is [-]."""
_LEAST_VARIANCE = 1e-6
"""Least variance of a component along every coordinate, over that of the weighted draws [-]."""
_PER_DIMENSION = 40
"""Effective draws that a fit of the proposal needs for each dimension [-]."""
_STEPS = 4
"""Steps of expectation maximisation per round."""
_ROUNDED = 1e-12
"""Standard deviation of points below which they are one, over 1 and their distance from 0 [-]."""
_NO_WEIGHT = 1e-9
"""Draws with less than this share of the mean weight do not take part in the fit [-]."""
_NO_MASS = 1e-4
"""Components with less than this share of the weight are omitted [-]."""
_CLUSTERS, _PER_CLUSTER, _CLUSTER_STEPS = 20, 20, 15
"""Most clusters of a proposal, effective draws per dimension for each of them, and steps that improve it."""
_LEAST_SIZE = 1e-4
"""Least variance of a cluster along every coordinate, over that of the weighted draws [-]."""
_EQUAL = 6, 2
"""Largest weights for each dimension that are made equal (Koblents and Miguez 2015), while draws are few and
once they are settled [-]."""
_LEVELLED, _WIDE = (0.3, 0.1), (0.15, 0.1)
"""Share of such a proposal whose clusters have equal weights, and of one that is wider, likewise [-]."""
_HEAVIEST, _NEAR, _SHARPENED = 12, 7, 0.4
"""Heaviest draws that get a component of their own, draws for each dimension that give its width, and share
of such components [-]."""
_PER_COEFFICIENT, _NEARLY, _BEYOND = 4, 3.0, 2.0
"""Least points for each coefficient of a quadratic [-], how far below the highest those lie, per dimension,
that are used in any case [nat], and how far beyond their spread it may lead [-]."""


def weighty(optima: Sequence[Optimum]) -> list[Optimum]:
    """Optima whose Gaussian approximation has a mass that counts."""
    masses = [
        optimum.log_density + 0.5 * float(np.linalg.slogdet(optimum.covariance)[1]) for optimum in optima
    ]
    finite = [mass if np.isfinite(mass) else -np.inf for mass in masses]
    chosen = [o for o, mass in zip(optima, finite, strict=True) if mass >= max(finite) - _NEGLIGIBLE]
    return chosen or list(optima[:1])


def around(
    posterior: Posterior, chart: Chart, optima: Sequence[Optimum], rng: np.random.Generator
) -> Mixture | None:
    """Groups of Gaussian shape around optima, first as wide in the chart as their linearised covariance; None
    where no optimum has a surrounding inside the prior and its chart."""
    means, factors = [], []
    for optimum in optima:
        centre = posterior.coordinates(optimum.values[None])[0]
        root = root_of(optimum.covariance)
        standard = rng.standard_normal((_AROUND, centre.size))
        near, wide = (
            _inside(posterior, chart, centre, scale * root, standard, rng) for scale in (_SMALL, 1.0)
        )
        if min(len(near), len(wide)) < 2 * centre.size:
            continue
        # on a bound the chart has no slope: there what lies inside it at full width gives place and size
        linear, full = near.std(axis=0) / _SMALL, wide.std(axis=0)
        bent = linear > _BENT * full
        shrunk = np.where(bent, full / linear, 1.0)
        mean = np.where(bent, wide.mean(axis=0), near.mean(axis=0))
        covariance = np.cov(near, rowvar=False).reshape(centre.size, centre.size) / _SMALL**2
        covariance *= np.outer(shrunk, shrunk)
        factor = np.linalg.cholesky(covariance + 1e-12 * np.diag(np.diag(covariance)))
        means += [mean, *(mean + standard[: _GROUP - 1] @ factor.T)]
        factors += [factor] * _GROUP
    if not means:
        return None
    return Mixture(np.full(len(means), 1 / len(means)), np.array(means), np.array(factors))


def _inside(
    posterior: Posterior, chart: Chart, centre: Vector, root: Matrix, first: Matrix, rng: np.random.Generator
) -> Matrix:
    """Charted points about a centre that are inside the prior; of an optimum in a corner few of the first."""
    inside = _charted(posterior, chart, centre + first @ root.T)
    for _ in range(_MORE):
        if len(inside) < 2 * centre.size:
            more = centre + rng.standard_normal(first.shape) @ root.T
            inside = np.concatenate([inside, _charted(posterior, chart, more)])
    return inside


def split(core: Mixture, rng: np.random.Generator) -> Mixture:
    """Every component with others of its shape at draws from it, for a posterior that needs more of them."""
    count = len(core.means)
    steps = np.einsum("kij,gkj->gki", core.factors, rng.standard_normal((_GROUP - 1, count, core.dimension)))
    means = np.concatenate([core.means[None], core.means + steps]).reshape(-1, core.dimension)
    return Mixture(np.tile(core.weights / _GROUP, _GROUP), means, np.tile(core.factors, (_GROUP, 1, 1)))


def _charted(posterior: Posterior, chart: Chart, z: Matrix) -> Matrix:
    """Chart of those points that lie inside the prior."""
    return chart.usable(z[posterior.log_prior(z) > -np.inf])[1]


class Proposal(Protocol):
    """A density that can be drawn from."""

    def draw(self, count: int, rng: np.random.Generator, /) -> Matrix:
        """Independent draws, (count, dimension)."""

    def log_density(self, points: Matrix, /) -> Vector:
        """Log density, (n,)."""


@final
@dataclass(frozen=True)
class Blend:
    """A proposal that is in part another."""

    main: Proposal
    other: Proposal
    share: float
    """Of the other [-]."""

    def draw(self, count: int, rng: np.random.Generator) -> Matrix:
        """Independent draws, (count, dimension), in random order."""
        others = rng.binomial(count, self.share)
        parts = self.main.draw(count - others, rng), self.other.draw(others, rng)
        return np.asarray(rng.permutation(np.concatenate(parts)))

    def log_density(self, points: Matrix) -> Vector:
        """Log density, (n,)."""
        both = self.main.log_density(points), self.other.log_density(points)
        return np.asarray(np.logaddexp(np.log1p(-self.share) + both[0], np.log(self.share) + both[1]))


@final
@dataclass(frozen=True)
class Product:
    """A proposal of independent groups of coordinates, each with its own: where a posterior nearly divides
    so, far fewer components cover it."""

    groups: tuple[Index, ...]
    """Columns of each, all of them together."""
    proposals: tuple[Proposal, ...]

    def draw(self, count: int, rng: np.random.Generator) -> Matrix:
        """Independent draws, (count, dimension)."""
        out = np.empty((count, sum(len(group) for group in self.groups)))
        for group, proposal in zip(self.groups, self.proposals, strict=True):
            out[:, group] = proposal.draw(count, rng)
        return out

    def log_density(self, points: Matrix) -> Vector:
        """Log density, (n,)."""
        parts = zip(self.groups, self.proposals, strict=True)
        return np.asarray(sum(proposal.log_density(points[:, group]) for group, proposal in parts))


@final
@dataclass(frozen=True, eq=False)
class Seen:
    """Draws of all proposals so far, weighted as draws of their mixture (Cornuet, Marin, Mira and Robert
    2012, Scand. J. Statist. 39)."""

    proposals: tuple[Proposal, ...] = ()
    counts: tuple[int, ...] = ()
    """Draws of each, those without density included."""
    points: tuple[Matrix, ...] = ()
    log_densities: tuple[Vector, ...] = ()
    by_proposal: Matrix = field(default_factory=lambda: np.empty((0, 0)))
    """Log density of every proposal at all points, (proposals, points) [nat]."""

    def joined(self, proposal: Proposal, count: int, y: Matrix, log_density: Vector) -> Seen:
        """With the draws y of another proposal, those of `count` that may have a density."""
        points = (*self.points, y)
        known = np.array([one.log_density(y) for one in self.proposals]).reshape(-1, len(y))
        by_proposal = np.vstack(
            [np.hstack([self.by_proposal, known]), proposal.log_density(np.concatenate(points))]
        )
        return Seen(
            (*self.proposals, proposal),
            (*self.counts, count),
            points,
            (*self.log_densities, log_density),
            by_proposal,
        )

    def last_weights(self) -> Vector:
        """Of the last proposal's draws, as draws of it alone [nat]."""
        return np.asarray(self.log_densities[-1] - self.by_proposal[-1, -len(self.points[-1]) :])

    def log_weights(self, since: int = 0) -> Vector:
        """Log of the density of each point of the proposals `since` one over that of their mixture [nat]; the
        mean over all their draws is that of the density's integral."""
        shares = np.array(self.counts[since:])[:, None] / sum(self.counts[since:])
        first = sum(map(len, self.points[:since]))
        mixture = logsumexp(self.by_proposal[since:, first:], axis=0, b=shares)
        return np.asarray(np.concatenate(self.log_densities[since:]) - mixture)

    def efficiency(self, proposal: Proposal, log_weights: Vector) -> float:
        """Effective draws per draw of a proposal, by all points and their `log_weights` [-]: a region that it
        hardly draws from shows if ever a point lay there."""
        density = np.concatenate(self.log_densities)
        ratio = density - proposal.log_density(np.concatenate(self.points))
        level = 2 * logsumexp(log_weights) - np.log(sum(self.counts)) - logsumexp(log_weights + ratio)
        return float(np.exp(min(level, 0.0)))  # above 1 where it is narrow about the point of all the weight


def fitted(core: Mixture, y: Matrix, log_weights: Vector) -> tuple[Mixture, Mixture]:
    """A mixture after a few steps of expectation maximisation on weighted draws; and with wider components,
    as draws are proposed from it.

    Weights of few effective draws are raised to a power below 1 that leaves enough of them (Koblents and
    Miguez 2015, Statistics and Computing 25): the proposal nears the posterior without collapsing before.
    """
    weights = tempered(log_weights, min(_PER_DIMENSION * y.shape[1], 0.25 * log_weights.size))
    cloud = _Cloud.of(y, weights, _LEAST_VARIANCE)
    core = cloud.maximised(core, _STEPS)
    wider = Mixture(core.weights, core.means, _WIDER * core.factors)
    return core, core.blended(wider.blended(cloud.around_all, 0.5), _DEFENSIVE)


def clustered(y: Matrix, log_weights: Vector, seed: int, *, settled: bool = False) -> Mixture:
    """A proposal of clusters of weighted draws (n, dimension), improved by expectation maximisation; in part
    with equal weights, so that a small mode is drawn from often enough, and in part wider: less of both where
    the draws are `settled`, known to cover what they were drawn for."""
    equals, levelled, wide = (own[int(settled)] for own in (_EQUAL, _LEVELLED, _WIDE))
    weights = tempered(log_weights, min(_PER_CLUSTER * y.shape[1], 0.25 * log_weights.size))
    # the largest weights made equal: a cluster around one draw would cover nothing of what it stands for
    equal = min(equals * y.shape[1], np.count_nonzero(weights))
    weights = np.minimum(weights, np.partition(weights, -equal)[-equal])
    weights /= weights.sum()
    count = int(np.clip(1 / (weights @ weights) / (_PER_CLUSTER * y.shape[1]), 1, _CLUSTERS))
    cloud = _Cloud.of(y, weights, _LEAST_SIZE)
    core = cloud.maximised(cloud.clusters(count, seed), _CLUSTER_STEPS)
    wider = replace(core.levelled(), factors=_WIDER * core.factors).blended(cloud.around_all, 0.3)
    return core.blended(core.levelled(), levelled).blended(wider, wide)


def adapted(y: Matrix, log_weights: Vector, seed: int) -> Mixture:
    """A proposal of clusters of weighted draws and of components at the heaviest draws, which the proposals
    so far hardly cover (Raftery and Bao 2010, Biometrics 66)."""
    return clustered(y, log_weights, seed).blended(_at_heaviest(y, log_weights), _SHARPENED)


def _at_heaviest(y: Matrix, log_weights: Vector) -> Mixture:
    """Components at the heaviest draws, none near another, each as wide as the draws nearest to it."""
    weights = np.exp(log_weights - logsumexp(log_weights))
    cloud = _Cloud.of(y, weights, _LEAST_SIZE)
    y, open_to = cloud.y, cloud.weights.copy()
    scaled = np.linalg.solve(np.linalg.cholesky(cloud.whole + cloud.floor), y.T).T
    near, means, factors = _NEAR * y.shape[1], list[Vector](), list[Matrix]()
    while len(means) < _HEAVIEST and open_to.any():
        at = int(np.argmax(open_to))
        chosen = np.argsort(((scaled - scaled[at]) ** 2).sum(axis=1), kind="stable")[:near]
        own = cloud.weights[chosen]
        own = 0.5 * (own / own.sum() + 1 / own.size)
        apart = y[chosen] - y[at]
        means.append(y[at])
        factors.append(np.linalg.cholesky((own[:, None] * apart).T @ apart + cloud.floor))
        open_to[chosen[: near // 2]] = 0.0
    return Mixture(np.full(len(means), 1 / len(means)), np.array(means), np.array(factors))


def paraboloid(y: Matrix, log_density: Vector) -> Mixture | None:
    """A component with the mode and curvature of a quadratic fitted to the highest log densities: it moves
    and turns towards a single mode where hardly a draw has any weight. None with too few points, or with such
    as only rounding distinguishes."""
    size = y.shape[1]
    first, second = np.triu_indices(size)
    wanted = _PER_COEFFICIENT * (1 + size + first.size)
    if np.count_nonzero(np.isfinite(log_density)) < wanted:
        return None
    near = np.count_nonzero(log_density > log_density.max() - _NEARLY * (1 + size))
    best = np.argsort(-log_density, kind="stable")[: max(wanted, near)]
    centre, scale = y[best].mean(axis=0), y[best].std(axis=0)
    if (scale <= _ROUNDED * (1.0 + np.abs(centre))).any():
        return None
    x, level = (y[best] - centre) / scale, log_density[best] - log_density[best[0]]
    terms = np.column_stack([np.ones(best.size), x, x[:, first] * x[:, second]])
    counted = 1.0 / (1.0 - level / size)  # far below the highest a density is not quadratic
    fit = np.linalg.lstsq(counted[:, None] * terms, counted * level, rcond=None)[0]
    curved = np.zeros((size, size))
    curved[first, second] = fit[1 + size :]
    steep, axes = np.linalg.eigh(-(curved + curved.T))
    # no direction wider than the points, and no mode beyond them
    spread = np.sqrt(((x @ axes) ** 2).mean(axis=0)) + 1e-150
    precision = np.maximum(steep, 1.0 / (_BEYOND * spread) ** 2)
    mode = np.clip(axes.T @ fit[1 : 1 + size] / precision, -_BEYOND * spread, _BEYOND * spread)
    # the Cholesky factor of the covariance, also where its digits do not suffice to factorise it
    upper = np.asarray(np.linalg.qr((axes / np.sqrt(precision)).T, mode="r"))
    factor = upper.T * np.sign(np.diag(upper))
    return Mixture(np.ones(1), (centre + scale * (axes @ mode))[None], (scale[:, None] * factor)[None])


@final
@dataclass(frozen=True, eq=False)
class _Cloud:
    """Weighted draws that components are fitted to."""

    y: Matrix
    """(n, dimension)."""
    weights: Vector
    """Normalised, (n,) [-]."""
    centre: Vector
    whole: Matrix
    """Covariance."""
    floor: Matrix
    """Least covariance of a component."""

    @classmethod
    def of(cls, y: Matrix, weights: Vector, least: float) -> _Cloud:
        """Of normalised weights, without the draws of hardly any; `least` variance over that of all [-]."""
        kept = weights > _NO_WEIGHT / weights.size
        y, weights = y[kept], weights[kept] / weights[kept].sum()
        centre = weights @ y
        whole = (weights[:, None] * (y - centre)).T @ (y - centre)
        return cls(y, weights, centre, whole, np.diag(least * np.diag(whole) + 1e-300))

    @property
    def around_all(self) -> Mixture:
        """One component for all draws, wider than they are."""
        factor = np.asarray(_WIDER * np.linalg.cholesky(self.whole + self.floor), dtype=float)
        return Mixture(np.ones(1), self.centre[None], factor[None])

    def clusters(self, count: int, seed: int) -> Mixture:
        """A component for each of `count` clusters of the draws."""
        y, masses, means, factors = self.y, [], [], []
        scaled = y / np.sqrt(np.diag(self.floor))
        found = KMeans(count, n_init=1, random_state=seed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # clusters without a draw are omitted below
            labels = found.fit(scaled, sample_weight=self.weights).labels_
        for cluster in range(count):
            own = self.weights * (labels == cluster)
            if own.sum() > _NO_MASS:
                mean = own @ y / own.sum()
                covariance = (own[:, None] * (y - mean)).T @ (y - mean) / own.sum()
                masses.append(own.sum())
                means.append(mean)
                factors.append(np.linalg.cholesky(covariance + self.floor))
        return Mixture(np.array(masses) / np.sum(masses), np.array(means), np.array(factors))

    def maximised(self, core: Mixture, steps: int) -> Mixture:
        """Student components after steps of expectation maximisation."""
        size = self.y.shape[1]
        for _ in range(steps):
            distances = core.distances(self.y)
            own = core.shares(distances) * self.weights
            mass = own.sum(axis=1)
            kept = mass >= _NO_MASS
            own, mass = own[kept], mass[kept]
            heavy = own * (FREEDOM + size) / (FREEDOM + distances[kept])
            moments, total = heavy @ self._moments, heavy.sum(axis=1, keepdims=True)
            shift = moments[:, :size] / total
            second = np.empty((len(mass), size, size))
            first, other = np.triu_indices(size)
            second[:, first, other] = second[:, other, first] = moments[:, size:]
            second -= total[..., None] * shift[:, :, None] * shift[:, None]
            factors = np.linalg.cholesky(second / mass[:, None, None] + self.floor)
            core = Mixture(mass / mass.sum(), self.centre + shift, factors)
        return core

    @cached_property
    def _moments(self) -> Matrix:
        """Deviations of the draws from their centre and products of any two, (n, dimension and pairs)."""
        apart = self.y - self.centre
        first, other = np.triu_indices(apart.shape[1])
        return np.concatenate([apart, apart[:, first] * apart[:, other]], axis=1)
