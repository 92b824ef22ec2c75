"""Numbers over the fitted plant and sums of lags hold what is true of plants that are no Kelvin element."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from inference.test_lagsum import DELAY, GAINS, SD, TIMES, lags, made
from small import record, study

from lcopa_bayes.bench.command import step
from lcopa_bayes.core.estimate import Estimate
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.openeffects import Weighed
from lcopa_bayes.results.alternatives import Alternatives, Averaged, alternatives_of, with_alternatives
from lcopa_bayes.results.averages import parts_of_sd, pooled, pooled_parts
from lcopa_bayes.results.fit import Fit
from lcopa_bayes.results.fit import fit as sampled
from lcopa_bayes.results.integerfit import integer_fit
from lcopa_bayes.sampling import lagdraws
from lcopa_bayes.verbs.fit import fit

QUICK = {"target_ess": 50}


@pytest.fixture(scope="module", autouse=True)
def few_draws() -> Iterator[None]:
    """A quarter of the draws of sums of lags: no number here is compared with another run's."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("_DRAWN", "_WANTED", "_KEPT"):
            patch.setattr(lagdraws, name, getattr(lagdraws, name) // 4)
        yield


def one_term(study: Study) -> Fit:
    """Fitted as a plant of one term, though it is none."""
    return sampled(
        Study("short", None, "s", 0, study.fit, (), terms=1, noise={"kind": "white"}, sampler=QUICK)
    )


@pytest.fixture(scope="module")
def short() -> Fit:
    return one_term(made())


@pytest.fixture(scope="module")
def beside(short: Fit) -> Fit:
    return with_alternatives(short, integer_fit(short))


@pytest.fixture(scope="module")
def over(beside: Fit) -> Alternatives:
    assert beside.alternatives is not None
    return beside.alternatives


def test_a_plant_that_records_reject_gives_way_to_the_lags(short: Fit, over: Alternatives) -> None:
    (one,) = over.alternatives
    assert one.support == "lags"
    assert one.search.best.lags == len(TIMES)
    numbers = {number.estimate.name: number for number in over.numbers}
    truth = {
        "steady_state[y]": sum(GAINS),
        "delay[y]": DELAY,
        "value_at_end[y]": float(lags(np.array([short.curves.time[-1]]), GAINS, TIMES, DELAY)[0]),
    }
    for name, true in truth.items():
        here = numbers[name]
        assert here.estimate.lower <= true <= here.estimate.upper
    for name in ("steady_state[y]", "delay[y]"):
        alone = np.quantile(numbers[name].plant, (0.05, 0.95))
        assert numbers[name].moved
        assert not alone[0] <= truth[name] <= alone[1]


def test_the_advantage_is_akaikes_criterion_of_two_least_squares(short: Fit, over: Alternatives) -> None:
    """Second method: chi-square of the closed form at the optimum of the lags, and of the band's median."""
    (one,) = over.alternatives
    lagged, plant = 0.0, 0.0
    best = one.search.best.coordinates
    noise = float(short.draws.column("sigma").mean())
    columns, target = [], []
    for k, made_record in enumerate(short.study.fit):
        height = made_record.drive[-1, 0]
        parts = [
            height * lags(made_record.time, (1.0,), (time,), float(best[-1])) for time in np.exp(best[:-1])
        ]
        columns.append(np.stack([*parts, *np.outer(np.eye(2)[k], np.ones(made_record.time.size))]))
        target.append(made_record.response[:, 0])
    whole, y = np.concatenate(columns, axis=1), np.concatenate(target)
    weights = np.linalg.lstsq(whole.T, y, rcond=None)[0]
    lagged = float(np.sum((y - weights @ whole) ** 2)) / noise**2
    plant = sum(float(np.sum((band.observed - band.plant[2]) ** 2)) for band in short.bands) / noise**2
    expected = plant + 2 * 4 - lagged - 2 * 5
    assert one.advantage == pytest.approx(expected, rel=0.15)


def test_a_better_sum_of_lags_limits_every_number(beside: Fit) -> None:
    assert beside.draws.grade.level == "tentative"
    assert "sums of 2 to 3 lags follow y better" in beside.draws.grade.reason
    reported = {one.name: one for one in beside.metrics}["delay[y]"]
    assert reported.lower <= DELAY <= reported.upper
    assert "of sums of lags" in reported.note


def test_figures_over_lags_are_no_better_than_the_fit(
    short: Fit, over: Alternatives, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Few effective draws make a number tentative at best, not what is unusable anyway."""
    few = tuple(replace(one, ess_bulk=50.0) for one in short.draws.qualities)
    poor = replace(short, draws=replace(short.draws, qualities=few))
    assert poor.draws.grade.level == "unusable"
    monkeypatch.setattr("lcopa_bayes.results.alternatives.lags_beside", lambda *_, **__: over.alternatives)
    graded = with_alternatives(poor, None).alternatives
    assert graded is not None
    assert {one.estimate.grade for one in graded.numbers} == {"unusable"}


@pytest.fixture(scope="module")
def own() -> Fit:
    """Of the plant that made the records."""
    records = [
        record(k, command=step(h, at=0.35), name=f"r{k}", noise_sd=0.004) for k, h in ((1, 1.0), (2, -0.5))
    ]
    return sampled(study(*records, sampler=QUICK))


def test_where_both_follow_the_records_intervals_are_over_both(own: Fit) -> None:
    fitted = with_alternatives(own, integer_fit(own))
    other = fitted.alternatives
    assert other is not None
    (one,) = other.alternatives
    if one.support == "plant":
        assert other.numbers == ()
        assert fitted.metrics == own.metrics
        return
    assert one.support == "both"
    number = {number.estimate.name: number for number in other.numbers}["steady_state[y]"]
    ours, theirs = number.parts["plant"], number.parts["lags"]
    assert number.shares == {"plant": 0.5, "lags": 0.5}
    every = np.concatenate([np.repeat(ours, theirs.size), np.repeat(theirs, ours.size)])
    assert number.estimate.lower == pytest.approx(float(np.quantile(every, 0.05)), rel=0.02)
    noise, structure = parts_of_sd([ours, theirs], np.array([0.5, 0.5]))
    assert noise**2 + structure**2 == pytest.approx(float(np.var(every)), rel=1e-6)
    shown = number.as_json()
    assert np.hypot(shown["sd_noise"], shown["sd_structure"]) == pytest.approx(shown["sd"], rel=1e-3)


def test_a_number_that_moves_limits_its_parameter_alone() -> None:
    noisy = one_term(made(sd=4 * SD))
    other = with_alternatives(noisy, integer_fit(noisy)).alternatives
    assert other is not None
    assert other.alternatives[0].support == "both"
    limitations = other.limitations({"delay[y]": ("delay",), "steady_state[y]": ("gain",)})
    assert limitations
    assert {name for one in limitations for name in one.parameters} <= {"delay", "gain"}
    assert all(one.level == "tentative" for one in limitations)


@pytest.mark.slow
def test_without_gaussian_noise_or_a_moving_drive_there_is_none() -> None:
    students = study(record(), noise="student", sampler=QUICK)
    assert alternatives_of(sampled(students)) == ()


@pytest.mark.slow
def test_a_fit_whose_structure_the_records_chose_shows_them(tmp_path: Path) -> None:
    fitted = fit(study(record(), terms="auto", sampler=QUICK), folder=tmp_path)
    values = json.loads((tmp_path / "results.json").read_text())["alternatives"]
    assert fitted.alternatives is not None
    assert values == fitted.alternatives.as_json()
    assert values["sentence"] in fitted.verdict
    page = fitted.report(tmp_path).read_text()
    assert "sums of lags" in page


def test_a_stated_structure_has_none() -> None:
    stated = study(record(camera=0.8), sampler=QUICK, priors={"delay": 0.73, "order_1": 0.8})
    assert fit(stated).alternatives is None


def test_the_square_of_the_parts_is_the_variance_of_the_mixture() -> None:
    rng = np.random.default_rng(0)
    values = [rng.normal(0, 1, 4000), rng.normal(2, 3, 4000)]
    weights = np.array([0.25, 0.75])
    noise, structure = parts_of_sd(values, weights)
    means = np.array([one.mean() for one in values])
    second = weights @ np.array([np.mean(one**2) for one in values])
    assert noise**2 + structure**2 == pytest.approx(float(second - (weights @ means) ** 2))
    assert np.isnan(parts_of_sd([np.array([1.0, np.inf]), values[0]], weights)).all()


def test_one_draw_far_out_makes_no_part_larger_than_the_whole() -> None:
    rng = np.random.default_rng(1)
    values, weights = [rng.normal(0, 1, 4000), rng.normal(2, 3, 4000)], np.array([0.25, 0.75])
    stray = [np.append(values[0], 1e4), values[1]]  # by which the variance of all draws is 6e3
    whole = pooled(stray, weights)
    noise, structure = parts_of_sd(*pooled_parts(stray, weights))
    assert noise**2 + structure**2 == pytest.approx(whole.var(), rel=1e-12)
    assert (noise, structure) == pytest.approx(parts_of_sd(values, weights), rel=0.01)
    estimate = Estimate.of("a", "V", whole, ess=100.0, grade="reliable", note="")
    kinds = ("plant", "lags")
    averaged = Averaged(
        estimate, dict(zip(kinds, stray, strict=True)), dict(zip(kinds, weights, strict=True))
    )
    weighed = Weighed("a", "V", stray, weights).as_json(ess=100.0, grade="reliable", interval="Laplace")
    for shown in (averaged.as_json(), weighed):
        assert np.hypot(shown["sd_noise"], shown["sd_structure"]) == pytest.approx(shown["sd"], rel=1e-3)
