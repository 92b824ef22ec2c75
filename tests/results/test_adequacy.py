"""Limitations by what speaks against a model: quiet on records it explains, raised on those it does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small import TRUTH, U, Y, draws_of, problem, record, study

from lcopa_bayes.bench.command import step
from lcopa_bayes.data.record import Record
from lcopa_bayes.identifiability.audit import audit
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.optimum import find_optima
from lcopa_bayes.results.adequacy import _coverage, limitations
from lcopa_bayes.results.fit import fit
from lcopa_bayes.results.prediction import bands
from lcopa_bayes.results.residuals import residuals
from lcopa_bayes.results.resonances import RESONANCE_PEAK, peaks, unresolved
from lcopa_bayes.results.summary import results
from lcopa_bayes.sampling.convergence import Limitation
from lcopa_bayes.sampling.draws import Draws

NOISE = TRUTH | {"sigma_ar": 0.003, "rho": 0.5, "nu": 200.0}


def about(made: Problem, spread: float = 1e-3, **changes: float) -> Draws:
    """Draws near the truth, or what is changed of it, that count as perfectly converged."""
    reported = NOISE | changes
    middle = np.array([reported[name] if row.free else row.value for name, row in named(made)])
    free = np.array([row.free for _, row in named(made)])
    noise = np.random.default_rng(0).standard_normal((400, middle.size))
    return draws_of(made.posterior.table, middle * (1 + spread * free * noise))


def named(made: Problem):
    return zip(made.posterior.table.names, made.posterior.table.rows, strict=True)


def found(made: Problem, draws: Draws) -> tuple[Limitation, ...]:
    posterior, rng = made.posterior, np.random.default_rng(1)
    shown = bands(draws, posterior.model, posterior.samples, posterior.noise, held_out=False, seed=0)
    left = residuals(draws, shown, posterior.noise, made.scales.period)
    return limitations(made, draws, shown, left, rng)


def measured(seed: int, **options: object) -> Record:
    return record(seed, command=step(1.0, at=4.0), duration=24.0, **options)


@pytest.mark.parametrize(("noise", "correlation"), [("white", 0.0), ("white+ar1", 0.0), ("student", 0.0)])
def test_a_model_that_explains_its_record_is_rarely_limited(noise, correlation):
    """At most one in a hundred is promised; of 15 three are four errors above."""
    alarms = 0
    for seed in range(15):
        made = problem(measured(seed, correlation=correlation), noise=noise)
        alarms += bool(found(made, about(made)))
    assert alarms <= 15 * 0.02 + 4 * np.sqrt(15 * 0.02)


def test_correlated_noise_under_a_model_of_it_is_not_limited():
    alarms = 0
    for seed in range(20):
        made = problem(measured(seed, correlation=0.8), noise="ar1")
        alarms += bool(found(made, about(made, rho=0.8)))
    assert alarms <= 3


def test_correlated_noise_under_a_white_model_is_named():
    made = problem(measured(3, correlation=0.8), noise="white")
    (one,) = [reported for reported in found(made, about(made)) if "not white" in reported.reason]
    assert one.level == "tentative"
    assert one.reason.startswith("intervals hold only if")
    assert "corrected for 2 tests" in one.reason
    assert "`loop`" in one.remedy


def test_a_whiteness_that_one_of_many_records_lacks_by_chance_is_not_called():
    """p just below the threshold on one record counts alone, not among twenty."""
    made = problem(measured(1), noise="white")
    posterior, draws = made.posterior, about(made)
    shown = bands(draws, posterior.model, posterior.samples, posterior.noise, held_out=False, seed=0)
    (left,) = residuals(draws, shown, posterior.noise, made.scales.period)
    slight = replace(left, p_white=2e-3)
    alone = limitations(made, draws, shown, [slight], np.random.default_rng(2))
    among = limitations(
        made, draws, shown, [slight, *[replace(left, p_white=0.5)] * 19], np.random.default_rng(2)
    )
    assert ["not white" in one.reason for one in alone] == [True]
    assert among == ()
    held = replace(slight, p_white=1e-70, held_out=True)
    assert limitations(made, draws, shown, [held], np.random.default_rng(2)) == ()


@pytest.mark.parametrize(("factor", "word"), [(4.0, "wider"), (0.4, "narrower")])
def test_bands_that_hold_too_many_or_too_few_samples_are_named(factor, word):
    made = problem(measured(2), noise="white")
    reported = found(made, about(made, sigma=factor * TRUTH["sigma"]))
    assert [one for one in reported if f"which is {word} than the residual" in one.reason]


def test_coverage_is_judged_by_the_independent_samples_there_are():
    """p-values of correlated noise under its own model are not small more often than they may be."""
    small = 0
    for seed in range(40):
        made = problem(measured(seed, correlation=0.9), noise="ar1")
        draws = about(made, rho=0.9)
        posterior, rng = made.posterior, np.random.default_rng(seed)
        (band,) = bands(draws, posterior.model, posterior.samples, posterior.noise, held_out=False, seed=seed)
        small += _coverage(made, draws, band, rng).p < 0.05
    assert small <= 40 * 0.05 + 4 * np.sqrt(40 * 0.05)


def test_what_to_do_is_said_once_where_residual_and_bands_speak_against_a_model():
    made = problem(measured(3, correlation=0.8), noise="white")
    remedies = [one.remedy for one in found(made, about(made, sigma=0.4 * TRUTH["sigma"]))]
    assert len(remedies) >= 2
    assert sum("add terms" in remedy for remedy in set(remedies)) == 1
    (alone,) = {one.remedy for one in found(problem(measured(2), noise="white"), wide())}
    assert alone.startswith("choose another [noise] kind, add terms")


def wide() -> Draws:
    """Draws of more noise than a record has."""
    return about(problem(measured(2), noise="white"), sigma=4.0 * TRUTH["sigma"])


def unpredicted(seed: int, spread: float, **changes: float) -> tuple[Limitation, ...]:
    """Limitations by a held-out record alone."""
    made = problem(measured(seed), noise="white")
    draws = about(made, spread, **changes)
    samples, model = made.simulated((measured(seed + 100, name="held"),))
    shown = bands(draws, model, samples, made.posterior.noise, held_out=True, seed=seed)
    return limitations(made, draws, shown, [], np.random.default_rng(2))


def test_a_held_out_record_that_the_bands_do_not_hold_is_named():
    """An error of 3 % beyond what the draws allow is, the same error within their spread is not."""
    wrong = {"gain": 1.03 * TRUTH["gain"]}
    (one,) = unpredicted(1, 1e-3, **wrong)
    assert one.level == "tentative"
    assert "predicts held, axis y, worse than it claims" in one.reason
    assert unpredicted(1, 0.03, **wrong) == ()


def test_held_out_records_of_the_model_itself_are_rarely_named():
    alarms = sum(bool(unpredicted(seed, 1e-3)) for seed in range(30))
    assert alarms <= 30 * 0.01 + 4 * np.sqrt(30 * 0.01)


def test_a_residual_far_above_the_scatter_at_rest_is_named():
    """The same misfit is called where samples at rest are there to compare with, and only there."""
    wrong = {"gain": 2.4, "sigma": 0.3}
    quiet, none = measured(4), record(4, command=step(1.0, at=0.0), duration=20.0)
    made = problem(quiet, noise="white")
    assert [one for one in found(made, about(made, **wrong)) if "at rest noise is at most" in one.reason]
    assert not [one for one in found(made, about(made)) if "at rest" in one.reason]
    without = problem(none, noise="white")
    assert not [one for one in found(without, about(without, **wrong)) if "at rest" in one.reason]


def test_noise_correlated_over_much_of_the_record_is_named():
    made = problem(measured(5), noise="ar1")
    for rho, called in ((0.999, True), (0.95, True), (0.8, False)):
        reported = [one for one in found(made, about(made, 1e-5, rho=rho)) if "correlated over" in one.reason]
        assert bool(reported) == called


def test_a_noise_parameter_at_the_end_of_its_prior_is_named():
    made = problem(measured(6), noise="white+ar1")
    row = made.posterior.table.rows[made.posterior.table.names.index("sigma_ar")]
    high = row.domain[1]
    for share, called in ((0.97, True), (0.5, False)):
        reported = found(made, about(made, sigma_ar=share * high))
        assert bool([one for one in reported if "the end of its prior" in one.reason]) == called


def thermal(seed: int = 3) -> Record:
    """Three lags of 60, 35 and 20 s, gain 0.8, after a step at 60 s, sampled every 2 s, noise 0.003."""
    lags, gain = np.array([60.0, 35.0, 20.0]), 0.8
    time = np.arange(0.0, 600.0, 2.0)
    after = np.maximum(time - 60.0, 0.0)[:, None]
    weights = [lag**2 / np.prod([lag - other for other in lags if other != lag]) for lag in lags]
    response = gain * (1 - np.exp(-after / lags) @ np.array(weights))
    noisy = response + 0.003 * np.random.default_rng(seed).standard_normal(time.size)
    drive = (time >= 60.0).astype(float)
    return Record("heater", time, drive[:, None], noisy[:, None], (U,), (Y,), "s")


@pytest.mark.parametrize("noise", ["white", "ar1", "white+ar1", "student"])
def test_three_lags_fitted_by_one_term_are_never_reliable(noise):
    """However noise may swallow what the plant lacks."""
    made = problem(thermal(), noise=noise)
    best = find_optima(made.posterior, np.random.default_rng(0))[0].values
    draws = draws_of(made.posterior.table, np.tile(best, (400, 1)))
    assert draws.grade.level == "reliable"
    reported = found(made, draws)
    assert reported
    limited = draws.limited(reported)
    assert limited.grade.level != "reliable"
    assert "reliable" not in {one.grade for one in limited.estimates()}
    assert "intervals hold only if" in limited.grade.reason
    assert "add terms" in limited.grade.reason


@pytest.mark.slow
def test_three_lags_fitted_by_one_term_from_record_to_audit():
    """The grade of the whole fit, of each of its numbers, and the headline of its audit."""
    few = {"ensembles": 2, "walkers": 32, "steps": 600, "thin": 2}
    made = fit(study(thermal(), noise="ar1", sampler=few))
    assert made.draws.grade.level != "reliable"
    reported = results(made)
    assert "intervals hold only if" in reported["verdict"]
    assert "reliable" not in {row["grade"] for row in reported["parameters"] + reported["step_metrics"]}
    assert reported["limitations"]
    said = audit(made).sentence
    assert said.startswith("Given this model, ")
    assert "But intervals hold only if" in said


# -- resonances ------------------------------------------------------------------------------------


def test_the_peak_of_one_term_in_closed_form():
    orders = np.array([1.95, 1.9, 1.936, 1.5, 2.0])
    found, at = peaks(np.full((5, 1), 0.3), orders[:, None])
    exact = 1 / (2 * np.abs(np.cos(np.pi * orders[:3] / 4)))
    assert found[:3] == pytest.approx(exact, rel=0.01)
    assert at[:3] == pytest.approx(1 / 0.3, rel=0.02)
    assert found[2] == pytest.approx(RESONANCE_PEAK, rel=0.02)
    assert found[3] < 2
    assert found[4] > 50


def test_a_second_term_damps_the_resonance():
    times, orders = np.array([[0.3, 0.3]]), np.array([[2.0, 1.0]])
    assert peaks(times, orders)[0] < 1.5
    assert peaks(np.array([[0.3, 1e-4]]), orders)[0] > RESONANCE_PEAK


@pytest.mark.parametrize(
    ("time", "order", "named"),
    [(0.1, 2.0, True), (0.19, 1.99, True), (0.3, 2.0, False), (0.1, 1.8, False), (1.5, 0.8, False)],
)
def test_an_undamped_resonance_faster_than_the_samples_is_no_plant(time, order, named):
    made = problem(measured(7))
    assert made.scales.period == pytest.approx(0.2)
    draws = about(made, 1e-4, time_1=time, order_1=order * (1 - 1e-3))
    reported = [one for one in found(made, draws) if "not a plant" in one.reason]
    assert bool(reported) == named
    if named:
        assert reported[0].level == "unusable"
        (one,) = unresolved(made, draws)
        assert one.samples == pytest.approx(2 * np.pi * time / 0.2, rel=0.03)
        assert f"{one.samples:.2g} sampling periods" in reported[0].reason


def test_a_minor_mode_that_is_an_alias_keeps_numbers_from_being_reliable():
    made = problem(measured(8))
    draws, alias = about(made, 1e-4), about(made, 1e-4, time_1=0.1, order_1=1.995)
    for share, level in ((0.0, None), (0.02, None), (0.2, "tentative"), (0.8, "unusable")):
        count = round(share * 200)
        values = np.concatenate([alias.values[:, :count], draws.values[:, count:]], axis=1)
        mixed = replace(draws, values=values)
        levels = [one.level for one in limitations(made, mixed, [], [], np.random.default_rng(0))]
        assert levels == ([level] if level else [])
