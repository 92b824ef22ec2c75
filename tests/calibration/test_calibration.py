"""Calibration: exact rank statistics, what a replica simulates, the same numbers however they are made."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import replace
from importlib.util import module_from_spec, spec_from_file_location
from itertools import product
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from small import ONE, TRUTH, TWO, check_page, problem, record, row_values, same_quantiles, study

from lcopa_bayes.bench.command import on_off
from lcopa_bayes.bench.inversion import step_response
from lcopa_bayes.calibration.calibrate import Calibration, Store, calibrate
from lcopa_bayes.calibration.ranks import Coverage, bin_limits, corridor, p_uniform, rank_of
from lcopa_bayes.calibration.replica import (
    ENGINES,
    RANKED,
    Failure,
    Outcome,
    Replication,
    command_of,
    device_of,
    exact_responses,
    holds,
    measured,
    model_gap,
)
from lcopa_bayes.calibration.truths import Truths, truths_around, truths_stated
from lcopa_bayes.cli import main
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.record import Record, save_record
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.results.discretisation import resolved
from lcopa_bayes.results.fit import Fit, fit, plan_of
from lcopa_bayes.verbs.calibrate import results


@pytest.fixture(scope="module")
def defaults() -> ModuleType:
    """The study of the default settings."""
    path = Path(__file__).parents[2] / "studies" / "calibration" / "defaults.py"
    spec = spec_from_file_location("calibration_defaults", path)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


PRIORS = {
    "gain": ("norm", {"loc": 2.0, "scale": 0.5}),
    "time_1": ("loguniform", {"a": 1.0, "b": 3.0}),
    "order_1": TRUTH["order_1"],
    "delay": TRUTH["delay"],
    "sigma": ("loguniform", {"a": 0.05, "b": 0.2}),
}
FIXED = {name: TRUTH[name] for name in ("order_1", "delay")}
BRIEF = {"ensembles": 2, "walkers": 6, "steps": 40, "thin": 1}
STUDY = study(record(camera=0.6), noise="white", priors=PRIORS, sampler=BRIEF)
"""A fit too short to be graded reliable, for what does not depend on that."""


def replication(of=STUDY) -> Replication:
    made = problem_of(of)
    return Replication(made, plan_of(made, quick=False), Truths(made.posterior.table))


def same(a: Calibration, b: Calibration) -> None:
    """All but the time they took."""
    assert [replace(o, seconds=0.0) for o in a.outcomes] == [replace(o, seconds=0.0) for o in b.outcomes]
    assert a.failures == b.failures


@pytest.fixture(scope="module")
def alone() -> Calibration:
    return calibrate(STUDY, replicas=3)


# -- rank statistics -------------------------------------------------------------------------------


def by_enumeration(counts: list[int]) -> float:
    """p-value from every way ranks can fall."""
    values, replicas = len(counts), sum(counts)
    share = np.arange(1, values) / values

    def least_likely(ranks) -> float:
        below = [sum(r < i for r in ranks) for i in range(1, values)]
        low, high = (
            stats.binom.cdf(below, replicas, share),
            stats.binom.sf(np.array(below) - 1, replicas, share),
        )
        return float(np.minimum(low, high).min())

    seen = least_likely(np.repeat(np.arange(values), counts))
    every = [least_likely(ranks) for ranks in product(range(values), repeat=replicas)]
    return float(np.mean([value <= seen * (1 + 1e-9) for value in every]))


@pytest.mark.parametrize("counts", [[5, 0, 0], [2, 1, 2], [0, 4, 0, 1], [1, 1, 2, 0, 0], [3, 0, 0, 2]])
def test_p_of_uniform_ranks_is_exact(counts):
    assert_allclose(p_uniform(np.array(counts)), by_enumeration(counts), rtol=1e-10)


@given(st.lists(st.integers(0, 5), min_size=2, max_size=12).filter(any))
def test_p_does_not_change_when_ranks_are_turned_round(counts):
    p = p_uniform(np.array(counts))
    assert 0 < p <= 1
    assert_allclose(p_uniform(np.array(counts[::-1])), p, rtol=1e-8)


def test_small_p_values_keep_their_digits():
    counts = np.zeros(100, dtype=int)
    counts[0] = 40  # below no other value can so many be so unlikely: every rank is the lowest
    assert_allclose(p_uniform(counts), 2 * 0.01**40, rtol=1e-6)


def test_no_ranks_say_nothing():
    assert p_uniform(np.zeros(100, dtype=int)) == 1.0


def test_p_is_as_often_small_as_it_says(rng):
    found = [p_uniform(np.bincount(rng.integers(0, 10, 40), minlength=10)) for _ in range(400)]
    for level in (0.05, 0.2, 0.5):
        assert abs(np.mean(np.array(found) <= level) - level) < 4 * np.sqrt(level * (1 - level) / 400) + 0.02


@pytest.mark.parametrize(("replicas", "values"), [(30, 10), (200, 100)])
def test_the_corridor_holds_all_of_uniform_ranks_together(rng, replicas, values):
    lower, upper = corridor(replicas, values, 0.9)
    ranks = rng.integers(0, values, (4000, replicas))
    below = np.array([(ranks < i).sum(axis=1) for i in range(1, values)]).T
    share = np.mean(((below >= lower) & (below <= upper)).all(axis=1))
    assert share > 0.9 - 4 * np.sqrt(0.09 / 4000)
    assert share < 0.95  # discrete, but not needlessly wide


def test_bins_of_uniform_ranks_lie_within_their_limits(rng):
    low, high = bin_limits(200, 20)
    counts = rng.multinomial(200, np.full(20, 0.05), size=4000)
    share = np.mean(((counts >= low) & (counts <= high)).all(axis=1))
    assert 0.95 - 4 * np.sqrt(0.05 * 0.95 / 4000) < share < 0.995


def conjugate(rng, *, replicas: int = 200, shift: float = 0.0, widen: float = 1.0) -> tuple[float, float]:
    """Overall p and 90 % coverage of a normal mean with a normal prior, its posterior known exactly."""
    ranks, inside = [], 0
    for _ in range(replicas):
        truth = rng.normal()
        centre, sd = 0.5 * (truth + rng.normal()), np.sqrt(0.5)
        draws = centre + shift + widen * sd * rng.normal(size=2000)
        ranks.append(rank_of(truth, draws[:99], rng))
        inside += holds(draws, truth, 0.9)
    return p_uniform(np.bincount(ranks, minlength=100)), inside / replicas


def test_an_exact_posterior_passes(rng):
    p, covered = conjugate(rng)
    assert p > 0.01
    assert abs(covered - 0.9) < 4 * np.sqrt(0.09 / 200)


@pytest.mark.parametrize(
    "error", [{"shift": 0.35}, {"shift": -0.35}, {"widen": 0.6}, {"widen": 1.8}], ids=str
)
def test_a_biased_too_narrow_or_too_wide_posterior_fails(rng, error):
    p, covered = conjugate(rng, **error)
    assert p < 1e-3
    if "widen" in error:
        band = Coverage("x", "parameter", 0.9, round(200 * covered), 200, 0.99)
        assert not band.holds
        assert (band.observed < 0.9) == (error["widen"] < 1)


def test_ties_are_broken_at_random(rng):
    draws = np.array([0.0, 1.0, 1.0, 1.0, 2.0])
    ranks = [rank_of(1.0, draws, rng) for _ in range(4000)]
    counts = np.bincount(ranks, minlength=6)
    assert counts[0] == counts[5] == 0
    assert np.abs(counts[1:5] - 1000).max() < 4 * np.sqrt(1000 * 0.75)
    assert rank_of(-1.0, draws, rng) == 0
    assert rank_of(3.0, draws, rng) == 5


# -- coverage --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("hits", "of"), [(0, 10), (9, 10), (10, 10), (171, 200)])
def test_the_band_is_clopper_and_pearsons(hits, of):
    row = Coverage("x", "parameter", 0.9, hits, of, 0.95)
    exact = stats.binomtest(hits, of).proportion_ci(0.95, method="exact")
    assert_allclose([row.lower, row.upper], [exact.low, exact.high], rtol=1e-10, atol=1e-15)
    if hits:  # at its lower end so many hits or more have just the probability of one tail
        assert_allclose(stats.binom.sf(hits - 1, of, row.lower), 0.025, rtol=1e-9)
    assert row.holds == (row.lower <= 0.9 <= row.upper)
    assert row.as_json()["observed"] == hits / of


def test_the_band_holds_the_true_coverage_as_often_as_it_says():
    n, level = 60, 0.9
    inside = sum(
        stats.binom.pmf(h, n, level) for h in range(n + 1) if Coverage("x", "", level, h, n, 0.95).holds
    )
    assert 0.95 <= inside < 0.99


# -- simulated records -----------------------------------------------------------------------------


def test_the_truth_on_the_bench_is_the_bundled_device():
    made = problem(record(), noise="white")
    truth = row_values(made.posterior.table, TRUTH)
    assert device_of(made.posterior.table, truth, 0, time_unit="ms").paths[0][0].gain == TRUTH["gain"]
    clean = record(noise_sd=0.0)
    taken = ~np.isnan(clean.response[:, 0])
    assert_allclose(exact_responses(made, truth)[0], clean.response[taken], atol=1e-8)
    assert model_gap(made, truth, exact_responses(made, truth)) < 0.5


def test_two_axes_rests_exposure_and_missing_cells_are_kept():
    reported = record(device=TWO, noise_sd=0.0)
    holes = np.array(reported.response)
    holes[3:9, 0] = np.nan
    holes[20, :] = np.nan
    holed = Record(
        "holed", reported.time, reported.drive, holes, reported.drive_axes, reported.response_axes, "ms"
    )
    made = problem(reported, holed, noise="ar1", terms={"direct": 2, "cross": 1}, exposure_ms=0.1)
    table = made.posterior.table
    truth = table.draw(1, np.random.default_rng(4))[0]
    exact = exact_responses(made, truth)
    device = device_of(table, truth, 1, time_unit="ms")
    command = on_off((1.0, 0.6), hold=5.0, at=0.35, rest=(0.0, 0.2))
    assert_array_equal(command_of(reported).times, command.times)
    assert_array_equal(command_of(reported).values, command.values)
    times = made.posterior.samples[1].times
    assert_allclose(exact[1], device.response(command, times, exposure=0.1), rtol=1e-12)
    assert exact[0].std() > 0
    rng, seen = np.random.default_rng(1), made.posterior.samples
    again = [measured(made, truth, one, clean, rng) for one, clean in zip(seen, exact, strict=True)]
    for old, new in zip((reported, holed), again, strict=True):
        assert_array_equal(np.isnan(old.response), np.isnan(new.response))
        assert_array_equal(old.drive, new.drive)
        assert_array_equal(old.time, new.time)
    assert np.nanmax(np.abs(again[0].response - again[1].response)) > 0


def test_noise_has_the_strength_and_correlation_of_the_truth():
    made = problem(record(duration=600.0), noise="ar1")
    table = made.posterior.table
    truth = row_values(table, TRUTH | {"rho": 0.6})
    exact = exact_responses(made, truth)
    (seen,) = made.posterior.samples
    noisy = measured(made, truth, seen, exact[0], np.random.default_rng(2)).response
    noise = noisy[~np.isnan(noisy)] - exact[0][:, 0]
    assert_allclose(noise.std(), TRUTH["sigma"], rtol=0.1)
    assert_allclose(np.corrcoef(noise[1:], noise[:-1])[0, 1], 0.6, atol=0.06)


def test_terms_of_one_order_become_one():
    made = problem(record(), terms=2, orders=(1.0, 1.0))
    table = made.posterior.table
    truth = table.draw(1, np.random.default_rng(4))[0]
    path = device_of(table, truth, 0, time_unit="ms").paths[0][0]
    times = truth[[table.at("time", 0, 0), table.at("time", 0, 1)]]
    assert path.orders == (1.0,)
    assert_allclose(path.etas, [times.sum()], rtol=1e-14)


# -- replicas --------------------------------------------------------------------------------------


def test_priors_stay_the_studys_own(monkeypatch):
    """Defaults derived from the records must not be derived anew from the simulated ones."""
    from lcopa_bayes.calibration import replica

    seen = []
    monkeypatch.setattr(replica, "sample", lambda posterior, plan: seen.append((posterior, plan)) or 1 / 0)
    made = replace(replication(study(record(camera=0.6), noise="white", sampler=BRIEF)), engine="sampling")
    for number in (0, 1):
        assert isinstance(made.attempt(number), Failure)
    (first, plan), (second, other) = seen
    own = made.problem.posterior
    assert first.table is second.table is own.table
    values = [posterior.samples[0].axes[0].values for posterior in (own, first, second)]
    assert not np.isin(values[1], values[0]).any()
    assert not np.isin(values[1], values[2]).any()
    assert plan.seed == made.seed_of(0) != other.seed == made.seed_of(1)
    assert plan == replace(made.plan, seed=plan.seed)


def test_a_replica_that_was_lost_with_its_worker_says_so():
    made = replication(STUDY)
    failure = made.lost(3, RuntimeError("all 4 workers died. Inspect the logs."))
    assert (failure.replica, failure.seed) == (3, made.seed_of(3))
    assert failure.error == "its worker was lost, perhaps for want of memory (all 4 workers died)"


def test_a_replica_ranks_everything(alone):
    quantities, table = alone.replication.quantities, alone.replication.problem.posterior.table
    names = [quantity.name for quantity in quantities]
    assert names[:4] == ["gain", "time_1", "offset", "sigma"]
    assert [q.kind for q in quantities[4:]] == ["step response"] * 4 + ["log likelihood"]
    assert quantities[4].unit == "rad/V"
    for outcome in alone.outcomes:
        assert len(outcome.truths) == len(outcome.ranks) == len(outcome.inside) == len(quantities)
        assert all(0 <= rank <= RANKED for rank in outcome.ranks)
        assert all(inner <= outer for inner, outer in outcome.inside)
        truth = row_values(table, dict(zip(names, outcome.truths, strict=False)) | FIXED)
        path = device_of(table, truth, 0, time_unit="ms").paths[0][0]
        assert_allclose(outcome.truths[4:8], step_response(path, alone.replication.step_times), rtol=2e-3)
    assert len({outcome.truths for outcome in alone.outcomes}) == 3


def test_step_responses_are_looked_at_after_every_delay():
    made = replication(study(record(camera=0.6)))  # default delay: uniform over 0.4 of the span
    span = made.problem.scales.span
    assert (made.step_times > 0.4 * 0.999 * span).all()
    assert made.step_times[-1] == pytest.approx(span)
    assert (np.diff(made.step_times) > 0).all()


def test_a_replica_that_fails_is_reported(monkeypatch, alone):

    def poor(self, number):
        if number == 1:
            raise ArithmeticError("two contours differ")
        return alone.outcomes[number]

    monkeypatch.setattr(Replication, "__call__", poor)
    made = calibrate(STUDY, replicas=3)
    seed = made.replication.seed_of(1)
    assert made.failures == (Failure(1, seed, "ArithmeticError: two contours differ"),)
    assert [o.replica for o in made.outcomes] == [0, 2]
    assert made.outcomes[0].ranks == alone.outcomes[0].ranks
    reported = results(made)
    assert reported["replicas"] == 2
    assert reported["asked"] == 3
    assert reported["grades"]["failed"] == 1
    assert reported["failures"] == [
        {"replica": 1, "seed": seed, "error": "ArithmeticError: two contours differ"}
    ]
    assert f"number 1 (seed {seed}): ArithmeticError: two contours differ" in reported["verdict"]

    def dead(self, number):
        raise ArithmeticError("nothing works")

    monkeypatch.setattr(Replication, "__call__", dead)
    with pytest.raises(InputError, match="not one of 2 replicas"):
        calibrate(STUDY, replicas=2)


# -- engines ---------------------------------------------------------------------------------------


def test_both_engines_give_a_replica_the_same_posterior():
    few = {"ensembles": 2, "walkers": 16, "target_ess": 150}
    known = {"order_1": TRUTH["order_1"]}
    reported = study(record(camera=0.6), noise="white", sampler=few, priors=known)
    found = {}
    for engine in ENGINES:
        made = replace(replication(reported), engine=engine)
        seed = made.seed_of(0)
        truth = made.truths.draw(np.random.default_rng(1))
        truth[made.problem.posterior.table.of_kind("sigma")] = 0.02
        noise = np.random.default_rng(2)
        (seen,), (exact,) = made.problem.posterior.samples, exact_responses(made.problem, truth)
        samples = (Samples.of(measured(made.problem, truth, seen, exact, noise), made.problem.scales.period),)
        again = replace(made.problem, posterior=replace(made.problem.posterior, samples=samples))
        _, draws, used, k = made._inferred(again, seed, np.random.default_rng(3))
        assert used == engine
        assert (k is not None) == (engine == "importance")
        assert draws.grade.level == "reliable"
        found[engine] = draws
    assert same_quantiles(found["importance"], found["sampling"])


@pytest.mark.slow
def test_weights_that_are_not_good_lead_to_the_ensembles(alone, monkeypatch):
    assert results(alone)["engine"]["importance"] == 3
    monkeypatch.setattr("lcopa_bayes.sampling.importance.LEAST_EFFICIENCY", 9.0)
    made = calibrate(STUDY, replicas=1)
    counted = results(made)["engine"]
    assert (counted["wanted"], counted["importance"], counted["sampling"]) == ("importance", 0, 1)
    assert all(outcome.pareto_k is not None for outcome in made.outcomes)
    forced = calibrate(STUDY, replicas=1, engine="sampling")
    assert [replace(o, seconds=0.0, pareto_k=None) for o in made.outcomes] == [
        replace(o, seconds=0.0) for o in forced.outcomes
    ]
    assert results(forced)["engine"]["largest_k"] is None


# -- a stated truth --------------------------------------------------------------------------------


STATED = {"gain": 2.1, "time_1": 1.4, "offset": 0.3, "sigma": 0.1}


def test_a_stated_truth_is_the_same_in_every_replica():
    made = calibrate(STUDY, replicas=2, truth=STATED)
    names = [quantity.name for quantity in made.replication.quantities]
    for outcome in made.outcomes:
        assert {name: outcome.truths[names.index(name)] for name in STATED} == STATED
    assert len({outcome.ranks for outcome in made.outcomes}) == 2  # the noise differs
    reported = results(made)
    assert reported["truths"] == {"from": "stated", "folder": None, "grade": None, "stated": STATED}
    assert "The truth was stated" in reported["verdict"]
    assert "Ranks are" not in reported["verdict"]
    json.dumps(reported, allow_nan=False)


def test_default_priors_of_a_stated_truth_are_those_of_its_own_records():
    """As a fit derives them; where truths are drawn from the prior, the prior stays."""
    reported = study(record(camera=0.6), noise="white")
    made = replication(reported)
    records = (record(7, camera=0.6, noise_sd=0.2),)
    assert made._measured_again(records).posterior.table is made.problem.posterior.table
    stated = replace(made, truths=truths_stated(TRUTH, made.problem.posterior.table))
    again = stated._measured_again(records).posterior.table
    assert str(again.rows[0].prior) != str(made.problem.posterior.table.rows[0].prior)
    assert again.rows == problem_of(study(*records, noise="white")).posterior.table.rows


def test_what_the_width_of_the_blocks_does_is_counted(monkeypatch):
    """Wide blocks that may not be narrowed: the shift is measured, lowers the grade, and both are counted."""
    monkeypatch.setattr("lcopa_bayes.results.discretisation.FINEST", 1)
    priors = PRIORS | {"order_1": ("uniform", {"loc": 0.2, "scale": 1.0})}
    clean = record(camera=0.6, noise_sd=1e-4)
    coarse = study(clean, noise="white", priors=priors | {"sigma": 1e-4}, blocks=4)
    truth = {name: TRUTH[name] for name in ("gain", "time_1", "order_1", "offset")}
    made = calibrate(coarse, replicas=1, truth=truth)
    (outcome,) = made.outcomes
    reported = results(made)
    assert outcome.shift > 0.2
    assert not outcome.resolved
    assert outcome.grade != "reliable"
    assert reported["discretisation"]["negligible"] == 0
    assert reported["discretisation"]["largest"] == outcome.shift


@pytest.mark.parametrize("delay", [1.0, 1.07])
@pytest.mark.parametrize("order", [0.6, 0.9, 1.8])
def test_the_model_is_as_exact_as_the_noise_allows(defaults, order, delay):
    """On blocks as a fit chooses them, at a noise of 0.2 % of the step, also with an onset on a sample.

    A parabola through the three blocks around the onset was 9.7 noise standard deviations off at order 0.9.
    """
    cell = defaults.Cell(0.002, delay, (3.4,), (order,), "white")
    made = resolved(problem_of(cell.study(1)))
    truth = truths_stated(cell.truth, made.posterior.table).draw(np.random.default_rng(0))
    assert model_gap(made, truth, exact_responses(made, truth)) < 0.5


def test_where_the_likelihood_has_an_edge_the_posterior_is_that_of_the_bench(defaults):
    """Order 0.6, response beginning on a sample: delays just shorter are excluded by that sample, and 90 %
    intervals hold the delay in a fifth of the replicas. Draws weighted by the bench's own response agree:
    it is the problem that is so, not the numerics.
    """
    cell = defaults.Cell(0.002, 1.0, (3.4,), (0.6,), "white")
    made = replication(cell.study(11))
    made = replace(made, truths=truths_stated(cell.truth, made.problem.posterior.table))
    truth = made.truths.draw(np.random.default_rng(0))
    (seen,), (clean,) = made.problem.posterior.samples, exact_responses(made.problem, truth)
    records = (measured(made.problem, truth, seen, clean, np.random.default_rng(1)),)
    again, draws, _, _ = made._inferred(made._measured_again(records), 1, np.random.default_rng(2))
    values, (observed,) = draws.thinned(150), again.posterior.samples[0].axes
    exact = np.array([exact_responses(again, row)[0][observed.index, 0] for row in values])
    sigma = values[:, [again.posterior.table.at("sigma", 0)]]
    change = stats.norm.logpdf(observed.values, exact, sigma).sum(axis=1)
    change -= again.posterior.pointwise(values)[0][0].sum(axis=1)
    weights = np.exp(change - change.max()) / np.exp(change - change.max()).sum()
    assert 1 / (weights @ weights) > 0.9 * len(values)
    shifts = (weights @ values - values.mean(axis=0)) / values.std(axis=0).clip(1e-12)
    assert np.abs(shifts).max() < 0.15
    delays = values[:, again.posterior.table.at("delay", 0)]
    assert np.mean(delays > 0.9995) > 0.9


def test_what_is_not_stated_is_drawn_from_the_prior():
    made = calibrate(STUDY, replicas=2, truth={"time_1": 1.4})
    at = [quantity.name for quantity in made.replication.quantities].index("time_1")
    assert [outcome.truths[at] for outcome in made.outcomes] == [1.4, 1.4]
    assert made.outcomes[0].truths[0] != made.outcomes[1].truths[0]
    assert results(made)["truths"]["from"] == "stated and prior"


def test_a_stated_range_is_drawn_evenly():
    table = problem(record()).posterior.table
    truths = truths_stated(TRUTH | {"delay": (0.6, 0.8)}, table)
    assert truths.fixed
    rng = np.random.default_rng(0)
    drawn = np.array([truths.draw(rng) for _ in range(400)])
    delays = drawn[:, table.at("delay", 0)]
    assert stats.kstest(delays, "uniform", args=(0.6, 0.2)).pvalue > 1e-3
    assert np.ptp(drawn[:, table.at("gain", 0, 0)]) == 0.0
    with pytest.raises(InputError, match="excluded by the prior"):
        truths_stated(TRUTH | {"delay": (-0.1, 0.8)}, table)


def test_a_stated_order_keeps_the_terms_in_their_order():
    table = problem(record(), terms=2).posterior.table
    truths = truths_stated({"order_1": 1.0}, table)
    drawn = np.array([truths.draw(np.random.default_rng(seed)) for seed in range(20)])
    assert (drawn[:, table.at("order", 0, 0)] == 1.0).all()
    assert (drawn[:, table.at("order", 0, 1)] < 1.0).all()
    with pytest.raises(InputError, match="state the orders and times of all terms"):
        truths_stated({"order_1": 0.5, "order_2": 0.9}, table)


@pytest.mark.parametrize(
    ("truth", "said"),
    [
        ({"delay": 1.0}, "'delay' is stated, but this study does not infer it"),
        ({"gian": 1.0}, "gain"),
        ({"time_1": 9.0}, "time_1 = 9.0 is excluded by the prior"),
    ],
)
def test_a_truth_that_cannot_be_is_refused(truth, said):
    with pytest.raises(InputError, match=said):
        calibrate(STUDY, replicas=1, truth=truth)


def test_a_store_of_another_truth_or_engine_is_refused(tmp_path):
    calibrate(STUDY, replicas=1, folder=tmp_path, truth=STATED)
    for options in ({}, {"truth": STATED | {"gain": 2.2}}, {"truth": STATED, "engine": "sampling"}):
        with pytest.raises(InputError, match="of other records"):
            calibrate(STUDY, replicas=1, folder=tmp_path, resume=True, **options)


# -- the same numbers however they are made --------------------------------------------------------


def test_two_processes_give_the_same_numbers(alone):
    same(alone, calibrate(STUDY, replicas=3, jobs=2))


def test_more_replicas_begin_with_the_same(alone):
    fewer = calibrate(STUDY, replicas=1)
    assert replace(fewer.outcomes[0], seconds=0.0) == replace(alone.outcomes[0], seconds=0.0)


@pytest.fixture
def address() -> Iterator[str]:
    """Scheduler of a cluster of two worker processes."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0", memory_limit=0
    ) as cluster:
        yield cluster.scheduler_address


