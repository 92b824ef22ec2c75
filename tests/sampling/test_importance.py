"""Importance sampling: closed forms, quadrature, the ensembles, and what it must not call good."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from scipy.special import logsumexp
from small import Toy, problem, record, same_quantiles

from lcopa_bayes.inference.optimum import Optimum, find_optima
from lcopa_bayes.results.fit import plan_of
from lcopa_bayes.sampling.aroundoptima import _PLAN
from lcopa_bayes.sampling.coordinates import Chart, charted_density
from lcopa_bayes.sampling.draws import gather, weighted_draws
from lcopa_bayes.sampling.evidence import evidence
from lcopa_bayes.sampling.importance import (
    Effort,
    Importance,
    ImportancePlan,
    importance,
)
from lcopa_bayes.sampling.sampler import sample
from lcopa_bayes.sampling.weighted import Weighted, error_of, resampled, tail_smoothed

WIDE = ("norm", {"loc": 0.0, "scale": 10.0})


def optimum(centre, sd) -> Optimum:
    """A start at a place of a toy, whose values are its coordinates."""
    centre = np.asarray(centre, dtype=float)
    return Optimum(centre, np.diag(np.square(np.broadcast_to(sd, centre.shape))), 0.0)


def looked(posterior, seed: int) -> Importance:
    """Importance sampling around the optima of a posterior."""
    rng = np.random.default_rng(seed)
    return importance(posterior, find_optima(posterior, rng, starts=6), rng)


def moments(found: Importance) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, its standard error, and covariance under the weights."""
    weights, z = np.exp(found.weighted.log_weights), found.weighted.coordinates
    mean = weights @ z
    covariance = (weights[:, None] * (z - mean)).T @ (z - mean)
    return mean, np.sqrt(np.square(weights) @ np.square(z - mean)), covariance


# -- known answers ---------------------------------------------------------------------------------


@pytest.mark.parametrize("start", [optimum([0.5, -1.0, 2.0], [1.0, 0.1, 0.4]), optimum(np.zeros(3), 2.0)])
def test_a_gaussian_has_its_moments_and_its_evidence(rng, start):
    """Also from a start several standard deviations away and of another shape."""
    root = np.array([[1.0, 0.0, 0.0], [0.15, 0.1, 0.0], [0.1, -0.3, 0.3]])
    centre, likelihood = np.array([0.5, -1.0, 2.0]), root @ root.T
    toy = Toy(
        lambda z: stats.multivariate_normal(centre, likelihood).logpdf(z).reshape(len(z)),
        {"a": WIDE, "b": WIDE, "c": WIDE},
    )
    found = importance(toy, [start], rng)
    exact = np.linalg.inv(np.linalg.inv(likelihood) + np.eye(3) / 100)
    middle = exact @ np.linalg.solve(likelihood, centre)
    mean, error, covariance = moments(found)
    assert found.good(400)
    assert np.abs((mean - middle) / error).max() < 4
    assert_allclose(covariance, exact, atol=6 * np.sqrt(np.diag(exact).max() / found.weighted.ess), rtol=0.15)
    marginal = stats.multivariate_normal(np.zeros(3), likelihood + 100 * np.eye(3)).logpdf(centre)
    assert abs(found.weighted.log_evidence - marginal) < 4 * found.weighted.log_evidence_sd < 0.1


def normal_toy(centre: float) -> Toy:
    """A normal likelihood of standard deviation 0.5 about a point of two dimensions."""
    return Toy(lambda z: stats.norm(centre, 0.5).logpdf(z).sum(axis=1), {"a": WIDE, "b": WIDE})


def test_a_proposal_learned_from_a_rough_density_gives_draws_of_the_posterior(rng):
    """One that is off by half a standard deviation: the moments are not."""
    toy, off = normal_toy(1.0), normal_toy(1.25)
    rough = partial(charted_density, off, Chart.of(toy))
    found = importance(toy, [optimum([1.0, 1.0], 0.5)], rng, rough=rough)
    mean, error, _ = moments(found)
    assert found.good(400)
    assert np.abs((mean - 100 / 100.25) / error).max() < 4
    assert (np.abs(mean - 125 / 100.25) > 8 * error).all()
    evidence_there = 2 * stats.norm(0.0, np.sqrt(100.25)).logpdf(1.0)
    assert abs(found.weighted.log_evidence - evidence_there) < 4 * found.weighted.log_evidence_sd < 0.1


def test_a_good_proposal_gives_as_many_draws_as_are_wanted(rng):
    """Also where an attempt asks for fewer; one that is not good gives no more."""
    plan = ImportancePlan((Effort(500, 1_000, 6),))
    found = importance(normal_toy(1.0), [optimum([1.0, 1.0], 0.5)], rng, plan)
    assert found.good(400)
    assert 500 < found.weighted.count <= 1_500
    far = importance(two_modes(7.0), [optimum([-3.5, 0], 1.0)], rng, ImportancePlan((Effort(300, 1, 0),)))
    assert far.weighted.count == 300


