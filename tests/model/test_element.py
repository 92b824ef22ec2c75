"""The Kelvin element: what it refuses, and the paper's two normalisations there and back."""

from __future__ import annotations

from math import inf, nan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lcopa_bayes.data.literature import PAPER
from lcopa_bayes.model.element import Element, PaperForm, from_paper, to_paper

PATHS = {name: getattr(PAPER.plant, name) for name in ("xx", "xy", "yx", "yy")}
elements = st.lists(st.tuples(st.floats(0.05, 2.0), st.floats(-3.0, 3.0)), min_size=1, max_size=5).map(
    lambda terms: Element(
        tuple(10.0**time for _, time in terms), tuple(sorted((order for order, _ in terms), reverse=True))
    )
)


def form_of(name: str) -> PaperForm:
    path = PATHS[name]
    return PaperForm(path.gain, path.etas, path.orders, path.stiffness)


def assert_same(got: PaperForm, wanted: PaperForm) -> None:
    assert got.orders == wanted.orders
    assert got.gain == pytest.approx(wanted.gain, rel=1e-13)
    assert got.etas == pytest.approx(wanted.etas, rel=1e-13)
    assert got.stiffness == pytest.approx(wanted.stiffness, rel=1e-13)


@pytest.mark.parametrize("name", PATHS)
def test_stated_numbers_return_with_the_stiffness_known(name):
    gain, element = from_paper(form_of(name))
    assert gain == pytest.approx(PATHS[name].gain / PATHS[name].stiffness, rel=1e-15)
    assert_same(to_paper(gain, element, stiffness=PATHS[name].stiffness), form_of(name))


@pytest.mark.parametrize("name", ["xx", "yy"])
def test_stated_numbers_return_with_eta3_one(name):
    """Eq. 65 prints the direct paths with eta3 = 1."""
    assert_same(to_paper(*from_paper(form_of(name))), form_of(name))


@pytest.mark.parametrize("name", ["xy", "yx"])
def test_cross_paths_with_the_last_viscosity_one(name):
    path, form = PATHS[name], to_paper(*from_paper(form_of(name)))
    assert form.etas[-1] == pytest.approx(1.0, rel=1e-14)
    assert form.stiffness == pytest.approx(path.stiffness / path.etas[-1], rel=1e-13)
    assert form.gain == pytest.approx(path.gain / path.etas[-1], rel=1e-13)


def test_times_of_the_direct_path():
    _, element = from_paper(form_of("xx"))
    s = 0.3 + 0.4j
    path = PATHS["xx"]
    ours = 1 + sum((time * s) ** order for time, order in zip(element.times, element.orders, strict=True))
    theirs = sum(eta * s**order for eta, order in zip(path.etas, path.orders, strict=True)) + path.stiffness
    assert ours * path.stiffness == pytest.approx(theirs, rel=1e-14)
    assert element.times[0] == pytest.approx((16.02 / 5.57) ** (1 / 1.8), rel=1e-15)


@settings(max_examples=100, deadline=None)
@given(element=elements, gain=st.floats(-10, 10), stiffness=st.one_of(st.none(), st.floats(1e-3, 1e3)))
def test_there_and_back(element, gain, stiffness):
    form = to_paper(gain, element, stiffness=stiffness)
    again, same = from_paper(form)
    assert again == pytest.approx(gain, rel=1e-12)
    assert same.orders == element.orders
    assert np.array(same.times) == pytest.approx(np.array(element.times), rel=1e-9)
    if stiffness is None:
        assert form.etas[-1] == pytest.approx(1.0, rel=1e-12)
    else:
        assert form.stiffness == stiffness


def test_integer_rival_has_equal_orders():
    element = Element((1.0, 2.0, 3.0), (2.0, 1.0, 1.0))
    assert to_paper(0.5, element, stiffness=2.0).etas == (2.0, 4.0, 6.0)


@pytest.mark.parametrize(
    ("times", "orders", "why"),
    [
        ((), (), "one time constant per order"),
        ((1.0,), (1.0, 0.5), "one time constant per order"),
        ((0.0,), (1.0,), "positive and finite"),
        ((-1.0,), (1.0,), "positive and finite"),
        ((inf,), (1.0,), "positive and finite"),
        ((nan,), (1.0,), "positive and finite"),
        ((1.0, 1.0), (0.5, 1.0), "must not increase"),
        ((1.0,), (2.1,), "within"),
        ((1.0,), (0.0,), "within"),
        ((1.0, 1.0), (1.0, -0.5), "within"),
        ((1.0,), (nan,), "within"),
        ((1.0, 1.0, 1.0), (1.5, nan, 0.5), "within"),
    ],
)
def test_impossible_elements_are_refused(times, orders, why):
    with pytest.raises(ValueError, match=why):
        Element(times, orders)
