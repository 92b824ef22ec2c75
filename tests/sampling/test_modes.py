"""Modes of a marginal: planted ones are found with their shares, a single one is never split."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lcopa_bayes.sampling.convergence import Quality, overall, shares_grade
from lcopa_bayes.sampling.modes import Modes, modes_of

SHAPE = (4, 25, 10)
"""Ensembles, walkers, draws: a thousand independent draws."""
GOOD = Quality("order_2", 900.0, 900.0, 1.0)


def mixture(rng, shares, distance=6.0, shape=SHAPE, *, stay=False):
    """Normal modes at 0 and `distance`, the upper one with `shares` per ensemble; walkers may never leave."""
    upper = rng.random((*shape[:2], 1 if stay else shape[2])) < np.reshape(shares, (-1, 1, 1))
    return rng.normal(size=shape) + distance * upper


@pytest.mark.parametrize("log_scale", [False, True])
@pytest.mark.parametrize("stay", [False, True])
def test_two_modes_are_found_with_their_shares(rng, log_scale, stay):
    x = mixture(rng, [0.7], shape=(4, 200, 10), stay=stay)
    found = modes_of("order_2", "-", np.exp(x) if log_scale else x, log_scale=log_scale)
    (boundary,) = np.log(found.boundaries) if log_scale else found.boundaries
    assert 2.0 < boundary < 4.0
    assert np.all(np.abs(found.shares - [0.3, 0.7]) < 4 * found.errors)
    assert np.all(np.abs(found.pooled - [0.3, 0.7]) < 4 * found.pooled_errors)
    exact = np.sqrt(0.3 * 0.7 / (200 if stay else 2000))
    assert found.errors == pytest.approx(exact, rel=0.25)
    assert found.pooled_errors[0] == pytest.approx(exact / 2, rel=0.8)
    assert found.shares.sum(axis=1) == pytest.approx(1.0)


def test_three_modes_from_the_lowest_up(rng):
    which = rng.choice(3, p=[0.2, 0.3, 0.5], size=(4, 50, 20))
    found = modes_of("time_1", "ms", rng.normal(size=which.shape) + 8 * which)
    assert [round(b / 4) for b in found.boundaries] == [1, 3]
    assert found.pooled == pytest.approx([0.2, 0.3, 0.5], abs=0.04)
    assert found.sentence().startswith("three modes of time_1 (separated at ")


SINGLE = {
    "normal": lambda rng: rng.normal(size=SHAPE),
    "uniform": lambda rng: rng.random(SHAPE),
    "gamma": lambda rng: rng.gamma(2.0, size=SHAPE),
    "piled up at an open edge": lambda rng: rng.gamma(0.5, size=SHAPE),
    "lognormal": lambda rng: rng.lognormal(sigma=1.0, size=SHAPE),
    "exponential": lambda rng: rng.exponential(size=SHAPE),
    "highest at its bound": lambda rng: rng.beta(5.0, 1.0, size=SHAPE),
    "heavy tails": lambda rng: rng.standard_t(2.0, size=SHAPE),
}


@pytest.mark.parametrize("name", SINGLE)
def test_one_mode_stays_one(name):
    split = [
        len(modes_of("x", "-", SINGLE[name](np.random.default_rng(seed))).boundaries) for seed in range(100)
    ]
    assert np.mean(np.array(split) > 0) <= 0.05


def test_two_modes_are_found_in_nearly_every_sample():
    found = [modes_of("x", "-", mixture(np.random.default_rng(seed), [0.7])) for seed in range(50)]
    assert np.mean([len(one.boundaries) == 1 for one in found]) >= 0.95
    assert np.mean([one.pooled[1] for one in found]) == pytest.approx(0.7, abs=4 * np.sqrt(0.21 / 50_000))


@pytest.mark.parametrize(("distance", "modes"), [(3.0, 1), (5.0, 2)])
def test_a_shallow_valley_does_not_part_modes(rng, distance, modes):
    """Midway the density is 0.64 or 0.09 of that on either mode; the limit is a half."""
    found = modes_of("x", "-", mixture(rng, [0.5], distance, (4, 100, 100)))
    assert len(found.boundaries) + 1 == modes


def test_sluggish_walkers_on_one_mode_do_not_make_two():
    """An autoregression with an autocorrelation time of about 19: 20 000 draws are worth a thousand."""
    split = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        x = rng.normal(size=(4, 25, 200))
        for k in range(1, 200):
            x[..., k] = 0.9 * x[..., k - 1] + np.sqrt(1 - 0.9**2) * x[..., k]
        split += len(modes_of("x", "-", x).boundaries) > 0
    assert split <= 1


@given(st.floats(1e-6, 1e6), st.floats(-1e3, 1e3), st.integers(0, 5))
@settings(max_examples=20, deadline=None)
def test_units_do_not_matter(scale, shift, seed):
    x = mixture(np.random.default_rng(seed), [0.6])
    plain, other = modes_of("x", "-", x), modes_of("x", "-", scale * (x + shift))
    assert len(plain.boundaries) == len(other.boundaries) == 1
    assert other.boundaries[0] / scale - shift == pytest.approx(plain.boundaries[0], abs=0.2)
    assert other.shares == pytest.approx(plain.shares, abs=0.01)


@pytest.mark.parametrize("log_scale", [False, True])
def test_draws_that_rounding_tells_apart_have_one_mode(rng, log_scale):
    """As of an ensemble that has not moved: a histogram has more cells than numbers lie between them."""
    values = 3.7 + np.spacing(3.7) * rng.integers(0, 40, SHAPE)
    assert modes_of("gain", "-", values, log_scale=log_scale).boundaries == ()


def test_draws_that_do_not_vary_have_one_mode():
    assert modes_of("x", "-", np.ones(SHAPE)).boundaries == ()
    assert modes_of("x", "-", np.ones(SHAPE)).sentence() == "one mode of x"


@pytest.mark.parametrize("bad", [np.ones((2, 3)), np.full(SHAPE, np.nan), -np.ones(SHAPE)])
def test_draws_that_cannot_be_used_are_refused(bad):
    with pytest.raises(ValueError, match="draws must be"):
        modes_of("x", "-", bad, log_scale=True)


def test_shares_must_fit_the_boundaries():
    with pytest.raises(ValueError, match="2 modes"):
        Modes("x", "-", (1.0,), np.ones((2, 3)), np.ones((2, 3)))


# ---------------------------------------------------------------- the grade


def reported(lower, error=0.01) -> Modes:
    lower = np.array(lower)
    shares = np.column_stack([lower, 1 - lower])
    return Modes("order_2", "-", (1.1,), shares, np.full(shares.shape, error))


@pytest.mark.parametrize(
    ("lower", "error", "spread", "level"),
    [
        ([0.3, 0.3, 0.3, 0.3], 0.01, 0.0, "reliable"),
        ([0.3, 0.34, 0.3, 0.3], 0.005, 0.04, "reliable"),
        ([0.3, 0.36, 0.3, 0.3], 0.005, 0.06, "tentative"),
        ([0.3, 0.36, 0.3, 0.3], 0.02, 0.0, "reliable"),  # within Monte Carlo error
        ([0.3, 0.5, 0.4, 0.3], 0.01, 0.2, "tentative"),
        ([0.3, 0.52, 0.4, 0.3], 0.01, 0.22, "unusable"),
    ],
)
def test_unequal_shares_lower_the_grade(lower, error, spread, level):
    found = reported(lower, error)
    assert found.spread == pytest.approx(spread)
    assert shares_grade(found).level == level
    graded = overall([GOOD], 400, [found])
    assert graded.level == level
    assert ("run longer" in graded.reason) == (level != "reliable")
    if level != "reliable":
        wanted = f"two modes of order_2 (below and above 1.1), share of the lower mode {min(lower):.2f} to "
        assert graded.reason.startswith(f"{wanted}{max(lower):.2f} over independent sets of draws")


def test_the_worse_of_shares_and_quality_counts_and_both_are_reported():
    weak = Quality("delay", 300.0, 300.0, 1.0)
    graded = overall([weak], 400, [reported([0.3, 0.6])])
    assert graded.level == "unusable"
    assert "two modes" in graded.reason
    assert "delay" in graded.reason
    assert overall([Quality("delay", 9.0, 9.0, 1.5)], 400, [reported([0.3, 0.4])]).level == "unusable"
    several = overall([GOOD], 400, [reported([0.3, 0.4]), reported([0.3, 0.5])])
    assert "0.30 to 0.50" in several.reason
    assert "(and 1 more like this)" in several.reason


def test_from_draws_to_the_grade():
    rng = np.random.default_rng(7)
    shape = (4, 100, 10)
    alike = modes_of("order_2", "-", mixture(rng, [0.4], shape=shape))
    uneven = modes_of("order_2", "-", mixture(rng, [0.3, 0.4, 0.5, 0.6], shape=shape))
    apart = modes_of("order_2", "-", mixture(rng, [0.0, 0.0, 1.0, 1.0], shape=shape))
    assert [overall([GOOD], 400, [one]).level for one in (alike, uneven, apart)] == [
        *("reliable", "unusable", "unusable"),
    ]
    assert alike.spread == 0.0
    assert "equal in all sets of draws" in alike.sentence()
    assert uneven.spread == pytest.approx(0.3, abs=0.06)
    assert apart.spread > 0.98


def test_equal_shares_hardly_ever_lower_the_grade():
    lowered = [
        shares_grade(modes_of("x", "-", mixture(np.random.default_rng(seed), [0.4]))).level != "reliable"
        for seed in range(100)
    ]
    assert np.mean(lowered) <= 0.05


def test_plain_values_say_all(rng):
    said = modes_of("x", "ms", mixture(rng, [0.7])).as_json()
    assert {
        "parameter",
        "unit",
        "boundaries",
        "shares",
        "shares_mcse",
        "pooled",
        "pooled_mcse",
    } <= said.keys()
    assert (len(said["shares"]), len(said["shares"][0]), len(said["pooled"])) == (4, 2, 2)
    assert all(a < b for a, b in pairwise(said["boundaries"]))
