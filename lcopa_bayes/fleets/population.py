r"""The population of one parameter over a fleet, from each device's own posterior draws.

Devices are normal around a mean :math:`\mu` with a spread :math:`\sigma`, on the scale the parameter is
sampled on; a share :math:`\epsilon` of them does not belong and comes from a broad normal instead. Divided by
the prior they were drawn under, the draws of a device stand for its likelihood (Hogg, Myers and Bovy 2010,
ApJ 725; Foreman-Mackey, Hogg and Morton 2014, ApJ 795). They are held as a mixture of normals, smoothed
without a change of mean and variance (West 1993, J. R. Stat. Soc. B 55), so that a population narrower than
the distance of draws has a likelihood too; integrals over a device are then closed forms, and :math:`(\mu,
\log\sigma, \epsilon)` is a grid. Other parameters of a device keep their own priors.

Priors: :math:`\mu` flat; :math:`\sigma` half-Cauchy (Gelman 2006, Bayesian Analysis 1) with a scale U, the
scatter of n devices times 1 + 4 / n; :math:`\epsilon` beta(1, 19); the broad normal has 10 U.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from scipy.special import expit, logit, logsumexp
from scipy.stats import median_abs_deviation

from lcopa_bayes.core.arrays import Array, Flags, Index, Matrix, Vector
from lcopa_bayes.core.estimate import HALF_WIDTH
from lcopa_bayes.sampling.importanceweights import LARGEST_K, effective, smoothed

_NODES = 32
"""Normals that a device's likelihood is held as [-]."""
_BROAD = 10.0
"""Standard deviation of devices that do not belong [scatter of the devices]."""
_BETA = 19.0
"""Second parameter of the prior of their share, beta(1, .) [-]: one in twenty."""
_FEW = 4.0
"""Devices so few that the scatter between them counts twice [-]: that of a few may be small by chance."""
_SHARES = 20
"""Values of that share on the grid."""
_COARSE, _FINE, _ACROSS = 72, 48, 33
"""Values of the log spread, before and where its mass is known, and of the mean for each."""
_REACH = 8.0
"""Ends of the mean [standard deviations given the spread]."""
_LOST = 30.0
"""What is less probable than the maximum by this is left out [nat]."""
_DRAWS, _FEWER = 4000, 400
"""Draws of the population, and those that a device is shrunk by."""
_FAR = 3.0
"""Standard deviations from which a device weighs less in the centre of the grid [-]."""
LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)
"""Quantiles that are reported: the median, and the ends of 50 and 90 % intervals."""


@final
@dataclass(frozen=True, eq=False)
class Population:
    """The posterior of a population, with what it says of each device, on the sampled scale."""

    mean: Vector
    """Draws of the mean, (draws,)."""
    spread: Vector
    """Draws of the standard deviation over devices, (draws,)."""
    following: Vector
    """Draws of the next device that belongs, (draws,)."""
    shrunk: Matrix
    """Draws of every device given all of them, (devices, fewer draws)."""
    odd: Vector
    """Probability that a device does not belong, (devices,) [-]."""
    pareto_k: Vector
    """Of the weights of each device's draws under the population, (devices,) [-]; NaN where weights are
    equal."""

    @property
    def failed(self) -> Flags:
        """Devices whose weights fail: their draws stand for a normal likelihood instead."""
        return np.asarray(self.pareto_k > LARGEST_K)

    @property
    def prior(self) -> tuple[float, float]:
        """Mean and standard deviation of the normal that has the median and 90 % interval of the next
        device."""
        low, _, middle, _, high = np.quantile(self.following, LEVELS)
        return float(middle), float((high - low) / (2 * HALF_WIDTH))


@final
@dataclass(frozen=True, eq=False)
class _Nodes:
    """Likelihoods of devices as mixtures of normals, each (devices, nodes)."""

    weight: Matrix
    centre: Matrix
    variance: Matrix

    @classmethod
    def of(cls, draws: Sequence[Vector], log_prior: Sequence[Vector], as_normal: Flags) -> _Nodes:
        return cls(
            *np.stack([_mixture(*one) for one in zip(draws, log_prior, as_normal, strict=True)], axis=1)
        )

    def moments(self) -> tuple[Vector, Vector]:
        """Mean and variance of each device."""
        mean = (self.weight * self.centre).sum(axis=1)
        square = self.variance + (self.centre - mean[:, None]) ** 2
        return mean, (self.weight * square).sum(axis=1)

    def log_terms(self, mean: Array, variance: Array) -> Array:
        """Log of each node's part of the likelihood of a normal population; the population's axes come
        first, (..., devices, nodes)."""
        total = variance[..., None, None] + self.variance
        away = (self.centre - mean[..., None, None]) ** 2 / total
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(self.weight) - 0.5 * (away + np.log(2 * np.pi * total)))

    def log_likelihood(self, mean: Vector, variance: Vector) -> Matrix:
        """Log likelihood of each device under each of these populations, (populations, devices)."""
        out = np.empty((mean.size, self.weight.shape[0]))
        for k in range(mean.size):
            total = variance[k] + self.variance
            away = (self.centre - mean[k]) ** 2 / total
            least = away.min(axis=1)
            away -= least[:, None]
            density = self.weight / np.sqrt(2 * np.pi * total) * np.exp(-0.5 * away)
            out[k] = np.log(density.sum(axis=1)) - 0.5 * least
        return out


