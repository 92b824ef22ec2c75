"""Dispersed starts for independent ensembles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lcopa_bayes.arrays import Matrix
from lcopa_bayes.inference.optimum import Optimum
from lcopa_bayes.inference.posterior import Posterior

_TEMPERATURE = 5.0
"""Hills share the walkers in proportion to ``exp(log density / temperature)``: lower hills get a chance."""
_INFLATION = 2.0
"""Walkers spread so many linearised standard deviations wide."""
_WIDEST = 1.5
"""Largest spread of a start [natural log or parameter unit]; a flat direction has no linearised width."""
_TRIES = 40
"""Halvings of the spread before a walker is placed on its hill top."""


def dispersed_start(
    posterior: Posterior, optima: Sequence[Optimum], walkers: int, rng: np.random.Generator
) -> Matrix:
    """Walker positions around the optima, wider than the hills, (walkers, dimension).

    RuntimeError when there is no optimum to start from.
    """
    if not optima:
        raise RuntimeError("least squares found no point of finite posterior density to start from")
    heights = np.array([optimum.log_density for optimum in optima])
    weights = np.exp((heights - heights.max()) / _TEMPERATURE)
    hills = rng.choice(len(optima), size=walkers, p=weights / weights.sum())
    centres = np.stack([posterior.coordinates(optimum.values[None])[0] for optimum in optima])
    shapes = np.stack([_spread(optimum.covariance) for optimum in optima])
    out = np.empty((walkers, posterior.dimension))
    waiting, width = np.arange(walkers), _INFLATION
    for _ in range(_TRIES):
        jump = rng.standard_normal((waiting.size, posterior.dimension))
        out[waiting] = centres[hills[waiting]] + width * np.einsum("bij,bj->bi", shapes[hills[waiting]], jump)
        inside = posterior.log_prior(out[waiting]) > -np.inf
        waiting, width = waiting[~inside], width / 2 ** (1 / 4)
        if waiting.size == 0:
            return out
    raise RuntimeError(
        f"{waiting.size} of {walkers} walkers found no start inside the prior; check the priors' supports"
    )


def _spread(covariance: Matrix) -> Matrix:
    """A square root of the covariance with no direction wider than `_WIDEST`."""
    values, vectors = np.linalg.eigh(covariance)
    widths = np.sqrt(np.maximum(values, 1e-16))
    return np.asarray(vectors * np.minimum(widths, _WIDEST / _INFLATION))
