"""Importance draws from a cover of where ensembles have been.

Ensembles that share a way of starting can agree while a mode that is hard to reach still fills in all of
them alike. Independent draws of a cover fitted to what they visited, weighted by the posterior, have shares
and means of their own, whose errors are known from the weights. They are the better result where the weights
converge in the whole and in each tail and mode by itself; where they do not, ensembles go on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import ceil
from typing import Any, final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.cover import Cover
from lcopa_bayes.sampling.importanceweights import LARGEST_K
from lcopa_bayes.sampling.weighted import Weighted

_COMPONENTS = 60
"""Components of the cover."""
_PILOT = 20_000
"""Draws that tell how many are needed."""
_MOST = 400_000
"""Most draws."""
_SPARE = 1.15
"""Factor on the number of draws that the pilot says are needed [-]."""
_PART = 500
"""Fewest draws of a task."""
_TASKS = 8
"""Most tasks."""

Crew = Callable[[Callable[[Posterior, Any], Any], Sequence[Any]], Iterable[Any]]
"""A map of a task over its inputs, in this process or in others."""


@final
@dataclass(frozen=True)
class _Density:
    """Task: log density of points."""

    def __call__(self, posterior: Posterior, z: Matrix) -> Vector:
        return posterior.log_density(z)


def cover_draws(
    posterior: Posterior, visited: Matrix, wanted: float, seed: int, crew: Crew
) -> Weighted | None:
    """Weighted draws worth `wanted` effective ones for the centre, the tails and the shares of modes of every
    sampled parameter, from a cover of the points `visited` (n, dimension); None where no number of draws in
    reach gives them or the weights do not converge.

    Deterministic given the arguments; FloatingPointError where the density is NaN.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(6_000,)))
    cover = Cover.fitted(posterior, visited, seed, _COMPONENTS)
    pilot = _weighted(posterior, cover, _PILOT, rng, crew)
    if pilot.pareto_k > LARGEST_K:
        return None
    worth, _ = pilot.convergence(rng)
    needed = ceil(_SPARE * _PILOT * wanted / worth) if worth > 0 else _MOST + 1
    if needed > _MOST:
        return None
    found = _weighted(posterior, cover, max(needed, _PILOT), rng, crew)
    worth, shape = found.convergence(rng)
    return found if worth >= wanted and shape <= LARGEST_K else None


def _weighted(
    posterior: Posterior, cover: Cover, count: int, rng: np.random.Generator, crew: Crew
) -> Weighted:
    """`count` draws of a cover, those that no chart has included, with their weights."""
    z = rng.permutation(cover.draw(count, rng))
    parts = np.array_split(z, max(1, min(_TASKS, len(z) // _PART)))
    density = np.concatenate(list(crew(_Density(), parts)))
    inside = np.isfinite(density)
    z, density = z[inside], density[inside]
    raw = density + posterior.table.log_permutations - cover.log_density(z)
    return Weighted.of(posterior, z, density, raw, count)