@pytest.mark.slow
def test_a_dask_cluster_gives_the_same_numbers(alone, address, tmp_path):
    same(alone, calibrate(STUDY, replicas=3, dask=address, folder=tmp_path))
    assert len(list((tmp_path / "replicas").iterdir())) == 3
    same(alone, calibrate(STUDY, replicas=3, folder=tmp_path, resume=True))


def test_stored_replicas_are_not_done_again(alone, tmp_path, monkeypatch):
    store = Store.within(tmp_path, alone.replication)
    for outcome in alone.outcomes:
        store.save(outcome)
    (tmp_path / "replicas" / "00001.json").unlink()
    done = []
    real = Replication.__call__
    monkeypatch.setattr(Replication, "__call__", lambda self, k: done.append(k) or real(self, k))
    same(alone, calibrate(STUDY, replicas=3, folder=tmp_path, resume=True))
    assert done == [1]
    calibrate(STUDY, replicas=1, folder=tmp_path)
    assert done == [1, 0]
    assert [path.name for path in (tmp_path / "replicas").iterdir()] == ["00000.json"]


def test_a_store_of_another_study_or_a_damaged_one_is_refused(tmp_path, alone):
    store = Store.within(tmp_path, alone.replication)
    store.save(alone.outcomes[0])
    assert store.load(5) == {0: alone.outcomes[0]}
    for other in (
        STUDY.with_seed(6),
        study(record(2, camera=0.6), noise="white", priors=PRIORS, sampler=BRIEF),
        study(record(camera=0.6), noise="white", priors=PRIORS, sampler=BRIEF | {"walkers": 12}),
    ):
        with pytest.raises(InputError, match="of other records"):
            calibrate(other, replicas=1, folder=tmp_path, resume=True)
    path = tmp_path / "replicas" / "00000.json"
    for text in (
        "",
        "[]",
        path.read_text()[:200],
        json.dumps({"fingerprint": store.fingerprint, "replica": 0}),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match="damaged"):
            calibrate(STUDY, replicas=1, folder=tmp_path, resume=True)


