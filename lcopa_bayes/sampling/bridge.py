"""Draws transferred from one posterior to another of the same coordinates, without starting from the prior.

A mixture fitted to draws of one posterior proposes draws of the other, which are weighted (`importance`).
Where their weights do not converge populations follow ``source^(1-b) target^b`` while b rises from 0 to 1,
resampled and moved at every rise (Del Moral, Doucet and Jasra 2006, J. R. Statist. Soc. B 68), and then
sample the target. This refits a model to fewer samples, or under other priors, at a fraction of the cost.
Modes that no walker of the source was in, such as one excluded by the omitted data, are reached by tails of
the mixture and by moves alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import emcee
import numpy as np
from arviz_stats.base import array_stats  # type: ignore[attr-defined]

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.evidence import Evidence
from lcopa_bayes.sampling.importance import Effort, ImportancePlan, importance
from lcopa_bayes.sampling.mixture import Mixture
from lcopa_bayes.sampling.mixturemoves import learned
from lcopa_bayes.sampling.ridgemoves import emcee_sampler
from lcopa_bayes.sampling.tempering import largest_rise, survivors
from lcopa_bayes.sampling.weighted import BATCHES, CHAIN
from lcopa_bayes.sampling.weightedrun import usable

_PLAN = ImportancePlan((Effort(3_000, 1_000, 4),))
"""Effort of importance sampling."""
_DELIVERED = 400
"""Draws of each of its batches that are delivered."""
_MOVES = 15
"""Moves of every walker at each rise."""
_BURN = 40
"""Moves in the target before draws are kept."""
_KEPT = 20
"""Draws kept of every walker ..."""
_THIN = 5
"""... one in this many moves."""


@final
@dataclass(frozen=True, eq=False)
class Transferred:
    """Draws of the target."""

    coordinates: Array
    """(ensembles, walkers, draws, dimension)."""
    ess: float
    """Smallest effective sample size over the coordinates [draws]."""
    rhat: float
    """Largest nested R-hat between ensembles [-]."""
    evidence: Evidence | None = None
    """Of the target, where importance sampling gave it."""


def transferred(
    source: Posterior, target: Posterior, positions: Array, seed: int, *, jump: bool
) -> Transferred:
    """Draws of `target` from walkers (ensembles, walkers, dimension) of `source`.

    With `jump` in one rise: for posteriors whose supports differ, but little else. Deterministic given
    `seed`.
    """
    mixture = learned(target, list(positions), seed)
    weighed = _weighed(target, mixture, np.random.default_rng([seed, 3_001]))
    if weighed is not None:
        return weighed
    chains = []
    for number, position in enumerate(positions):
        sequence = np.random.SeedSequence(seed, spawn_key=(number, 3_000))
        rng = np.random.default_rng(sequence)
        random = tuple(np.random.RandomState(np.random.MT19937(sequence.spawn(1)[0])).get_state())
        heat = 0.0
        while heat < 1.0:
            before, after = source.log_density(position), target.log_density(position)
            gain = after - before
            rise = 1.0 - heat if jump else largest_rise(gain, 1.0 - heat)
            heat = 1.0 if heat + rise > 1.0 - 1e-9 else heat + rise
            position = position[survivors(rise * gain, rng)]
            moves = _BURN if heat == 1.0 else _MOVES
            sampler = emcee_sampler(target, _Between(source, target, heat), len(position), mixture, random)
            state = sampler.run_mcmc(
                emcee.State(_parted(position, rng)), moves, skip_initial_state_check=True, store=False
            )
            position, random = np.array(state.coords), tuple(sampler.random_state)
        sampler = emcee_sampler(target, target.log_density, len(position), mixture, random)
        sampler.run_mcmc(emcee.State(position), _KEPT, thin_by=_THIN, skip_initial_state_check=True)
        chains.append(sampler.get_chain().swapaxes(0, 1))
    return _judged(np.stack(chains))


def _weighed(target: Posterior, mixture: Mixture, rng: np.random.Generator) -> Transferred | None:
    """Importance draws of the target that begin with a mixture in its chart; None where they will not do."""
    tried = importance(target, (), rng, _PLAN, begin=mixture)
    if tried is None or not usable(tried.weighted):
        return None
    weighted = tried.weighted
    drawn = weighted.coordinates[weighted.batches(_DELIVERED, rng)]
    judged = _judged(drawn.reshape(BATCHES, -1, CHAIN, target.dimension))
    level = Evidence(weighted.log_evidence, weighted.log_evidence_sd, ())
    return replace(judged, ess=weighted.ess, evidence=level)


@final
@dataclass(frozen=True, eq=False)
class _Between:
    """Log density between source and target."""

    source: Posterior
    target: Posterior
    heat: float

    def __call__(self, coordinates: Matrix) -> Vector:
        after = self.target.log_density(coordinates)
        if self.heat == 1.0:
            return after
        total = np.full(len(coordinates), -np.inf)
        inside = np.isfinite(after)
        if inside.any():
            before = self.source.log_density(coordinates[inside])
            total[inside] = (1 - self.heat) * before + self.heat * after[inside]
        return total


def _parted(position: Matrix, rng: np.random.Generator) -> Matrix:
    """Walkers in another sequence: the runs of copies that resampling makes are spread."""
    return position[rng.permutation(len(position))]


def _judged(coordinates: Array) -> Transferred:
    ensembles, walkers = coordinates.shape[:2]
    owner = np.repeat(np.arange(ensembles), walkers)
    chains = coordinates.reshape(ensembles * walkers, *coordinates.shape[2:])
    ess, rhat = [], []
    for k in range(chains.shape[-1]):
        ess.append(float(array_stats.ess(chains[..., k], method="bulk")))  # type: ignore[no-untyped-call]
        rhat.append(float(array_stats.rhat_nested(chains[..., k], owner)))  # type: ignore[no-untyped-call]
    return Transferred(coordinates, min(ess), max(rhat))
