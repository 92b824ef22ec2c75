"""Parts of a comparison against exact answers: weights, integer orders, predictions, draws, decisions."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from math import log

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.stats import norm
from small import Toy, problem, record

from lcopa_bayes.comparison.averaging import stretches, total_sd
from lcopa_bayes.comparison.compare import judged, probabilities, stacking_weights
from lcopa_bayes.comparison.decision import decided
from lcopa_bayes.comparison.integerorder import savage_dickey
from lcopa_bayes.comparison.priorwidth import _scaled
from lcopa_bayes.comparison.sequentialdensity import CUTS, parts_of, predicted, without
from lcopa_bayes.core.estimate import Estimate
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.parameter import Parameter, Place
from lcopa_bayes.inference.priors import Prior
from lcopa_bayes.sampling import bridge
from lcopa_bayes.sampling.bridge import transferred


@pytest.fixture
def rng():
    return np.random.default_rng(11)


# -- weights ---------------------------------------------------------------------------------------


def test_probabilities_are_those_of_the_evidences(rng):
    shares, error = probabilities(np.log([0.2, 0.6, 0.2]) - 1e4, np.full(3, 1e-3), rng)
    np.testing.assert_allclose(shares, [0.2, 0.6, 0.2], rtol=1e-8)
    np.testing.assert_allclose(error, 1e-3 * np.sqrt([0.2 * 0.2, 0.6 * 0.6, 0.04]), rtol=1.0)


def test_stacking_finds_the_best_mixture(rng):
    y = np.where(rng.random(500) < 0.3, rng.normal(-2, 1, 500), rng.normal(2, 1, 500))
    density = np.stack([norm.logpdf(y, -2), norm.logpdf(y, 2)], axis=1)

    def loss(share: float) -> float:
        return -float(np.logaddexp(density[:, 0] + log(share), density[:, 1] + log(1 - share)).sum())

    exact = minimize_scalar(loss, bounds=(1e-6, 1 - 1e-6), method="bounded", options={"xatol": 1e-8}).x
    assert stacking_weights(density) == pytest.approx([exact, 1 - exact], abs=1e-3)


def test_stacking_leaves_out_what_never_helps(rng):
    y = rng.normal(size=300)
    weights = stacking_weights(np.stack([norm.logpdf(y), norm.logpdf(y, 5)], axis=1))
    assert weights[1] < 1e-3


# -- integer orders --------------------------------------------------------------------------------


def estimate(draws: np.ndarray, ess: float, grade: str = "reliable") -> Estimate:
    return Estimate.of("order_1", "-", draws, ess=ess, grade=grade)


@pytest.mark.parametrize(("mean", "sd"), [(1.02, 0.05), (0.9, 0.1), (1.15, 0.1)])
def test_savage_dickey_is_the_ratio_of_densities(rng, mean, sd):
    draws, prior = rng.normal(mean, sd, 20_000), rng.uniform(0, 2, 200_000)
    found = savage_dickey(draws, prior, estimate(draws, 20_000))
    window = found.window
    exact = (norm.cdf(1 + window, mean, sd) - norm.cdf(1 - window, mean, sd)) / window
    assert found.nearest == 1
    assert found.method == "draws at the integer"
    assert abs(found.log_bayes_factor - log(exact)) < 4 * found.log_sd
    assert found.log_bayes_factor == pytest.approx(log(norm.pdf(1, mean, sd) / 0.5), abs=0.15)


def test_far_from_the_integer_the_tail_is_normal_and_says_so(rng):
    draws, prior = rng.normal(0.8, 0.02, 4_000), rng.uniform(0, 2, 200_000)
    found = savage_dickey(draws, prior, estimate(draws, 400))
    assert found.method == "normal tail"
    assert found.answer == "not an integer"
    assert abs(found.log_bayes_factor - norm.logpdf(1, 0.8, 0.02) - log(2)) < 4 * found.log_sd


@pytest.mark.parametrize("sd", [0.0005, 0.0008, 0.002])
@pytest.mark.parametrize("apart", [0.0, 3.0, 6.0])
def test_a_sharply_known_order_is_not_an_integer_because_it_is_near_one(rng, sd, apart):
    """Windows follow the posterior however narrow: 6 standard deviations off are 6 standard deviations."""
    draws, prior = rng.normal(1 + apart * sd, sd, 4_000), rng.uniform(0, 2, 200_000)
    found = savage_dickey(draws, prior, estimate(draws, 4_000))
    exact = norm.logpdf(apart) - log(sd) + log(2)
    assert abs(found.log_bayes_factor - exact) < 4 * found.log_sd + 0.02
    assert found.answer == {0.0: "integer", 3.0: "integer", 6.0: "not an integer"}[apart]


def test_draws_that_do_not_vary_say_nothing(rng):
    draws = np.ones(4_000)
    found = savage_dickey(draws, rng.uniform(0, 2, 200_000), estimate(draws, 4_000))
    assert (found.method, found.answer) == ("undefined", "undecided")


def test_an_order_at_an_end_of_its_domain_is_compared_with_the_prior_there(rng):
    draws, prior = 2 - np.abs(rng.normal(0, 0.05, 20_000)), rng.uniform(0, 2, 200_000)
    found = savage_dickey(draws, prior, estimate(draws, 20_000))
    assert found.nearest == 2
    assert found.answer == "integer"
    assert found.log_bayes_factor == pytest.approx(log(2 * norm.pdf(0, 0, 0.05) / 0.5), abs=0.1)


def test_a_prior_alone_says_nothing_and_unusable_draws_neither(rng):
    draws, prior = rng.uniform(0, 2, 4_000), rng.uniform(0, 2, 200_000)
    assert savage_dickey(draws, prior, estimate(draws, 4_000)).answer == "undecided"
    sharp = rng.normal(1.0, 0.01, 4_000)
    assert savage_dickey(sharp, prior, estimate(sharp, 4_000)).answer == "integer"
    assert savage_dickey(sharp, prior, estimate(sharp, 50, "unusable")).answer == "undecided"


def test_the_error_of_the_ratio_is_that_of_repetition():
    found = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        draws = rng.normal(0.85, 0.08, 1_000)
        found.append(savage_dickey(draws, rng.uniform(0, 2, 100_000), estimate(draws, 1_000)))
    spread = np.std([one.log_bayes_factor for one in found])
    assert 0.6 < spread / np.mean([one.log_sd for one in found]) < 1.6


# -- what is predicted from what -------------------------------------------------------------------


def test_every_record_is_left_out_whole():
    two = problem(record(1, name="a"), record(2, name="b"))
    parts = parts_of(two.posterior, ["c"])
    assert [(one.name, one.kind) for one in parts] == [
        ("c", "held-out record"),
        ("a", "record left out"),
        ("b", "record left out"),
    ]
    target = without(two.posterior, parts[2])
    assert target.size == two.posterior.samples[0].axes[0].values.size
    values = two.posterior.table.draw(3, np.random.default_rng(1))
    alone = two.posterior.pointwise(values)[0][0].sum(axis=1)
    np.testing.assert_allclose(target.pointwise(values)[0][0].sum(axis=1), alone)
    assert target.pointwise(values)[1][0].size == 0


@pytest.mark.parametrize("noise", ["white", "student"])
def test_a_left_out_record_counts_no_more_in_the_likelihood(noise):
    two = problem(record(1, name="a"), record(2, name="b"), noise=noise)
    target = without(two.posterior, parts_of(two.posterior, [])[0])
    z = two.posterior.coordinates(two.posterior.table.draw(4, np.random.default_rng(2)))
    assert np.isfinite(target.log_density(z)).all()
    changed = replace(record(1, name="a"), response=record(1, name="a").response + 1.0)
    other = problem(changed, record(2, name="b"), noise=noise)
    again = without(other.posterior, parts_of(other.posterior, [])[0])
    same = replace(again, table=two.posterior.table)  # the priors look at amplitudes
    np.testing.assert_allclose(same.log_density(z), target.log_density(z))


def test_of_one_record_the_future_is_predicted_stretch_by_stretch():
    one = problem()
    parts = parts_of(one.posterior, [])
    assert all(part.kind == "future of the record" for part in parts)
    covered = np.concatenate([predicted(one.posterior.samples[0].axes[0], part) for part in parts])
    count = one.posterior.size
    assert sorted(covered) == list(range(round(CUTS[0] * count), count))
    for part in parts:
        known = without(one.posterior, part)
        assert known.size == part.known


def test_the_error_of_a_total_knows_that_neighbours_err_together():
    totals, reported = [], []
    pointwise = {"part": ["a"] * 400, "axis": ["y"] * 400}
    where = stretches(pointwise)
    for seed in range(200):
        rng = np.random.default_rng(seed)
        noise = np.convolve(rng.normal(size=409), np.ones(10) / 10, mode="valid")
        totals.append(noise.sum())
        reported.append(total_sd(np.array([noise[where == block].sum() for block in np.unique(where)])))
    assert 0.75 < np.mean(reported) / np.std(totals) < 1.15
    naive = 20 * np.std(noise)
    assert naive < 0.5 * np.std(totals)


# -- reweighted draws ---------------------------------------------------------------------------------


def gauss(data: np.ndarray) -> Toy:
    def log_likelihood(z: np.ndarray) -> np.ndarray:
        return norm.logpdf(data[None, :, None], z[:, None, :], 0.5).sum(axis=(1, 2))

    return Toy(log_likelihood, {"a": ("norm", {"loc": 0.0, "scale": 2.0}), "b": ("norm", {"scale": 2.0})})


def test_draws_reweighted_to_fewer_data_are_those_of_the_smaller_posterior(rng, monkeypatch):
    data = np.concatenate([rng.normal(1.0, 0.5, 3), rng.normal(-1.5, 0.5, 12)])
    source, target = gauss(data), gauss(data[:3])

    def exact(seen: np.ndarray) -> tuple[float, float]:
        precision = 0.25 + seen.size / 0.25
        return seen.sum() / 0.25 / precision, precision**-0.5

    mean, sd = exact(data)
    positions = rng.normal(mean, sd, (3, 40, 2))
    found = transferred(source, target, positions, 5, jump=False)
    wanted, spread = exact(data[:3])
    assert abs(wanted - mean) > 4 * sd  # far enough to be a test
    draws = found.coordinates.reshape(-1, 2)
    np.testing.assert_allclose(draws.mean(axis=0), wanted, atol=4 * spread / np.sqrt(found.ess))
    np.testing.assert_allclose(draws.std(axis=0), spread, rtol=0.15)
    assert found.rhat < 1.1
    again = transferred(source, target, positions, 5, jump=False)
    np.testing.assert_array_equal(found.coordinates, again.coordinates)
    monkeypatch.setattr(bridge, "usable", lambda weighted: False)
    walked, rough = (
        transferred(source, target, positions, 5, jump=False, roughly=roughly) for roughly in (False, True)
    )
    np.testing.assert_array_equal(rough.coordinates, found.coordinates)
    assert np.isnan(rough.rhat)  # averages over the weights are not known to converge
    assert walked.evidence is None
    draws = walked.coordinates.reshape(-1, 2)
    np.testing.assert_allclose(draws.mean(axis=0), wanted, atol=4 * spread / np.sqrt(walked.ess))


# -- widths of priors ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "dist", "reported", "half", "twice"),
    [
        ("gain", "norm", {"loc": 1.0, "scale": 2.0}, (1.0, 1.0), (1.0, 4.0)),
        ("delay", "uniform", {"loc": 0.0, "scale": 4.0}, (0.0, 2.0), (0.0, 8.0)),
        ("delay", "uniform", {"loc": 2.0, "scale": 4.0}, (3.0, 2.0), (0.0, 8.0)),
        ("time", "loguniform", {"a": 0.01, "b": 100.0}, (0.1, 10.0), (0.01, 1e6)),
        ("time", "lognorm", {"s": 0.5, "scale": 3.0}, (0.25, 3.0), (1.0, 3.0)),
        ("gain", "halfnorm", {"loc": 1.0, "scale": 2.0}, (1.0, 1.0), (1.0, 4.0)),
        (
            "gain",
            "beta",
            {"a": 2.0, "b": 2.0, "loc": 2.0, "scale": 4.0},
            (2.0, 2.0, 3.0, 2.0),
            (2.0, 2.0, 0.0, 8.0),
        ),
        ("gain", "cauchy", {"loc": 1.0, "scale": 2.0}, (1.0, 1.0), (1.0, 4.0)),
    ],
)
def test_priors_half_and_twice_as_wide(kind, dist, reported, half, twice):
    row = Parameter(kind, "-", kind, Place(0, 0), Prior(dist, reported))
    for factor, wanted in ((0.5, half), (2.0, twice)):
        made = _scaled(row, factor).prior.parameters
        assert tuple(made.values()) == pytest.approx(wanted)


def test_orders_and_noise_keep_their_priors():
    for kind, dist in (("order", "uniform"), ("sigma", "loguniform"), ("offset", "norm")):
        reported = {"a": 0.1, "b": 1.0} if dist == "loguniform" else {"loc": 0.0, "scale": 1.0}
        row = Parameter(kind, "-", kind, Place(0, 0), Prior(dist, reported))
        assert _scaled(row, 2.0) is row


# -- decisions -------------------------------------------------------------------------------------


def prior_widths(half: float | None, twice: float | None) -> list[dict]:
    """Log evidence under priors half and twice as wide; None: it could not be had."""
    return [
        {"factor": factor, "log_evidence": value, "sd": None if value is None else 0.1}
        for factor, value in ((0.5, half), (2.0, twice))
    ]


def card(name: str, evidence: float | None, lpd: float, **reported: object) -> dict:
    """A card whose 40 predicted samples share `lpd` evenly, with a small fixed wobble."""
    wobble = 0.01 * np.sin(np.arange(40.0) * (1 + len(name)))
    scores = [{"record": "a", "axis": "y", "unit": "rad", "rmse": 1.0, "samples": 40}]
    base = {
        "name": name,
        "usable": True,
        "max_log_likelihood": lpd,
        "quantiles": {},
        "grade": "reliable",
        "grade_reason": "fine",
        "integer": "order" in name,
        "terms": 1,
        "parameters": 5,
        "log_evidence": evidence,
        "log_evidence_sd": None if evidence is None else 0.1,
        "evidence_undefined": "",
        "prior_widths": [] if evidence is None else prior_widths(evidence, evidence),
        "pointwise": {
            "part": ["b"] * 40,
            "axis": ["y"] * 40,
            "log_density": (lpd / 40 + wobble - wobble.mean()).tolist(),
        },
        "curves": {},
        "predictions": [{"monte_carlo_sd": 0.01}],
        "residual_tests": [],
        "residual_rms": {"y": 1.0},
        "fit_scores": scores,
        "held_out": [],
        "order_is_integer": [],
        "sums_of_lags": [],
        "containment": {"contains": [], "sampled_again": False, "met": True},
    }
    return base | reported


@cache
def any_study() -> Study:
    return problem().study


def outcome(*cards: dict) -> dict:
    return judged(cards, any_study())


def test_the_simpler_of_equals_suffices_and_the_gain_is_reported():
    reported = outcome(card("two", 10.0, 5.0), card("three", 10.3, 5.0, parameters=7))
    assert reported["preferred"] == "two"
    assert "three, with more parameters, gains +0.3 ± 0.1 nats" in reported["why"]
    assert reported["agreement"]["agree"]
    richer = outcome(card("two", 10.0, 5.0), card("three", 14.0, 5.0, parameters=7))
    assert richer["preferred"] == "three"


def test_unseen_records_decide_where_fit_and_prediction_disagree():
    held = [{"record": "b", "axis": "y", "unit": "rad", "rmse": 2.0, "samples": 40}]
    fits = card("one", 30.0, 5.0, held_out=held, residual_rms={"y": 0.5})
    predicts = card("two", 10.0, 15.0, held_out=[held[0] | {"rmse": 1.0}])
    reported = outcome(fits, predicts)
    assert reported["preferred"] == "two"
    assert reported["agreement"]["agree"] is False
    assert "one has the highest evidence and predicts worst of all" in reported["why"]
    equal = outcome(fits, predicts | {"log_evidence": 30.3, "parameters": 7})
    assert "one is the simplest that no evidence speaks against and predicts worst of all" in equal["why"]
    assert [flag["kind"] for flag in reported["flags"]] == ["overfit"]
    same_record = outcome(card("one", 30.0, 5.0), card("two", 10.0, 15.0))
    assert same_record["preferred"] == "one"  # no unseen record: a warning alone
    assert "warning" in same_record["why"]


def test_an_unusable_candidate_is_ranked_nowhere():
    reported = outcome(
        card("one", 10.0, 5.0),
        card("two", 9.0, 5.0),
        card("bad", 90.0, 50.0, usable=False, grade_reason="its draws do not vary"),
    )
    row = next(model for model in reported["models"] if model["name"] == "bad")
    assert reported["preferred"] == "one"
    assert row["probability"] is row["stacking"] is row["elpd"] is None
    assert "its draws do not vary" in reported["unranked"][0]["reason"]


def test_without_evidence_prediction_stands_alone():
    reported = outcome(
        card("one", None, 5.0, evidence_undefined="improper prior of gain"), card("two", 9.0, 5.0)
    )
    assert reported["evidence_undefined"][0]["name"] == "one"
    assert reported["models"][0]["elpd"] is not None
    assert reported["models"][0]["probability"] is None
    neither = outcome(card("one", None, 5.0), card("two", None, 9.0))
    assert neither["preferred"] == "two"


def fractional(gain: float, predicted: float, **reported: object) -> str:
    free = card("free", gain, predicted, parameters=6, **reported)
    return str(outcome(free, card("first-order", 0.0, 0.0, **reported))["fractional"]["verdict"])


def test_a_fractional_win_needs_evidence_and_prediction():
    assert fractional(20.0, 10.0) == "warranted"
    assert fractional(20.0, 0.0) == "not shown"
    assert fractional(2.0, 10.0) == "not shown"
    assert fractional(20.0, -10.0) == "not warranted"
    assert fractional(-20.0, 0.0) == "not warranted"


def test_a_win_needs_sums_of_lags_to_lose_too():
    def held(support: str, advantage: float) -> dict:
        lags = {
            "said": "sums of 2 lags",
            "paths": ["p"],
            "support": support,
            "aic_advantage": advantage,
        }
        free = card("free", 20.0, 10.0, parameters=6, sums_of_lags=[lags])
        return dict(outcome(free, card("first-order", 0.0, 0.0))["fractional"])

    assert held("plant", -30.0)["verdict"] == "warranted"
    assert "against first-order and sums of lags" in held("plant", -30.0)["sentence"]
    assert held("both", 3.0)["verdict"] == "not shown"
    assert (
        "sums of 2 lags for p (AIC lower by 3.0) follow the records as well" in held("both", 3.0)["sentence"]
    )
    assert held("lags", 30.0)["verdict"] == "not warranted"
    assert "AIC lower by 30.0) follow the records better" in held("lags", 30.0)["sentence"]


def test_a_win_that_hangs_on_the_prior_is_not_claimed():
    free = card("free", 20.0, 10.0, parameters=6, prior_widths=prior_widths(20.0, 1.0))
    whole = card("first-order", 0.0, 0.0)
    assert outcome(free, whole)["fractional"]["verdict"] == "not shown"


@pytest.mark.parametrize(("half", "twice", "said"), [(None, 20.0, "0.5"), (20.0, None, "2")])
def test_a_width_that_could_not_be_computed_is_reported_and_no_win_claimed(half, twice, said):
    """Such a width is no width at which the win holds."""
    whole = card("first-order", 0.0, 0.0)
    known = outcome(card("free", 20.0, 10.0, parameters=6, prior_widths=prior_widths(20.0, 19.0)), whole)
    assert known["fractional"]["verdict"] == "warranted"
    assert "least over priors half and twice as wide +19.0" in known["fractional"]["sentence"]
    free = card("free", 20.0, 10.0, parameters=6, prior_widths=prior_widths(half, twice))
    found = outcome(free, whole)["fractional"]
    assert found["verdict"] == "not shown"
    assert f"under priors {said} times as wide free gave no evidence" in found["sentence"]
    other = outcome(
        card("free", 20.0, 10.0, parameters=6), whole | {"prior_widths": prior_widths(half, twice)}
    )
    assert "first-order gave no evidence" in other["fractional"]["prior_widths_unknown"][0]
    lost = outcome(card("free", -20.0, -20.0, parameters=6, prior_widths=prior_widths(half, twice)), whole)
    assert lost["fractional"]["verdict"] == "not warranted"


def test_a_high_order_over_a_residual_that_is_not_white_is_flagged():
    high = {"estimate": {"name": "order_1", "value": 1.7, "lower": 1.6, "upper": 1.8}}
    left = {"record": "a", "axis": "y", "held_out": False, "p_white": 1e-8}
    one = card("one", 0.0, 0.0, residual_tests=[left], order_is_integer=[high])
    plain = card("two", 0.0, 0.0, residual_tests=[left | {"p_white": 0.5}], order_is_integer=[high])
    flags = decided(judged_rows(one, plain))["flags"]
    assert [(flag["model"], flag["kind"]) for flag in flags] == [("one", "imitation")]


def test_a_residual_is_held_against_all_that_are_tested():
    left = [{"record": "a", "axis": f"y{k}", "held_out": False, "p_white": 0.9} for k in range(9)]
    for p, flagged in ((0.005, []), (0.0005, ["one"])):
        one = card("one", 0.0, 0.0, residual_tests=[*left, left[0] | {"p_white": p}])
        flags = decided(judged_rows(one, card("two", 0.0, 0.0)))["flags"]
        assert [flag["model"] for flag in flags] == flagged


def judged_rows(*cards: dict) -> list[dict]:
    totals = {"elpd": 0.0, "elpd_monte_carlo_sd": 0.0, "held_out_rmse": {}}
    return [one | totals for one in cards]


def test_the_error_of_a_difference_holds_what_the_draws_add():
    """Second method: the spread over ten stretches of four samples, and the Monte Carlo error of both."""
    cards = [card("base", -100.0, -50.0), card("longer", -100.0, -40.0)]
    behind, best = judged(cards, any_study())["models"]
    gap = np.subtract(*(one["pointwise"]["log_density"] for one in cards))
    where = stretches(cards[0]["pointwise"])
    sums = np.bincount(where, gap)
    expected = np.sqrt(sums.size * np.var(sums, ddof=1) + 2 * 0.01**2)
    assert behind["elpd_difference"] == pytest.approx(-10.0)
    assert behind["elpd_difference_sd"] == pytest.approx(expected)
    assert best["elpd_difference_sd"] == 0.0
