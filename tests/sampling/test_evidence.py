"""Log evidence: known ratios, closed forms, quadrature and the mean likelihood of prior draws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.integrate import dblquad
from scipy.special import logsumexp
from small import TRUTH, Toy, problem, record

from lcopa_bayes.comparison.predictivedensity import Predicted
from lcopa_bayes.comparison.sequentialdensity import Part
from lcopa_bayes.core.arrays import Array, Matrix
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.draws import gather
from lcopa_bayes.sampling.evidence import Evidence, bridge, evidence
from lcopa_bayes.sampling.run import SamplePlan
from lcopa_bayes.sampling.sampler import sample

GAIN = ("gennorm", {"beta": 2.0, "loc": 1.0, "scale": 2.0 * np.sqrt(2)})
"""A normal density under another name, so that the gain is sampled and not integrated out."""
SEEDS = 24


def scattered(found: list[tuple[float, float]], exact: float) -> None:
    """Estimates with the error they claim: none far off, no bias, and a spread that is the claim."""
    values, errors = np.transpose(found)
    assert (np.abs(values - exact) < 4.5 * errors).all()
    assert abs(np.mean(values) - exact) < 4 * np.std(values, ddof=1) / np.sqrt(len(values))
    ratio = np.var(values, ddof=1) / np.mean(errors**2)
    low, high = stats.chi2(len(values) - 1).ppf([1e-3, 1 - 1e-3]) / (len(values) - 1)
    assert low < ratio < high


@pytest.mark.parametrize(("shift", "width"), [(0.0, 1.0), (1.5, 1.0), (0.5, 0.4), (0.5, 2.0)])
def test_a_bridge_between_two_normals_has_the_known_ratio_and_error(shift, width):
    level, found = 123.4, []
    here, there = stats.norm(shift, width), stats.norm(0.0, 1.3)

    def log_ratio(x: Array) -> Array:
        return level + here.logpdf(x) - there.logpdf(x)

    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        ours, theirs = here.rvs(size=400, random_state=rng), there.rvs(size=900, random_state=rng)
        found.append(bridge(log_ratio(ours), log_ratio(theirs), 400.0))
    scattered(found, level)


def test_a_bridge_from_the_density_itself_is_exact():
    value, error = bridge(np.full(50, 7.25), np.full(80, 7.25), 50.0)
    assert value == pytest.approx(7.25, abs=1e-9)
    assert error == pytest.approx(0.0, abs=1e-9)


def test_a_bridge_takes_what_lies_outside():
    """Half of the mixture lies where the density is zero."""
    rng = np.random.default_rng(0)
    inside = rng.random(4000) < 0.5
    value, error = bridge(np.full(1000, np.log(2.0)), np.where(inside, np.log(2.0), -np.inf), 1000.0)
    assert abs(value) < 4 * error
    assert error == pytest.approx(1 / np.sqrt(4000), rel=0.3)  # a share of one half of 4000 draws


@pytest.mark.parametrize("gap", [0.0, 30.0, 1e4, 1e8])
def test_a_bridge_between_sides_that_never_meet_ends_in_the_middle(gap):
    """By symmetry; iterations on the ratio take steps that shrink with the exponential of the gap."""
    value, _ = bridge(np.zeros(40), np.full(40, -gap), 40.0)
    assert value == pytest.approx(-gap / 2, abs=1e-6)


@given(st.integers(0, 2**32), st.floats(0.0, 300.0), st.floats(0.1, 30.0))
def test_a_bridge_is_where_its_iteration_would_stay(seed, gap, spread):
    rng = np.random.default_rng(seed)
    ours, theirs = rng.normal(0.0, 1.0, 50), rng.normal(-gap, spread, 80)
    value, _ = bridge(ours, theirs, 20.0)
    above = logsumexp(theirs - np.logaddexp(np.log(0.2) + theirs, np.log(0.8) + value)) - np.log(80)
    below = logsumexp(-np.logaddexp(np.log(0.2) + ours, np.log(0.8) + value)) - np.log(50)
    assert above - below == pytest.approx(value, abs=1e-6)


def test_correlated_draws_are_worth_fewer():
    here, there = stats.norm(0.5, 2.0), stats.norm(0.0, 1.3)
    rng = np.random.default_rng(1)
    ours, theirs = here.rvs(size=1000, random_state=rng), there.rvs(size=4000, random_state=rng)
    sides = [here.logpdf(x) - there.logpdf(x) for x in (ours, theirs)]
    errors = [bridge(*sides, ess)[1] for ess in (30.0, 300.0, 1000.0, 1e9)]
    assert errors[0] > 1.5 * errors[1] > 1.5 * errors[2]
    assert errors[2] == errors[3]  # no more than there are


def linear_gaussian() -> tuple[Posterior, float, float, float]:
    """One gain unknown: the posterior, its mean and standard deviation, and its exact log evidence."""
    fixed = {name: TRUTH[name] for name in ("time_1", "order_1", "delay", "offset")} | {"sigma": 0.3}
    posterior = problem(record(camera=0.6, noise_sd=0.3), priors=fixed | {"gain": GAIN}).posterior
    seen = posterior.samples[0].axes[0]
    dynamics = posterior.table.dynamics(posterior.values(np.zeros((1, 1))))
    unit = posterior.model.unit_responses(dynamics)[0][0, 0, seen.index]
    covariance = 4 * np.outer(unit, unit) + 0.3**2 * np.eye(unit.size)
    exact = stats.multivariate_normal(1.0 * unit + TRUTH["offset"], covariance).logpdf(seen.values)
    precision = unit @ unit / 0.3**2 + 1 / 4
    mean = (unit @ (seen.values - TRUTH["offset"]) / 0.3**2 + 1 / 4) / precision
    return posterior, float(mean), float(precision**-0.5), float(exact)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 20))])
def test_the_evidence_of_a_linear_model_is_that_of_a_normal_density(seed):
    """From exact posterior draws."""
    posterior, mean, sd, exact = linear_gaussian()
    draws = mean + sd * np.random.default_rng(seed).standard_normal((3, 10, 40, 1))
    reported = evidence(posterior, draws, 1200.0, seed)
    assert reported is not None
    assert reported.value == pytest.approx(np.mean(reported.by_ensemble))
    assert len(reported.by_ensemble) == 3
    assert reported.grade.level == "reliable"
    assert 0.002 < reported.sd < 0.05
    assert abs(reported.value - exact) < 4.5 * reported.sd


def test_the_claimed_error_is_the_scatter_of_many_runs():
    """Exact draws of a normal density in a normal prior; the larger of two errors is claimed."""
    toy = Toy(lambda z: -0.5 * (z**2).sum(axis=1), {k: ("norm", {"loc": 1.0, "scale": 2.0}) for k in "ab"})
    exact = 2 * (stats.norm(1, np.sqrt(5)).logpdf(0.0) + 0.5 * np.log(2 * np.pi))
    rng, found = np.random.default_rng(4), []
    for seed in range(SEEDS):
        draws = 0.2 + np.sqrt(0.8) * rng.standard_normal((2, 10, 15, 2))
        reported = evidence(toy, draws, 300.0, seed)
        assert reported is not None
        found.append((reported.value, reported.sd))
    values, errors = np.transpose(found)
    assert (np.abs(values - exact) < 4.5 * errors).all()
    assert abs(values.mean() - exact) < 4 * values.std(ddof=1) / np.sqrt(SEEDS)
    assert 0.5 < values.std(ddof=1) / np.sqrt(np.mean(errors**2)) < 1.4


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 8))])
def test_a_run_gives_the_evidence_of_a_linear_model(seed):
    posterior, _, _, exact = linear_gaussian()
    walkers, target = (24, 200.0) if seed else (16, 100.0)
    run = sample(posterior, SamplePlan(2, walkers, 400, 2, target, seed))
    reported = evidence(posterior, run.kept()[0], gather(posterior, run).ess, seed)
    assert reported is not None
    assert reported.sd < 0.1
    assert abs(reported.value - exact) < 4.5 * reported.sd


def banana(z: Matrix) -> Array:
    """A curved ridge that the bounds of the prior cut."""
    return np.asarray(-0.5 * (z[:, 0] / 0.9) ** 2 - 0.5 * ((z[:, 1] - z[:, 0] ** 2) / 0.3) ** 2)


def test_two_bounded_parameters_against_quadrature():
    toy = Toy(
        banana, {"a": ("uniform", {"loc": -2, "scale": 4}), "b": ("uniform", {"loc": -0.2, "scale": 3.2})}
    )
    integral, _ = dblquad(
        lambda b, a: float(np.exp(banana(np.array([[a, b]]))[0])), -2, 2, -0.2, 3.0, epsabs=1e-7
    )
    exact = float(np.log(integral / 4 / 3.2))
    run = sample(toy, SamplePlan(2, 24, 400, 3, 150.0, 6))
    reported = evidence(toy, run.kept()[0], gather(toy, run).ess, 6)
    assert reported is not None
    assert reported.sd < 0.1
    assert abs(reported.value - exact) < 4.5 * reported.sd
    again = evidence(toy, run.kept()[0], gather(toy, run).ess, 6)
    assert again == reported


def test_draws_of_unknown_worth_count_as_one_of_each_ensemble():
    """Walkers that hardly moved have no effective sample size."""
    posterior, mean, sd, exact = linear_gaussian()
    draws = mean + sd * np.random.default_rng(0).standard_normal((3, 10, 40, 1))
    unknown, known = (evidence(posterior, draws, ess, 1) for ess in (float("nan"), 3.0))
    assert unknown is not None
    assert unknown == known
    assert abs(unknown.value - exact) < 4.5 * unknown.sd


def test_a_single_ensemble_has_no_evidence():
    posterior, mean, sd, _ = linear_gaussian()
    draws = mean + sd * np.random.default_rng(0).standard_normal((1, 10, 25, 1))
    assert evidence(posterior, draws, 100.0, 1) is None


def test_ensembles_far_apart_have_no_evidence():
    """One of them where there is no density."""
    toy = Toy(
        lambda z: np.where(np.abs(z[:, 0]) > 1.9, 0.0, -np.inf),
        {"a": ("uniform", {"loc": -2, "scale": 4}), "b": ("uniform", {"loc": 0, "scale": 1})},
    )
    rng = np.random.default_rng(0)
    draws = rng.uniform((1.95, 0.45), (1.951, 0.55), (2, 10, 25, 2))
    assert evidence(toy, draws, 250.0, 1) is not None
    draws[1, ..., 0] = rng.uniform(-0.5, 0.5, (10, 25))
    assert evidence(toy, draws, 250.0, 1) is None


@pytest.mark.parametrize("alike", [True, False])
def test_exchangeable_terms_are_counted_once(alike):
    """Against the mean likelihood of prior draws; noise so loud that these find the posterior, and the
    posterior draws are prior draws kept by their likelihood."""
    reported = {"gain": GAIN, "sigma": 3.0, "offset": 0.3}
    if not alike:
        reported |= {"time_1": ("gamma", {"a": 2.0, "scale": 3.0})}
    posterior = problem(record(camera=1.0), terms=2, priors=reported, blocks=8).posterior
    assert posterior.table.exchangeable == (alike,)
    rng = np.random.default_rng(0)
    drawn = posterior.table.draw(6_000, rng)
    heights = posterior.log_likelihood(drawn)
    exact = float(logsumexp(heights) - np.log(len(heights)))
    relative = np.exp(heights - heights.max())
    error = float(relative.std() / relative.mean() / np.sqrt(len(drawn)))
    kept = drawn[rng.random(len(drawn)) < relative]
    count = len(kept) // 40
    assert count >= 30
    coordinates = posterior.coordinates(kept[: 40 * count])
    if alike:  # sampled in any order
        element = [
            posterior.sampled.index(posterior.table.at(k, 0, t)) for k in ("time", "order") for t in (0, 1)
        ]
        swapped = rng.random(len(coordinates)) < 0.5
        turned = coordinates[:, [element[1], element[0], element[3], element[2]]]
        coordinates[:, element] = np.where(swapped[:, None], turned, coordinates[:, element])
    found = evidence(posterior, coordinates.reshape(4, 10, count, -1), 40.0 * count, 1)
    assert found is not None
    assert error < 0.03
    assert found.sd < 0.1
    assert abs(found.value - exact) < 4.5 * np.hypot(found.sd, error)


@pytest.mark.parametrize(("sd", "level"), [(0.5, "reliable"), (0.51, "tentative"), (2.1, "unusable")])
def test_the_grade_of_an_evidence_is_that_of_its_error(sd, level):
    reported = replace(Evidence(-3.0, 0.1, (-3.0,)), sd=sd)
    assert reported.grade.level == level
    assert f"{sd:.2f} nat" in reported.grade.reason


@pytest.mark.parametrize(
    ("error", "level"), [(0.4, "reliable"), (1.0, "tentative"), (1444.0, "unusable"), (np.nan, "unusable")]
)
def test_a_log_density_is_no_better_than_its_error(error, level):
    """1016 nat with an error of 1444 says nothing, however good the draws."""
    part = Part("future", "future of the record", 0, 1, 2)
    found = Predicted(
        part, ("y",), np.zeros(1), np.array([1016.0]), error, "exact", np.nan, 400.0, np.nan, ()
    )
    assert found.grade("reliable") == level
    assert found.grade("unusable") == "unusable"