def test_a_bent_posterior_agrees_with_quadrature(rng):
    """A banana within bounds that cut one of its ends off."""

    def log_likelihood(z):
        return -0.5 * ((z[:, 0] / 0.8) ** 2 + ((z[:, 1] - 0.7 * z[:, 0] ** 2) / 0.25) ** 2)

    priors = {"a": ("uniform", {"loc": -1.5, "scale": 4.5}), "b": ("uniform", {"loc": -2.0, "scale": 8.0})}
    toy = Toy(log_likelihood, priors)
    found = importance(toy, [optimum([0.0, 0.0], [0.8, 0.25])], rng)
    axes = [np.linspace(-1.5, 3.0, 1201), np.linspace(-2.0, 6.0, 1601)]
    middles = [0.5 * (axis[1:] + axis[:-1]) for axis in axes]
    grid = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1).reshape(-1, 2)
    density = log_likelihood(grid) - np.log(4.5 * 8.0)
    cell = np.log((axes[0][1] - axes[0][0]) * (axes[1][1] - axes[1][0]))
    share = np.exp(density - logsumexp(density))
    mean, error, _ = moments(found)
    assert found.good(400)
    assert (
        abs(found.weighted.log_evidence - logsumexp(density) - cell)
        < 4 * found.weighted.log_evidence_sd
        < 0.2
    )
    assert np.abs((mean - share @ grid) / error).max() < 4


def test_it_agrees_with_the_ensembles_on_a_study():
    made = problem(
        record(camera=0.6), noise="ar1", sampler={"ensembles": 2, "walkers": 24, "target_ess": 200}
    )
    posterior = made.posterior
    found = looked(posterior, 3)
    assert found.good(400)
    look = weighted_draws(posterior, found.weighted, np.random.default_rng(4), target_ess=400)
    assert look.grade.level == "reliable"
    run = sample(posterior, plan_of(made, quick=False))
    chains = gather(posterior, run)
    assert same_quantiles(look, chains)
    weighed = evidence(posterior, run.kept()[0], chains.ess, 1)
    assert weighed is not None
    assert abs(found.weighted.log_evidence - weighed.value) < 4 * np.hypot(
        found.weighted.log_evidence_sd, weighed.sd
    )


# -- what must be seen -----------------------------------------------------------------------------


def two_modes(apart: float) -> Toy:
    """Two Gaussians of unit width and equal mass in two dimensions, `apart` standard deviations apart."""

    def log_likelihood(z):
        return np.logaddexp(*(-0.5 * ((z - [side, 0]) ** 2).sum(axis=1) for side in (-apart / 2, apart / 2)))

    return Toy(log_likelihood, {"a": WIDE, "b": WIDE})


@pytest.mark.parametrize("apart", [5.0, 7.0])
def test_a_second_mode_that_no_start_met_is_seen_or_reached(apart):
    """Given one of two equal modes: either the weights are not good, or the shares are right.

    At 12 standard deviations no draw of the proposal meets the other mode: hence several starts.
    """
    wrong = []
    for seed in range(6):
        found = importance(two_modes(apart), [optimum([-apart / 2, 0], 1.0)], np.random.default_rng(seed))
        share = np.exp(found.weighted.log_weights) @ (found.weighted.coordinates[:, 0] > 0)
        wrong.append(found.good(400) and abs(share - 0.5) > 4 * 0.5 / np.sqrt(found.weighted.ess))
    assert not any(wrong)


def test_without_adaptation_a_second_mode_shows_in_k():
    plan = ImportancePlan((Effort(4_000, 1, 0),))
    found = [
        importance(two_modes(7.0), [optimum([-3.5, 0], 1.0)], np.random.default_rng(seed), plan)
        for seed in range(4)
    ]
    assert all(one.weighted.pareto_k > 0.7 for one in found)
    assert not any(one.good(1) for one in found)


def test_two_modes_that_were_met_have_their_shares(rng):
    found = importance(two_modes(40.0), [optimum([-20, 0], 1.0), optimum([20, 0], 1.0)], rng)
    share = np.exp(found.weighted.log_weights) @ (found.weighted.coordinates[:, 0] > 0)
    assert found.modes == 2
    assert found.good(400)
    assert abs(share - 0.5) < 4 * 0.5 / np.sqrt(found.weighted.ess)


def test_where_nothing_has_a_density_nothing_is_good(rng):
    toy = Toy(lambda z: np.full(len(z), -np.inf), {"a": WIDE, "b": WIDE})
    found = importance(toy, [optimum([0.0, 0.0], 1.0)], rng)
    assert found.weighted.pareto_k == np.inf
    assert not found.good(0)
    assert found.weighted.log_evidence == -np.inf


# -- weights ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("k", [0.2, 0.5, 1.0])
def test_k_is_that_of_the_tail_of_the_weights(rng, k):
    """Weights ``u^-k``, u uniform, have a Pareto tail of shape k; of their inverses it is negative."""
    raw = -k * np.log(rng.random(20_000))
    smoothed, found = tail_smoothed(raw)
    assert abs(found - k) < 4 * (1 + k) / np.sqrt(3 * np.sqrt(raw.size))
    assert_allclose(logsumexp(smoothed), 0.0, atol=1e-9)
    assert (np.diff(smoothed[np.argsort(raw)]) >= -1e-9).all()
    assert tail_smoothed(-raw)[1] < 0


