"""Power scaling: the exact Gaussian case, planted conflict, a likelihood that says nothing."""

from __future__ import annotations

import logging

import arviz_base
import arviz_stats
import numpy as np
import pytest
from scipy import stats
from small import problem, record

from lcopa_bayes.results.sensitivity import ALPHAS, THRESHOLD, power_scaled, sensitivity
from lcopa_bayes.sampling.convergence import Quality
from lcopa_bayes.sampling.draws import Draws

PRIOR_SD, NOISE_SD = 1.0, 0.5


def gaussian(rng, *, seen, noise_sd=NOISE_SD, size=(4, 500)):
    """Draws of x ~ N(0, PRIOR_SD^2) given one measurement `seen` of it, and both log densities."""
    mean, sd = posterior_of(seen, noise_sd)
    x = mean + sd * rng.normal(size=size)
    return x, stats.norm.logpdf(x, 0.0, PRIOR_SD), stats.norm.logpdf(seen, x, noise_sd)


def posterior_of(seen, noise_sd, prior_power=1.0, likelihood_power=1.0):
    weights = prior_power / PRIOR_SD**2, likelihood_power / noise_sd**2
    return weights[1] * seen / sum(weights), sum(weights) ** -0.5


def exact(x, *, seen, noise_sd, which):
    """The sensitivity by quadrature of the exact distributions over the range of the draws."""
    grid = np.linspace(x.min(), x.max(), 40_001)
    whole = stats.norm.cdf(grid, *posterior_of(seen, noise_sd))
    slopes = []
    for alpha in ALPHAS:
        moved = stats.norm.cdf(grid, *posterior_of(seen, noise_sd, **{f"{which}_power": alpha}))
        found = max(distance(whole, moved), distance(1 - whole, 1 - moved))
        slopes.append(found / abs(np.log2(alpha)))
    return np.mean(slopes)


def distance(p, q):
    """Cumulative Jensen-Shannon distance (Kallioinen et al. 2024, Eq. 7) of values on a regular grid."""
    middle = 0.5 * (p + q)
    parts = [f * np.log2(f / middle) + 0.5 / np.log(2) * (g - f) for f, g in ((p, q), (q, p))]
    return np.sqrt(np.sum(parts) / np.sum(p + q))


@pytest.mark.parametrize("seen", [0.0, 1.0, 4.0])
@pytest.mark.parametrize("noise_sd", [pytest.param(0.5, marks=pytest.mark.slow), 1.0])
def test_a_scaled_gaussian_is_known_exactly(seen, noise_sd):
    kinds = ("prior", "likelihood")
    values, errors, off = ({kind: [] for kind in kinds} for _ in range(3))
    for seed in range(20):
        x, prior, likelihood = gaussian(np.random.default_rng(seed), seen=seen, noise_sd=noise_sd)
        (found,) = power_scaled(["x"], x[..., None], prior, likelihood, ["reliable"])
        for kind in kinds:
            values[kind].append(getattr(found, kind))
            errors[kind].append(getattr(found, f"{kind}_mcse"))
            off[kind].append(values[kind][-1] - exact(x, seen=seen, noise_sd=noise_sd, which=kind))
    for kind in kinds:
        assert np.max(np.abs(off[kind]) / errors[kind]) < 5.0
        assert abs(np.mean(off[kind])) < 0.1 * np.mean(values[kind])
        assert 0.5 < np.std(values[kind]) / np.mean(errors[kind]) < 1.7  # the Monte Carlo error is one


def test_a_prior_far_from_the_data_is_a_conflict(rng):
    (found,) = power_scaled(["x"], *stacked(gaussian(rng, seen=5.0)), ["reliable"])
    assert found.prior > 4 * THRESHOLD
    assert found.diagnosis == "prior-data conflict"
    assert found.note == ""
    (calm,) = power_scaled(["x"], *stacked(gaussian(rng, seen=0.0, noise_sd=0.1)), ["reliable"])
    assert calm.prior < THRESHOLD < calm.likelihood
    assert calm.diagnosis == "-"


def test_a_likelihood_that_says_nothing_leaves_the_prior(rng):
    x, prior, likelihood = gaussian(rng, seen=0.0, noise_sd=100.0)
    for flat in (likelihood, np.full(x.shape, -7.0)):
        (found,) = power_scaled(["x"], x[..., None], prior, flat, ["reliable"])
        assert found.prior > THRESHOLD > 1e-3 > found.likelihood
        assert found.diagnosis == "weak likelihood: the prior decides"
    (found,) = power_scaled(["x"], x[..., None], np.full(x.shape, -1.0), likelihood, ["reliable"])
    assert (found.prior, found.diagnosis) == (0.0, "-")
    assert "bounds" in found.note


def stacked(drawn):
    x, prior, likelihood = drawn
    return x[..., None], prior, likelihood


def test_the_parameter_that_the_prior_moves_comes_first(rng):
    x, prior, likelihood = gaussian(rng, seen=5.0)
    aside = rng.normal(size=(*x.shape, 2))
    values = np.concatenate([aside[..., :1], x[..., None], aside[..., 1:]], axis=2)
    found = power_scaled(["a", "x", "b"], values, prior, likelihood, ["reliable", "tentative", "reliable"])
    assert found[0].parameter == "x"
    assert found[0].grade == "tentative"
    assert {one.diagnosis for one in found[1:]} == {"-"}