def test_a_full_disk_leaves_the_store_intact(tmp_path, alone, monkeypatch):
    store = Store.within(tmp_path, alone.replication)
    store.save(alone.outcomes[0])

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("os.replace", full)
        with pytest.raises(InputError, match=r"(?s)No space left on device.*--resume"):
            store.save(alone.outcomes[1])
    assert len(list(store.folder.iterdir())) == 1
    assert store.load(3) == {0: alone.outcomes[0]}


# -- around a posterior ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def own() -> Fit:
    return fit(STUDY)


@pytest.fixture(scope="module")
def fitted(own, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("fitted")
    own.save(folder)
    return folder


def test_truths_around_a_posterior_are_its_draws(own, fitted):
    table = problem_of(STUDY).posterior.table
    truths = truths_around(fitted, table)
    drawn = own.draws.flat
    truth = truths.draw(np.random.default_rng(1))
    assert (np.abs(drawn - truth).max(axis=1) == 0).any()
    assert truth[table.at("delay", 0)] == TRUTH["delay"]
    made = calibrate(STUDY, replicas=1, around=fitted)
    reported = results(made)
    source = {"from": "posterior", "folder": str(fitted), "grade": truths.grade, "stated": None}
    assert reported["truths"] == source
    assert "inferred under the prior of the study" in reported["verdict"]
    assert made.replication.truths.digest


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"delay": ("uniform", {"loc": 0.0, "scale": 2.0})}, "has no draws of 'delay'"),
        ({"gain": 2.0}, "has the parameter 'gain', which this study does not infer"),
        ({"sigma": ("uniform", {"loc": 5.0, "scale": 1.0})}, "'sigma' has draws that the prior"),
    ],
)
def test_a_posterior_of_another_study_is_refused(fitted, changed, said):
    other = study(record(camera=0.6), noise="white", priors=PRIORS | changed, sampler=BRIEF)
    with pytest.raises(InputError, match=said):
        calibrate(other, replicas=1, around=fitted)


