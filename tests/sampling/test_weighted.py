"""Importance draws as a result: effective sizes, agreement with ensembles, resuming."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from scipy.special import logsumexp
from small import Toy, problem, record

from lcopa_bayes.sampling.draws import gather
from lcopa_bayes.sampling.evidence import evidence_of
from lcopa_bayes.sampling.run import SURPLUS, Run, SamplePlan
from lcopa_bayes.sampling.sampler import sample
from lcopa_bayes.sampling.weighted import BATCHES, Weighted

WIDE = ("norm", {"loc": 0.0, "scale": 10.0})
TOY = Toy(lambda z: stats.norm(0.0, 1.0).logpdf(z).sum(axis=1), {"a": WIDE, "b": WIDE})


def test_an_error_that_hangs_on_few_draws_is_taken_larger(rng):
    """Weights of so heavy a tail that hardly more than one of them makes the error."""
    z = rng.standard_normal((5_000, 2))
    raw = rng.exponential(1.2, 5_000)  # a tail of shape 1.2
    weighted = Weighted.of(TOY, z, np.zeros(5_000), raw, 5_000, smooth=False)
    by_weights = 1 / np.sum(np.exp(2 * weighted.log_weights))
    assert weighted.smallest_ess < 0.5 * by_weights


def test_effective_sizes_are_those_of_equal_weights():
    rng = np.random.default_rng(2)
    z = rng.standard_normal((4_000, 2))
    weighted = Weighted.of(TOY, z, np.zeros(4_000), np.zeros(4_000), 4_000, smooth=False)
    assert weighted.ess == pytest.approx(4_000)
    assert_allclose(weighted.centre_ess, 4_000, rtol=0.1)
    assert_allclose(weighted.tail_ess, 4_000, rtol=0.25)
    assert weighted.log_evidence == pytest.approx(0.0)
    assert np.isnan(weighted.pareto_k)


def test_where_one_draw_has_all_the_weight_there_is_one(rng):
    """Not infinitely many, though nothing varies among those that count."""
    z, raw = rng.standard_normal((500, 2)), np.zeros(500)
    raw[7] = 1e4
    weighted = Weighted.of(TOY, z, np.zeros(500), raw, 500, smooth=False)
    assert_allclose([weighted.centre_ess, weighted.tail_ess], 1.0)


CENTRES, SHARES = np.array([0.0, 7.0, -8.0]), np.array([0.88, 0.09, 0.03])


def three_modes(seed: int, count: int = 6_000) -> Weighted:
    """Draws of a wide normal, weighted as of three narrow modes of `a` and one of `b`."""
    rng, wide = np.random.default_rng(seed), stats.norm(0.0, [6.0, 1.5])
    z = wide.rvs((count, 2), random_state=rng)
    parts = stats.norm(CENTRES, 1.0).logpdf(z[:, :1]) + np.log(SHARES)
    density = logsumexp(parts, axis=1) + stats.norm(0.0, 1.0).logpdf(z[:, 1])
    return Weighted.of(TOY, z, density, density - wide.logpdf(z).sum(axis=1), count, smooth=False)


def test_draws_that_suffice_a_search_are_graded_reliable():
    """Modes and effective sizes are the same to the search that stops and to the grade, whichever draws are
    taken for delivery and however their parts scatter."""
    for seed in range(12):
        weighted = three_modes(seed)
        plan = SamplePlan.of(2, seed=seed, target_ess=weighted.smallest_ess / SURPLUS)
        draws = gather(TOY, Run((), plan, weighted))
        assert draws.sampling_grade.level == "reliable"
        assert plan.target_ess < draws.ess < weighted.smallest_ess
        assert [len(modes.boundaries) for modes in draws.modes] == [2]


@pytest.mark.parametrize("count", [400, *(pytest.param(n, marks=pytest.mark.slow) for n in (100, 3_000))])
def test_resampling_adds_the_variance_that_is_stated(count):
    """Means of resampled draws about the weighted mean, over 150 sets of draws, whose order decides."""
    rng, stated, errors = np.random.default_rng(1), [], []
    for seed in range(150):
        weighted = three_modes(seed, 1_600)
        own, logs = weighted.coordinates[:, 1], weighted.log_weights
        shares = [np.exp(logs[part] - logsumexp(logs[part])) for part in weighted.parts]
        means = [share @ own[part] for share, part in zip(shares, weighted.parts, strict=True)]
        variance = np.exp(logs) @ (own - np.mean(means)) ** 2
        stated.append(float(weighted.resampling_variance(own[:, None], count)[0] * variance))
        errors += [own[weighted.batches(count, rng)].mean() - np.mean(means) for _ in range(4)]
    assert np.mean(np.square(errors)) == pytest.approx(np.mean(stated), rel=4 * np.sqrt(2 / 150))
    assert stated[0] < variance / (4 * count)


def test_shares_of_modes_scatter_as_their_errors_say():
    found, errors, edges = [], [], (-4.0, 3.5)
    for seed in range(120):
        weighted = three_modes(seed)
        vars(weighted)["boundaries"] = (edges, ())
        draws = gather(TOY, Run((), SamplePlan.of(2, seed=seed), weighted))
        (modes,) = draws.modes
        assert modes.shares.shape == (1, 3)
        delivered = np.searchsorted(edges, draws.column("a"))
        found.append([np.mean(delivered == k) for k in range(3)])
        errors.append(modes.pooled_errors)
    exact = [SHARES[2], SHARES[0], SHARES[1]]
    apart = (np.array(found) - exact) / np.array(errors)
    assert np.abs(apart.mean(axis=0)).max() < 4 / np.sqrt(120)
    low, high = stats.chi2(120).ppf([1e-4, 1 - 1e-4]) / 120
    scatter = np.mean(apart**2, axis=0)
    assert (scatter < high).all()
    assert (scatter > 0.7 * low).all()  # errors that hang on few draws are taken a little larger


@pytest.fixture(scope="module")
def weighted_run(tmp_path_factory) -> tuple[Run, object]:
    made = problem(record(camera=0.3))
    plan = SamplePlan.of(made.posterior.dimension, seed=4, ensembles=2, walkers=32, method="auto")
    path = tmp_path_factory.mktemp("run") / "chain.h5"
    run = sample(made.posterior, plan, chain_file=path, fingerprint="it")
    return run, (made.posterior, plan, path)


@pytest.mark.slow
def test_a_study_is_sampled_by_importance_draws_that_agree_with_its_ensembles(weighted_run):
    run, (posterior, plan, _) = weighted_run
    assert run.weighted is not None
    assert run.ensembles == ()
    draws = gather(posterior, run)
    assert draws.sampling_grade.level == "reliable"
    assert all(quality.ess >= plan.target_ess for quality in draws.qualities)
    alone = sample(posterior, replace(plan, method="ensembles"))
    assert alone.weighted is None
    chains = gather(posterior, alone)
    for name in (row.name for row in draws.table.rows if row.free):
        ours, theirs = draws.column(name), chains.column(name)
        error = ours.std() * np.hypot(*(one.ess**-0.5 for one in (draws, chains)))
        assert abs(ours.mean() - theirs.mean()) < 4.5 * error
        assert abs(np.log(ours.std() / theirs.std())) < 4.5 * error / ours.std()
    weighed = [evidence_of(posterior, one, chains.ess) for one in (run, alone)]
    assert abs(weighed[0].value - weighed[1].value) < 4.5 * np.hypot(weighed[0].sd, weighed[1].sd)
    assert len(weighed[0].by_ensemble) == BATCHES


def test_a_finished_run_resumes_to_the_same_importance_draws(weighted_run):
    run, (posterior, plan, path) = weighted_run
    again = sample(posterior, plan, chain_file=path, fingerprint="it", resume=True)
    assert again.weighted is not None
    assert_array_equal(again.weighted.coordinates, run.weighted.coordinates)
    assert_array_equal(again.kept()[0], run.kept()[0])


def test_importance_draws_do_not_depend_on_the_number_of_processes(weighted_run):
    run, (posterior, plan, _) = weighted_run
    again = sample(posterior, plan, jobs=2)
    assert_array_equal(again.weighted.coordinates, run.weighted.coordinates)
    assert_array_equal(again.weighted.log_weights, run.weighted.log_weights)
