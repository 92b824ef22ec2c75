"""A run of a posterior whose plant has effects: importance sampling around the optima.

One response with effects costs as much as ten without, and ensembles from the prior ask for a million. Draws
of a proposal fitted to the posterior are weighted instead (`importance`), by way of a surrogate where one
holds. What no draw reaches no weight shows, so a run whose proposal is far from the posterior is tentative,
and ensembles follow where weights fail.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import ceil
from time import monotonic
from typing import final

import numpy as np
from scipy.special import logsumexp

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.core.parallel import workers
from lcopa_bayes.inference.optimum import Optimum, find_optima
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.inference.surrogate import Surrogate
from lcopa_bayes.sampling.convergence import Limitation, qualities
from lcopa_bayes.sampling.coordinates import Mapped, spread
from lcopa_bayes.sampling.draws import Draws, draws_of
from lcopa_bayes.sampling.ensemble import Ensemble, advance
from lcopa_bayes.sampling.importance import LEAST_EFFICIENCY, Effort, ImportancePlan, importance
from lcopa_bayes.sampling.importanceweights import effective, usable_k
from lcopa_bayes.sampling.mixture import Mixture
from lcopa_bayes.sampling.mixturemoves import learned
from lcopa_bayes.sampling.proposal import weighty
from lcopa_bayes.sampling.run import Run, SamplePlan
from lcopa_bayes.sampling.separateaxes import importance_by_axis
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
_EVEN = 0.9
"""Effective draws per draw from which weights are so even that their largest ones do not matter, whatever the
shape of their tail [-]."""
_TRIED = 128
"""Draws at which a surrogate is compared with the posterior before more is spent on it [-]."""
_SURPLUS = 2.5
"""Effective draws of a surrogate that are weighted by the posterior itself, over those wanted [-]: the error
of a quantile is uncertain itself, and resampling costs the rest."""
_LEAST = 1_500.0
"""Such draws at least [-]: with fewer the means of their four parts scatter too much to show that they agree
(`convergence.RELIABLE_SCATTER`)."""
_WALKERS = 64
"""Walkers of an ensemble that moves weighted draws on, at least [-]."""
_ROUNDS, _KEPT, _THIN = 24, 20, 5
"""Most rounds of such moves, draws kept of each, and steps per draw [-]."""
_MOVED = 0.15
"""Change of a mean by a round of moves from which walkers do not rest, and by all of them from which the
weights missed part of a posterior [sd]."""
_APART = 1.5
"""Draws of a walker from one taken to the next, over those that are worth one independent draw [-]: of an
AR(1) process these are worth 0.9 of as many independent ones, and draws at random half as many."""


def weighted_run(
    posterior: Posterior,
    plan: SamplePlan,
    *,
    jobs: int = 1,
    quick: bool = False,
    optima: Sequence[Optimum] = (),
    attempts: int | None = None,
    begin: float | None = None,
) -> tuple[Run, Draws] | None:
    """Importance draws as a run, and its draws; None where no weights are usable.

    `optima` are those of the posterior where they are known; else they are searched for. With `attempts` no
    more proposals than these are fitted around them. Deterministic given the plan's seed, whatever `jobs`
    [processes]; with a budget of `plan.seconds` from `begin` (`time.monotonic`), by default from now, after
    which no further proposal is fitted, on the speed of the machine too.
    """
    begin = monotonic() if begin is None else begin

    def late() -> bool:
        return plan.seconds is not None and monotonic() > begin + plan.seconds

    rng = np.random.default_rng([plan.seed, _STREAM])
    size = min(plan.target_ess, 400.0) if quick else plan.target_ess
    wanted = replace(_QUICK if quick else _PLAN, wanted=size)
    wanted = replace(wanted, efforts=wanted.efforts[:attempts])
    with workers(None, jobs=jobs) as crew:
        mapped = crew.map
        optima = optima or find_optima(posterior, rng, starts=wanted.starts)
        if not optima:
            return None
        near, weighted, share = posterior, None, 0.0
        chosen = weighty(optima)
        if posterior.simulation is not None and _together(posterior, chosen):
            near, weighted, share = _by_surrogate(posterior, chosen[0], rng, size, mapped, late)
        if weighted is None or not usable(weighted):
            around = partial(_around, rng, wanted, mapped, late)
            near, weighted = posterior, importance_by_axis(posterior, optima, around, plan.delivered, rng)
            if weighted is None:
                return None
            parts = [part for part, _ in weighted.factors] or [weighted]
            share = min(one.ess / one.count for one in parts)
    stopped = monotonic() - begin if late() else None
    run = Run((), plan, weighted, surrogate=near.surrogate, stopped_after=stopped)
    draws = draws_of(near, run)
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


def _around(
    rng: np.random.Generator,
    wanted: ImportancePlan,
    mapped: Mapped,
    late: Callable[[], bool],
    posterior: Posterior,
    optima: Sequence[Optimum],
    _: float,
) -> Weighted | None:
    """Importance draws around optima; None where they are of no use. One axis of several has all the time
    that is left."""
    tried = importance(posterior, optima, rng, wanted, mapped, late)
    return None if tried is None or not usable(tried.weighted) else tried.weighted


def usable(weighted: Weighted) -> bool:
    """Whether averages converge and enough draws count."""
    converging = weighted.pareto_k <= usable_k(weighted.count) or weighted.ess >= _EVEN * weighted.count
    return converging and weighted.ess >= _FEWEST


def _together(posterior: Posterior, optima: Sequence[Optimum]) -> bool:
    """Whether optima lie within a standard deviation of the best, where a descent stops on its way."""
    z = posterior.coordinates(np.array([one.values for one in optima]))
    return bool((np.abs(z - z[0]) <= np.sqrt(np.diag(optima[0].covariance))).all())


def _by_surrogate(
    posterior: Posterior,
    optimum: Optimum,
    rng: np.random.Generator,
    wanted: float,
    mapped: Mapped,
    late: Callable[[], bool],
) -> tuple[Posterior, Weighted | None, float]:
    """The posterior of a surrogate about an optimum; draws of it weighted by the posterior itself; and how
    efficient they can be called [-]. No draws where the surrogate does not hold.

    Draws of the surrogate are those of the posterior where their weights differ so little that no mean moves
    by more than the Monte Carlo error of as many draws as are wanted: a few of them show it.
    """
    surrogate = Surrogate.of(posterior, optimum, rng, mapped)
    if surrogate is None:
        return posterior, None, 0.0
    near = replace(posterior, surrogate=surrogate)
    # rounds of it cost little beside walkers, who show what a proposal misses that is not efficient
    enough = replace(_PLAN, wanted=_SURPLUS * wanted)
    about_optimum = importance(near, [optimum], rng, enough, mapped, late)
    if about_optimum is None or about_optimum.weighted.ess < _FEWEST:
        return posterior, None, 0.0
    first = about_optimum.weighted
    tried = first.batches(_TRIED // BATCHES, rng).ravel()
    ratios = spread(posterior, first.coordinates[tried], mapped) - first.log_density[tried]
    total, share = float(logsumexp(ratios)), first.ess / first.count
    held = effective(ratios - total) / ratios.size if np.isfinite(total) else 0.0
    if held < LEAST_EFFICIENCY:
        return posterior, None, 0.0
    least = max(_SURPLUS * wanted, _LEAST)
    apart = 1.0 / held - 1.0  # variance of the weights over their mean squared: no mean moves by more sd
    if apart <= 1.0 / wanted and usable(first) and share >= LEAST_EFFICIENCY and first.ess >= least:
        return near, first.shifted(total - np.log(ratios.size), np.sqrt(apart / ratios.size)), share
    count = int(least / held)
    drawn = first.batches(max(1, int(min(count, first.ess)) // BATCHES), rng).ravel()
    z, about = first.coordinates[drawn], first.log_density[drawn]
    if share < LEAST_EFFICIENCY or not usable(first):
        walk = _walked(near, first, rng, mapped, late)
        if not (walk.agree or usable(first)):
            return posterior, None, 0.0
        share = 1.0 if walk.agree else share
        if walk.moved > _MOVED or not usable(first):
            z, about = walk.draws(count, rng)
    exact = spread(posterior, z, mapped)
    inside = np.isfinite(exact)
    raw = (exact - about)[inside] + first.log_evidence
    weighted = Weighted.of(posterior, z[inside], exact[inside], raw, len(z), smooth=True)
    if not (usable(weighted) and weighted.ess >= LEAST_EFFICIENCY * weighted.count):
        return posterior, None, 0.0
    error = float(np.hypot(weighted.log_evidence_sd, first.log_evidence_sd))
    return near, replace(weighted, log_evidence_sd=error), share


@final
@dataclass(frozen=True, eq=False)
class _Walk:
    """Ensembles of walkers that set out from weighted draws."""

    chain: Array
    """Kept coordinates, (ensembles, walkers, draws, dimension)."""
    log_density: Array
    """(ensembles, walkers, draws)."""
    worth: float
    """Independent draws by the scatter within ensembles [-]."""
    agree: bool
    """Whether the ensembles do, at rest."""
    moved: float
    """Largest change of a mean from that of the weighted draws [sd]."""

    def draws(self, most: int, rng: np.random.Generator) -> tuple[Matrix, Vector]:
        """Nearly independent draws, as many of every ensemble and `most` at most, and log densities."""
        stride = max(1, ceil(_APART * self.log_density.size / max(self.worth, 1.0)))
        flat = self.chain.reshape(len(self.chain), -1, self.chain.shape[-1])[:, ::stride]
        about = self.log_density.reshape(len(flat), -1)[:, ::stride]
        order = rng.permutation(flat.shape[1])[: max(1, most // len(flat))]
        return flat[:, order].reshape(-1, flat.shape[-1]), about[:, order].ravel()


def _walked(
    near: Posterior, first: Weighted, rng: np.random.Generator, mapped: Mapped, late: Callable[[], bool]
) -> _Walk:
    """Draws of weighted ones moved on as ensembles of walkers until these agree and rest, or it is `late`.

    Resampling and moving (Gilks and Berzuini 2001, J. R. Statist. Soc. B 63): where the proposal misses part
    of the posterior the walkers leave for it, and the means move; their agreement tells whether they have
    arrived. In many dimensions walkers are worth less than the weights, which stay where nothing moves.
    """
    walkers = max(_WALKERS, 2 * near.dimension + 2)
    ensembles = []
    for chosen in first.batches(walkers, rng):
        seed = np.random.SeedSequence(int(rng.integers(2**32)))
        position = first.coordinates[chosen]
        ensembles.append(Ensemble.started(position, first.log_density[chosen], position, seed))
    mixture = learned(near, [one.position[None] for one in ensembles], int(rng.integers(2**31)))
    names = [near.table.names[k] for k in near.sampled]
    mean = start = np.exp(first.log_weights) @ first.coordinates
    for _ in range(_ROUNDS):
        tasks = [(near, one, _KEPT, _THIN, mixture) for one in ensembles]
        ensembles = list(mapped(_advanced, tasks))
        chain = np.stack([one.chain for one in ensembles])
        kept = chain[:, 2 * chain.shape[1] // 5 :].swapaxes(1, 2)
        measured = qualities(names, kept)
        before, mean, sd = mean, kept.mean(axis=(0, 1, 2)), kept.std(axis=(0, 1, 2))
        # they set out together, so that they may agree on their way
        rest = bool(np.all(np.abs(mean - before) <= _MOVED * sd))
        agree = rest and all(quality.grade(_FEWEST).level == "reliable" for quality in measured)
        if agree or late():
            break
    return _Walk(
        kept,
        np.stack([one.log_density for one in ensembles])[:, -kept.shape[2] :].swapaxes(1, 2),
        float(np.min([(quality.ess_bulk, quality.ess_tail) for quality in measured])),
        agree,
        float(np.max(np.abs(mean - start) / sd)),
    )


def _advanced(task: tuple[Posterior, Ensemble, int, int, Mixture]) -> Ensemble:
    return advance(*task)
