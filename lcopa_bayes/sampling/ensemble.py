"""One emcee ensemble as a value that can be advanced, stored and taken up again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import emcee
import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.mixture import Mixture
from lcopa_bayes.sampling.ridgemoves import walking
from lcopa_bayes.sampling.tempering import CROWD, temper


@final
@dataclass(frozen=True, eq=False)
class Ensemble:
    """Kept draws of one ensemble and all it needs to go on."""

    chain: Array
    """Sampled coordinates, (draws, walkers, dimension)."""
    log_density: Matrix
    """(draws, walkers)."""
    position: Matrix
    """Where the walkers stand, (walkers, dimension)."""
    position_log_density: Vector
    """(walkers,)."""
    accepted: Vector
    """Kept draws at which each walker had just moved: emcee counts moves only where it keeps a draw."""
    steps: int
    """Steps taken."""
    random: tuple[Any, ...]
    """State of the legacy generator that emcee draws from."""
    trail: Matrix
    """Where the population stood on the last part of its way from the prior, (points, dimension)."""
    way: int
    """Moves per walker that the way from the prior took [-]."""

    @classmethod
    def born(
        cls,
        posterior: Posterior,
        walkers: int,
        sweeps: int,
        seed: np.random.SeedSequence,
        crowd: int = CROWD,
    ) -> Ensemble:
        """A population tempered from the prior; emcee needs a legacy generator, seeded here and nowhere
        else."""
        draw, walk = seed.spawn(2)
        random = tuple(np.random.RandomState(np.random.MT19937(walk)).get_state())
        population, random = temper(posterior, walkers, sweeps, np.random.default_rng(draw), random, crowd)
        return cls(
            np.empty((0, walkers, posterior.dimension)),
            np.empty((0, walkers)),
            population.position,
            population.log_density,
            np.zeros(walkers),
            0,
            random,
            population.trail,
            population.moves,
        )

    @property
    def acceptance(self) -> float:
        """Share of accepted moves."""
        return float(self.accepted.mean() / max(1, self.chain.shape[0]))


def advance(
    posterior: Posterior,
    ensemble: Ensemble,
    draws: int,
    thin: int,
    mixture: Mixture | None = None,
) -> Ensemble:
    """The ensemble after ``draws * thin`` more steps, every `thin`-th of them kept.

    With `mixture` some moves follow it. Deterministic: the same ensemble advanced twice gives
    the same draws, in whatever process.
    """
    walkers = ensemble.position.shape[0]
    sampler = walking(posterior, posterior.log_density, walkers, mixture, ensemble.random)
    state = emcee.State(ensemble.position, log_prob=ensemble.position_log_density)
    last = sampler.run_mcmc(state, draws, thin_by=thin, skip_initial_state_check=True)
    return Ensemble(
        np.concatenate([ensemble.chain, sampler.get_chain()]),
        np.concatenate([ensemble.log_density, sampler.get_log_prob()]),
        np.array(last.coords),
        np.array(last.log_prob),
        ensemble.accepted + sampler.backend.accepted,
        ensemble.steps + draws * thin,
        tuple(sampler.random_state),
        ensemble.trail,
        ensemble.way,
    )
