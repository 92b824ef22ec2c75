"""What stands for a posterior with effects near the draws of its fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lcopa_bayes.core.parallel import workers
from lcopa_bayes.inference.optimum import Optimum
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.inference.surrogate import Surrogate
from lcopa_bayes.sampling.draws import Draws

_TRIED = 128
"""Draws at which a surrogate is compared with the posterior [-]."""
_ASTRAY = 1.0
"""Standard deviation of the difference of their log likelihoods from which it is not used [nat]."""


def surrogate_about(
    posterior: Posterior, draws: Draws, rng: np.random.Generator, *, jobs: int = 1
) -> Surrogate | None:
    """A surrogate of the responses about draws, simulated in `jobs` processes; None where it does not hold
    there."""
    best = draws.flat[np.argmax(draws.log_density.ravel())]
    covariance = np.cov(posterior.coordinates(draws.flat).T)
    about = Optimum(best, covariance, float(draws.log_density.max()))
    tried = draws.thinned(_TRIED)
    with workers(None, jobs=jobs) as crew:
        surrogate = Surrogate.of(posterior, about, rng, crew.map)
        parts = np.array_split(tried, max(1, _TRIED // 16))
        exact = np.concatenate(list(crew.map(posterior.joint_log_likelihood, parts)))
    if surrogate is None:
        return None
    level = replace(posterior, surrogate=surrogate).joint_log_likelihood(tried)
    return surrogate if float(np.std(exact - level)) < _ASTRAY else None
