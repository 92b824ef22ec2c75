"""Starts of a base fit: the best of many prior draws, far from each other."""

from __future__ import annotations

import numpy as np

from lcopa_bayes.arrays import Matrix, Vector
from lcopa_bayes.inference.posterior import Posterior

_SCREENED = 512
"""Prior draws whose misfit is looked at [-]."""
_DISTINCT = 0.5
"""Starts closer than this in every sampled coordinate count as one [natural log or parameter unit]."""
_SCREEN_NOISE = 0.05
"""Noise scale of the screening over the spread of a response [-]: coarse, so that no draw is hopeless."""


def screened(posterior: Posterior, rng: np.random.Generator, *, count: int) -> list[Vector]:
    """Table values, (rows,), of the `count` best distinct prior draws, gains and offsets at their best."""
    table = posterior.table
    drawn = table.draw(_SCREENED, rng)
    for axis in range(len(table.layout.responses)):
        pooled = np.concatenate([samples.axes[axis].values for samples in posterior.samples])
        scale = _SCREEN_NOISE * (float(pooled.std()) or 1.0)
        for name, value in (("sigma", scale), ("rho", 0.1), ("nu", 10.0)):
            if name in posterior.noise.names:
                drawn[:, table.at(name, axis)] = value
    density = posterior.log_likelihood(drawn)
    ranked = drawn[np.argsort(-np.where(np.isnan(density), -np.inf, density), kind="stable")]
    return [_completed(posterior, values) for values in _distinct(posterior, ranked, count)]


def _completed(posterior: Posterior, values: Vector) -> Vector:
    return np.asarray(posterior.complete(posterior.coordinates(values[None]), None)[0])


def _distinct(posterior: Posterior, ranked: Matrix, count: int) -> list[Vector]:
    kept: list[Vector] = []
    places: list[Vector] = []
    for values in ranked:
        here = posterior.coordinates(values[None])[0]
        if all(np.abs(here - other).max() > _DISTINCT for other in places):
            kept.append(values)
            places.append(here)
        if len(kept) == count:
            break
    return kept