def _mixture(draws: Vector, log_prior: Vector, as_normal: bool) -> Matrix:
    """Weights, centres and variances of the normals of one device, (3, nodes)."""
    log_weight = -log_prior - logsumexp(-log_prior)
    order = np.argsort(draws)
    x, w = draws[order], np.exp(log_weight[order])
    mean = float(w @ x)
    variance = float(w @ (x - mean) ** 2)
    if not has_likelihood(draws[:, None]):
        raise ValueError(f"a likelihood needs {_NODES} draws or more that vary; got {draws.size}")
    if as_normal:
        return np.stack([np.eye(1, _NODES)[0], np.full(_NODES, mean), np.full(_NODES, variance)])
    width = 1.06**2 * effective(log_weight) ** -0.4  # of a kernel, in the variance: Silverman's rule
    group = np.arange(x.size) * _NODES // x.size
    weight = np.bincount(group, w, _NODES)
    centre = np.bincount(group, w * x, _NODES) / weight
    within = np.bincount(group, w * (x - centre[group]) ** 2, _NODES) / weight
    return np.stack(
        [weight, mean + np.sqrt(1 - width) * (centre - mean), (1 - width) * within + width * variance]
    )


def has_likelihood(draws: Matrix) -> bool:
    """Whether draws of a device, (draws, parameters), are enough and vary."""
    return draws.shape[0] >= _NODES and bool((np.ptp(draws, axis=0) > 0).all())


def population_of(
    draws: Sequence[Vector], log_prior: Sequence[Vector], rng: np.random.Generator
) -> Population:
    """The population that devices come from.

    `draws` are each device's posterior draws of the parameter on its sampled scale, `log_prior` the log
    density there of the prior they were drawn under, up to a constant. ValueError for fewer than two devices,
    and for draws that are few or do not vary.

    Where weights fail by their Pareto k, the likelihood of a device is a normal with the moments of its
    draws. Accuracy: for normal posteriors exact but for the grid and the Monte Carlo error of 4000 draws.
    """
    if len(draws) < 2:
        raise ValueError(f"a population needs two devices or more; got {len(draws)}")
    as_normal = np.zeros(len(draws), dtype=bool)
    result, pareto_k = _estimated(draws, log_prior, as_normal, rng)
    failed = pareto_k > LARGEST_K
    if failed.any():
        result, _ = _estimated(draws, log_prior, failed, rng)
    return Population(*result, pareto_k)


