"""Covers and importance draws from them: closed forms, and errors that are what scatter shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from small import Toy, problem, record

from lcopa_bayes.core.parallel import workers
from lcopa_bayes.sampling import coverdraws
from lcopa_bayes.sampling.cover import Cover
from lcopa_bayes.sampling.coverdraws import cover_draws
from lcopa_bayes.sampling.draws import gather
from lcopa_bayes.sampling.evidence import evidence_of
from lcopa_bayes.sampling.sampler import Run, SamplePlan, sample
from lcopa_bayes.sampling.weighted import BATCHES, Weighted

WIDE = ("norm", {"loc": 0.0, "scale": 10.0})
SMALL, NARROW, APART = 0.06, 0.15, 8.0
"""Share and width of a second mode, and its distance from the first, whose width is one."""


def log_likelihood(z):
    wide = stats.norm(0.0, 1.0).logpdf(z).sum(axis=1)
    narrow = stats.norm(APART, NARROW).logpdf(z[:, 0]) + stats.norm(0.0, 1.0).logpdf(z[:, 1])
    return np.logaddexp(np.log(1 - SMALL) + wide, np.log(SMALL) + narrow)


TOY = Toy(log_likelihood, {"a": WIDE, "b": WIDE})


def exact_share() -> float:
    """Share of the narrow mode: both are Gaussians, multiplied by the Gaussian prior."""
    masses = []
    for share, centre, width in ((1 - SMALL, 0.0, 1.0), (SMALL, APART, NARROW)):
        masses.append(share * stats.norm(0.0, np.hypot(width, 10.0)).pdf(centre))
    return masses[1] / sum(masses)


def underfilled(rng, share: float, count: int = 4_000):
    """Where ensembles have been that agree on a wrong share of the narrow mode."""
    narrow = rng.random(count) < share
    first = np.where(narrow, APART + NARROW * rng.standard_normal(count), rng.standard_normal(count))
    return np.column_stack([first, rng.standard_normal(count)])


@pytest.mark.parametrize("share", [0.01, 0.3])
def test_shares_are_right_where_those_of_the_ensembles_are_not(share):
    """Over seeds: no bias, and the scatter is the reported error."""
    found, errors, means = [], [], []
    for seed in range(16):
        with workers(TOY) as crew:
            weighted = cover_draws(TOY, underfilled(np.random.default_rng(seed), share), 1_000, seed, crew)
        assert weighted is not None
        weights, inside = np.exp(weighted.log_weights), weighted.sampled[:, 0] > APART / 2
        found.append(weights @ inside)
        worth = weighted.share_ess(weighted.sampled[:, 0], [APART / 2])
        assert min(worth) >= 1_000
        errors.append(np.sqrt(found[-1] * (1 - found[-1]) / worth[1]))
        means.append((weights @ weighted.sampled[:, 1]) * np.sqrt(weighted.centre_ess[1]))
    assert abs(np.mean(found) - exact_share()) < 4 * np.mean(errors) / np.sqrt(len(found))
    for ratio in (np.var(found, ddof=1) / np.mean(np.square(errors)), np.mean(np.square(means))):
        low, high = stats.chi2(15).ppf([1e-3, 1 - 1e-3]) / 15
        assert low < ratio < high


def test_a_cover_counts_as_easy_only_where_its_draws_are_worth_enough():
    """The same points and cover: accepted without a least efficiency, refused above its own."""
    visited = underfilled(np.random.default_rng(3), 0.3)
    with workers(TOY) as crew:
        drawn = cover_draws(TOY, visited, 400, 3, crew, least=0.3)
        assert drawn is not None
        efficiency = drawn.ess / drawn.count
        assert cover_draws(TOY, visited, 400, 3, crew, least=1.02 * efficiency) is None


@pytest.mark.parametrize("share", [0.0, 0.05])
def test_visited_points_that_a_cover_misses_are_noticed(share):
    """A mode 30 standard deviations away, in none of the points the cover is fitted to."""

    def far(z):
        mode = stats.norm(30.0, NARROW).logpdf(z[:, 0]) + stats.norm(0.0, 1.0).logpdf(z[:, 1])
        return np.logaddexp(stats.norm(0.0, 1.0).logpdf(z).sum(axis=1), mode)

    toy, rng = Toy(far, {"a": WIDE, "b": WIDE}), np.random.default_rng(5)
    points = rng.standard_normal((4_000, 2))
    cover = Cover.fitted(toy, points, 5, 10)
    visited = points + np.where(rng.random((4_000, 1)) < share, [[30.0, 0.0]], 0.0)
    with workers(toy) as crew:
        z, density, raw = coverdraws._drawn(toy, cover, 2_000, rng, crew)
        weighted = Weighted.of(toy, z, density, raw, 2_000, smooth=False)
        assert coverdraws._misses(toy, cover, weighted, visited, crew, rng) == (share > 0)


def test_an_error_that_hangs_on_few_draws_is_taken_larger(rng):
    """Weights of so heavy a tail that hardly more than one of them makes the error."""
    z = rng.standard_normal((5_000, 2))
    raw = rng.exponential(1.2, 5_000)  # a tail of shape 1.2
    weighted = Weighted.of(TOY, z, np.zeros(5_000), raw, 5_000, smooth=False)
    by_weights = 1 / np.sum(np.exp(2 * weighted.log_weights))
    assert weighted.smallest_ess(rng) < 0.5 * by_weights


def test_the_cover_is_a_normalised_density_of_a_posterior_with_elements(rng):
    """Draws of one cover weighted by another have the mean weight one."""
    posterior = problem(record(camera=0.6), terms=2).posterior
    points = posterior.coordinates(posterior.table.draw(3_000, rng))
    points = posterior.coordinates(posterior.values(points))
    one = Cover.fitted(posterior, points, 1, 12)
    other = Cover.fitted(posterior, points[::2], 2, 6)
    assert len(one.charts) > 1
    z = one.draw(20_000, rng)
    log_one, log_other = one.log_density(z), other.log_density(z)
    kept = len(z) / 20_000  # the rest of the mass has no point of the posterior's coordinates
    ratio = np.exp(log_other - log_one) * kept
    back = other.draw(20_000, rng)
    assert abs(ratio.mean() - len(back) / 20_000) < 5 * ratio.std() / np.sqrt(ratio.size) + 0.01


def test_effective_sizes_are_those_of_equal_weights():
    rng = np.random.default_rng(2)
    z = rng.standard_normal((4_000, 2))
    weighted = Weighted.of(TOY, z, np.zeros(4_000), np.zeros(4_000), 4_000, smooth=False)
    assert weighted.ess == pytest.approx(4_000)
    assert_allclose(weighted.centre_ess, 4_000, rtol=0.1)
    assert_allclose(weighted.tail_ess, 4_000, rtol=0.25)
    assert weighted.log_evidence == pytest.approx(0.0)
    assert np.isnan(weighted.pareto_k)


@pytest.fixture(scope="module")
def weighted_run(tmp_path_factory) -> tuple[Run, object]:
    made = problem(record(camera=0.3))
    plan = SamplePlan.of(made.posterior.dimension, seed=4, ensembles=2, walkers=32, method="auto")
    path = tmp_path_factory.mktemp("run") / "chain.h5"
    run = sample(made.posterior, plan, chain_file=path, fingerprint="it")
    return run, (made.posterior, plan, path)


def test_a_study_is_sampled_by_importance_draws_that_agree_with_its_ensembles(weighted_run):
    run, (posterior, plan, _) = weighted_run
    assert run.weighted is not None
    draws = gather(posterior, run)
    assert draws.sampling_grade.level == "reliable"
    assert all(quality.ess >= plan.target_ess for quality in draws.qualities)
    chains = gather(posterior, replace(run, weighted=None))
    for name in (row.name for row in draws.table.rows if row.free):
        ours, theirs = draws.column(name), chains.column(name)
        error = ours.std() * np.hypot(*(one.ess**-0.5 for one in (draws, chains)))
        assert abs(ours.mean() - theirs.mean()) < 4.5 * error
    weighed = [evidence_of(posterior, one, chains.ess) for one in (run, replace(run, weighted=None))]
    assert abs(weighed[0].value - weighed[1].value) < 4.5 * np.hypot(weighed[0].sd, weighed[1].sd)
    assert len(weighed[0].by_ensemble) == BATCHES


def test_a_finished_run_resumes_to_the_same_importance_draws(weighted_run):
    run, (posterior, plan, path) = weighted_run
    again = sample(posterior, plan, chain_file=path, fingerprint="it", resume=True)
    assert again.weighted is not None
    assert_array_equal(again.weighted.coordinates, run.weighted.coordinates)
    assert_array_equal(again.kept()[0], run.kept()[0])


def test_ensembles_alone_where_the_plan_says_so(weighted_run):
    _, (posterior, plan, _) = weighted_run
    assert sample(posterior, replace(plan, method="ensembles", steps=100)).weighted is None