def test_scale_and_direction_of_a_parameter_do_not_matter(rng):
    x, prior, likelihood = gaussian(rng, seen=2.0)
    values = np.stack([x, -1e-3 * x + 7.0], axis=-1)
    one, other = power_scaled(["x", "y"], values, prior, likelihood, ["reliable"] * 2)
    assert one.prior == pytest.approx(other.prior, rel=1e-6)
    assert one.likelihood_mcse == pytest.approx(other.likelihood_mcse, rel=1e-6)


def test_uneven_importance_weights_are_not_trusted(rng):
    """exp(0.01 * 200 e), e exponential, has a Pareto tail of shape 2."""
    x, prior, _ = gaussian(rng, seen=0.0)
    wild = -200.0 * rng.exponential(size=x.shape)
    (found,) = power_scaled(["x"], x[..., None], prior, wild, ["reliable"])
    assert found.likelihood_k == pytest.approx(2.0, abs=0.5)
    assert np.isnan(found.prior)
    assert np.isnan(found.likelihood)
    assert found.diagnosis == "not trusted"
    assert "Pareto k" in found.note
    assert found.as_json()["likelihood"] is None


@pytest.mark.parametrize("least", [1e5, 1e6, 1e8])
def test_draws_that_have_not_arrived_are_not_trusted(rng, least):
    """Walkers far below the mode still: a few draws have all the weight, and their tail has no finite fit."""
    climbing = rng.permutation(-np.geomspace(1.0, least, 400)).reshape(2, 200)
    values = rng.standard_normal((2, 200, 1))
    (found,) = power_scaled(["x"], values, climbing, climbing, ["unusable"])
    assert found.diagnosis == "not trusted"
    assert np.isnan(found.prior)


def test_a_parameter_that_has_not_moved_is_not_trusted(rng):
    x, prior, likelihood = gaussian(rng, seen=1.0)
    values = np.stack([x, np.full(x.shape, 0.3)], axis=-1)
    found = power_scaled(["x", "still"], values, prior, likelihood, ["reliable", "unusable"])
    by_name = {one.parameter: one for one in found}
    assert by_name["still"].diagnosis == "not trusted"
    assert np.isnan(by_name["still"].prior)
    (alone,) = power_scaled(["x"], x[..., None], prior, likelihood, ["reliable"])
    assert by_name["x"].prior == alone.prior


def test_too_few_draws_are_not_trusted(rng):
    (found,) = power_scaled(["x"], *stacked(gaussian(rng, seen=0.0, size=(2, 20))), ["unusable"])
    assert found.diagnosis == "not trusted"
    assert "40 draws are too few" in found.note


def test_a_prior_with_a_plateau_needs_no_smoothing(rng):
    x, prior, likelihood = gaussian(rng, seen=1.0)
    (found,) = power_scaled(["x"], x[..., None], np.minimum(-1.0, prior), likelihood, ["reliable"])
    assert np.isfinite(found.prior)
    assert found.prior > 0


# ---------------------------------------------------------------- of a posterior


def drawn(posterior, size=(2, 200)) -> Draws:
    """Draws near the truth: what is tested is the bookkeeping, so they need not be of the posterior."""
    rng = np.random.default_rng(3)
    reported = {"gain": 2.0, "time_1": 1.5, "order_1": 0.8, "delay": 0.73, "offset": 0.3, "sigma": 0.02}
    centre = np.array([reported[name] for name in posterior.table.names])
    values = centre * np.exp(0.002 * rng.normal(size=(*size, centre.size)))
    found = tuple(Quality(row.name, 900.0, 900.0, 1.0) for row in posterior.table.rows if row.free)
    return Draws(posterior.table, values, np.zeros(size), found, 400.0)


def test_agrees_with_arviz_on_the_same_groups(caplog):
    """Two methods: groups as `posterior.nc` has them, through `psense_summary`."""
    posterior = problem(record(), priors={"delay": 0.73}).posterior
    draws = drawn(posterior)
    draws.values[..., posterior.table.names.index("delay")] = 0.73
    rows = [(k, row) for k, row in enumerate(posterior.table.rows) if row.free]
    density = posterior.pointwise(draws.flat)
    shape = draws.values.shape[:2]
    scaled = {r.name: np.log(draws.values[..., k]) if r.log_scale else draws.values[..., k] for k, r in rows}
    tree = arviz_base.from_dict(
        {
            "posterior": scaled,
            "log_prior": {
                r.name: (r.log_prior(x) + (np.log(x) if r.log_scale else 0.0)).reshape(shape)
                for r, x in ((r, draws.flat[:, k]) for k, r in rows)
            },
            "log_likelihood": {"y": density[0][0].reshape(*shape, -1)},
        }
    )
    with caplog.at_level(logging.ERROR):
        table = arviz_stats.psense_summary(tree, round_to=12)
    found = sensitivity(draws, posterior)
    assert {one.parameter for one in found} == {row.name for _, row in rows}
    for one in found:
        assert one.prior == pytest.approx(float(table.loc[one.parameter, "prior"]), rel=1e-6, abs=1e-9)
        assert one.likelihood == pytest.approx(float(table.loc[one.parameter, "likelihood"]), rel=1e-6)