def test_weights_without_a_tail():
    equal, k = tail_smoothed(np.full(1000, 3.0))
    assert_allclose(equal, -np.log(1000))
    assert np.isnan(k)
    few = np.full(1000, -np.inf)
    few[:5] = 0.0
    assert tail_smoothed(few)[1] == np.inf


def test_resampling_takes_each_draw_as_often_as_its_weight(rng):
    weights = rng.dirichlet(np.ones(50))
    counts = np.bincount(resampled(np.log(weights), 1000, rng), minlength=50)
    assert np.abs(counts - 1000 * weights).max() < 1 + 1e-9


def test_batches_are_resampled_from_parts_of_their_own(rng):
    weights = rng.dirichlet(np.ones(52))
    zeros = np.zeros((52, 1)), np.zeros(52), np.zeros(52)
    weighted = Weighted(*zeros, np.log(weights), 0.0, 52, 0.0, 0.0, np.zeros((52, 1)), (False,))
    for k, batch in enumerate(weighted.batches(200, rng)):
        own = slice(13 * k, 13 * (k + 1))
        counts = np.bincount(batch, minlength=52)
        assert counts[own].sum() == 200
        assert np.abs(counts[own] - 200 * weights[own] / weights[own].sum()).max() < 1 + 1e-9


def test_the_same_randomness_gives_the_same_draws():
    posterior = problem(record(camera=0.6)).posterior
    one, other = (looked(posterior, 7) for _ in range(2))
    assert one is not None
    assert other is not None
    assert_array_equal(one.weighted.coordinates, other.weighted.coordinates)
    own = one.weighted
    assert own.pareto_k == other.weighted.pareto_k
    assert_allclose(posterior.log_density(own.coordinates), own.log_density, rtol=1e-9)
    assert one.good(400)
    assert not replace(one, weighted=replace(own, count=round(own.ess / 0.39))).good(400)
    assert not replace(one, weighted=replace(own, pareto_k=0.71)).good(400)


# -- a posterior with a long arm along its orders --------------------------------------------------

_BODY, _ARM = stats.norm(0.85, 0.1), stats.uniform(0.15, 0.5)
_SHARE = 0.08


def _follow(order):
    """Where the higher order, a delay and a time go along the lower order."""
    return np.stack([1.3 + 0.3 * order**4, 2.0 - np.exp(-3.0 * order), 1.0 / (0.3 + order)], axis=-1)


def armed() -> Toy:
    """Two orders and three others that follow the lower one closely; 8 % of the mass is in an arm that a
    Gaussian at the optimum does not reach."""
    unit = stats.norm()

    def log_likelihood(z):
        middle = np.logaddexp(
            np.log1p(-_SHARE) + _BODY.logpdf(z[:, 1]), np.log(_SHARE) + _ARM.logpdf(z[:, 1])
        )
        apart = (z[:, [0, 2, 3]] - _follow(z[:, 1])) / (0.03, 0.02, 0.03)
        prior = stats.norm(0.0, 10.0).logpdf(z[:, [2, 3]]).sum(axis=1)
        return middle + unit.logpdf(apart).sum(axis=1) + unit.logpdf(z[:, 4]) - prior

    order = ("uniform", {"loc": 0.0, "scale": 2.0})
    toy = Toy(log_likelihood, {"upper": order, "lower": order, "delay": WIDE, "time": WIDE, "noise": WIDE})
    toy.rows = tuple(replace(row, kind="order") if k < 2 else row for k, row in enumerate(toy.rows))
    toy.table.rows = toy.rows
    return toy


def along(at) -> Optimum:
    """A place on the ridge."""
    upper, delay, time = _follow(np.array(at))
    return optimum([upper, at, delay, time, 0.0], [0.05, 0.05, 0.05, 0.05, 1.0])


def test_the_share_of_a_long_arm_scatters_as_reported():
    """Started along it; the exact share is known in closed form."""
    toy, plan = armed(), replace(_PLAN, wanted=400.0)
    exact = (1 - _SHARE) * _BODY.cdf(0.6) + _SHARE * _ARM.cdf(0.6)
    apart = []
    for seed in range(6):
        starts = [along(at) for at in (0.85, 1.0, 0.7, 0.6, 0.45, 0.2)]
        found = importance(toy, starts, np.random.default_rng(seed), plan)
        assert found.good(400, efficient=False)
        weights = np.exp(found.weighted.log_weights)
        inside = (found.weighted.sampled[:, 1] < 0.6).astype(float)
        reported = error_of(weights, inside)
        assert reported < 0.3 * exact
        apart.append((weights @ inside - exact) / reported)
    assert np.sqrt(np.mean(np.square(apart))) < 1.4