def test_a_folder_without_posterior_is_refused(fitted, tmp_path):
    with pytest.raises(InputError, match="no fit has finished there"):
        calibrate(STUDY, replicas=1, around=tmp_path)
    for file in fitted.iterdir():
        if file.is_file():
            (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / "posterior.nc").write_text("not netCDF")
    with pytest.raises(InputError, match="cannot be read as draws"):
        calibrate(STUDY, replicas=1, around=tmp_path)


# -- the summary -----------------------------------------------------------------------------------


def gathered(
    rng, made: Replication, replicas: int, *, narrow: str = "", reliable: float = 1.0
) -> Calibration:
    """Outcomes as an exact procedure gives them, but for one quantity whose intervals are too narrow."""
    outcomes = []
    for number in range(replicas):
        at = rng.random(len(made.quantities))
        for k, quantity in enumerate(made.quantities):
            if quantity.name == narrow:
                at[k] = stats.norm.cdf(1.6 * stats.norm.ppf(at[k]))
        grade = "reliable" if number < reliable * replicas else "tentative"
        inside = tuple((bool(abs(u - 0.5) < 0.25), bool(abs(u - 0.5) < 0.45)) for u in at)
        ranks = tuple(int(u * (RANKED + 1)) for u in at)
        outcomes.append(
            Outcome(
                *(number, made.seed_of(number), grade, "why", 400.0, 1.0, 0.1),
                *(tuple(at), ranks, inside, "importance", 0.1, 1, 0.02, True),
            )
        )
    return Calibration(made, tuple(outcomes), ())


