"""A run of a posterior whose plant has effects: importance sampling around the optima.

One response with effects costs as much as fifty without, and ensembles from the prior ask for a million.
Draws of a proposal fitted to the posterior are weighted instead (`importance`). What no draw reaches no
weight shows, so a run whose proposal is far from the posterior is tentative, and ensembles follow where
weights fail.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.parallel import crew
from lcopa_bayes.inference.optimum import Optimum, find_optima
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.inference.surrogate import Surrogate
from lcopa_bayes.sampling.convergence import Limitation, qualities
from lcopa_bayes.sampling.draws import Draws
from lcopa_bayes.sampling.ensemble import Ensemble, advance
from lcopa_bayes.sampling.evidence import Evidence, Mapped, spread
from lcopa_bayes.sampling.importance import (
    LEAST_EFFICIENCY,
    Effort,
    Importance,
    ImportancePlan,
    importance,
    tail_smoothed,
    weighted_draws,
)
from lcopa_bayes.sampling.importanceweights import effective, usable_k
from lcopa_bayes.sampling.mixture import Mixture
from lcopa_bayes.sampling.mixturemoves import learned
from lcopa_bayes.sampling.proposal import weighty
from lcopa_bayes.sampling.sampler import Run, SamplePlan

_PLAN = ImportancePlan((Effort(4_000, 1_500, 6), Effort(8_000, 3_000, 6), Effort(16_000, 6_000, 4)), starts=4)
_QUICK = ImportancePlan((Effort(2_000, 1_000, 5), Effort(4_000, 2_000, 4)), starts=2)
_STREAM = 12
"""Marks the randomness of such a run."""
_FEWEST = 100.0
"""Effective draws below which weights are not used [-]."""
_EXACT = 6.0
"""Draws of a surrogate that are weighted by the posterior itself, over the effective draws wanted [-]."""
_WALKERS = 64
"""Walkers of an ensemble that moves draws of a surrogate on, at least [-]."""
_ROUNDS, _KEPT, _THIN = 8, 20, 5
"""Most rounds of such moves, draws kept of each, and steps per draw [-]."""
_WALKED = 1000.0
"""Effective draws at which they end [-]."""
_SMALL = 0.5
"""Largest Pareto k of the weights of a surrogate [-]: their variance is finite below it."""
_STEPS = 50
"""Draws of every walker that stand for a chain [-]."""


class Weighted(NamedTuple):
    """What importance sampling gave, in the form of a run of ensembles."""

    run: Run
    draws: Draws
    evidence: Evidence
    found: Importance


def weighted_run(
    posterior: Posterior, plan: SamplePlan, *, jobs: int = 1, quick: bool = False
) -> Weighted | None:
    """Draws, evidence and the weights they rest on; None where these are not usable.

    Deterministic given the plan's seed, whatever `jobs` [processes]. Parts of the draws stand for ensembles:
    each is resampled from its own proposals' draws.
    """
    rng = np.random.default_rng([plan.seed, _STREAM])
    wanted = replace(
        _QUICK if quick else _PLAN, wanted=min(plan.target_ess, 400.0) if quick else plan.target_ess
    )
    with crew(jobs) as mapped:
        optima = find_optima(posterior, rng, starts=wanted.starts)
        if not optima:
            return None
        near, found, share = posterior, None, 0.0
        chosen = weighty(optima)
        if posterior.simulation is not None and len(chosen) == 1:
            near, found, share = _by_surrogate(posterior, chosen[0], rng, wanted, mapped)
        if found is None or not usable(found, _FEWEST):
            near, found = posterior, importance(posterior, optima, rng, wanted, mapped)
            share = found.ess / found.log_weights.size
    if not usable(found, _FEWEST):
        return None
    draws = weighted_draws(near, found, rng, target_ess=plan.target_ess)
    if share < LEAST_EFFICIENCY:
        draws = draws.limited(
            [
                Limitation(
                    "tentative",
                    f"the proposal of the importance sampling is {100 * share:.0f} % efficient (Pareto k "
                    f"{found.pareto_k:.2f}): a mode away from the optima would be missed",
                    'sample by ensembles, [sampler] method = "ensembles", or narrow the priors',
                )
            ]
        )
    return Weighted(_run(posterior, found, plan, rng), draws, _evidence(found, plan.ensembles), found)


def _by_surrogate(
    posterior: Posterior, optimum: Optimum, rng: np.random.Generator, plan: ImportancePlan, mapped: Mapped
) -> tuple[Posterior, Importance | None, float]:
    """The posterior of a surrogate about an optimum; draws of it weighted by the posterior itself; and how
    efficient the worse of both steps was [-]. No draws where the surrogate does not hold."""
    surrogate = Surrogate.of(posterior, optimum, rng, mapped)
    if surrogate is None:
        return posterior, None, 0.0
    near = replace(posterior, surrogate=surrogate)
    first = importance(near, [optimum], rng, plan, mapped)
    if not usable(first, _FEWEST):
        return posterior, None, 0.0
    count, share = int(_EXACT * plan.wanted), first.ess / first.log_weights.size
    if share < LEAST_EFFICIENCY:
        z, about, ess, share = _walked(near, first, count, rng, mapped)
    else:
        drawn = np.concatenate([first.resampled(count // 4, rng, part=part) for part in _parts(first, 4)])
        z, about, ess = first.coordinates[drawn], first.log_density[drawn], first.ess
    exact = spread(posterior, z, mapped)
    raw = exact - about
    log_weights, k = tail_smoothed(raw)
    if not (k <= _SMALL and effective(log_weights) >= LEAST_EFFICIENCY * count):
        return posterior, None, 0.0
    ess = 1.0 / (1.0 / effective(log_weights) + 1.0 / ess)
    mean = float(logsumexp(raw) - np.log(raw.size))
    error = float(np.hypot(np.std(np.exp(raw - mean)) / np.sqrt(raw.size), first.log_evidence_sd))
    whole = first.log_evidence + mean
    evaluations = count + len(surrogate.bases)
    made = Importance(z, exact, log_weights, k, ess, whole, error, 1, evaluations, raw + first.log_evidence)
    return near, made, share


def _walked(
    near: Posterior, first: Importance, count: int, rng: np.random.Generator, mapped: Mapped
) -> tuple[Matrix, Vector, float, float]:
    """Draws of weighted ones moved on as four ensembles of walkers, `count` of them; log densities, effective
    size, and 1 where the ensembles agree, else the efficiency of the weights.

    Resampling and moving (Gilks and Berzuini 2001, J. R. Statist. Soc. B 63): where the proposal is far from
    the posterior the walkers leave it, and their agreement tells whether they have arrived.
    """
    walkers = max(_WALKERS, 2 * near.dimension + 2)
    ensembles = []
    for part in _parts(first, 4):
        chosen = first.resampled(walkers, rng, part=part)
        position, density = first.coordinates[chosen], first.log_density[chosen]
        random = tuple(np.random.RandomState(rng.integers(2**32)).get_state())
        nothing = np.empty((0, walkers, near.dimension)), np.empty((0, walkers))
        still = np.zeros(walkers)
        ensembles.append(Ensemble(*nothing, position, density, still, 0, random, position, 0))
    mixture = learned(near, [one.position[None] for one in ensembles], int(rng.integers(2**31)))
    names = [near.table.names[k] for k in near.sampled]
    for _ in range(_ROUNDS):
        tasks = [(near, one, _KEPT, _THIN, mixture) for one in ensembles]
        ensembles = list(mapped(_advanced, tasks))
        chain = np.stack([one.chain for one in ensembles])
        kept = chain[:, 2 * chain.shape[1] // 5 :].swapaxes(1, 2)
        found = qualities(names, kept)
        if all(quality.grade(_WALKED).level == "reliable" for quality in found):
            break
    agree = all(quality.grade(_FEWEST).level == "reliable" for quality in found)
    log_density = np.stack([one.log_density for one in ensembles])[:, -kept.shape[2] :].swapaxes(1, 2)
    flat = kept.reshape(len(ensembles), -1, near.dimension)
    places = np.linspace(0, flat.shape[1] - 1, count // 4).astype(int)
    order = rng.permutation(flat.shape[1])[places]
    z = flat[:, order].reshape(-1, near.dimension)
    about = log_density.reshape(len(ensembles), -1)[:, order].ravel()
    share = 1.0 if agree else first.ess / first.log_weights.size
    return z, about, float(np.min([quality.ess for quality in found])), share


def _advanced(task: tuple[Posterior, Ensemble, int, int, Mixture]) -> Ensemble:
    return advance(*task)


def usable(found: Importance, wanted: float) -> bool:
    """Whether averages converge and enough draws count."""
    return found.pareto_k <= usable_k(found.log_weights.size) and found.ess >= wanted


def _parts(found: Importance, count: int) -> list[slice]:
    size = found.log_weights.size
    return [slice(k * size // count, (k + 1) * size // count) for k in range(count)]


def _run(posterior: Posterior, found: Importance, plan: SamplePlan, rng: np.random.Generator) -> Run:
    """Equally weighted draws as chains of walkers."""
    ensembles = []
    for part in _parts(found, plan.ensembles):
        chosen = found.resampled(_STEPS * plan.walkers, rng, part=part)
        chain = found.coordinates[chosen].reshape(_STEPS, plan.walkers, posterior.dimension)
        density = found.log_density[chosen].reshape(_STEPS, plan.walkers)
        accepted = np.full(plan.walkers, _STEPS * found.ess / found.log_weights.size)
        ensembles.append(Ensemble(chain, density, chain[-1], density[-1], accepted, 0, (), chain[-1], 0))
    return Run(tuple(ensembles), plan)


def _evidence(found: Importance, count: int) -> Evidence:
    """Log evidence of the whole and of every part."""
    means = [
        float(logsumexp(found.raw[part]) - np.log(found.raw[part].size)) for part in _parts(found, count)
    ]
    return Evidence(found.log_evidence, found.log_evidence_sd, tuple(means))
