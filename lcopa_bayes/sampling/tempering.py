"""From the prior to the posterior by adaptive tempering, so that every ridge is found in its share.

A population drawn from the prior follows ``prior * likelihood^b`` while b rises from 0 to 1. Each rise is
as large as keeps half the population effective; the population is then resampled and moved by the same
emcee moves that sample the posterior (Del Moral, Doucet and Jasra 2006, J. R. Statist. Soc. B 68).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import emcee
import numpy as np
from scipy.optimize import brentq
from scipy.special import logsumexp

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.convergence import rank_correlation
from lcopa_bayes.sampling.mixturemoves import learned
from lcopa_bayes.sampling.ridgemoves import walking

_WARM = 0.01
"""Below this power of the likelihood a population travels fast and a third of the sweeps is enough."""
_NEAR = 0.1
"""From this power on populations are remembered: they lie where the posterior does, only wider."""
_EFFECTIVE = 0.5
"""Share of the population that stays effective in one rise of the temperature."""
CROWD = 4
"""How many times more walkers come from the prior than are kept."""
_BLOCK = 5
"""Moves of every walker between two looks at how far they have travelled."""
_TRAVELLED = 0.3
"""Memory of a population at which it has travelled enough at one temperature [-]."""


@final
@dataclass(frozen=True, eq=False)
class Population:
    """Walkers that have come from the prior to the posterior."""

    position: Matrix
    """(walkers, dimension)."""
    log_density: Vector
    """Log posterior density, (walkers,) [nat]."""
    trail: Matrix
    """Where the population stood on the last part of its way, (points, dimension)."""
    moves: int
    """Moves per walker delivered that the way took [-]."""


def temper(
    posterior: Posterior,
    walkers: int,
    sweeps: int,
    rng: np.random.Generator,
    random: tuple[Any, ...],
    factor: int = CROWD,
) -> tuple[Population, tuple[Any, ...]]:
    """A population of the posterior and the state of emcee's generator afterwards.

    At each temperature every walker makes moves until the population has left where it stood, at most
    `sweeps` of them and a third while the temperature is low. `factor` times as many walkers come from the
    prior as are kept. Deterministic given `rng` and `random`.
    """
    crowd = factor * walkers
    position = posterior.coordinates(posterior.table.draw(crowd, rng))
    prior = posterior.log_prior(position)
    likelihood = posterior.log_density(position) - prior
    heat, rises, made, trail = 0.0, 0, 0, []
    while heat < 1.0:
        rise = _rise(likelihood, 1.0 - heat)
        heat, rises = (1.0 if heat + rise > 1.0 - 1e-9 else heat + rise), rises + 1
        kept = _resampled(rise * likelihood, rng)
        position, prior, likelihood = position[kept], prior[kept], likelihood[kept]
        mixture = learned(posterior, [position], rises)
        sampler = walking(posterior, _Tempered(posterior, heat), crowd, mixture, random)
        state = emcee.State(position, log_prob=prior + heat * likelihood)
        for _ in range(max(1, (sweeps if heat > _WARM else sweeps // 3) // _BLOCK)):
            state = sampler.run_mcmc(state, _BLOCK, skip_initial_state_check=True, store=False)
            made += factor * _BLOCK
            if _memory(posterior, position, state.coords) <= _TRAVELLED:
                break
        random = tuple(sampler.random_state)
        position = np.array(state.coords)
        prior = posterior.log_prior(position)
        likelihood = (np.array(state.log_prob) - prior) / heat
        if heat > _NEAR:
            trail.append(position)
    kept = rng.permutation(crowd)[:walkers]
    return Population(position[kept], (prior + likelihood)[kept], np.concatenate(trail), made), random


def _memory(posterior: Posterior, before: Matrix, after: Matrix) -> float:
    """Largest rank correlation over walkers of where they stood and stand, of any sampled parameter."""
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


def _rise(likelihood: Vector, room: float) -> float:
    """Largest rise of the temperature that keeps the wanted share effective, at most `room`."""

    def excess(log_rise: float) -> float:
        weights = np.exp(log_rise) * likelihood
        share = np.exp(2 * logsumexp(weights) - logsumexp(2 * weights)) / likelihood.size
        return float(share) - _EFFECTIVE

    if excess(np.log(room)) >= 0.0:
        return room
    low = np.log(1e-3 / max(1.0, float(np.ptp(likelihood))))
    return float(np.exp(brentq(excess, low, np.log(room), xtol=1e-3)))


def _resampled(log_weights: Vector, rng: np.random.Generator) -> np.ndarray[Any, np.dtype[np.intp]]:
    """Systematic resampling: members in proportion to their weights, with one random number."""
    weights = np.exp(log_weights - logsumexp(log_weights))
    places = (np.arange(weights.size) + rng.random()) / weights.size
    return np.minimum(np.searchsorted(np.cumsum(weights), places), weights.size - 1)