def test_an_exact_procedure_is_said_to_cover(rng):
    reported = results(gathered(rng, replication(), 200, reliable=0.95))
    assert reported["replicas"] == reported["asked"] == 200
    assert reported["grade"] == "reliable"
    assert reported["grades"] == {"reliable": 190, "tentative": 10, "unusable": 0, "failed": 0}
    assert reported["reliable"]["replicas"] == 190
    assert len(reported["not_reliable"]) == 10
    assert reported["p_value"] > 0.05
    rows = reported["coverage"]
    assert [(row["parameter"], row["level"]) for row in rows[:2]] == [("gain", 0.5), ("gain", 0.9)]
    assert len(rows) == 2 * (4 + 4)
    assert all(row["lower"] <= row["level"] <= row["upper"] and row["within"] for row in rows)
    assert all(sum(row["counts"]) == 200 and len(row["counts"]) == RANKED + 1 for row in reported["ranks"])
    assert "within its Monte Carlo band" in reported["verdict"]
    assert "every one of 4 parameters" in reported["verdict"]
    assert "Ranks are uniform" in reported["verdict"]
    assert "outside" not in reported["verdict"]


def test_intervals_that_are_too_narrow_are_named(rng):
    reported = results(gathered(rng, replication(), 200, narrow="time_1"))
    assert reported["p_value"] < 1e-3
    bad = [row["parameter"] for row in reported["coverage"] if not row["within"]]
    assert set(bad) == {"time_1"}
    assert "outside its Monte Carlo band" in reported["verdict"]
    assert "time_1 at 90 %" in reported["verdict"]
    assert "Ranks are not uniform" in reported["verdict"]
    assert "gain" not in reported["verdict"]


