"""The transfer path: what it refuses, and one response in either of the paper's normalisations."""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from lcopa_bayes.bench.inversion import step_response
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.model.literature import PAPER
from lcopa_bayes.model.path import Normalisation, TransferPath
from lcopa_bayes.model.powerseries import denominator
from lcopa_bayes.paper.paths import response_to

PATHS = {name: getattr(PAPER.plant, name) for name in ("xx", "xy", "yx", "yy")}
TERM = st.tuples(st.floats(0.05, 2.0), st.floats(-3.0, 3.0))
TERMS = st.lists(TERM, min_size=1, max_size=5, unique_by=lambda term: term[0]).map(
    lambda terms: sorted(terms, reverse=True)
)
paths = st.builds(
    lambda gain, delay, terms, stiffness: TransferPath(
        gain, delay, tuple(10.0**eta for _, eta in terms), tuple(order for order, _ in terms), 10.0**stiffness
    ),
    st.floats(-10, 10),
    st.floats(0, 10),
    TERMS,
    st.floats(-3, 3),
)


def assert_same(got: TransferPath, wanted: TransferPath, rel: float = 1e-12) -> None:
    assert (got.orders, got.delay) == (wanted.orders, wanted.delay)
    assert got.gain == pytest.approx(wanted.gain, rel=rel)
    assert got.etas == pytest.approx(wanted.etas, rel=rel)
    assert got.stiffness == pytest.approx(wanted.stiffness, rel=rel)


def frequency_response(path: TransferPath, angular: np.ndarray) -> np.ndarray:
    """``b exp(-i w tau) / (sum eta (i w)^order + k)``, term by term."""
    s = 1j * angular
    below = sum(eta * s**order for eta, order in zip(path.etas, path.orders, strict=True)) + path.stiffness
    return path.gain * np.exp(-s * path.delay) / below


# -- conversions -----------------------------------------------------------------------------------


@settings(max_examples=100, deadline=None)
@given(path=paths, stiffness=st.floats(1e-3, 1e3))
def test_every_conversion_goes_there_and_back(path, stiffness):
    given_k = path.normalised(Normalisation.STIFFNESS, stiffness)
    last_eta = path.normalised(Normalisation.LAST_ETA)
    assert given_k.stiffness == pytest.approx(stiffness, rel=1e-14)
    assert last_eta.etas[-1] == 1.0
    for one in (given_k, last_eta):
        assert_same(one.normalised(Normalisation.STIFFNESS, path.stiffness), path)
    assert_same(given_k.normalised(Normalisation.LAST_ETA), last_eta)
    assert_same(last_eta.normalised(Normalisation.STIFFNESS, stiffness), given_k)
    again = TransferPath.of_times(path.steady, path.delay, path.times, path.orders)
    assert_same(again.normalised(Normalisation.STIFFNESS, path.stiffness), path)
    assert again.times == pytest.approx(path.times, rel=1e-12)


@settings(max_examples=50, deadline=None)
@given(path=paths)
def test_both_normalisations_are_one_frequency_response(path):
    """And that of the form with time constants; not at 1, the pole of an undamped element of unit size."""
    angular = np.geomspace(1.1e-2, 1.1e2, 9)
    wanted = frequency_response(path, angular)
    for normalisation in Normalisation:
        got = frequency_response(path.normalised(normalisation, 5.57), angular)
        assert_allclose(got, wanted, rtol=1e-12, atol=1e-300)
    below = denominator(np.array([path.times]), np.array([path.orders]), angular)[0]
    assert_allclose(path.steady * np.exp(-1j * angular * path.delay) / below, wanted, rtol=1e-9, atol=1e-300)


