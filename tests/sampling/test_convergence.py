"""Grades: independent normal draws pass, modes that ensembles disagree about do not."""

from __future__ import annotations

import re

import numpy as np
import pytest
from small import draws_of, problem

from lcopa_bayes.sampling.convergence import (
    Grade,
    Limitation,
    Quality,
    also_said,
    between,
    drift,
    limited,
    overall,
    qualities,
    with_shares,
)
from lcopa_bayes.sampling.modes import Modes

SHAPE = (4, 16, 60)
"""Ensembles, walkers, draws."""


def one(values: np.ndarray) -> Quality:
    (quality,) = qualities(["it"], values[..., None])
    return quality


def normal(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=SHAPE)


def test_independent_normal_draws_are_reliable():
    quality = one(normal())
    count = np.prod(SHAPE)
    assert quality.rhat < 1.005
    assert 0.7 * count < quality.ess_bulk < 1.3 * count
    assert 0.5 * count < quality.ess_tail < 1.5 * count
    assert quality.grade(400).level == "reliable"
    assert overall([quality], 400).level == "reliable"
    assert "independent sets of draws agree" in overall([quality], 400).reason


def test_ensembles_on_different_modes_are_unusable_however_many_draws():
    apart = normal() + np.array([0.0, 0.0, 0.0, 6.0])[:, None, None]
    quality = one(apart)
    assert quality.rhat > 1.1
    assert quality.grade(1).level == "unusable"
    reported = overall([quality], 1)
    assert reported.level == "unusable"
    assert "several modes" in reported.reason


def test_modes_that_all_ensembles_weigh_differently_are_not_reliable():
    rng = np.random.default_rng(1)
    share = np.array([0.2, 0.4, 0.6, 0.8])
    mode = rng.random(SHAPE[:2]) < share[:, None]  # a walker never changes its mode
    assert one(normal() + 5.0 * mode[..., None]).grade(1).level != "reliable"


def test_modes_that_every_walker_visits_are_fine():
    mode = np.random.default_rng(2).random(SHAPE) < 0.5
    assert one(normal() + 5.0 * mode).grade(400).level == "reliable"


def test_ensembles_of_different_width_are_seen():
    wide = normal() * np.array([1.0, 1.0, 1.0, 4.0])[:, None, None]
    assert one(wide).grade(400).level != "reliable"


def test_slow_walkers_have_few_effective_draws():
    rng = np.random.default_rng(3)
    rho, walk = 0.98, rng.normal(size=SHAPE)
    for k in range(1, SHAPE[2]):
        walk[..., k] = rho * walk[..., k - 1] + np.sqrt(1 - rho**2) * walk[..., k]
    quality = one(walk)
    assert quality.ess_bulk < 0.1 * np.prod(SHAPE)
    assert quality.grade(np.prod(SHAPE)).level != "reliable"


def test_effective_sample_size_of_an_autoregression():
    rng, rho = np.random.default_rng(4), 0.7
    chains = rng.normal(size=(4, 4, 2000))
    for k in range(1, 2000):
        chains[..., k] = rho * chains[..., k - 1] + np.sqrt(1 - rho**2) * chains[..., k]
    exact = chains.size * (1 - rho) / (1 + rho)
    assert one(chains).ess_bulk == pytest.approx(exact, rel=0.15)


def test_a_parameter_that_does_not_vary_is_unusable():
    stuck = np.ones(SHAPE)
    assert one(stuck).grade(1).level == "unusable"


@pytest.mark.parametrize("bulk_tail", [(np.nan, 500.0), (500.0, np.nan)])
def test_an_undefined_sample_size_is_never_overlooked(bulk_tail):
    quality = Quality("it", *bulk_tail, 1.0)
    assert np.isnan(quality.ess)
    assert quality.grade(1).level == "unusable"


@pytest.mark.parametrize(
    ("rhat", "ess", "level"),
    [
        (1.0, 400, "reliable"),
        (1.02, 400, "reliable"),
        (1.021, 400, "tentative"),
        (1.0, 399, "tentative"),
        (1.1, 100, "tentative"),
        (1.101, 400, "unusable"),
        (1.0, 99, "unusable"),
        (np.nan, 400, "unusable"),
    ],
)
def test_levels(rhat, ess, level):
    quality = Quality("it", ess, 2 * ess, rhat)
    assert quality.grade(400).level == level
    assert f"R-hat {rhat:.3f}, effective sample size {ess}" in quality.grade(400).reason


