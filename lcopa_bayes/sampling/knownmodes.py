"""Modes of a posterior that are known from elsewhere than its own ensembles, as proposals of a move.

A population started on such modes is moved in the posterior; a mixture learned from where it went is blended
into the mixture that independence proposals are drawn from (`sampler`, `mixturemoves`). That mixture is fixed
while it is used and every proposal is accepted by Metropolis and Hastings' rule, so the posterior stays
invariant whatever the starts were: walkers leave a mode of no mass, and enter one of all the mass at the
first proposals. No walker is put anywhere by hand.
"""

from __future__ import annotations

import emcee
import numpy as np

from lcopa_bayes.core.arrays import Matrix
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.mixture import Mixture
from lcopa_bayes.sampling.mixturemoves import learned
from lcopa_bayes.sampling.ridgemoves import emcee_sampler

_MOVES = 120
"""Moves of the population; what it did in the first half is forgotten."""
_THIN = 5
_WALKERS = 8
"""Walkers per sampled coordinate at least [-]."""
_WIDEST, _NARROWEST = 0.1, 1e-10
"""Largest and smallest deviation added to copies of starts, in sampled coordinates."""
_LOST = 2.0
"""Log density per sampled coordinate that a copy may lose [nat]."""


def around(posterior: Posterior, starts: Matrix, seed: int) -> Mixture:
    """Mixture over the modes that `starts`, table values (starts, rows), lie on.

    Starts outside the prior are omitted; InputError when none is inside. Deterministic given `seed`.
    """
    sequence = np.random.SeedSequence(seed, spawn_key=(4_000,))
    rng, moves = np.random.default_rng(sequence), sequence.spawn(1)[0]
    z = posterior.coordinates(starts)
    z = z[np.isfinite(z).all(axis=1)]
    z = z[np.isfinite(posterior.log_density(z))]
    if not len(z):
        raise InputError("none of the known starts of this posterior lies inside its prior; omit them")
    count = max(_WALKERS * posterior.dimension, len(z))
    population = _filled(posterior, z, count + count % 2, rng)
    random = tuple(np.random.RandomState(np.random.MT19937(moves)).get_state())
    sampler = emcee_sampler(posterior, posterior.log_density, len(population), None, random)
    sampler.run_mcmc(emcee.State(population), _MOVES // _THIN, thin_by=_THIN, skip_initial_state_check=True)
    chain = sampler.get_chain()
    return learned(posterior, [chain[len(chain) // 2 :]], seed).levelled()


def _filled(posterior: Posterior, z: Matrix, count: int, rng: np.random.Generator) -> Matrix:
    """`count` different points: the starts given, then copies of them as far apart as the modes are wide."""
    density, out, spread = posterior.log_density(z), z, _WIDEST
    while len(out) < count and spread > _NARROWEST:
        parent = rng.integers(len(z), size=count)
        copies = z[parent] + spread * rng.standard_normal((count, z.shape[1]))
        near = posterior.log_density(copies) > density[parent] - _LOST * z.shape[1]
        out = np.concatenate([out, copies[near]]) if near.mean() > 0.1 else out
        spread = spread if near.mean() > 0.1 else 0.5 * spread
    if len(out) < count:
        raise InputError(
            "a known start of this posterior lies at an edge of its prior or on a narrow peak that sampling "
            "cannot resolve; omit it"
        )
    return np.asarray(out[:count])
