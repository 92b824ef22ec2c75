"""Draws of an easy posterior: a proposal around its optima, checked by points of the whole prior.

A draw there costs one response where a point of a search (`marginal`) costs the descent of everything beside
orders and noise. What such draws cannot show, mass that the proposal does not cover, the first points of the
search do: each has a weight, and the mean of the weights of points that are not covered estimates that mass
without bias.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.parallel import Workers
from lcopa_bayes.inference.optimum import Optimum, along_orders, find_optima
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.coordinates import Chart, charted_density
from lcopa_bayes.sampling.importance import Effort, ImportancePlan, importance
from lcopa_bayes.sampling.proposal import weighty
from lcopa_bayes.sampling.weighted import Weighted

_PLAN = ImportancePlan(
    (Effort(2_000, 2_000, 8), Effort(4_000, 2_000, 3), Effort(8_000, 3_000, 3)),
    promising=0.05,
    efficient=False,
    straightened=True,
)
_LEAST = 0.1
"""Effective draws per draw from which a proposal that began all along the orders covers what it does not
miss far from there, which points of the whole prior show [-]."""
_ATTEMPTS, _STRAY = 2, 3
"""Attempts, and points that the second one begins at, the heaviest that the first does not cover [-]."""
_SPARSE, _NEGLIGIBLE = 30.0, 0.01
"""Posterior density over that of a proposal from which it does not cover a point, and posterior mass of such
points that may be missed [-]."""
_STARTS, _PRIOR = 12, 1_000
"""Starts of a search for optima, and points of the prior, where nothing else explores it."""


def around_optima(
    posterior: Posterior,
    crew: Workers[Posterior],
    scouts: Workers[Posterior],
    optima: Sequence[Optimum],
    hunted: tuple[Matrix, Vector, Vector],
    rng: np.random.Generator,
    wanted: float,
    late: Callable[[], bool],
) -> tuple[bool, Weighted | None]:
    """Draws of a proposal around optima, and whether they will do: not where the proposal does not come
    close to the posterior, nor where it does not cover what points of the whole prior show; none where no
    optimum has a surrounding inside the prior. The proposal is fitted by `scouts`, whose posterior may differ
    a little.

    `hunted` are coordinates of such points, (points, dimension), log densities there and log weights, whose
    sum estimates the evidence [nat]. A few may be far out in a tail, heavy by chance: a second attempt
    begins there too, and would find a mode.
    """
    chart, (z, density, log_weights) = Chart.of(posterior), hunted
    weighing, learning = (lambda _, portions, own=own: own.each(_density, portions) for own in (crew, scouts))
    drawn = np.isfinite(log_weights)
    z, density, log_weights = z[drawn], density[drawn], log_weights[drawn]
    y, log_volume = chart.charted(z)
    optima = [*optima, *along_orders(posterior, optima[0])]
    explored = np.zeros(len(y), dtype=bool)
    for _ in range(_ATTEMPTS):
        tried = importance(
            posterior,
            optima,
            rng,
            replace(_PLAN, wanted=wanted),
            weighing,
            late,
            rough=partial(charted_density, posterior, chart, mapped=learning),
        )
        if tried is None:
            return False, None
        weighted = tried.weighted
        if not tried.good(wanted, efficient=False) or weighted.ess < _LEAST * weighted.count:
            break
        log_ratio = density + posterior.table.log_permutations - log_volume - weighted.log_evidence
        sparse = (log_ratio - tried.proposal.log_density(y) > np.log(_SPARSE)) & ~explored
        share = np.minimum(log_weights - weighted.log_evidence, 0.0)  # all, where it is more than was found
        mass = np.where(sparse, np.exp(share), 0.0)
        if mass.sum() < _NEGLIGIBLE:
            return True, weighted
        missed = np.isin(np.arange(mass.size), np.argsort(-mass)[:_STRAY]) & sparse
        if mass[~missed].sum() > _NEGLIGIBLE:
            break
        explored |= missed
        places = zip(posterior.values(z[missed]), density[missed], strict=True)
        optima = [*optima, *(Optimum(at, optima[0].covariance, float(level)) for at, level in places)]
    return False, weighted


def without_search(
    posterior: Posterior,
    crew: Workers[Posterior],
    optima: Sequence[Optimum],
    rng: np.random.Generator,
    wanted: float,
    late: Callable[[], bool],
) -> Weighted | None:
    """Draws around `optima`, or where there are none those of a search of its own, of a plant whose orders or
    noise are stated, so that `marginal` has nothing to search; points of the prior show what they miss. None
    where they will not do."""
    found = weighty(optima or find_optima(posterior, rng, starts=_STARTS, crew=crew))
    if not found:
        return None
    z = posterior.coordinates(posterior.table.draw(_PRIOR, rng))
    density = posterior.log_density(z)
    log_weights = density - posterior.log_prior(z) - np.log(len(z))
    enough, weighted = around_optima(
        posterior, crew, crew, found, (z, density, log_weights), rng, wanted, late
    )
    return weighted if enough else None


def _density(posterior: Posterior, z: Matrix) -> Vector:
    return posterior.log_density(z)
