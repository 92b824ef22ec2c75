"""Draws of the sums of lags that a response axis may be: time constants and delays by emcee, weights exactly.

The number of lags is the best by BIC and one more, which the records need not show: what it leaves open of a
number is part of that number's interval. Delays are tabulated over all that is asked first and then where
they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, final

import emcee
import numpy as np
from arviz_stats.base import array_stats  # type: ignore[attr-defined]

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.core.covariance import root_of
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.lagsum import MOST, LagFit, LagTable, best_of, lag_fits, lag_table

_COARSE, _FINE = 17, 33
"""Delays tabulated over all that is asked, and where they are."""
_NEAR = 20.0
"""BIC above the least of a number of lags whose delay is still looked at [-]."""
_REACH = 10.0
"""Standard deviations of a delay that are tabulated on either side [-]."""
_WALKERS, _STEPS, _THIN = 48, 1_000, 10
_ROUNDS = 4
"""Most times that many steps are made; the first are left out."""
_WANTED = 200.0
"""Effective draws that end them."""
_KEPT = 1_000
"""Most draws that are kept."""
_AT_END = 0.01
"""Share of the draws beside an end of the tabulated delays that moves the end."""


@final
@dataclass(frozen=True, eq=False)
class LagSearch:
    """Least squares of sums of lags for some drives of a `lag_problem` on one response axis."""

    problem: Problem
    axis: int
    drives: tuple[int, ...]
    noise: Vector
    """Its parameters, (names,)."""
    delays: Matrix
    """Ends between which delays are uniform, (paths, 2) [time unit]."""
    near: Matrix
    """Those between which they are tabulated, (paths, 2) [time unit]."""

    @classmethod
    def over(
        cls, problem: Problem, axis: int, drives: Sequence[int], noise: Vector, delays: Matrix
    ) -> LagSearch:
        """A search over all delays between their ends (paths, 2) [time unit], and again where they are."""
        table = lag_table(problem, axis, drives, noise, _nodes(delays, _COARSE))
        return cls(problem, axis, tuple(drives), noise, delays, _near(table, lag_fits(table), delays))

    @cached_property
    def table(self) -> LagTable:
        """Responses of the delays that are tabulated."""
        return lag_table(self.problem, self.axis, self.drives, self.noise, _nodes(self.near, _FINE))

    @cached_property
    def fits(self) -> tuple[LagFit, ...]:
        """The best with each number of lags."""
        return lag_fits(self.table)

    @property
    def best(self) -> LagFit:
        """With the number of lags that is best by BIC."""
        return best_of(self.fits)

    @property
    def lags(self) -> int:
        """Lags of the draws: one more than the best has, where there may be so many."""
        return min(self.best.lags + 1, MOST)


@final
@dataclass(frozen=True, eq=False)
class LagDraws:
    """Equally probable sums of lags of the paths of one response axis."""

    times: Array
    """Time constants, (draws, paths, lags) [time unit]."""
    weights: Array
    """Theirs, (draws, paths, lags) [response unit / drive unit]."""
    delays: Matrix
    """(draws, paths) [time unit]."""
    ess: float
    """Smallest effective sample size of a steady value or delay [draws]."""

    @property
    def gains(self) -> Matrix:
        """Steady response per unit step, (draws, paths)."""
        return np.asarray(self.weights.sum(axis=2))

    def response(self, path: int, time: Vector) -> Matrix:
        """Response to a unit step at time 0, (draws, n)."""
        since = np.maximum(time - self.delays[:, path, None], 0.0)
        out = np.zeros(since.shape)
        for k in range(self.times.shape[2]):
            out -= self.weights[:, path, k, None] * np.expm1(-since / self.times[:, path, k, None])
        return out


def lag_draws(search: LagSearch, seed: int) -> LagDraws:
    """Draws about the optima of a search, tabulated farther out where they stand beside an end."""
    rng = np.random.default_rng(seed)
    chain, ess = _sampled(search, rng)
    wider = _wider(search, chain)
    while (wider != search.near).any():
        search = replace(search, near=wider)
        chain, ess = _sampled(search, rng)
        wider = _wider(search, chain)
    kept = chain.reshape(-1, chain.shape[-1])
    kept = kept[rng.choice(len(kept), min(_KEPT, len(kept)), replace=False)]
    log_times, own = search.table.parts(kept)
    scales = search.problem.scales
    units = scales.amplitude[search.axis] / scales.excursion[list(search.drives)]
    weights = search.table.conditional(kept).draw(rng).reshape(log_times.shape) * units[:, None]
    return LagDraws(np.exp(log_times), weights, own, ess)


def _near(table: LagTable, fits: Sequence[LagFit], delays: Matrix) -> Matrix:
    """Ends between which delays are, (paths, 2): those of every likely number of lags and around."""
    best = best_of(fits)
    likely = [one for one in fits if one.bic < best.bic + _NEAR]
    places = np.array([one.coordinates[-table.paths :] for one in likely])
    reach = (
        _REACH * np.sqrt(np.diag(best.covariance)[-table.paths :]) + table.delays[:, 1] - table.delays[:, 0]
    )
    low = np.maximum(places.min(axis=0) - reach, delays[:, 0])
    return np.stack([low, np.minimum(places.max(axis=0) + reach, delays[:, 1])], axis=1)


def _wider(search: LagSearch, chain: Array) -> Matrix:
    """The ends of the tabulated delays, farther out where draws stand beside them."""
    near, delays, paths = search.near, search.delays, len(search.drives)
    own, width = chain[..., -paths:].reshape(-1, paths), near[:, 1] - near[:, 0]
    edge = width / (_FINE - 1)
    below = (own < near[:, 0] + edge).mean(axis=0) > _AT_END
    above = (own > near[:, 1] - edge).mean(axis=0) > _AT_END
    low = np.where(below, np.maximum(near[:, 0] - width, delays[:, 0]), near[:, 0])
    return np.stack([low, np.where(above, np.minimum(near[:, 1] + width, delays[:, 1]), near[:, 1])], axis=1)


def _sampled(search: LagSearch, rng: np.random.Generator) -> tuple[Array, float]:
    """Coordinates of draws, (walkers, draws, dimension), and their effective number."""
    table = search.table
    position = _begun(search, rng)
    moves = [(emcee.moves.DEMove(), 0.8), (emcee.moves.StretchMove(), 0.2)]
    sampler = emcee.EnsembleSampler(*position.shape, table.log_density, vectorize=True, moves=moves)
    state = emcee.State(position, random_state=np.random.RandomState(rng.integers(2**32)).get_state())
    state = sampler.run_mcmc(state, _STEPS, skip_initial_state_check=True)
    sampler.reset()
    for _ in range(_ROUNDS):
        state = sampler.run_mcmc(state, _STEPS)
        chain = sampler.get_chain()[_THIN - 1 :: _THIN].swapaxes(0, 1)
        ess = _ess(table, chain)
        if ess >= _WANTED:
            break
    return chain, ess


def _ess(table: LagTable, chain: Array) -> float:
    """Smallest effective number of draws, of the mean steady values and of the delays."""
    flat = chain.reshape(-1, chain.shape[-1])
    conditional = table.conditional(flat)
    mean = np.linalg.solve(conditional.root.swapaxes(1, 2), conditional.bent[..., None])[..., 0]
    gains = mean.reshape(len(flat), table.paths, -1).sum(axis=2)
    values = np.concatenate([gains, flat[:, -table.paths :]], axis=1).reshape(*chain.shape[:2], -1)
    stats: Any = array_stats
    return float(min(stats.ess(values[..., k], chain_axis=0, draw_axis=1) for k in range(values.shape[2])))


def _begun(search: LagSearch, rng: np.random.Generator) -> Matrix:
    """Walkers, (walkers, dimension): half near the optimum of so many lags, half with one lag anywhere."""
    table, best, lags = search.table, search.best, search.lags
    richer = search.fits[lags - 1]
    low, high = table.ends(lags)
    count = max(_WALKERS, 4 * low.size)
    root = root_of(richer.covariance)
    near = richer.coordinates + 0.3 * rng.standard_normal((count, low.size)) @ root.T
    log_times, delays = table.parts(np.repeat(best.coordinates[None], count, axis=0))
    if lags > best.lags:
        anywhere = rng.uniform(table.log_times[0], table.log_times[-1], (count, table.paths, 1))
        log_times = np.concatenate([log_times, anywhere], axis=2)
    other = np.concatenate([log_times.reshape(count, -1), delays], axis=1)
    other += 1e-3 * rng.standard_normal(other.shape) * (high - low)
    mixed = np.where(rng.random((count, 1)) < 0.5, near, other)
    inside = (mixed > low) & (mixed < high)
    return np.where(inside, mixed, rng.uniform(low, high, mixed.shape))


def _nodes(ends: Matrix, count: int) -> Matrix:
    """Equally spaced delays between ends (paths, 2), (paths, count)."""
    return np.asarray(ends[:, :1] + (ends[:, 1:] - ends[:, :1]) * np.linspace(0, 1, count))
