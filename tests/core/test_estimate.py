"""Estimates: quantiles, open sides, and JSON that every reader accepts."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy import stats

from lcopa_bayes.core.estimate import EQUAL_TAILED, HALF_WIDTH, LEVEL, Estimate, plain


def of(draws: np.ndarray) -> Estimate:
    return Estimate.of("it", "ms", np.asarray(draws, dtype=float), ess=100.0, grade="reliable")


def test_quantiles_are_those_of_the_distribution():
    draws = stats.expon.ppf((np.arange(20_000) + 0.5) / 20_000)
    reported = of(draws)
    assert (reported.lower, reported.value, reported.upper) == pytest.approx(
        stats.expon.ppf([0.05, 0.5, 0.95]), rel=1e-3
    )
    assert (reported.mean, reported.sd) == pytest.approx((1.0, 1.0), rel=1e-3)
    assert (reported.level, reported.interval) == (0.9, EQUAL_TAILED)
    assert stats.norm.cdf([-HALF_WIDTH, HALF_WIDTH]) == pytest.approx(
        [(1 - LEVEL) / 2, (1 + LEVEL) / 2], rel=1e-12
    )


def test_draws_that_never_reach_it_open_the_upper_side():
    reported = of(np.r_[np.linspace(1, 2, 90), np.full(10, np.inf)])
    assert reported.upper == np.inf
    assert 1 < reported.value < 2
    assert np.isnan([reported.mean, reported.sd]).all()
    out = reported.as_json()
    assert (out["upper"], out["mean"], out["sd"]) == (None, None, None)
    assert out["lower"] == reported.lower
    few = of(np.r_[np.linspace(1, 2, 97), np.full(3, np.inf)])
    assert 1 < few.upper <= 2
    most = of(np.r_[np.linspace(1, 2, 10), np.full(90, np.inf)])
    assert (most.value, most.upper) == (np.inf, np.inf)
    assert np.isfinite(most.lower)
    none = of(np.full(10, np.inf))
    assert none.as_json()["lower"] is None


def test_nan_draws_are_an_error():
    with pytest.raises(ValueError, match="it: 2 of 5 draws are NaN"):
        of([1.0, np.nan, 2.0, np.nan, 3.0])


def test_json_has_what_other_tools_rely_on():
    out = of(np.arange(10.0)).as_json()
    assert {
        "name",
        "unit",
        "value",
        "mean",
        "sd",
        "lower",
        "upper",
        "level",
        "interval",
        "ess",
        "grade",
    } == set(out)
    noted = Estimate.of("it", "-", np.ones(3), ess=1.0, grade="unusable", note="why").as_json()
    assert noted["note"] == "why"


def test_plain_makes_strict_json():
    nested = {
        "array": np.array([[1.0, np.nan], [np.inf, -2.5]]),
        "numbers": (np.float64(-np.inf), np.int64(3), np.bool_(True), 2, True, None, "text"),
        "scalar array": np.array(4.0),
        1: [{"deep": np.float32(0.5)}],
    }
    reported = plain(nested)
    assert reported == {
        "array": [[1.0, None], [None, -2.5]],
        "numbers": [None, 3, True, 2, True, None, "text"],
        "scalar array": 4.0,
        "1": [{"deep": 0.5}],
    }
    assert type(reported["numbers"][2]) is bool
    assert json.loads(json.dumps(reported, allow_nan=False)) == reported