def test_few_or_unreliable_replicas_are_graded_so(rng, monkeypatch):
    """The last one is sampled after so short a tempering that no move is made twice."""
    monkeypatch.setattr("lcopa_bayes.sampling.sampler._SWEEPS", 1)
    made = replication()
    assert results(gathered(rng, made, 20))["grade"] == "tentative"
    assert results(gathered(rng, made, 60, reliable=0.8))["grade"] == "tentative"
    assert results(gathered(rng, made, 60, reliable=0.3))["grade"] == "unusable"
    reported = results(calibrate(STUDY, replicas=1, engine="sampling"))
    assert reported["grade"] == "unusable"
    assert reported["reliable"] is None
    assert reported["replicas"] == 1
    json.dumps(reported, allow_nan=False)


# -- the study of the default settings -------------------------------------------------------------


def test_the_study_of_the_defaults_counts_and_resumes(defaults, tmp_path, capsys):
    words = ("--cells", "white_0.5pc*", "--jobs", "1", "--out", str(tmp_path / "out"))
    words += ("--store", str(tmp_path / "store"), "--replicas")
    assert defaults.main([*words, "1"]) == 0
    first = json.loads((tmp_path / "out" / "results.json").read_text())
    assert defaults.main([*words, "2"]) == 0
    reported = json.loads((tmp_path / "out" / "results.json").read_text())
    assert (first["replicas"], reported["replicas"]) == (1, 2)
    (cell,) = reported["cells"]
    assert cell["cell"] == "white_0.5pc_order0.9_delay1"
    assert all(
        first["cells"][0]["hits"][name]["0.9"] <= hits["0.9"] <= 2 for name, hits in cell["hits"].items()
    )
    assert cell["discretisation"]["negligible"] == 2
    assert "| white_0.5pc_order0.9_delay1 | 2 |" in (tmp_path / "out" / "table.md").read_text()
    assert (tmp_path / "out" / "coverage.svg").read_text().rstrip().endswith("</svg>")


