"""What the loop integrates out is drawn at the noise scale that the residual shows, and chains forget their
starts: against conjugate posteriors in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats
from small import TRUTH, problem, record

from lcopa_bayes.bench.command import on_off
from lcopa_bayes.loop.autoregression import Autoregression
from lcopa_bayes.loop.basemodel import BaseModel
from lcopa_bayes.loop.density import LoopDensity
from lcopa_bayes.loop.draws import LoopDraws, sample_loop, settled
from lcopa_bayes.loop.extendedmodel import ExtendedModel
from lcopa_bayes.loop.gaussnewton import Regression
from lcopa_bayes.loop.scores import State
from lcopa_bayes.loop.whitening import Whitening
from lcopa_bayes.sampling.convergence import qualities

SCALE = 3.0
"""Scatter of the samples over the nominal noise [-]."""
ORDER = ("uniform", {"loc": TRUTH["order_1"] - 1e-6, "scale": 2e-6})
"""So narrow that the plant is linear in what is left."""


def linear_plant(quiet: float, *, offset_sd: float = 1e3, scale: float = SCALE) -> LoopDensity:
    """One record of a plant known but for gain and offset, its noise `scale` times the nominal one."""
    fixed = {name: TRUTH[name] for name in ("time_1", "delay")} | {"order_1": ORDER}
    wide = {
        "gain": ("norm", {"loc": 0.0, "scale": 1e3}),
        "offset": ("norm", {"loc": TRUTH["offset"], "scale": offset_sd}),
    }
    taken = record(7, command=on_off(1.0, hold=5.0, at=0.35), noise_sd=scale * TRUTH["sigma"])
    posterior = problem(taken, priors=fixed | wide).posterior
    base = BaseModel(posterior)
    noise = (Autoregression(np.empty(0), TRUTH["sigma"]),)
    regression = Regression(base, Whitening(posterior.samples, noise))
    start = dict(TRUTH)
    optimum = regression.descend(np.array([start[name] for name in base.names]))
    model = ExtendedModel.of(base, optimum.x)
    return LoopDensity(State(model, optimum, regression.whitening, optimum.covariance), quiet)


def exact(density: LoopDensity, quiet: float) -> tuple[dict[str, float], dict[str, float]]:
    """Mean and standard deviation of gain and offset under flat priors and 1 / variance, with `quiet` further
    samples of the nominal noise: a Student law (Gelman et al. 2013, Bayesian Data Analysis, 14.2)."""
    white, names = density.state.whitening, density.state.model.names
    at = [names.index("gain"), names.index("offset")]
    columns = density.state.optimum.jacobian[:, at]
    target = density.state.optimum.white + columns @ density.state.optimum.x[at]
    best, power, _, _ = np.linalg.lstsq(columns, target, rcond=None)
    freedom = quiet + white.size - 2
    covariance = np.linalg.inv(columns.T @ columns) * (quiet + power[0]) / (freedom - 2)
    keys = ("gain", "offset")
    return dict(zip(keys, best, strict=True)), dict(zip(keys, np.sqrt(np.diag(covariance)), strict=True))


@pytest.mark.parametrize("quiet", [0.0, 40.0])
def test_draws_of_a_linear_plant_are_of_its_student_law(quiet: float):
    """The gain is sampled, the offset drawn from its conditional; the noise scale is learnt from both."""
    density = linear_plant(quiet)
    drawn = sample_loop(density, 3)
    assert [density.state.model.names[k] for k in density.linear] == ["offset"]
    mean, sd = exact(density, quiet)
    for name in ("gain", "offset"):
        column = drawn.flat[:, density.state.model.names.index(name)]
        count = min(column.size, 300)  # draws that are kept hardly remember each other
        assert column.mean() == pytest.approx(mean[name], abs=4 * sd[name] / np.sqrt(count))
        assert column.std() == pytest.approx(sd[name], rel=4 / np.sqrt(2 * count))


@pytest.mark.parametrize("quiet", [0.0, 40.0])
def test_the_conditional_of_what_is_integrated_out(quiet: float):
    """At one place, by Kolmogorov and Smirnov: Student where the prior is wide, normal where it is narrow."""
    rng = np.random.default_rng(5)
    for offset_sd in (1e3, 1e-5):
        density = linear_plant(quiet, offset_sd=offset_sd)
        z = density.state.optimum.x[density.sampled]
        z[0] *= 1.001
        value, given = density.with_conditional(z)
        assert np.isfinite(value)
        draws = density.completed(np.tile(z, (3000, 1)), np.tile(given, (3000, 1)), rng)
        assert_allclose(draws[:, density.sampled], np.tile(z, (3000, 1)))
        column = density.columns[:, 0]
        if offset_sd > 1.0:
            size = np.sqrt((quiet + given[-1]) / density.freedom / (column @ column))
            law = stats.t(density.freedom, density.state.optimum.x[density.linear] + given[0], size)
        else:
            law = stats.norm(TRUTH["offset"], offset_sd)
        assert stats.kstest(draws[:, density.linear[0]], law.cdf).pvalue > 1e-3


def test_nothing_to_integrate_out():
    """Offsets shared by all records with a uniform prior are sampled like everything else."""
    density = linear_plant(10.0)
    flat = replace(density.state.model.base, posterior=_flat_offset(density))
    model = replace(density.state.model, base=flat)
    state = replace(density.state, model=model)
    drawn = sample_loop(LoopDensity(state, 10.0), 1, quick=True)
    assert isinstance(drawn, LoopDraws)
    assert drawn.flat.shape[1] == len(model.names)
    assert np.isfinite(drawn.flat).all()


def _flat_offset(density: LoopDensity):
    fixed = {name: TRUTH[name] for name in ("time_1", "delay")} | {"order_1": ORDER}
    taken = density.state.whitening.samples[0].record
    return problem(taken, priors=fixed | {"offset": ("uniform", {"loc": -5.0, "scale": 10.0})}).posterior


@pytest.mark.parametrize("forget", [2.0, 10.0, 25.0])
def test_chains_without_their_starts_have_the_variance_of_the_target(forget: float):
    """Autoregressive walkers of unit variance, started twice as wide: with their starts the variance is too
    large by a known amount; without, it is that of the target. 4 ensembles of 12 walkers, 40 replicates."""
    steps, replicates, rho = 120, 40, np.exp(-1 / forget)
    rng, kept, raw, size = np.random.default_rng(9), [], [], []
    for _ in range(replicates):
        z = 2.0 * rng.standard_normal((4, 12, 2))
        chain = np.empty((4, 12, steps, 2))
        for t in range(steps):
            z = rho * z + np.sqrt(1 - rho**2) * rng.standard_normal(z.shape)
            chain[:, :, t] = z
        short = settled(chain)
        assert np.array_equal(short, chain[:, :, steps - short.shape[2] :])
        kept.append(np.mean(short**2))
        raw.append(np.mean(chain**2))
        size.append(short.shape[2])
    error = np.std(kept) / np.sqrt(replicates)
    started = 3.0 * np.mean(rho ** (2 * np.arange(1, steps + 1)))
    assert np.mean(raw) == pytest.approx(1.0 + started, abs=5 * np.std(raw) / np.sqrt(replicates))
    # three memories of (1 + rho) / (1 - rho) steps, at most half
    left = min(3 * (1 + rho) / (1 - rho), steps / 2)
    assert np.mean(steps - np.array(size)) == pytest.approx(left, rel=0.35)
    assert np.mean(kept) == pytest.approx(1.0, abs=3.5 * error + 3 * rho ** (2 * left) * forget / steps)


def test_chains_that_have_not_moved_are_halved():
    still = np.tile(np.random.default_rng(2).standard_normal((4, 12, 1, 2)), (1, 1, 40, 1))
    assert settled(still).shape[2] == 20
    assert qualities(["a", "b"], still)[0].grade(400.0).level == "unusable"
