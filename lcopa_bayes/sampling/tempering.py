"""From the prior to the posterior by adaptive tempering, so that every mode is reached in proportion to its
mass.

A population drawn from the prior follows ``prior * likelihood^b`` while b rises from 0 to 1. Each rise is
as large as keeps half the population effective; the population is then resampled and moved by the same
emcee moves that sample the posterior (Del Moral, Doucet and Jasra 2006, J. R. Statist. Soc. B 68).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import monotonic
from typing import Any, final

import emcee
import numpy as np
from scipy.optimize import brentq
from scipy.special import logsumexp

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.covariance import root_of
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.inference.optimum import Optimum
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.convergence import rank_correlation
from lcopa_bayes.sampling.mixturemoves import learned
from lcopa_bayes.sampling.ridgemoves import emcee_sampler

_WARM = 0.01
"""Below this power of the likelihood a population mixes fast and a third of the sweeps is enough."""
_NEAR = 0.1
"""From this power on populations are kept: they cover the posterior, only wider."""
_EFFECTIVE = 0.5
"""Share of the population that stays effective in one rise of the temperature."""
_CROWD = 4
"""How many times more walkers come from the prior than are kept."""
_BLOCK = 5
"""Moves of every walker between two checks of how far they have moved."""
_TRAVELLED = 0.3
"""Rank correlation with its start at which a population has moved enough at one temperature [-]."""
_AT_ONCE = 2.0
"""Times the time that is given, after which the temperature rises no further in steps [-]: under noise of
nearly nothing there are some hundred, and a budget of 5 s became ten minutes."""


@final
@dataclass(frozen=True, eq=False)
class Population:
    """Walkers tempered from the prior to the posterior."""

    position: Matrix
    """(walkers, dimension)."""
    log_density: Vector
    """Log posterior density, (walkers,) [nat]."""
    trail: Matrix
    """Positions of the population on the last part of the tempering path, (points, dimension)."""
    moves: int
    """Moves of tempering per walker delivered [-]."""


def temper(
    posterior: Posterior,
    walkers: int,
    sweeps: int,
    rng: np.random.Generator,
    random: tuple[Any, ...],
    seconds: float = np.inf,
    near: Matrix | None = None,
) -> tuple[Population, tuple[Any, ...]]:
    """A population of the posterior and the state of emcee's generator afterwards.

    At each temperature every walker makes moves until the population has lost its correlation with its start,
    at most `sweeps` of them and a third while the temperature is low. `_CROWD` times as many walkers come
    from the prior as are kept; those with a likelihood of 0 are drawn again. After `seconds` the moves at
    each temperature are the fewest. Points `near` the posterior, sampled coordinates of as many walkers as
    are kept, may take the place of draws of the prior. After `_AT_ONCE` times as many the rest of the rise is
    one step: few walkers survive it, which their grade shows. Deterministic given `rng` and `random` where it
    takes less. InputError when none of them has a likelihood above 0.
    """
    crowd, begin = _CROWD * walkers if near is None else walkers, monotonic()
    position = posterior.coordinates(posterior.table.draw(crowd, rng)) if near is None else near
    prior = posterior.log_prior(position)
    likelihood = posterior.log_density(position) - prior
    while (dead := np.isneginf(likelihood)).any():  # where effects leave no bounded response
        if dead.all():
            raise InputError("no draw of the prior has a likelihood above 0; narrow the priors")
        position[dead] = posterior.coordinates(posterior.table.draw(int(dead.sum()), rng))
        prior[dead] = posterior.log_prior(position[dead])
        likelihood[dead] = posterior.log_density(position[dead]) - prior[dead]
    heat, rises, moves, trail = 0.0, 0, 0, []
    while heat < 1.0:
        spent = monotonic() - begin > _AT_ONCE * seconds
        rise = 1.0 - heat if spent else largest_rise(likelihood, 1.0 - heat)
        heat, rises = (1.0 if heat + rise > 1.0 - 1e-9 else heat + rise), rises + 1
        kept = survivors(rise * likelihood, rng)
        position, prior, likelihood = position[kept], prior[kept], likelihood[kept]
        mixture = learned(posterior, [position], rises)
        sampler = emcee_sampler(posterior, _Tempered(posterior, heat), crowd, mixture, random)
        state = emcee.State(position, log_prob=prior + heat * likelihood)
        for _ in range(max(1, (sweeps if heat > _WARM else sweeps // 3) // _BLOCK)):
            state = sampler.run_mcmc(state, _BLOCK, skip_initial_state_check=True, store=False)
            moves += crowd // walkers * _BLOCK
            late = monotonic() - begin > seconds
            if late or _memory(posterior, position, state.coords) <= _TRAVELLED:
                break
        random = tuple(sampler.random_state)
        position = np.array(state.coords)
        prior = posterior.log_prior(position)
        likelihood = (np.array(state.log_prob) - prior) / heat
        if heat > _NEAR:
            trail.append(position)
    kept = rng.permutation(crowd)[:walkers]
    return Population(position[kept], (prior + likelihood)[kept], np.concatenate(trail), moves), random


def surroundings(
    posterior: Posterior, optima: Sequence[Optimum], count: int, rng: np.random.Generator
) -> Matrix:
    """Points of normal distributions about optima, as many about each, folded at the ends of the prior,
    (count, dimension): about an optimum in a corner hardly a point would be inside."""
    ends = [posterior.table.rows[k].sampled_domain for k in posterior.sampled]
    low, high = np.array(ends).T
    centres = posterior.coordinates(np.array([one.values for one in optima]))
    roots = np.array([root_of(one.covariance) for one in optima])
    chosen = np.arange(count) % len(optima)
    z = centres[chosen] + np.einsum("nij,nj->ni", roots[chosen], rng.standard_normal((count, low.size)))
    z = np.where(z < low, 2 * low - z, z)
    z = np.where(z > high, 2 * high - z, z)
    outside = ~np.isfinite(posterior.log_prior(z))
    z[outside] = centres[chosen[outside]]
    return np.asarray(z)


def _memory(posterior: Posterior, before: Matrix, after: Matrix) -> float:
    """Largest rank correlation over walkers between earlier and present positions, of any sampled
    parameter."""
    then, now = (posterior.values(z)[:, posterior.sampled] for z in (before, after))
    return max(rank_correlation(then[:, k], now[:, k]) for k in range(then.shape[1]))


@final
@dataclass(frozen=True, eq=False)
class _Tempered:
    """Log density with the likelihood raised to a power."""

    posterior: Posterior
    heat: float

    def __call__(self, coordinates: Matrix) -> Vector:
        return self.posterior.log_density(coordinates, heat=self.heat)


def largest_rise(likelihood: Vector, room: float) -> float:
    """Largest rise of the temperature that keeps the wanted share effective, at most `room`."""

    def excess(log_rise: float) -> float:
        weights = np.exp(log_rise) * likelihood
        share = np.exp(2 * logsumexp(weights) - logsumexp(2 * weights)) / likelihood.size
        return float(share) - _EFFECTIVE

    if excess(np.log(room)) >= 0.0:
        return room
    low = np.log(1e-3 / max(1.0, float(np.ptp(likelihood))))
    return float(np.exp(brentq(excess, low, np.log(room), xtol=1e-3)))


def survivors(log_weights: Vector, rng: np.random.Generator) -> np.ndarray[Any, np.dtype[np.intp]]:
    """Systematic resampling: members in proportion to their weights, with one random number."""
    weights = np.exp(log_weights - logsumexp(log_weights))
    places = (np.arange(weights.size) + rng.random()) / weights.size
    return np.minimum(np.searchsorted(np.cumsum(weights), places), weights.size - 1)
