"""The loop reports its terms by decreasing order, and keeps them so where their priors differ."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import minimize
from small import U, Y, path, problem, record

from lcopa_bayes.bench.command import staircase
from lcopa_bayes.bench.device import Device
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.noiselaw import Law
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.summary import moved
from lcopa_bayes.effectsearch.whitening import Whitening

NOISE = 0.01
DEVICE = Device(((path(2.0, 0.5, (1.0, 20.0), (0.7, 1.4)),),), (U,), (Y,), (0.0,))
"""The slow term has the larger order."""
COMMAND = staircase([1.0, -0.5, 0.3], hold=15.0, start=0.5)
TAKEN = record(3, device=DEVICE, command=COMMAND, duration=60.0, noise_sd=NOISE)
UNLIKE = {
    "time_1": ("loguniform", {"a": 0.1, "b": 8.0}),
    "time_2": ("loguniform", {"a": 8.0, "b": 80.0}),
}
"""Priors that want the slow term second, against the order of its order."""
FIRST, SECOND = 2, 4
"""Coordinates order_1 and order_2."""


def fitted(**priors: object) -> tuple[ExtendedModel, Regression]:
    posterior = problem(TAKEN, terms=2, offset="none", priors=priors).posterior
    model = ExtendedModel(posterior)
    assert model.names == ("gain", "time_1", "order_1", "time_2", "order_2", "delay")
    noise = (Law(NOISE),)
    return model, Regression(model, Whitening(posterior.samples, noise))


LIKE, DIFFERENT = fitted(), fitted(**UNLIKE)
SWAPPED = np.array([2.0, np.log(1.0), 0.7, np.log(20.0), 1.4, 0.5])
"""The truth with its terms in the raw sequence."""


def test_an_optimum_is_reported_by_decreasing_order():
    """From a start in the other sequence: same plant, same cost, slopes of the coordinates they stand for."""
    model, regression = LIKE
    optimum = regression.descend(SWAPPED)
    assert optimum.x[FIRST] > optimum.x[SECOND]
    table = model.posterior.table
    orders = [model.values(optimum.x)[table.at("order", 0, term)] for term in (0, 1)]
    assert_allclose(orders, optimum.x[[FIRST, SECOND]])
    other = regression.descend(model.canonical(SWAPPED))
    assert optimum.cost == pytest.approx(other.cost, abs=0.05)
    for k in range(optimum.x.size):
        step = 1e-5 * np.eye(optimum.x.size)[k]
        numeric = (model.predict(optimum.x + step) - model.predict(optimum.x - step)) / 2e-5
        assert_allclose(optimum.tangents[:, k], numeric, atol=1e-5 * (1 + np.abs(numeric).max()))


def test_canonical_coordinates_are_those_of_the_parameter_table():
    model, _ = LIKE
    rng = np.random.default_rng(1)
    for _ in range(20):
        x = SWAPPED + 0.3 * rng.standard_normal(SWAPPED.size)
        reported = model.canonical(x)
        assert_allclose(reported, model.coordinates(model.values(x)), atol=1e-12)
        assert_allclose(model.predict(reported), model.predict(x), atol=1e-12)
        assert_allclose(DIFFERENT[0].canonical(x), x, atol=0)


def test_unlike_priors_keep_the_sequence_of_orders():
    """Against a constrained minimiser of the same cost; without the constraint the cost is far lower."""
    model, regression = DIFFERENT
    start = np.array([2.0, np.log(2.0), 1.2, np.log(15.0), 0.8, 0.5])
    optimum = regression.descend(start)
    assert optimum.x[FIRST] >= optimum.x[SECOND]
    low, high = model.bounds
    best = np.inf
    for shift in (0.0, 0.1):
        reference = minimize(
            lambda x: regression.cost(np.clip(x, low, high)),
            optimum.x + shift * (start - optimum.x),
            method="SLSQP",
            bounds=list(zip(low, high, strict=True)),
            constraints={"type": "ineq", "fun": lambda x: x[FIRST] - x[SECOND] - 1e-9},
        )
        best = min(best, reference.fun)
    assert optimum.cost < best + 0.1


@pytest.mark.parametrize("gap", [0.3, 1e-3, 0.0])
def test_orders_of_unlike_terms_never_change_places(gap):
    """Whatever a descent does on its way, from terms that are nearly merged or merged already."""
    model, regression = DIFFERENT
    start = np.array([2.0, np.log(1.2), 0.9 + gap, np.log(18.0), 0.9, 0.4])
    optimum = regression.descend(start, most=60)
    assert optimum.x[FIRST] >= optimum.x[SECOND]
    assert np.isfinite(optimum.cost)
    assert model.supported(optimum.x[None])[0]


@pytest.mark.parametrize("start", [[1.9, -6.0, 0.8, 1.0], [0.9, -6.0, 0.8, 1.0], [1.3, -1.0, 0.5, -5.0]])
def test_terms_stay_resolved_wherever_a_descent_begins(start):
    """Of default priors, a term of order above 1 is no faster than the samples show; slower ones may be."""
    posterior = problem(TAKEN, terms=2, offset="none").posterior
    model = ExtendedModel(posterior)
    assert len(posterior.table.limited) == 2
    noise = (Law(NOISE),)
    regression = Regression(model, Whitening(posterior.samples, noise))
    first, time_1, second, time_2 = start
    optimum = regression.descend(np.array([2.0, time_1, first, time_2, second, 0.5]), most=60)
    assert model.supported(optimum.x[None])[0]
    assert np.isfinite(optimum.cost)
    rng = np.random.default_rng(3)
    for x in optimum.x + 2.0 * rng.standard_normal((200, 6)):  # nor does any step within the bounds leave it
        inside = np.clip(x, *model.bounds)
        if model.supported(inside[None])[0]:
            step = np.clip(inside + rng.standard_normal(6), *model.bounds_about(inside))
            assert model.supported(step[None])[0]


def test_shifts_are_those_of_the_reported_numbers():
    """A fit that ends in the other sequence has not moved: unlike terms are not compared."""
    model, regression = LIKE
    before = regression.descend(SWAPPED)
    x = model.canonical(before.x)
    after = regression.at(x + 3.0 * before.sd * np.array([1.0, 0, 0, 0, 0, 0]))
    sides = [
        SimpleNamespace(
            state=SimpleNamespace(
                optimum=one,
                covariance=before.covariance,
                model=SimpleNamespace(plant_size=x.size, values=model.values),
            )
        )
        for one in (before, after)
    ]
    found = SimpleNamespace(
        effects=("any",), before=sides[0], after=sides[1], base=SimpleNamespace(model=model)
    )
    rows = moved(found)
    assert [row["name"] for row in rows] == ["gain"]
    (row,) = rows
    assert row["shift_in_sd"] == pytest.approx((row["after"] - row["before"]) / before.sd[0])