def counted(defaults: ModuleType, rng, *, narrow: str = "") -> dict:
    """A summary over cells whose intervals cover as stated, but for one parameter of every cell."""
    rows = []
    for cell in defaults.cells()[:8]:
        names = cell.truth
        hits = {
            name: {
                str(level): int(rng.binomial(200, level - (0.06 if name == narrow else 0.0)))
                for level in (0.5, 0.9)
            }
            for name in names
        }
        shown = {
            "noise": cell.noise,
            "level": cell.level,
            "orders": cell.orders,
            "hits": hits,
            "replicas": 200,
        }
        rows.append(
            {"cell": cell.name, "onset": cell.onset, "engine": {"sampling": 0}, **shown}
            | {"grades": {"reliable": 200, "failed": 0}, "discretisation": {"largest": 0.0}}
            | {"seconds": {"median": 1.0}}
        )
    return defaults.summary(rows, 1)


def test_a_small_bias_in_every_cell_shows_when_cells_are_pooled(defaults, rng):
    """Six points of coverage, too few for one cell of 200 replicas."""
    reported = counted(defaults, rng)
    assert all(row["within"] for row in reported["coverage"] + reported["pooled"])
    reported = counted(defaults, rng, narrow="delay")
    outside = {row["parameter"] for row in reported["pooled"] if not row["within"]}
    assert outside == {"delay"}
    assert "outside: " in reported["verdict"][3]
    assert "delay at 90%" in reported["verdict"][3]


@pytest.mark.slow
@pytest.mark.parametrize("delay", [1.0, 1.07])
def test_default_settings_cover_at_a_stated_truth(defaults, delay):
    """On wide blocks read through a parabola 90 % intervals covered 0.3 to 0.7 (100 replicas)."""
    cell = defaults.Cell(0.002, delay, (3.4,), (0.9,), "white")
    made = calibrate(cell.study(2), replicas=60, truth=cell.truth, jobs=2)
    reported = results(made)
    assert all(row["within"] for row in reported["coverage"] if row["kind"] == "parameter")


# -- the command line ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    """The study as a folder."""
    folder = tmp_path_factory.mktemp("written")
    save_record(record(camera=0.6), folder / "step.csv")
    lines = ['[study]\nname = "small"\nseed = 5\n[noise]\nkind = "white"\n[sampler]']
    lines += [f"{key} = {value}" for key, value in BRIEF.items()]
    lines += ["[priors]"]
    for name, prior in PRIORS.items():
        inner = "" if isinstance(prior, float) else ", ".join(f"{k} = {v}" for k, v in prior[1].items())
        lines.append(
            f"{name} = {prior}"
            if isinstance(prior, float)
            else f'{name} = {{ dist = "{prior[0]}", {inner} }}'
        )
    (folder / "study.toml").write_text("\n".join(lines) + "\n")
    return folder


