"""Posterior draws of plant and effects: ensembles of walkers that also jump by the Laplace approximation."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from multiprocessing import get_context
from typing import Any, final

import emcee
import numpy as np
from scipy.stats import multivariate_t

from lcopa_bayes.arrays import Array, Matrix, Vector
from lcopa_bayes.estimate import Estimate
from lcopa_bayes.inference.grade import Grade, Quality, overall, qualities
from lcopa_bayes.loop.density import LoopDensity
from lcopa_bayes.loop.extended import ExtendedModel
from lcopa_bayes.plant.effects.simulator import UPSTREAM

ENSEMBLES = 4
_FREEDOM = 12
"""Degrees of freedom of the jump's t distribution [-]: heavier tails than any posterior it is used on."""
_JUMPS = 0.8
"""Share of the steps that jump by the approximation [-]."""
_BURN = 0.3
"""Share of the steps that is discarded [-]."""
_STEPS = 120
_STEPS_DEAR = 60
"""Steps where an effect bends the dynamics: a density costs thirty times as much."""
_KEPT = 400
"""Draws whose integrated coordinates are drawn [-]."""
TARGET_ESS = 400.0


@final
@dataclass(frozen=True, eq=False)
class LoopDraws:
    """Draws of all coordinates of a model."""

    model: ExtendedModel
    coordinates: Array
    """(ensembles, walkers, draws, k)."""
    qualities: tuple[Quality, ...]
    """Of the sampled coordinates."""
    acceptance: float
    """Share of accepted proposals [-]."""
    sampled: tuple[int, ...]
    """Coordinates that were sampled; the others were drawn from their conditional."""

    @property
    def grade(self) -> Grade:
        """Grade of the whole run."""
        return overall(self.qualities, TARGET_ESS)

    @cached_property
    def flat(self) -> Matrix:
        """All draws, (draws, k)."""
        return np.asarray(self.coordinates.reshape(-1, self.coordinates.shape[-1]))

    @cached_property
    def covariance(self) -> Matrix:
        """Of the coordinates, (k, k)."""
        return np.asarray(np.cov(self.flat.T))

    def estimate(self, k: int) -> Estimate:
        """Median, 90 % interval, effective sample size and grade of one coordinate."""
        name, unit, factor = unit_of(self.model, k)
        quality = next((q for q in self.qualities if q.name == name), None)
        level = quality.grade(TARGET_ESS).level if quality else self.grade.level
        ess = quality.ess if quality else float(np.min([q.ess for q in self.qualities]))
        column = self.flat[:, k] * factor
        rows, base = self.model.base.posterior.table.rows, self.model.base
        if k < self.model.plant_size and rows[base.least.columns[k]].log_scale:
            column = np.exp(column)
        return Estimate.of(name, unit, column, ess=ess, grade=level)


def unit_of(model: ExtendedModel, k: int) -> tuple[str, str, float]:
    """Name and unit of a coordinate, and the factor from the coordinate to it (before any logarithm)."""
    if k < model.plant_size:
        row = model.base.posterior.table.rows[model.base.least.columns[k]]
        return row.name, row.unit, 1.0
    placed = model.effected.coefficients[k - model.plant_size]
    layout = model.base.posterior.table.layout
    units = {"time": model.base.time_unit, "response": layout.responses[0].unit}
    unit = units.get(placed.coefficient.unit, placed.coefficient.unit)
    return placed.name, unit, placed.coefficient.scale


