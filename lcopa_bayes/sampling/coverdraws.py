"""Importance draws from a cover of where ensembles have been.

Ensembles that start alike can agree while a mode that is hard to reach still fills in all of
them alike. Independent draws of a cover fitted to what they visited, weighted by the posterior, have shares
and means of their own, whose errors follow from the weights. They are the better result where the weights
converge in the whole and in each tail and mode by itself; where they do not, ensembles go on.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, log
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.parallel import Workers
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.coordinates import Chart
from lcopa_bayes.sampling.cover import Cover
from lcopa_bayes.sampling.weighted import Weighted

_COMPONENTS = 60
"""Components of the cover."""
_PILOT = 20_000
"""First draws, from which the number needed is estimated."""
_MOST = 200_000
"""Most draws."""
_LOOKED_AT, _MISSED = 4_000, 1e-3
"""Visited points that are checked, and the share of them that a cover may almost miss [-]."""
_SPARE = 1.15
"""Factor on the estimated number of draws needed [-]."""
_PART = 500
"""Fewest draws of a task."""
_TASKS = 8
"""Most tasks."""


@final
@dataclass(frozen=True)
class _Density:
    """Task: log density of points."""

    def __call__(self, posterior: Posterior, z: Matrix) -> Vector:
        return posterior.log_density(z)


def cover_draws(
    posterior: Posterior,
    visited: Matrix,
    wanted: float,
    seed: int,
    crew: Workers[Posterior],
    *,
    least: float = 0.0,
) -> Weighted | None:
    """Weighted draws equivalent to `wanted` independent draws for the centre, the tails and the shares of
    modes of every sampled parameter, from a cover of the points `visited` (n, dimension); None where no
    number of draws in reach gives them, where a draw of the cover is worth less than `least` effective draws,
    or where it almost misses points that were visited.

    Deterministic given the arguments; FloatingPointError where the density is NaN.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(6_000,)))
    cover = Cover.fitted(posterior, visited, seed, _COMPONENTS)
    drawn: list[tuple[Matrix, Vector, Vector]] = []
    count, wanted_count = 0, _PILOT
    while wanted_count <= _MOST:
        drawn.append(_drawn(posterior, cover, wanted_count - count, rng, crew))
        count = wanted_count
        z, density, raw = (np.concatenate(part) for part in zip(*drawn, strict=True))
        weighted = Weighted.of(posterior, z, density, raw, count, smooth=False)
        if weighted.ess < least * count:
            return None
        # more draws of the same cover change nothing about what it misses
        if least > 0 and len(drawn) == 1 and _misses(posterior, cover, weighted, visited, crew, rng):
            return None
        worth = weighted.smallest_ess(rng)
        if worth >= wanted:
            return weighted
        needed = ceil(_SPARE * count * wanted / worth)
        if count >= 2 * _PILOT and needed > 2 * _MOST:
            return None
        wanted_count = min(max(needed, 2 * count), 4 * count)
    return None


def _misses(
    posterior: Posterior,
    cover: Cover,
    weighted: Weighted,
    visited: Matrix,
    crew: Workers[Posterior],
    rng: np.random.Generator,
) -> bool:
    """Whether a draw of the cover at some of the points visited would have more weight than all others
    together."""
    sample = visited[rng.choice(len(visited), min(_LOOKED_AT, len(visited)), replace=False)]
    chart = Chart.of(posterior)
    z = chart.usable(sample)[0]
    density = _density(z, crew) + posterior.table.log_permutations
    raw = density - cover.log_density(chart.terrain.sorted(z))
    return bool(np.mean(raw - weighted.log_evidence > log(weighted.count)) > _MISSED)


def _drawn(
    posterior: Posterior, cover: Cover, count: int, rng: np.random.Generator, crew: Workers[Posterior]
) -> tuple[Matrix, Vector, Vector]:
    """`count` draws of a cover, without those outside the charts or the prior: coordinates, log density and
    log weight."""
    z = rng.permutation(cover.draw(count, rng))
    density = _density(z, crew)
    inside = np.isfinite(density)
    z, density = z[inside], density[inside]
    return z, density, density + posterior.table.log_permutations - cover.log_density(z)


def _density(z: Matrix, crew: Workers[Posterior]) -> Vector:
    """Log density of points by the workers that share the posterior, (n,) [nat]."""
    parts = np.array_split(z, max(1, min(_TASKS, len(z) // _PART)))
    return np.concatenate(list(crew.each(_Density(), parts)))
