"""A run of a posterior whose plant has effects: importance sampling around the optima.

One response with effects costs as much as ten without, and ensembles from the prior ask for a million. Draws
of a proposal fitted to the posterior are weighted instead (`importance`), by way of a surrogate where one
holds. What no draw reaches no weight shows, so a run whose proposal is far from the posterior is tentative,
and ensembles follow where weights fail.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.parallel import workers
from lcopa_bayes.inference.optimum import Optimum, find_optima
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.inference.surrogate import Surrogate
from lcopa_bayes.sampling.convergence import Limitation, qualities
from lcopa_bayes.sampling.draws import Draws, gather
from lcopa_bayes.sampling.ensemble import Ensemble, advance
from lcopa_bayes.sampling.evidence import Mapped, spread
from lcopa_bayes.sampling.importance import LEAST_EFFICIENCY, Effort, ImportancePlan, importance
from lcopa_bayes.sampling.importanceweights import usable_k
from lcopa_bayes.sampling.mixture import Mixture
from lcopa_bayes.sampling.mixturemoves import learned
from lcopa_bayes.sampling.proposal import weighty
from lcopa_bayes.sampling.sampler import Run, SamplePlan
from lcopa_bayes.sampling.weighted import BATCHES, Weighted

STARTS, QUICK_STARTS = 4, 2
"""Starts of the search for optima [-]."""
_PLAN = ImportancePlan(
    (Effort(4_000, 1_500, 6), Effort(8_000, 3_000, 6), Effort(16_000, 6_000, 4)), starts=STARTS
)
_QUICK = ImportancePlan((Effort(2_000, 1_000, 5), Effort(4_000, 2_000, 4)), starts=QUICK_STARTS)
_STREAM = 12
"""Marks the randomness of such a run."""
_FEWEST = 100.0
"""Effective draws below which weights are not used [-]."""
_EXACT = 8.0
"""Draws of a surrogate that are weighted by the posterior itself, over the effective draws wanted [-]."""
_WALKERS = 64
"""Walkers of an ensemble that moves draws of a surrogate on, at least [-]."""
_ROUNDS, _KEPT, _THIN = 24, 20, 5
"""Most rounds of such moves, draws kept of each, and steps per draw [-]."""
_WALKED = 2000.0
"""Effective draws at which they end [-]."""
_SMALL = 0.5
"""Largest Pareto k of the weights of a surrogate [-]: their variance is finite below it."""


def weighted_run(
    posterior: Posterior,
    plan: SamplePlan,
    *,
    jobs: int = 1,
    quick: bool = False,
    optima: Sequence[Optimum] = (),
) -> tuple[Run, Draws] | None:
    """Importance draws as a run, and its draws; None where no weights are usable.

    `optima` are those of the posterior where they are known; else they are searched for. Deterministic given
    the plan's seed, whatever `jobs` [processes].
    """
    rng = np.random.default_rng([plan.seed, _STREAM])
    size = min(plan.target_ess, 400.0) if quick else plan.target_ess
    wanted = replace(_QUICK if quick else _PLAN, wanted=size)
    with workers(None, jobs=jobs) as crew:
        mapped = crew.map
        optima = optima or find_optima(posterior, rng, starts=wanted.starts)
        if not optima:
            return None
        near, weighted, share = posterior, None, 0.0
        chosen = weighty(optima)
        if posterior.simulation is not None and len(chosen) == 1:
            near, weighted, share = _by_surrogate(posterior, chosen[0], rng, wanted, mapped)
        if weighted is None or not usable(weighted):
            near, weighted = posterior, importance(posterior, optima, rng, wanted, mapped).weighted
            share = weighted.ess / weighted.count
    if not usable(weighted):
        return None
    run = Run((), plan, weighted)
    draws = gather(near, run)
    if share < LEAST_EFFICIENCY:
        draws = draws.limited(
            [
                Limitation(
                    "tentative",
                    f"the proposal of the importance sampling is {100 * share:.0f} % efficient (Pareto k "
                    f"{weighted.pareto_k:.2f}): a mode far from the optima would be missed",
                    'sample by ensembles, [sampler] method = "ensembles", or narrow the priors',
                )
            ]
        )
    return run, draws


def usable(weighted: Weighted) -> bool:
    """Whether averages converge and enough draws count."""
    return weighted.pareto_k <= usable_k(weighted.count) and weighted.ess >= _FEWEST


def _by_surrogate(
    posterior: Posterior, optimum: Optimum, rng: np.random.Generator, plan: ImportancePlan, mapped: Mapped
) -> tuple[Posterior, Weighted | None, float]:
    """The posterior of a surrogate about an optimum; draws of it weighted by the posterior itself; and how
    efficient they can be called [-]. No draws where the surrogate does not hold."""
    surrogate = Surrogate.of(posterior, optimum, rng, mapped)
    if surrogate is None:
        return posterior, None, 0.0
    near = replace(posterior, surrogate=surrogate)
    first = importance(near, [optimum], rng, plan, mapped).weighted
    if not usable(first):
        return posterior, None, 0.0
    count, share = int(_EXACT * plan.wanted), first.ess / first.count
    if share < LEAST_EFFICIENCY:
        z, about, share = _walked(near, first, count, rng, mapped)
    else:
        drawn = first.batches(int(min(count, first.ess)) // BATCHES, rng).ravel()
        z, about = first.coordinates[drawn], first.log_density[drawn]
    exact = spread(posterior, z, mapped)
    inside = np.isfinite(exact)
    raw = (exact - about)[inside] + first.log_evidence
    weighted = Weighted.of(posterior, z[inside], exact[inside], raw, len(z), smooth=True)
    if not (weighted.pareto_k <= _SMALL and weighted.ess >= LEAST_EFFICIENCY * weighted.count):
        return posterior, None, 0.0
    error = float(np.hypot(weighted.log_evidence_sd, first.log_evidence_sd))
    return near, replace(weighted, log_evidence_sd=error), share


def _walked(
    near: Posterior, first: Weighted, most: int, rng: np.random.Generator, mapped: Mapped
) -> tuple[Matrix, Vector, float]:
    """Draws of weighted ones moved on as ensembles of walkers, as many as they are worth and `most` at most;
    log densities, and 1 where the ensembles agree, else the efficiency of the weights.

    Resampling and moving (Gilks and Berzuini 2001, J. R. Statist. Soc. B 63): where the proposal is far from
    the posterior the walkers leave it, and their agreement tells whether they have arrived.
    """
    walkers = max(_WALKERS, 2 * near.dimension + 2)
    ensembles = []
    for chosen in first.batches(walkers, rng):
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
        measured = qualities(names, kept)
        if all(quality.grade(_WALKED).level == "reliable" for quality in measured):
            break
    agree = all(quality.grade(_FEWEST).level == "reliable" for quality in measured)
    worth = float(np.min([quality.ess for quality in measured]))
    log_density = np.stack([one.log_density for one in ensembles])[:, -kept.shape[2] :].swapaxes(1, 2)
    flat = kept.reshape(len(ensembles), -1, near.dimension)
    count = max(1, int(min(most, worth)) // BATCHES)
    order = rng.permutation(flat.shape[1])[:count]
    z = flat[:, order].reshape(-1, near.dimension)
    about = log_density.reshape(len(ensembles), -1)[:, order].ravel()
    return z, about, 1.0 if agree else first.ess / first.count


def _advanced(task: tuple[Posterior, Ensemble, int, int, Mixture]) -> Ensemble:
    return advance(*task)