def test_the_worst_parameter_grades_the_run_and_is_named():
    good, weak, bad = (
        Quality("good", 900, 900, 1.0),
        Quality("weak", 300, 300, 1.0),
        Quality("bad", 9, 9, 1.3),
    )
    assert overall([good], 400).level == "reliable"
    reported = overall([good, weak, Quality("other", 350, 350, 1.0)], 400)
    assert reported.level == "tentative"
    assert reported.reason.startswith("weak")
    assert "(also other)" in reported.reason
    assert "sample more steps" in reported.reason
    assert overall([good, weak, bad], 400).reason.startswith("bad")
    worst = Grade.worst([quality.grade(400) for quality in (good, bad, weak)])
    assert worst == bad.grade(400)


# -- limitations -----------------------------------------------------------------------------------


@pytest.mark.parametrize("sampled", ["reliable", "tentative", "unusable"])
def test_the_grade_is_the_worst_of_the_sampling_and_every_limitation_and_names_all(sampled):
    before = Grade(sampled, "the ensembles")
    first = Limitation("tentative", "intervals hold only if A", "do A")
    second = Limitation("unusable", "intervals hold only if B")
    assert limited(before, []) is before
    assert limited(before, [first]).level == ("tentative" if sampled == "reliable" else sampled)
    both = limited(before, [first, second])
    assert both.level == "unusable"
    for words in ("the ensembles", "intervals hold only if A; do A", "intervals hold only if B"):
        assert words in both.reason
    # what no sampling mends comes first
    assert both.reason.index("only if B") < min(map(both.reason.index, ("only if A", "the ensembles")))
    alone = limited(before, [first])
    assert (alone.reason.index("the ensembles") < alone.reason.index("only if A")) is (sampled != "reliable")


def test_a_limitation_that_names_parameters_leaves_the_others():
    one = Limitation("tentative", "intervals hold only if A", parameters=("gain",))
    table = problem().posterior.table
    draws = draws_of(table, np.ones((8, len(table.rows)))).limited([one])
    assert draws.grade.level == "tentative"
    grades = {estimate.name: estimate.grade for estimate in draws.estimates()}
    assert grades["gain"] == "tentative"
    assert {grade for name, grade in grades.items() if name != "gain"} == {"reliable"}
    assert draws.limited([Limitation("unusable", "B")]).limitations[0] is one


# -- the grade as a decision ------------------------------------------------------------------------


def share_reliable(ensembles: int, error: float, trials: int = 100, draws: int = 60) -> float:
    """Of `trials` runs whose ensembles are off by normal errors of `error` standard deviations each."""
    rng = np.random.default_rng([ensembles, round(100 * error)])
    reliable = 0
    for _ in range(trials):
        off = error * rng.standard_normal((ensembles, 1, 1))
        reliable += one(rng.standard_normal((ensembles, 16, draws)) + off).grade(400).level == "reliable"
    return reliable / trials


@pytest.mark.parametrize("ensembles", [2, 4, *(pytest.param(n, marks=pytest.mark.slow) for n in (3, 8))])
def test_errors_that_an_ensemble_shares_are_rarely_called_reliable(ensembles):
    """0.3 posterior standard deviations each: promised is one in ten, four errors of a share are granted."""
    assert share_reliable(ensembles, 0.3) <= 0.1 + 4 * np.sqrt(0.1 * 0.9 / 100)


@pytest.mark.parametrize(
    ("ensembles", "draws"),
    [(2, 240), (4, 60), *(pytest.param(n, 60, marks=pytest.mark.slow) for n in (3, 8))],
)
def test_independent_draws_are_nearly_always_called_reliable(ensembles, draws):
    """As many draws as the docstring of the bound promises nine of ten for, and more."""
    share = share_reliable(ensembles, 0.0, draws=draws)
    assert share >= 0.9 - 4 * np.sqrt(0.1 * 0.9 / 100)
    assert ensembles == 2 or share >= 0.95


