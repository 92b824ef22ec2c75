"""Posterior draws of plant and effects: ensembles of walkers that mostly propose by a surrogate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, final

import emcee
import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.core.estimate import Estimate
from lcopa_bayes.core.parallel import workers
from lcopa_bayes.effectsearch.density import LoopDensity
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.proposals import Counted, Jump, Walk, learnt
from lcopa_bayes.effectsearch.surrogate import Surrogate
from lcopa_bayes.sampling.convergence import Grade, Quality, overall, qualities

_LENGTH = 6.0
"""Least length of a chain over the steps after which it forgets [-]."""
_FORGET = 3.0
"""Steps left out at the start of a chain over those after which it forgets [-]: of starts twice as wide as
the posterior less than 1 % of the excess variance is left then."""

ENSEMBLES = 4
_NEAR = 0.2
"""Share of the steps that walk a short way on the surrogate [-]."""
_INDEPENDENT = (0.4, 0.75)
"""Share of those that walk far or jump, where few and where most of these are accepted [-]; the rest combine
walkers."""
_FIRST = (0.4, 0.3)
"""Shares of steps that walk and that jump during the burn-in [-]."""
_FAVOUR = 4
"""Power of the acceptance by which moves share the steps [-]."""
_WALKERS = 12
"""Walkers of an ensemble, at least [-]."""
_BURN = 5
"""Steps of either half of the burn-in [-]."""
_ROUND = 10
_STEPS = 160
"""Most steps of an ensemble [-]."""
_SAMPLES = 10_000
_LONGER = 8.0
"""Samples from which these are the most; of fewer, which cost less, there may be so many times more [-]."""
_KEPT = 400
"""Draws kept of all coordinates, at least [-]."""
TARGET_ESS = 400.0
_BEYOND = 1.2
"""Effective sample size at which ensembles end, over the target [-]: its estimate scatters, and to end with
the first that reaches the target would favour those that are too high."""


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
    left_out: int
    """Steps of every walker that were left out: those of the burn-in, and those after it from which the
    starts were not yet forgotten."""
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
    """Four independent ensembles from overdispersed starts about the optimum; deterministic given `seed`.

    They go on, 10 steps at a time, until the draws grade as reliable, or to `_STEPS` for a record of 10 000
    samples and longer for a shorter one (half as long with `quick`). Draws from which the starts are not yet
    forgotten are left out (`settled`).
    """
    longer = min(max(1.0, _SAMPLES / density.state.whitening.size), _LONGER)
    most = int(longer * _STEPS) // (2 if quick else 1)
    names = [unit_of(density.state.model, int(k))[0] for k in density.sampled]
    surrogate = Surrogate.of(density)
    law = learnt(surrogate, surrogate.centre, surrogate.root, np.random.RandomState([seed, 22]))
    with workers(None, jobs=min(jobs, ENSEMBLES)) as crew:
        runs = list(crew.each(_begun, [(surrogate, law, seed, number) for number in range(ENSEMBLES)]))
        while True:
            runs = list(crew.each(_continued, [(surrogate, law, run) for run in runs]))
            whole = np.stack([run.chain for run in runs])
            chains = settled(whole)
            found, taken, kept = qualities(names, chains), whole.shape[2], chains.shape[2]
            enough = overall(found, _BEYOND * TARGET_ESS).level == "reliable" and long_enough(found, chains)
            if enough or taken >= most:
                break
    stride = max(1, chains.shape[0] * chains.shape[1] * kept // _KEPT)
    thin = chains[:, :, ::-1][:, :, ::stride]
    given = np.stack([run.conditional for run in runs])[:, :, taken - kept :][:, :, ::-1][:, :, ::stride]
    flat = thin.shape[0] * thin.shape[1] * thin.shape[2]
    rng = np.random.default_rng([seed, 21])
    full = density.completed(thin.reshape(flat, -1), given.reshape(flat, -1), rng)
    return LoopDraws(
        density.state.model,
        full.reshape(*thin.shape[:3], -1),
        found,
        float(np.mean([run.accepted for run in runs]) / (taken * chains.shape[1])),
        2 * _BURN + taken - kept,
        tuple(int(k) for k in density.sampled),
    )


@final
@dataclass(frozen=True, eq=False)
class _Run:
    """An ensemble where it stands, and what it has drawn."""

    state: Any
    jump: Jump
    shares: tuple[float, float]
    """Of the steps that walk on the surrogate, and of those that jump [-]."""
    chain: Array
    """(walkers, draws, dimension)."""
    conditional: Array
    """What `LoopDensity.with_conditional` gives beside the density, (walkers, draws, linear + 1)."""
    accepted: int
    """Proposals accepted in the chain."""


def _begun(shared: None, task: tuple[Surrogate, Jump, int, int]) -> _Run:
    """An ensemble after its burn-in, in which its jump and the shares of its moves are learnt."""
    surrogate, law, seed, number = task
    density, k = surrogate.density, law.centre.size
    walkers = max(k + 2, _WALKERS)
    random = np.random.RandomState(np.random.MT19937(np.random.SeedSequence([seed, 20, number])))
    start = emcee.State(_started(density, law, walkers, random), random_state=random.get_state())
    empty = np.zeros((walkers, 0, k)), np.zeros((walkers, 0, density.linear.size + 1))
    run = _Run(start, law, _FIRST, *empty, 0)
    sampler, _, _ = _sampler(surrogate, law, run)
    state = sampler.run_mcmc(start, _BURN, skip_initial_state_check=True)
    jump = law.updated(sampler.get_chain(discard=_BURN // 2, flat=True))
    sampler, walk, jumped = _sampler(surrogate, law, replace(run, jump=jump))
    state = sampler.run_mcmc(state, _BURN, skip_initial_state_check=True)
    # what is learnt from draws that are discarded is fixed from here on: those kept are of one Markov chain
    low, high = _INDEPENDENT
    both = low + (high - low) * max(walk.acceptance, jumped.acceptance)
    share = both / (1 + (jumped.acceptance / walk.acceptance) ** _FAVOUR)
    return _Run(state, jump, (share, both - share), *empty, 0)


def _continued(shared: None, task: tuple[Surrogate, Jump, _Run]) -> _Run:
    """The ensemble with further draws."""
    surrogate, law, run = task
    sampler, _, _ = _sampler(surrogate, law, run)
    reached = sampler.run_mcmc(run.state, _ROUND, skip_initial_state_check=True)
    chain, given = sampler.get_chain().swapaxes(0, 1), sampler.get_blobs().swapaxes(0, 1)
    return _Run(
        reached,
        run.jump,
        run.shares,
        np.concatenate([run.chain, chain], axis=1),
        np.concatenate([run.conditional, given.reshape(*chain.shape[:2], -1)], axis=1),
        run.accepted + int(sampler.backend.accepted.sum()),
    )


def _sampler(surrogate: Surrogate, law: Jump, run: _Run) -> tuple[Any, Counted, Counted]:
    """A sampler with the moves of a run, and those that are counted."""
    walk, jump = Counted(Walk(surrogate, law)), Counted(run.jump)
    rest = (1 - _NEAR - sum(run.shares)) / 2
    # beside moves that go anywhere, the two that combine walkers need not span the space themselves
    moves = [
        (walk, run.shares[0]),
        (emcee.moves.MHMove(Walk(surrogate, law, near=True)), _NEAR),
        (jump, run.shares[1]),
        (emcee.moves.DEMove(live_dangerously=True), rest),
        (emcee.moves.StretchMove(live_dangerously=True), rest),
    ]
    walkers, dimension = run.chain.shape[0], run.chain.shape[2]
    sampler = emcee.EnsembleSampler(walkers, dimension, surrogate.density.with_conditional, moves=moves)
    return sampler, walk, jump


def _started(density: LoopDensity, law: Jump, walkers: int, random: np.random.RandomState) -> Matrix:
    """Walkers twice as widely spread as the surrogate, inside the support."""
    out: list[Vector] = []
    wide = 2.0
    while len(out) < walkers:
        noise = random.standard_normal((walkers, law.centre.size))
        for z in law.centre + wide * noise @ law.root.T:
            if len(out) < walkers and np.isfinite(density(z)):
                out.append(z)
        wide *= 0.8  # where the support is narrow, starts come closer
    return np.array(out)


def memory(measured: Sequence[Quality], chains: Array) -> float:
    """Steps after which the slowest coordinate of chains (ensembles, walkers, draws, k) forgets where it was:
    draws over the smallest effective sample size within chains; infinite where nothing has moved."""
    worst = np.min([(quality.ess_bulk, quality.ess_tail) for quality in measured])
    return float(chains[..., 0].size / worst) if worst > 0 else np.inf  # NaN is not above 0


def settled(chains: Array) -> Array:
    """Chains (ensembles, walkers, draws, k) without the draws that still remember the starts.

    Three times the memory of the slowest coordinate is left out, at most half of all draws. It is measured on
    the later half, which the starts have affected least.
    """
    steps = chains.shape[2]
    later = chains[:, :, steps // 2 :]
    names = [str(k) for k in range(chains.shape[3])]
    start = min(np.ceil(_FORGET * memory(qualities(names, later), later)), steps // 2)
    return chains[:, :, int(start) :]


def long_enough(measured: Sequence[Quality], chains: Array) -> bool:
    """Whether every walker took many times the steps after which it forgets where it was: from shorter chains
    that number of steps cannot be told."""
    return bool(chains.shape[2] > _LENGTH * memory(measured, chains))
