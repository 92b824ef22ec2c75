"""The chart: there and back, its volume, and what lies outside it."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.special import ndtri
from scipy.stats import norm
from small import TWO, Toy, problem, record

from lcopa_bayes.core.arrays import Matrix
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.coordinates import Chart

GAINS = {
    "uniform": ("uniform", {"loc": -5.0, "scale": 10.0}),
    "loguniform": ("loguniform", {"a": 0.1, "b": 30.0}),
    "gamma": ("gamma", {"a": 2.0, "scale": 1.0}),
}
CASES = {
    "one term": {"terms": 1, "priors": {"gain": GAINS["uniform"]}},
    "two terms": {"terms": 2, "priors": {"gain": GAINS["loguniform"]}},
    "three terms": {"terms": 3, "priors": {"gain": GAINS["gamma"]}},
    "gain integrated out": {"terms": 2},
    "correlated noise": {"terms": 2, "noise": "ar1", "priors": {"gain": GAINS["gamma"]}},
    "terms that cannot be exchanged": {
        "terms": 2,
        "priors": {"time_1": ("gamma", {"a": 2.0, "scale": 3.0}), "gain": GAINS["gamma"]},
    },
    "bounded delay and scale": {
        "terms": 1,
        "priors": {"delay": ("uniform", {"loc": 0.2, "scale": 1.0}), "sigma": ("uniform", {"loc": 0.01})},
    },
    "scale below its largest": {"terms": 1, "priors": {"sigma": ("uniform", {"loc": 0.0, "scale": 0.3})}},
    "two axes": {"share": "all", "noise": "student"},
}


@cache
def made(name: str) -> tuple[Posterior, Chart]:
    device = {"device": TWO} if name == "two axes" else {}
    posterior = problem(record(camera=1.0, **device), blocks=8, **CASES[name]).posterior
    return posterior, Chart.of(posterior)


def drawn(name: str, count: int, seed: int = 0) -> Matrix:
    """Prior draws in canonical order whose orders leave room for a difference quotient."""
    posterior, chart = made(name)
    z = posterior.coordinates(posterior.table.draw(20 * count, np.random.default_rng(seed)))
    clear = np.ones(len(z), dtype=bool)
    for element in chart.terrain.elements:
        orders = z[:, element.orders]
        clear &= ((orders > 0.1) & (orders < 1.9)).all(axis=1)
        clear &= (np.diff(orders, axis=1) < -0.1).all(axis=1)
        clear &= (np.abs(z[:, element.times]) < 4).all(axis=1)
    assert clear.sum() >= count
    return z[clear][:count]


@pytest.mark.parametrize("name", CASES)
def test_there_and_back(name):
    _, chart = made(name)
    z = drawn(name, 40)
    y, log_volume = chart.charted(z)
    back, exists = chart.uncharted(y)
    assert exists.all()
    assert np.isfinite(log_volume).all()
    assert_allclose(back, z, rtol=1e-6, atol=1e-6)
    again, _ = chart.charted(back)
    assert_allclose(again, y, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", CASES)
def test_the_volume_is_that_of_central_differences(name):
    _, chart = made(name)
    z = drawn(name, 15, seed=1)
    steps = 1e-5 * np.eye(z.shape[1])
    slopes = [(chart.charted(z + step)[0] - chart.charted(z - step)[0]) / 2e-5 for step in steps]
    exact = np.linalg.slogdet(np.stack(slopes, axis=2))[1]
    assert_allclose(chart.charted(z)[1], exact, atol=2e-4)


@pytest.mark.parametrize("name", CASES)
def test_what_is_charted_as_stated(name):
    """Probits between two ends and of a scale below its largest, ratios for times, gain over level; all
    else as it is."""
    posterior, chart = made(name)
    z = drawn(name, 10, seed=2)
    y, _ = chart.charted(z)
    touched = set()
    for element in chart.terrain.elements:
        touched |= {int(k) for k in element.times} | {k for k, _ in element.gains}
        slow = chart.terrain.slowest
        c = np.exp(z[:, element.orders] * z[:, element.times])
        level = 1 + (c * slow ** z[:, element.orders]).sum(axis=1)
        top = 1 + (c * chart.terrain.fastest ** z[:, element.orders]).sum(axis=1)
        assert_allclose(y[:, element.times[-1]], np.log(top / level), rtol=1e-9)
        for column, by_logarithm in element.gains:
            expected = z[:, column] - np.log(level) if by_logarithm else z[:, column] / level
            assert_allclose(y[:, column], expected, rtol=1e-9, atol=1e-12)
    for column, k in enumerate(posterior.sampled):
        low, high = posterior.table.rows[k].sampled_domain
        if column not in touched and np.isfinite(high - low):
            assert_allclose(y[:, column], ndtri((z[:, column] - low) / (high - low)), rtol=1e-9, atol=1e-9)
        elif column not in touched and np.isfinite(high):
            assert_allclose(y[:, column], ndtri(np.exp(z[:, column] - high)), rtol=1e-9, atol=1e-9)
        elif column not in touched:
            assert_array_equal(y[:, column], z[:, column])


@pytest.mark.parametrize("name", ["two terms", "three terms", "correlated noise"])
def test_exchanged_terms_are_the_same_point(name):
    _, chart = made(name)
    z = drawn(name, 20, seed=3)
    (element,) = chart.terrain.elements
    turned = z.copy()
    for columns in (element.times, element.orders):
        turned[:, columns] = z[:, columns[::-1]]
    assert not np.array_equal(turned, z)
    for one, other in zip(chart.charted(z), chart.charted(turned), strict=True):
        assert_array_equal(one, other)
    back, exists = chart.uncharted(chart.charted(turned)[0])
    assert exists.all()
    assert (np.diff(back[:, element.orders], axis=1) < 0).all()
    assert_allclose(back, z, rtol=1e-6, atol=1e-6)


def test_terms_that_cannot_be_exchanged_stay_where_they_are():
    _, chart = made("terms that cannot be exchanged")
    z = drawn("terms that cannot be exchanged", 10, seed=4)
    (element,) = chart.terrain.elements
    turned = z.copy()
    for columns in (element.times, element.orders):
        turned[:, columns] = z[:, columns[::-1]]
    back, exists = chart.uncharted(chart.charted(turned)[0])
    assert exists.all()
    assert_allclose(back, turned, rtol=1e-6, atol=1e-6)


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(["one term", "two terms", "three terms", "correlated noise", "gain integrated out"]),
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.01, 0.1, 1.0, 4.0]),
)
def test_a_point_of_the_chart_exists_or_is_flagged(name, seed, reach):
    """Wherever a mixture may draw: a point that exists comes back to itself, no other is used."""
    posterior, chart = made(name)
    random = np.random.default_rng(seed)
    y = chart.charted(drawn(name, 32, seed=seed))[0]
    y += reach * random.standard_t(3, size=y.shape)
    z, exists = chart.uncharted(y)
    assert exists.any() or reach > 0.01
    assert np.isfinite(z[exists]).all()
    assert chart.terrain.in_order(z[exists]).all()
    assert (posterior.values(z[exists])[:, posterior.table.of_kind("order")] < 2).all()
    again, log_volume = chart.charted(z[exists])
    sound = np.isfinite(log_volume) & (np.abs(z[exists]) < 50).all(axis=1)
    sound &= (np.abs(y[exists]) < 7).all(axis=1)  # beyond, a probit is rounded next to its end
    assert sound.any() or reach > 0.01
    assert_allclose(again[sound], y[exists][sound], rtol=1e-4, atol=1e-4)


def test_what_the_chart_has_no_point_for():
    _, chart = made("two terms")
    (element,) = chart.terrain.elements
    y = chart.charted(drawn("two terms", 5, seed=5))[0]
    assert chart.uncharted(y)[1].all()
    y[0, element.orders] = y[0, element.orders[::-1]]  # orders that increase
    y[1, element.times] = (-1.0, 1.0)  # a response that falls with frequency
    y[2, element.orders[0]] = 800.0  # an order that rounds to the end of its prior
    y[3, element.orders] = 0.3  # equal orders: the ratios say nothing of each
    z, exists = chart.uncharted(y)
    assert_array_equal(exists, [False, False, False, False, True])
    assert np.isfinite(z[exists]).all()


def test_what_stands_on_an_end_is_not_usable():
    toy = Toy(lambda z: np.zeros(len(z)), {"a": ("uniform", {"loc": -1.0, "scale": 4.0}), "b": ("norm", {})})
    chart = Chart.of(toy)
    z = np.array([[0.0, 0.0], [-1.0, 0.0], [3.0, 0.0], [2.9, 5.0]])
    kept, y, log_volume = chart.usable(z)
    assert_array_equal(kept, z[[0, 3]])
    assert_allclose(y[:, 0], ndtri([0.25, 0.975]))
    assert_array_equal(y[:, 1], [0.0, 5.0])
    assert_allclose(log_volume, -np.log(4 * norm.pdf(ndtri([0.25, 0.975]))))