def _estimated(
    draws: Sequence[Vector], log_prior: Sequence[Vector], as_normal: Flags, rng: np.random.Generator
) -> tuple[tuple[Vector, Vector, Vector, Matrix, Vector], Vector]:
    """What `Population` holds, and the Pareto k of every device."""
    nodes = _Nodes.of(draws, log_prior, as_normal)
    centre, variance = nodes.moments()
    middle = float(np.median(centre))
    unit = float(np.sqrt(median_abs_deviation(centre, scale="normal") ** 2 + np.median(variance)))
    unit *= 1 + _FEW / len(draws)
    broad = np.array([middle]), np.array([(_BROAD * unit) ** 2])
    outside = nodes.log_likelihood(*broad)[0]
    root = (np.arange(_SHARES) + 0.5) / _SHARES  # cubed, for the share of a large fleet may be small
    shares = 0.5 * root**3
    log_share = 2 * np.log(root) + (_BETA - 1) * np.log1p(-shares)

    def posterior(spreads: Vector, across: int) -> tuple[Matrix, Matrix, Matrix, Array]:
        """Means and spreads, (spreads, across), log likelihoods (grid, devices) and log posterior (grid,
        shares)."""
        at, scale = _ridge(centre, variance, spreads)
        means = at[:, None] + scale[:, None] * np.linspace(-_REACH, _REACH, across)
        each = np.broadcast_to(spreads[:, None], means.shape)
        inside = nodes.log_likelihood(means.ravel(), each.ravel() ** 2)
        total = [
            np.logaddexp(np.log1p(-share) + inside, np.log(share) + outside).sum(axis=1) for share in shares
        ]
        # half-Cauchy in the spread, on a grid even in its logarithm and in the scaled mean
        prior = np.log(each * scale[:, None]) - np.log1p((each / unit) ** 2)
        return means, each, inside, np.stack(total, axis=1) + prior.reshape(-1, 1) + log_share

    wide = unit * np.geomspace(1e-3, 100.0, _COARSE)
    known = logsumexp(posterior(wide, 9)[3].reshape(_COARSE, -1), axis=1)
    kept = np.flatnonzero(known > known.max() - _LOST)
    low, high = wide[max(kept[0] - 1, 0)], wide[min(kept[-1] + 1, _COARSE - 1)]
    means, spreads, inside, log_posterior = posterior(np.geomspace(low, high, _FINE), _ACROSS)
    mass = np.exp(log_posterior - logsumexp(log_posterior))

    cells = _systematic(mass.ravel(), _DRAWS, rng)
    cell, share = np.divmod(cells, _SHARES)
    row, column = np.divmod(cell, _ACROSS)
    jitter = rng.uniform(-0.5, 0.5, (2, _DRAWS))
    mean = means[row, column] + jitter[0] * (means[row, 1] - means[row, 0])
    spread = spreads[row, 0] * (high / low) ** (jitter[1] / (_FINE - 1))
    odds = outside - inside
    odd = sum(mass[:, k] @ expit(odds + logit(share)) for k, share in enumerate(shares))
    inlying = sum(mass[:, k] @ expit(-odds - logit(share)) for k, share in enumerate(shares))
    some = rng.choice(_DRAWS, _FEWER, replace=False)
    shrunk = _shrunk(nodes, mean[some], spread[some] ** 2, shares[share[some]], broad, rng)
    following = mean + spread * rng.standard_normal(_DRAWS)
    belongs = float(mass.sum(axis=0) @ (1 - shares))
    typical = float(np.mean(mean)), float(np.sqrt(np.mean(spread**2)))
    k = [
        smoothed(
            np.logaddexp(
                np.log(belongs) + _log_normal(x, *typical),
                np.log1p(-belongs) + _log_normal(x, middle, _BROAD * unit),
            )
            - before
        )[1]
        for x, before in zip(draws, log_prior, strict=True)
    ]
    return (mean, spread, following, shrunk, np.asarray(odd / (odd + inlying))), np.array(k)


def _ridge(centre: Vector, variance: Vector, spreads: Vector) -> tuple[Vector, Vector]:
    """Mean and standard deviation of the population's mean given each spread, were devices normal; those that
    are far away weigh less (Huber 1964, Ann. Math. Statist. 35)."""
    total = spreads[:, None] ** 2 + variance
    at = np.full(spreads.size, np.median(centre))
    for _ in range(10):
        away = np.abs(centre - at[:, None]) / np.sqrt(total)
        weight = np.minimum(1.0, _FAR / np.maximum(away, _FAR)) / total
        at = (weight @ centre) / weight.sum(axis=1)
    return at, 1 / np.sqrt(weight.sum(axis=1))


def _shrunk(
    nodes: _Nodes,
    mean: Vector,
    variance: Vector,
    share: Vector,
    broad: tuple[Vector, Vector],
    rng: np.random.Generator,
) -> Matrix:
    """A draw of every device for each of these populations, (devices, populations)."""
    out = np.empty((nodes.weight.shape[0], mean.size))
    at = np.concatenate([mean, np.repeat(broad[0], mean.size)])  # populations, then as many times the outside
    wide = np.concatenate([variance, np.repeat(broad[1], mean.size)])
    level = np.log(np.concatenate([1 - share, share]))
    for d in range(out.shape[0]):
        one = _Nodes(nodes.weight[d : d + 1], nodes.centre[d : d + 1], nodes.variance[d : d + 1])
        terms = one.log_terms(at, wide)[:, 0] + level[:, None]
        both = np.concatenate(np.split(terms, 2), axis=1)  # (populations, 2 nodes)
        chances = np.cumsum(np.exp(both - logsumexp(both, axis=1, keepdims=True)), axis=1)
        chosen = (chances < rng.uniform(size=(mean.size, 1))).sum(axis=1).clip(max=2 * _NODES - 1)
        outer, node = np.divmod(chosen, _NODES)
        own, near = one.variance[0, node], outer * mean.size + np.arange(mean.size)
        total = own + wide[near]
        centre = (one.centre[0, node] * wide[near] + at[near] * own) / total
        out[d] = centre + np.sqrt(own * wide[near] / total) * rng.standard_normal(mean.size)
    return out


def _systematic(mass: Vector, count: int, rng: np.random.Generator) -> Index:
    """Positions drawn in proportion to a mass, in random order."""
    at = (rng.uniform() + np.arange(count)) / count * mass.sum()
    return np.asarray(rng.permutation(np.minimum(np.searchsorted(np.cumsum(mass), at), mass.size - 1)))


def _log_normal(x: Vector, mean: float, sd: float) -> Vector:
    return np.asarray(-0.5 * ((x - mean) / sd) ** 2 - np.log(sd * np.sqrt(2 * np.pi)))