@pytest.mark.parametrize("name", PATHS)
def test_both_normalisations_are_one_response(name):
    """On the bench and by the paper's algebra."""
    path, times = PATHS[name], np.linspace(0.1, 25.0, 250)
    drive = AxisDrive(np.zeros(1), np.ones(1))
    wanted, modelled = step_response(path, times), response_to(drive, path, times)
    for normalisation in Normalisation:
        other = path.normalised(normalisation, 2.0)
        assert_allclose(step_response(other, times), wanted, atol=1e-12 * path.steady)
        assert_allclose(response_to(drive, other, times), modelled, atol=1e-12 * path.steady)
    assert_allclose(modelled, wanted, atol=2e-3 * path.steady)


@pytest.mark.parametrize("name", ["xx", "yy"])
def test_eq_65_prints_the_direct_paths_with_eta3_one(name):
    assert PATHS[name].normalised(Normalisation.LAST_ETA) == PATHS[name]


def test_cross_paths_with_the_last_viscosity_one():
    path = PATHS["xy"]
    form = path.normalised(Normalisation.LAST_ETA)
    assert form.stiffness == pytest.approx(2.82 / 6.9062, rel=1e-14)
    assert form.gain == pytest.approx(0.005228 / 6.9062, rel=1e-14)
    assert form.steady == pytest.approx(path.steady, rel=1e-14)


def test_times_of_the_direct_path():
    path = PATHS["xx"]
    assert path.times[0] == pytest.approx((16.02 / 5.57) ** (1 / 1.8), rel=1e-15)
    assert path.steady == 0.100008 / 5.57


def test_terms_of_one_order_add_up():
    twice = TransferPath.of_times(0.5, 0.0, (1.0, 2.0, 3.0), (2.0, 1.0, 1.0))
    assert (twice.gain, twice.etas, twice.stiffness) == (0.5, (1.0, 2.0, 3.0), 1.0)
    once = twice.merged()
    assert (once.etas, once.orders) == ((1.0, 5.0), (2.0, 1.0))
    angular = np.array([0.3, 4.0])
    assert_allclose(frequency_response(once, angular), frequency_response(twice, angular), rtol=1e-14)
    assert once.merged() == once


# -- bad input -------------------------------------------------------------------------------------

SOUND = TransferPath(1.0, 0.5, (2.0, 1.0), (1.5, 0.5), 3.0)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"gain": nan}, "gain must be finite"),
        ({"delay": -0.1}, "delay must be at least 0"),
        ({"delay": inf}, "delay must be at least 0"),
        ({"etas": ()}, "one viscosity per order"),
        ({"etas": (1.0,)}, "one viscosity per order"),
        ({"etas": (), "orders": ()}, "one viscosity per order"),
        ({"etas": (1.0, nan)}, "must be finite"),
        ({"stiffness": 0.0}, "stiffness not 0"),
        ({"stiffness": inf}, "must be finite"),
        ({"orders": (1.0, 0.0)}, "orders must be positive"),
        ({"orders": (1.0, nan)}, "orders must be positive"),
    ],
)
def test_impossible_paths_are_refused(change, why):
    with pytest.raises(InputError, match=why):
        replace(SOUND, **change)


def test_all_problems_are_named_at_once():
    with pytest.raises(InputError) as caught:
        TransferPath(inf, -1.0, (1.0,), (1.0, 2.0), 0.0)
    assert len(caught.value.problems) == 4


@pytest.mark.parametrize("times", [(0.0, 1.0), (-1.0, 1.0), (inf, 1.0), (nan, 1.0)])
def test_times_must_be_positive(times):
    with pytest.raises(InputError, match="positive and finite"):
        TransferPath.of_times(1.0, 0.0, times, (1.5, 0.5))


def test_times_and_orders_come_in_pairs():
    with pytest.raises(InputError, match="one time constant per order"):
        TransferPath.of_times(1.0, 0.0, (1.0,), (1.5, 0.5))


def test_least_squares_may_give_a_path_that_no_dashpot_has():
    odd = replace(SOUND, etas=(2.0, -1.0))
    assert SOUND.physical
    assert not odd.physical
    with pytest.raises(InputError, match="time constants"):
        _ = odd.times
