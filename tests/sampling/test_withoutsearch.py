"""Draws around optima where orders and noise are stated: the distribution that a grid gives."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.special import logsumexp
from small import problem, record

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.parallel import workers
from lcopa_bayes.inference.optimum import Optimum
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling import aroundoptima
from lcopa_bayes.sampling.aroundoptima import without_search
from lcopa_bayes.sampling.run import Run, SamplePlan
from lcopa_bayes.sampling.sampler import sample
from lcopa_bayes.sampling.weighted import Weighted

STATED = {"order_1": 0.8, "sigma": 0.02}
POSTERIOR = problem(record(camera=0.6), priors=STATED).posterior


def run(posterior: Posterior, target: float = 400.0) -> Run:
    return sample(posterior, SamplePlan.of(posterior.dimension, seed=3, target_ess=target, method="auto"))


@cache
def delivered() -> Weighted:
    weighted = run(POSTERIOR).weighted
    assert weighted is not None
    return weighted


def moments(weighted: Weighted) -> tuple[Vector, Vector]:
    weights = np.exp(weighted.log_weights - logsumexp(weighted.log_weights))
    mean = weights @ weighted.coordinates
    return mean, np.sqrt(weights @ (weighted.coordinates - mean) ** 2)


def test_moments_and_evidence_are_those_of_a_grid():
    """Of time constant and delay, gain and offset integrated out: to five of their Monte Carlo errors."""
    names = [POSTERIOR.table.names[k] for k in POSTERIOR.sampled]
    assert set(names) == {"time_1", "delay"}
    weighted = delivered()
    worth, (mean, sd) = weighted.smallest_ess, moments(weighted)
    assert worth >= 400
    axes = [np.linspace(m - 7 * s, m + 7 * s, 121) for m, s in zip(mean, sd, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    density = POSTERIOR.log_density(grid)
    share = np.exp(density - logsumexp(density))
    exact = share @ grid
    spread = np.sqrt(share @ (grid - exact) ** 2)
    assert (np.abs(mean - exact) < 5 * spread / np.sqrt(worth)).all()
    assert (np.abs(sd / spread - 1.0) < 5 / np.sqrt(2 * worth)).all()
    cell = np.prod([axis[1] - axis[0] for axis in axes])
    assert weighted.log_evidence == pytest.approx(logsumexp(density) + np.log(cell), abs=0.1)


@pytest.mark.parametrize("seed", [pytest.param(0, marks=pytest.mark.slow), 1, 8])
def test_an_optimum_that_is_none_misleads_nobody(seed):
    """From a narrow surrounding of a draw of the prior: what is delivered is the posterior, or nothing. The
    last seed has points of the prior that are e^709 times as likely as all that was drawn."""
    rng = np.random.default_rng(seed)
    far = POSTERIOR.table.draw(1, rng)
    level = float(POSTERIOR.log_density(POSTERIOR.coordinates(far))[0])
    false = Optimum(far[0], 1e-6 * np.eye(POSTERIOR.dimension), level)
    with workers(POSTERIOR, jobs=1) as crew:
        weighted = without_search(POSTERIOR, crew, (false,), rng, 400.0, lambda: False)
    if weighted is not None:
        (mean, sd), (expected, spread) = moments(weighted), moments(delivered())
        assert (np.abs(mean - expected) < 5 * spread / np.sqrt(200)).all()
        assert (np.abs(sd / spread - 1.0) < 5 / np.sqrt(2 * 200)).all()


def test_points_of_the_prior_weigh_as_much_as_the_posterior(monkeypatch):
    """The sum of their weights is the evidence: noise above the response lets a thousand points show it."""
    vague = problem(record(camera=0.6), priors=STATED | {"sigma": 5.0}).posterior
    seen = []
    inner = aroundoptima.around_optima

    def noted(*given):
        seen.append(given[4])
        return inner(*given)

    monkeypatch.setattr(aroundoptima, "around_optima", noted)
    weighted = run(vague).weighted
    assert weighted is not None
    ((_, _, log_weights),) = seen
    share = np.exp(log_weights - log_weights.max())
    error = share.std() / share.mean() / np.sqrt(share.size)
    assert error < 0.1
    assert logsumexp(log_weights) == pytest.approx(weighted.log_evidence, abs=4 * error + 0.05)