@pytest.mark.parametrize("ensembles", [2, *(pytest.param(n, marks=pytest.mark.slow) for n in (4, 8))])
def test_scatter_of_ensemble_means_is_worth_as_many_draws_as_they_scatter(ensembles):
    """The reciprocal of the effective sample size is without bias: error**2 / ensembles."""
    rng, error, trials = np.random.default_rng(ensembles), 0.2, 400
    worth = []
    for _ in range(trials):
        off = error * rng.standard_normal((ensembles, 1, 1))
        worth.append(between(rng.standard_normal((ensembles, 16, 60)) + off)[0])
    exact = error**2 / ensembles + 1 / (960 * ensembles)
    mean = np.mean(1 / np.array(worth))
    assert mean == pytest.approx(exact, rel=0.05 + 4 * np.sqrt(2 / (ensembles - 1) / trials))


def test_the_bound_on_the_scatter_holds_as_often_as_promised():
    rng, error, trials = np.random.default_rng(9), 0.3, 300
    held = 0
    for _ in range(trials):
        off = error * rng.standard_normal((3, 1, 1))
        held += between(rng.standard_normal((3, 16, 60)) + off)[1] >= error / np.sqrt(1 + error**2)
    assert held / trials == pytest.approx(0.9, abs=4 * np.sqrt(0.9 * 0.1 / trials))


def test_ensembles_that_scatter_too_much_say_so_and_what_to_do():
    quality = Quality("it", 900.0, 900.0, 1.01, ess_between=60.0, scatter=0.5)
    grade = quality.grade(400)
    assert (grade.level, quality.ess) == ("tentative", 60.0)
    assert "an error of 0.50 standard deviations" in quality.remedy(400)
    assert "more ensembles" in quality.remedy(400)


def test_slow_exchange_between_modes_counts():
    """A mean that is known well beside shares of modes that are not."""
    shares = np.array([[0.02, 0.98], [0.04, 0.96], [0.06, 0.94], [0.04, 0.96]])
    found = Modes("it", "-", (1.0,), shares, np.full((4, 2), 0.001))
    exact = 0.04 * 0.96 / (shares[:, 0].var(ddof=1) / 4)
    assert found.ess == pytest.approx(exact)
    assert with_shares(Quality("it", 900.0, 900.0, 1.0), [found]).ess == pytest.approx(exact)
    assert with_shares(Quality("other", 900.0, 900.0, 1.0), [found]).ess == 900.0


def filling(rng: np.random.Generator, start: float, end: float) -> np.ndarray:
    """Draws whose second mode fills from a share to another in all ensembles alike; walkers stay long."""
    share = np.linspace(start, end, 60)
    threshold = rng.random((4, 64, 1)) if start != end else rng.random((4, 64, 60))
    return rng.standard_normal((4, 64, 60)) + 6.0 * (threshold < share)


def test_a_mode_that_fills_in_all_ensembles_alike_is_not_reliable():
    """Neither R-hat nor the scatter between ensembles can see what they have in common."""
    called = []
    for seed in range(20):
        quality = one(filling(np.random.default_rng(seed), 0.01, 0.07))
        assert quality.ess_drift < 0.05 * 0.95 / 0.02**2 * 2 or np.isinf(quality.ess_drift)
        called.append(np.isfinite(quality.ess_drift))
        if called[-1]:
            assert "still drift" in quality.remedy(1e9)
    assert np.mean(called) > 0.5


def test_draws_that_do_not_drift_are_rarely_said_to():
    """Three standard errors of three statistics: 0.8 % by a normal law."""
    drifts = sum(np.isfinite(drift(filling(np.random.default_rng(seed), 0.05, 0.05))) for seed in range(100))
    assert drifts <= 1 + 4


def test_the_worth_of_a_drift_in_closed_form():
    """A mean that rises linearly by a is 2 a / 3 higher in the last third."""
    rng = np.random.default_rng(0)
    values = rng.standard_normal((4, 64, 60)) + 0.3 * np.linspace(-0.5, 0.5, 60)
    assert drift(values) == pytest.approx(1 / 0.2**2, rel=0.3)


def test_a_reason_names_a_few_of_many_parameters():
    """A page that begins with thirty names is not read."""
    draws = np.stack([normal(k) + np.array([0.0, 0.0, 0.0, 6.0])[:, None, None] for k in range(9)], axis=-1)
    reason = overall(qualities([f"p{k}" for k in range(9)], draws), 1).reason
    assert len(re.findall(r"\bp\d\b", reason)) == 4
    assert " and 5 more)" in reason
    assert also_said(["a", "b", "c"]) == " (also a, b, c)"
    assert also_said([]) == ""
