"""Draws of the sums of lags that a response axis may be: times and delays, and exactly their weights.

The number of lags is the best by BIC in half of the draws, and in the others one more, which the records need
not show: what it leaves open of a number is part of that number's interval. Draws with a spare lag alone
would not do: most of its prior is at later delays, and an interval over them begins after the true one.

One path has so few coordinates that importance sampling from a mixture holds, which is fitted to the draws of
all its forerunners; these are fitted to powers of the density that rise to 1, so that ridges are followed to
their ends (Cappé, Guillin, Marin and Robert 2004, J. Comput. Graph. Stat. 13). Several paths, and one where
it does not hold, are sampled by emcee.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, final

import emcee
import numpy as np
from arviz_stats.base import array_stats  # type: ignore[attr-defined]
from scipy.stats.qmc import Halton

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector
from lcopa_bayes.core.covariance import covariance_of
from lcopa_bayes.inference.descents import descended
from lcopa_bayes.inference.diffusion import Kind, rises
from lcopa_bayes.inference.lagfits import LagDescents
from lcopa_bayes.inference.lagsearch import FINE, LagSearch
from lcopa_bayes.inference.lagsum import LagTable
from lcopa_bayes.sampling.importanceweights import usable_k
from lcopa_bayes.sampling.mixture import Mixture
from lcopa_bayes.sampling.proposal import Seen, adapted
from lcopa_bayes.sampling.weighted import resampled, tail_smoothed

_POWERS = (0.05, 0.1, 0.3, 1.0, 1.0)
"""Of the density, to which each mixture but the first is fitted [-]; the last where the one before is not
enough."""
_DRAWN = 2_000
"""Draws of each mixture."""
_SPARE, _LOOSE = 32, 0.1
"""Components of the first mixture with a spare lag anywhere, for each path, and the largest standard
deviation of its components, over the range of a coordinate [-]."""
_SETTLED, _GAIN = 8, 0.1
"""Most steps of everything else with such a lag in its place [-], and gain below which they end [nat]."""
_WEIGHTLESS, _LIGHT = 15.0, 3.0
"""Gaussian mass of components, below that of the heaviest, from which they are left out, and to which they
count by it [nat]."""
_WALKERS, _STEPS, _THIN = 96, 300, 10
_ROUNDS = 13
"""Most times that many steps are made; the first are left out."""
_MOVED = 3
"""Coordinates of a walker that a proposal moves [-]."""
_WANTED = 200.0
"""Effective draws that end them."""
_KEPT = 1_000
"""Most draws that are kept."""
_AT_END = 0.01
"""Share of the draws beside an end of the tabulated delays that moves the end."""


@final
@dataclass(frozen=True, eq=False)
class LagDraws:
    """Equally probable sums of lags of the paths of one response axis."""

    kind: Kind
    """What the first of them is."""
    times: Array
    """Time constants, (draws, paths, lags) [time unit]."""
    weights: Array
    """Theirs, (draws, paths, lags) [response unit / drive unit]."""
    delays: Matrix
    """(draws, paths) [time unit]."""
    ess: float
    """Effective sample size, by emcee the smallest of a steady value or delay [draws]."""

    @property
    def gains(self) -> Matrix:
        """Steady response per unit step, (draws, paths)."""
        return np.asarray(self.weights.sum(axis=2))

    def response(self, path: int, time: Vector) -> Matrix:
        """Response to a unit step at time 0, (draws, n)."""
        since = np.maximum(time - self.delays[:, path, None], 0.0)
        times, weights = self.times[:, path, :, None], self.weights[:, path, :, None]
        out = np.zeros(since.shape)
        for k in range(times.shape[1]):
            out += weights[:, k] * rises("lags" if k else self.kind, since, times[:, k])
        return out


@final
@dataclass(frozen=True, eq=False)
class LagMixture:
    """Equally probable draws of several kinds, in no order."""

    parts: tuple[LagDraws, ...]
    picked: Index
    """Places of the draws among those of all parts, (draws,)."""

    @classmethod
    def of(cls, searches: Sequence[LagSearch], seed: int) -> LagMixture:
        """As many draws of each search, and of each number of lags of one."""
        return cls.joined([lag_draws(*task) for task in lag_tasks(searches, seed)], seed)

    @classmethod
    def joined(cls, drawn: Sequence[LagDraws], seed: int) -> LagMixture:
        """As many draws of each kind."""
        rng = np.random.default_rng([seed, 1])
        sizes = np.array([len(one.delays) for one in drawn])
        each = zip(np.cumsum(sizes) - sizes, sizes, strict=True)
        picked = [first + rng.choice(size, sizes.min(), replace=False) for first, size in each]
        return cls(tuple(drawn), rng.permutation(np.concatenate(picked)))

    @cached_property
    def gains(self) -> Matrix:
        """Steady response per unit step, (draws, paths)."""
        return np.asarray(np.concatenate([one.gains for one in self.parts])[self.picked])

    @cached_property
    def delays(self) -> Matrix:
        """(draws, paths) [time unit]."""
        return np.asarray(np.concatenate([one.delays for one in self.parts])[self.picked])

    @property
    def ess(self) -> float:
        """Effective sample size of all, as the least of any kind allows [draws]."""
        return len(self.parts) * min(one.ess for one in self.parts)

    def response(self, path: int, time: Vector) -> Matrix:
        """Response to a unit step at time 0, (draws, n)."""
        return np.asarray(np.concatenate([one.response(path, time) for one in self.parts])[self.picked])


def lag_tasks(searches: Sequence[LagSearch], seed: int) -> list[tuple[LagSearch, int, int, float]]:
    """What `lag_draws` is asked for, for each search and each number of lags of one."""
    every = [(one, lags) for one in searches for lags in one.lags]
    return [(one, lags, seed, _WANTED / len(every)) for one, lags in every]


def lag_draws(search: LagSearch, lags: int, seed: int, wanted: float = _WANTED) -> LagDraws:
    """Draws of so many lags about the optima of a search, effectively as many as are `wanted`, tabulated
    farther out where they stand beside an end."""
    rng = np.random.default_rng([seed, lags])
    kept, ess = _sampled(search, lags, rng, wanted)
    wider = _wider(search, kept)
    while (wider != search.near).any():
        search = replace(search, near=wider)
        kept, ess = _sampled(search, lags, rng, wanted)
        wider = _wider(search, kept)
    log_times, own = search.table.parts(kept)
    scales = search.problem.scales
    units = scales.amplitude[search.axis] / scales.excursion[list(search.drives)]
    weights = search.table.conditional(kept).draw(rng).reshape(log_times.shape) * units[:, None]
    return LagDraws(search.kind, np.exp(log_times), weights, own, ess)


def _wider(search: LagSearch, draws: Matrix) -> Matrix:
    """The ends of the tabulated delays, farther out where draws stand beside them."""
    near, delays, paths = search.near, search.delays, len(search.drives)
    own, width = draws[:, -paths:], near[:, 1] - near[:, 0]
    edge = width / (FINE - 1)
    below = (own < near[:, 0] + edge).mean(axis=0) > _AT_END
    above = (own > near[:, 1] - edge).mean(axis=0) > _AT_END
    low = np.where(below, np.maximum(near[:, 0] - width, delays[:, 0]), near[:, 0])
    return np.stack([low, np.where(above, np.minimum(near[:, 1] + width, delays[:, 1]), near[:, 1])], axis=1)


def _sampled(search: LagSearch, lags: int, rng: np.random.Generator, wanted: float) -> tuple[Matrix, float]:
    """Coordinates of equally probable draws, (draws, dimension), and their effective number."""
    begun = _begun(search, lags, rng)
    weighted = _weighted(search, begun, rng) if search.table.paths == 1 else None
    return weighted or _walked(search, begun, rng, wanted)


def _weighted(search: LagSearch, proposal: Mixture, rng: np.random.Generator) -> tuple[Matrix, float] | None:
    """By importance sampling, which a first proposal begins; None where it does not hold."""
    seen = _joined(Seen(), search, proposal, rng)
    for power in _POWERS:
        density, log_weights = np.concatenate(seen.log_densities), seen.log_weights()
        known = np.isfinite(density)
        log_weights[known] -= (1 - power) * density[known]
        proposal = adapted(np.concatenate(seen.points), log_weights, int(rng.integers(2**31)))
        seen = _joined(seen, search, proposal, rng)
        if power < 1:
            continue
        log_weights = seen.log_weights()
        smooth, k = tail_smoothed(log_weights)
        ess = _DRAWN * seen.efficiency(proposal, log_weights)  # of the last alone, by what all have met
        if ess >= _WANTED and k <= usable_k(log_weights.size):
            kept = np.concatenate(seen.points)[resampled(smooth, _KEPT, rng)]
            return kept, 1 / (1 / ess + 1 / _KEPT)
    return None


def _joined(seen: Seen, search: LagSearch, proposal: Mixture, rng: np.random.Generator) -> Seen:
    """With draws of a proposal. Lags have no names: those whose times do not increase have no density."""
    table, y = search.table, proposal.draw(_DRAWN, rng)
    ordered = (np.diff(table.parts(y)[0][..., search.apart :], axis=2) >= 0).all(axis=(1, 2))
    density = np.full(len(y), -np.inf)
    density[ordered] = table.log_density(y[ordered])
    return seen.joined(proposal, len(y), y, density)


def _walked(
    search: LagSearch, begun: Mixture, rng: np.random.Generator, wanted: float = _WANTED
) -> tuple[Matrix, float]:
    """By emcee."""
    table = search.table
    low, high = table.ends((begun.dimension - table.paths) // table.paths)
    position = begun.draw(max(_WALKERS, 4 * low.size), rng)
    inside = (position > low) & (position < high)
    position = np.where(inside, position, rng.uniform(low, high, position.shape))
    sampler = emcee.EnsembleSampler(*position.shape, table.log_density, vectorize=True, moves=_FewMove())
    state = emcee.State(position, random_state=np.random.RandomState(rng.integers(2**32)).get_state())
    state = sampler.run_mcmc(state, _STEPS, skip_initial_state_check=True)
    sampler.reset()
    for _ in range(_ROUNDS):
        state = sampler.run_mcmc(state, _STEPS)
        chain = sampler.get_chain()[_THIN - 1 :: _THIN].swapaxes(0, 1)
        ess = _ess(table, chain)
        if ess >= wanted:
            break
    kept = chain.reshape(-1, low.size)
    picked = rng.choice(len(kept), min(_KEPT, len(kept)), replace=False)
    return kept[picked], 1 / (1 / ess + 1 / picked.size)


@final
class _FewMove(emcee.moves.DEMove):  # type: ignore[misc]
    """Differential evolution in a few coordinates of each walker: in all of ten lags and delays at once one
    proposal in a hundred is accepted, and walkers stay where they began."""

    def get_proposal(self, here: Matrix, others: Any, random: Any) -> tuple[Matrix, Vector]:
        """See emcee.moves.DEMove; symmetric as that."""
        proposed, factor = super().get_proposal(here, others, random)
        chosen = random.rand(*here.shape).argsort(axis=1) < _MOVED
        return np.where(chosen, proposed, here), factor


def _ess(table: LagTable, chain: Array) -> float:
    """Smallest effective number of draws, of the mean steady values and of the delays."""
    flat = chain.reshape(-1, chain.shape[-1])
    conditional = table.conditional(flat)
    mean = np.linalg.solve(conditional.root.swapaxes(1, 2), conditional.bent[..., None])[..., 0]
    gains = mean.reshape(len(flat), table.paths, -1).sum(axis=2)
    values = np.concatenate([gains, flat[:, -table.paths :]], axis=1).reshape(*chain.shape[:2], -1)
    stats: Any = array_stats
    return float(min(stats.ess(values[..., k], chain_axis=0, draw_axis=1) for k in range(values.shape[2])))


def _begun(search: LagSearch, lags: int, rng: np.random.Generator) -> Mixture:
    """Components near the optimum of so many lags, and, where the best has fewer, near those of everything
    else with a spare lag in many places; by their Gaussian mass, in which none is nearly nothing."""
    table, first = search.table, search.fits[lags - 1]
    low, high = table.ends(lags)
    widest = _LOOSE * (high - low)
    centres, covariances = first.coordinates[None], _narrowed(first.covariance, widest)[None]
    if lags > search.best.lags:
        spared = _spared(search, lags, widest, rng)
        centres, covariances = (
            np.concatenate(each) for each in zip(spared, (centres, covariances), strict=True)
        )
    mass = table.conditional(centres).log_marginal + 0.5 * np.linalg.slogdet(covariances)[1]
    mass -= mass.max()
    counts = np.flatnonzero(mass > -_WEIGHTLESS)
    weights = np.exp(np.maximum(mass[counts], -_LIGHT))
    log_times, delays = table.parts(np.arange(float(low.size))[None])
    means, factors = [], []
    for centre, covariance in zip(centres[counts], covariances[counts], strict=True):
        times = np.array(table.parts(centre[None])[0])
        times[..., : search.apart] = -np.inf  # stays first
        ranks = np.argsort(times, axis=2)
        order = np.append(np.take_along_axis(log_times, ranks, axis=2).ravel(), delays).astype(int)
        means.append(centre[order])
        factors.append(np.linalg.cholesky(covariance[np.ix_(order, order)]))
    return Mixture(weights / weights.sum(), np.array(means), np.array(factors))


def _spared(search: LagSearch, lags: int, widest: Vector, rng: np.random.Generator) -> tuple[Matrix, Array]:
    """Optima of everything else with a lag more than the best has in many places, (places, dimension), and
    their covariances."""
    table, fewer = search.table, search.fits[lags - 2]
    low, high = table.ends(lags)
    spare = np.arange(table.paths) * lags + fewer.lags
    own = np.setdiff1d(np.arange(low.size), spare)
    points = np.empty((_SPARE * table.paths, low.size))
    points[:, own] = fewer.coordinates
    places = Halton(table.paths, rng=rng).random(len(points))
    points[:, spare] = low[spare] + (high - low)[spare] * places
    ends = descended(LagDescents(table, own), points, steps=_SETTLED, least=_GAIN)
    covariances = np.tile(np.diag(widest**2), (len(points), 1, 1))
    for covariance, information in zip(covariances, ends.information, strict=True):
        covariance[np.ix_(own, own)] = _narrowed(covariance_of(information), widest[own])
    return ends.points, covariances


def _narrowed(covariance: Matrix, widest: Vector) -> Matrix:
    """A covariance with no larger standard deviation than the `widest`, nor one of nothing."""
    sd = np.sqrt(np.diag(covariance))
    shrunk = np.minimum(1.0, widest / np.maximum(sd, 1e-300))
    return np.asarray(covariance * np.outer(shrunk, shrunk) + np.diag((1e-2 * widest) ** 2))
