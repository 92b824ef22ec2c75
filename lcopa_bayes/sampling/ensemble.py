"""One emcee ensemble as a value that can be advanced, stored and resumed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import emcee
import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.inference.optimum import Optimum
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.mixture import Mixture
from lcopa_bayes.sampling.ridgemoves import emcee_sampler
from lcopa_bayes.sampling.tempering import surroundings, temper


@final
@dataclass(frozen=True, eq=False)
class Ensemble:
    """Kept draws of one ensemble and the state it continues from."""

    chain: Array
    """Sampled coordinates, (draws, walkers, dimension)."""
    log_density: Matrix
    """(draws, walkers)."""
    position: Matrix
    """Positions of the walkers, (walkers, dimension)."""
    position_log_density: Vector
    """(walkers,)."""
    accepted: Vector
    """Kept draws at which each walker had just moved: emcee counts moves only where it keeps a draw."""
    steps: int
    """Steps taken."""
    random: tuple[Any, ...]
    """State of the legacy generator that emcee draws from."""
    trail: Matrix
    """Positions of the population on the last part of the tempering path, (points, dimension)."""
    tempering_moves: int
    """Moves of tempering per walker [-]."""
    near: bool = False
    """Whether it began around optima, not in the whole prior."""

    @classmethod
    def started(
        cls, position: Matrix, log_density: Vector, trail: Matrix, seed: np.random.SeedSequence
    ) -> Ensemble:
        """Walkers at a population that is nearly the posterior's; `trail` others of it."""
        random = tuple(np.random.RandomState(np.random.MT19937(seed)).get_state())
        nothing = np.empty((0, *position.shape)), np.empty((0, len(position)))
        return cls(*nothing, position, log_density, np.zeros(len(position)), 0, random, trail, 0)

    @classmethod
    def tempered(
        cls,
        posterior: Posterior,
        walkers: int,
        sweeps: int,
        seed: np.random.SeedSequence,
        seconds: float = np.inf,
        optima: Sequence[Optimum] = (),
    ) -> Ensemble:
        """A population tempered from the prior, or from around `optima`; emcee needs a legacy generator,
        seeded here and nowhere else; `seconds` as `temper`."""
        draw, moves = seed.spawn(2)
        random = tuple(np.random.RandomState(np.random.MT19937(moves)).get_state())
        rng = np.random.default_rng(draw)
        near = surroundings(posterior, optima, walkers, rng) if optima else None
        population, random = temper(posterior, walkers, sweeps, rng, random, seconds, near)
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
            near is not None,
        )

    def parted(self, seeds: Sequence[np.random.SeedSequence]) -> tuple[Ensemble, ...]:
        """Ensembles of parts of its walkers, before any step."""
        count, out = len(seeds), list[Ensemble]()
        for k, seed in enumerate(seeds):
            own = self.position[k::count], self.position_log_density[k::count], self.trail[k::count]
            begun = Ensemble.started(*own, seed)
            out.append(replace(begun, tempering_moves=self.tempering_moves, near=self.near))
        return tuple(out)

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
    sampler = emcee_sampler(posterior, posterior.log_density, walkers, mixture, ensemble.random)
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
        ensemble.tempering_moves,
        ensemble.near,
    )


@final
@dataclass(frozen=True)
class Birth:
    """Task: a new ensemble of a seed."""

    walkers: int
    sweeps: int
    """Moves per temperature [-]."""
    seconds: float
    """What is left of the budget [s]."""
    optima: tuple[Optimum, ...] = ()
    """Optima that it begins around; none: it begins in the prior."""

    def __call__(self, posterior: Posterior, seed: np.random.SeedSequence) -> Ensemble:
        """The ensemble, tempered."""
        return Ensemble.tempered(posterior, self.walkers, self.sweeps, seed, self.seconds, self.optima)


@final
@dataclass(frozen=True)
class Round:
    """Task: an ensemble some steps further."""

    steps: int
    thin: int
    """Steps per kept draw [-]."""
    mixture: Mixture | None

    def __call__(self, posterior: Posterior, ensemble: Ensemble) -> Ensemble:
        """The ensemble after them."""
        return advance(posterior, ensemble, self.steps, self.thin, self.mixture)