def run(capsys, *words: object) -> tuple[int, str, str]:
    code = main([str(word) for word in words])
    out, err = capsys.readouterr()
    return code, out, err


@pytest.fixture(scope="module")
def finished(written, tmp_path_factory) -> tuple[Path, str]:
    """Folder of a calibration from the command line, and what it printed."""
    out, printed = tmp_path_factory.mktemp("finished") / "run", io.StringIO()
    words = ["calibrate", str(written), "--replicas", "2", "--jobs", "1", "--out", str(out), "--json"]
    with redirect_stdout(printed):
        assert main(words) == 0
    return out, printed.getvalue()


def test_calibrate_writes_its_folder_and_prints_json(finished, capsys):
    out, printed = finished
    reported = json.loads(printed)
    assert reported["replicas"] == 2
    assert reported["coverage"][0].keys() >= {"parameter", "level", "observed", "lower", "upper"}
    assert 0 < reported["p_value"] <= 1
    assert {path.name for path in out.iterdir()} == {
        *("results.json", "report.html", "provenance.json", "figures", "tables", "replicas")
    }
    page = check_page(out / "report.html")
    assert page.count("<svg") == 3
    assert '<th scope="row" class="code">time_1</th>' in page
    before = (out / "report.html").read_bytes()
    (out / "report.html").unlink()
    code, printed, _ = run(capsys, "report", out)
    assert code == 0
    assert (out / "report.html").read_bytes() == before


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("process", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_killed_calibration_resumes_to_the_same_result(written, finished, tmp_path, monkeypatch, process):
    """Interrupted in this process, or killed in one of its own; files are as whole either way."""
    script = "import sys; from lcopa_bayes.cli import main; sys.exit(main(sys.argv[1:]))"
    words = ["calibrate", str(written), "--replicas", "2", "--quiet", "--jobs", "1", "--out"]
    (whole, _), cut = finished, tmp_path / "cut"
    if process:
        killed = subprocess.Popen([sys.executable, "-c", script, *words, str(cut)])
        while not (cut / "replicas" / "00000.json").exists() and killed.poll() is None:
            time.sleep(0.01)
        killed.kill()
        killed.wait()
    else:
        save = Store.save

        def interrupted(store: Store, outcome: Outcome) -> None:
            if outcome.replica == 1:
                raise KeyboardInterrupt
            save(store, outcome)

        with monkeypatch.context() as patch:
            patch.setattr(Store, "save", interrupted)
            assert main([*words, str(cut)]) != 0
    assert 1 <= len(list((cut / "replicas").glob("0*.json"))) < 2, "the run ended before it could be killed"
    assert main([*words, str(cut), "--resume"]) == 0
    reported = [json.loads((folder / "results.json").read_text()) for folder in (whole, cut)]
    assert reported[0].pop("seconds").keys() == reported[1].pop("seconds").keys()
    assert reported[0] == reported[1]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--replicas", 0), "`replicas` must be a whole number from 1"),
        (("--replicas", -3), "`replicas`"),
        (("--around", "nowhere"), "there is no such run folder"),
        (("--around", "nowhere", "--truth", "gain=2"), "both say where truths come from"),
        (("--truth", "gain"), "--truth gain: give NAME=VALUE"),
        (("--truth", "gain=3:2"), "--truth gain=3:2: give NAME=VALUE or NAME=LOW:HIGH"),
        (
            ("--truth", "gain=2", "gain=3"),
            "--truth gain=3: give NAME=VALUE or NAME=LOW:HIGH in numbers, each name once",
        ),
        (("--truth", "gain=nan"), "--truth gain=nan"),
        (("--truth", "gian=2"), "gain"),
        (("--dask", "tcp://127.0.0.1:1"), "no Dask scheduler answers there"),
        (("--dask", "not an address"), "no Dask scheduler answers there"),
    ],
)
def test_bad_input_is_reported_and_nothing_is_written(written, tmp_path, capsys, monkeypatch, words, said):
    monkeypatch.setattr("lcopa_bayes.core.cluster.CONNECT", 0.5)
    out = tmp_path / "run"
    code, printed, reported = run(capsys, "calibrate", written, *words, "--out", out, "--quiet")
    assert code == 2
    assert printed == ""
    assert said in reported
    assert reported.startswith("error: ")
    assert not out.exists()


def test_dask_without_distributed_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install 'lcopa-bayes\[dask\]'"):
        calibrate(STUDY, replicas=1, dask="tcp://127.0.0.1:1")


@pytest.mark.parametrize("name", ["one-term", "two-terms", "three-terms"])
def test_the_bundled_studies_can_be_calibrated(name):
    """Their shortest time constant is long against a block, and the bench can simulate their truths."""
    from lcopa_bayes.data.studyfile import load_study

    made = problem_of(load_study(Path(__file__).parents[2] / "studies" / "calibration" / name))
    table, rng = made.posterior.table, np.random.default_rng(0)
    gaps = []
    for truth in table.draw(20, rng):
        gaps.append(model_gap(made, truth, exact_responses(made, truth)))
    assert np.median(gaps) < 0.1
    block = made.posterior.model.experiments[0].mesh.grid.step
    assert all(table.rows[k].domain[0] > 0.3 * block for k in table.of_kind("time"))
    assert ONE.time_unit == made.study.time_unit
