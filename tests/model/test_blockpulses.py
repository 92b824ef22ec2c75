"""Weights of fractional integration against 40 digits, closed forms and their own algebra."""

from __future__ import annotations

from functools import partial
from math import gamma

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from lcopa_bayes.model.blockpulses import (
    integration_matrix,
    integration_weights,
    integration_weights_and_slopes,
    lower_toeplitz,
)

ORDERS = (0.0, 1e-3, 0.5, 0.9, 0.999, 1.0, 1.3, 1.7, 2.0, 2.6, 3.0)
PLACES = (0, 1, 2, 3, 7, 14, 15, 16, 17, 18, 25, 60, 333, 1200, 1999)
orders_of = pytest.mark.parametrize("order", ORDERS)
mpmath.mp.dps = 40


def exact_weight(order: mpmath.mpf, place: int, step: float) -> mpmath.mpf:
    q, p = mpmath.mpf(order) + 1, mpmath.mpf(place)
    bend = mpmath.mpf(1) if place == 0 else (p + 1) ** q - 2 * p**q + (p - 1) ** q
    return mpmath.mpf(step) ** (q - 1) / mpmath.gamma(q + 1) * bend


def weights(order: float, n: int, step: float) -> np.ndarray:
    return integration_weights(np.array([order]), n, step)[0]


@orders_of
def test_integral_of_one_is_exact(order):
    n, step = 64, 0.25
    edges = step * np.arange(n + 1)
    exact = np.diff(edges ** (order + 1)) / (step * gamma(order + 2))
    assert_allclose(integration_matrix(order, n, step) @ np.ones(n), exact, rtol=1e-12)


@orders_of
@pytest.mark.parametrize("step", [1e-3, 0.0123, 7.0])
def test_weights_have_the_accuracy_they_claim(order, step):
    n = 2000
    exact = np.array([float(exact_weight(order, place, step)) for place in PLACES])
    scale = exact[0] * max(1.0, n ** (order - 1))
    assert np.abs(weights(order, n, step)[list(PLACES)] - exact).max() <= 1e-13 * scale


@pytest.mark.parametrize("order", [0.02, 0.5, 0.9, 1.3, 1.7, 2.6])
def test_direct_and_series_weights_meet(order):
    """The weights change from direct differences to their series at index 16."""
    exact = np.array([float(exact_weight(order, place, 1.0)) for place in range(12, 22)])
    assert_allclose(weights(order, 40, 1.0)[12:22], exact, rtol=3e-12)
    assert_allclose(weights(order, 17, 1.0), weights(order, 40, 1.0)[:17], rtol=1e-14)
    for n in (1, 2, 15, 16):
        assert_array_equal(weights(order, n, 1.0), weights(order, 40, 1.0)[:n])


def test_whole_orders_are_known():
    n, step = 50, 0.3
    p = np.arange(1.0, n)
    assert_array_equal(weights(0.0, n, step), np.eye(1, n)[0])
    assert_allclose(weights(1.0, n, step), step * np.r_[0.5, np.ones(n - 1)], rtol=1e-14)
    assert_allclose(weights(2.0, n, step), step**2 * np.r_[1 / 6, p], rtol=1e-14)
    assert_allclose(weights(3.0, n, step), step**3 * np.r_[1 / 24, (12 * p**2 + 2) / 24], rtol=1e-13)


@orders_of
def test_slope_in_the_order_is_that_of_the_exact_weight(order):
    n, step = 2000, 0.0123
    slope = integration_weights_and_slopes(np.array([order]), n, step)[1][0]
    exact = [
        mpmath.diff(partial(exact_weight, place=place, step=step), mpmath.mpf(order), h=mpmath.mpf("1e-13"))
        for place in PLACES
    ]
    scale = weights(order, n, step)[0] * max(1.0, n ** (order - 1)) * abs(np.log(step))
    assert np.abs(slope[list(PLACES)] - np.array([float(each) for each in exact])).max() <= 1e-12 * scale


@settings(max_examples=60, deadline=None)
@given(order=st.floats(0.01, 3.0), n=st.integers(1, 200), step=st.floats(1e-3, 10.0))
def test_slope_in_the_order_agrees_with_differences(order, n, step):
    nudge = 1e-5
    late, early = (weights(order + sign * nudge, n, step) for sign in (1, -1))
    scale = weights(order, n, step).max() * (1 + abs(np.log(step)) + np.log(n)) ** 3
    slope = integration_weights_and_slopes(np.array([order]), n, step)[1][0]
    assert_allclose(slope, (late - early) / (2 * nudge), atol=1e-8 * scale, rtol=0)


def test_a_batch_is_its_members():
    batch = np.array([0.0, 0.4, 1.7, 2.0])
    together = integration_weights_and_slopes(batch, 40, 0.1)
    assert_array_equal(together[0], integration_weights(batch, 40, 0.1))
    for k, order in enumerate(batch):
        for rows, alone in zip(
            together, integration_weights_and_slopes(np.array([order]), 40, 0.1), strict=True
        ):
            assert_allclose(rows[k], alone[0], rtol=1e-13, atol=1e-15)


def test_composition_gap_is_first_order():
    n = np.array([64, 128, 256, 512])

    def gap(k: int) -> float:
        a, b, both = (integration_matrix(order, k, 1.0 / k) for order in (0.4, 0.6, 1.0))
        return float(np.abs(a @ b - both).max())

    slope = -np.polyfit(np.log(n), np.log([gap(k) for k in n]), 1)[0]
    assert 0.9 < slope < 1.1


def test_orders_commute_and_one_integrates_twice():
    a, b = integration_matrix(0.3, 40, 0.1), integration_matrix(1.4, 40, 0.1)
    assert_allclose(a @ b, b @ a, rtol=1e-13)
    once = integration_matrix(1.0, 40, 0.1)
    assert np.abs(once @ once - integration_matrix(2.0, 40, 0.1)).max() == pytest.approx(
        0.1**2 / 12, rel=1e-9
    )


@pytest.mark.parametrize(
    ("order", "n", "step"), [(-0.1, 4, 1.0), (1.0, 0, 1.0), (1.0, 4, 0.0), (np.nan, 4, 1.0)]
)
def test_impossible_matrices_are_refused(order, n, step):
    with pytest.raises(ValueError, match="need order >= 0"):
        integration_matrix(order, n, step)


def test_lower_toeplitz_repeats_its_column():
    assert_array_equal(lower_toeplitz(np.array([1.0, 2.0, 3.0])), [[1, 0, 0], [2, 1, 0], [3, 2, 1]])