def sample_loop(density: LoopDensity, seed: int, *, jobs: int = 1, quick: bool = False) -> LoopDraws:
    """Four independent ensembles from overdispersed starts about the optimum; deterministic given `seed`."""
    dear = any(isinstance(effect, UPSTREAM) for effect in density.state.model.effects)
    steps = (_STEPS_DEAR if dear else _STEPS) // (2 if quick else 1)
    tasks = [(density, seed, number, steps) for number in range(ENSEMBLES)]
    if jobs > 1:
        with ProcessPoolExecutor(min(jobs, ENSEMBLES), mp_context=get_context("spawn")) as pool:
            done = list(pool.map(_ensemble, tasks))
    else:
        done = [_ensemble(task) for task in tasks]
    chains = np.stack([chain for chain, _ in done])
    names = [unit_of(density.state.model, int(k))[0] for k in density.sampled]
    found = qualities(names, chains)
    rng = np.random.default_rng([seed, 21])
    stride = max(1, chains.shape[0] * chains.shape[1] * chains.shape[2] // _KEPT)
    kept = chains[:, :, ::-1][:, :, ::stride]
    full = np.array([density.completed(z, rng) for z in kept.reshape(-1, kept.shape[-1])])
    return LoopDraws(
        density.state.model,
        full.reshape(*kept.shape[:3], -1),
        found,
        float(np.mean([share for _, share in done])),
        tuple(int(k) for k in density.sampled),
    )


def _ensemble(task: tuple[LoopDensity, int, int, int]) -> tuple[Array, float]:
    """Chain (walkers, draws, dimension) of one ensemble, and its acceptance."""
    density, seed, number, steps = task
    state = density.state
    centre = state.optimum.x[density.sampled]
    covariance = state.optimum.covariance[np.ix_(density.sampled, density.sampled)]
    random = np.random.RandomState(np.random.MT19937(np.random.SeedSequence([seed, 20, number])))
    walkers = 2 * centre.size + 2
    start = _started(density, centre, covariance, walkers, random)
    moves = [(emcee.moves.MHMove(_jump(centre, covariance)), _JUMPS), (emcee.moves.DEMove(), 0.15)]
    moves.append((emcee.moves.StretchMove(), 0.85 - _JUMPS))
    burn = int(_BURN * steps)
    first = emcee.EnsembleSampler(walkers, centre.size, density, moves=moves)
    first.random_state = random.get_state()
    reached = first.run_mcmc(start, burn, skip_initial_state_check=True)
    learnt = first.get_chain(discard=burn // 2, flat=True)
    # jumps learnt from what is discarded are fixed from here on, so the kept draws are of one Markov chain
    moves[0] = (emcee.moves.MHMove(_jump(learnt.mean(axis=0), np.cov(learnt.T))), _JUMPS)
    sampler = emcee.EnsembleSampler(walkers, centre.size, density, moves=moves)
    sampler.random_state = reached.random_state
    sampler.run_mcmc(reached, steps - burn, skip_initial_state_check=True)
    return np.asarray(sampler.get_chain().swapaxes(0, 1)), float(np.mean(sampler.acceptance_fraction))


def _started(
    density: LoopDensity, centre: Vector, covariance: Matrix, walkers: int, random: np.random.RandomState
) -> Matrix:
    """Walkers twice as widely spread as the Laplace approximation, inside the support."""
    out: list[Vector] = []
    wide = 2.0
    while len(out) < walkers:
        for z in _normal(centre, wide**2 * covariance, walkers, random):
            if len(out) < walkers and np.isfinite(density(z)):
                out.append(z)
        wide *= 0.8  # where the support is narrow, starts come closer
    return np.array(out)


def _normal(centre: Vector, covariance: Matrix, count: int, random: np.random.RandomState) -> Matrix:
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.where(values > 0, values, 0.0))
    return np.asarray(centre + random.standard_normal((count, centre.size)) @ root.T)


def _jump(centre: Vector, covariance: Matrix) -> Callable[..., Any]:
    """Independent proposals from the t distribution about the Laplace approximation."""
    law = multivariate_t(centre, covariance, df=_FREEDOM, allow_singular=True)

    def proposal(coordinates: Matrix, random: np.random.RandomState) -> tuple[Matrix, Vector]:
        wanted = np.atleast_2d(law.rvs(size=len(coordinates), random_state=random))
        return wanted, np.asarray(law.logpdf(coordinates) - law.logpdf(wanted))

    return proposal
