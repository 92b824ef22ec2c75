"""From the prior to the posterior by adaptive tempering, so that every ridge is found in its share.

A population drawn from the prior follows ``prior * likelihood^b`` while b rises from 0 to 1. Each rise is
as large as keeps half the population effective; the population is then resampled and moved by the same
emcee moves that sample the posterior (Del Moral, Doucet and Jasra 2006, J. R. Statist. Soc. B 68). The
mean weights multiply to the evidence.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import emcee
import numpy as np
from scipy.optimize import brentq
from scipy.special import logsumexp

from lcopa_bayes.arrays import Matrix, Vector
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.inference.ridgemoves import moves

_WARM = 0.01
"""Below this power of the likelihood a population travels fast and a third of the sweeps is enough."""
_EFFECTIVE = 0.5
"""Share of the population that stays effective in one rise of the temperature."""


@final
@dataclass(frozen=True, eq=False)
class Population:
    """Walkers that have come from the prior to the posterior."""

    position: Matrix
    """(walkers, dimension)."""
    log_density: Vector
    """Log posterior density, (walkers,) [nat]."""
    log_evidence: float
    """Estimate of this population alone [nat]."""
    rises: int
    """Number of temperatures passed."""


def temper(
    posterior: Posterior, walkers: int, sweeps: int, rng: np.random.Generator, random: tuple[Any, ...]
) -> tuple[Population, tuple[Any, ...]]:
    """A population of the posterior and the state of emcee's generator afterwards.

    `sweeps` moves of every walker at each temperature, a third of them while it is low. Deterministic
    given `rng` and `random`.
    """
    position = posterior.coordinates(posterior.table.draw(walkers, rng))
    prior = posterior.log_prior(position)
    likelihood = posterior.log_density(position) - prior
    heat, log_evidence, rises = 0.0, 0.0, 0
    while heat < 1.0:
        rise = _rise(likelihood, 1.0 - heat)
        heat, rises = (1.0 if heat + rise > 1.0 - 1e-9 else heat + rise), rises + 1
        weights = rise * likelihood
        log_evidence += float(logsumexp(weights)) - np.log(walkers)
        kept = _resampled(weights, rng)
        position, prior, likelihood = position[kept], prior[kept], likelihood[kept]
        sampler = emcee.EnsembleSampler(
            walkers,
            posterior.dimension,
            _Tempered(posterior, heat),
            moves=moves(posterior),
            vectorize=True,
        )
        sampler.random_state = random
        state = emcee.State(position, log_prob=prior + heat * likelihood)
        enough = sweeps if heat > _WARM else max(1, sweeps // 3)
        last = sampler.run_mcmc(state, enough, skip_initial_state_check=True, store=False)
        random = tuple(sampler.random_state)
        position = np.array(last.coords)
        prior = posterior.log_prior(position)
        likelihood = (np.array(last.log_prob) - prior) / heat
    return Population(position, prior + likelihood, log_evidence, rises), random


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
