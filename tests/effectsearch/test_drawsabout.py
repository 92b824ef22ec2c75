"""Draws about an optimum: those of a normal posterior where it is one, and none that the records reject where
it is not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from lcopa_bayes.bench.inversion import unit_step
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import ModelSettings, PriorSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.basemodel import fitted_base
from lcopa_bayes.effectsearch.drawsabout import _scales, beside_constants, likely_draws
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.model.path import TransferPath

LAG = TransferPath.of_times(1.0, 0.0, (2.0,), (1.0,))
NOISE, COUNT = 0.01, 2000


@cache
def at_optimum(terms: int) -> State:
    """Records of a lag, fitted with so many terms; of one its order and delay are known, so that its
    likelihood is nearly normal."""
    rng = np.random.default_rng(4)
    time = np.linspace(0.0, 30.0, 301)
    drive, since = (time >= 6.0).astype(float), np.maximum(time - 6.0, 1e-9)
    response = np.where(time > 6.0, unit_step(LAG, since), 0.0) + NOISE * rng.standard_normal(time.size)
    made = Record("run", time, drive[:, None], response[:, None], (Axis("u", "V"),), (Axis("y", "V"),), "s")
    known = {"order_1": 1.0, "delay": 0.0} if terms == 1 else {}
    priors = {name: PriorSettings(name, fixed=value) for name, value in known.items()}
    study = Study("draws", None, "s", 3, (made,), (), ModelSettings(terms=terms), priors=priors)
    return fitted_base(study, (), as_stated=True, draws=100).start


def rises(state: State, drawn: np.ndarray) -> np.ndarray:
    """Cost over that of the optimum [nat], each by itself."""
    regression = Regression(state.model, state.whitening)
    return np.array([regression.cost(x) for x in drawn]) - regression.cost(state.optimum.x)


def test_of_a_nearly_normal_posterior_they_have_its_covariance() -> None:
    state = at_optimum(1)
    drawn = likely_draws(state, np.random.default_rng(1), COUNT)
    assert len(drawn) > 0.99 * COUNT
    whitened = np.linalg.solve(np.linalg.cholesky(state.covariance), (drawn[1:] - state.optimum.x).T)
    off = np.cov(whitened) - np.eye(len(whitened))
    assert np.abs(off).max() < 5 * np.sqrt(2 / COUNT) + 0.02  # 1 in 1000 are left out
    assert np.abs(whitened.mean(axis=1)).max() < 5 / np.sqrt(COUNT) + 0.02


@pytest.mark.parametrize("terms", [2, 3])
def test_they_follow_the_records_where_normal_draws_do_not(terms: int) -> None:
    """Terms that nothing needs: most draws do, of one of them, and several times as many as normal ones."""
    state = at_optimum(terms)
    limit, (low, high) = chi2.isf(1e-3, state.optimum.x.size) / 2, state.model.bounds
    rng = np.random.default_rng(1)
    normal = rng.multivariate_normal(state.optimum.x, state.covariance, COUNT // 10, method="eigh")
    inside = normal[((normal >= low) & (normal <= high)).all(axis=1)]
    follow = int((rises(state, inside) <= limit).sum())
    likely = likely_draws(state, np.random.default_rng(1), COUNT // 10)
    assert len(likely) > max(2 * follow, COUNT // 20 if terms == 2 else 0)
    assert ((likely >= low) & (likely <= high)).all()
    assert rises(state, likely).max() <= limit + 1e-9


def test_the_optimum_is_first() -> None:
    state = at_optimum(1)
    first = likely_draws(state, np.random.default_rng(0), 5)[0]
    np.testing.assert_array_equal(first, state.optimum.x)


@pytest.mark.parametrize("wanted", [1.0, 0.3, 0.01])
def test_a_scale_is_that_of_the_normal_that_falls_as_steeply(wanted: float) -> None:
    """To each side of an axis by itself."""
    widths = np.array([wanted, 0.5])
    scales = _scales(lambda step, which: 0.5 * (step / widths[which]) ** 2, np.ones(2))
    np.testing.assert_allclose(scales, widths, rtol=1e-12)


@pytest.mark.parametrize("falls", [lambda step: 0.1 * step**2, lambda step: -step, np.zeros_like])
def test_a_scale_is_never_wider_than_the_normal_one(falls: Callable[[np.ndarray], np.ndarray]) -> None:
    np.testing.assert_array_equal(_scales(lambda step, _: falls(step), np.array([1.0, 0.2])), [1.0, 0.2])


def test_a_scale_ends_inside_the_support() -> None:
    (scale,) = _scales(lambda step, _: np.where(step > 0.03, np.inf, 0.5 * step**2), np.ones(1))
    assert 0.01 < scale <= 0.03


def test_an_axis_without_width_has_none() -> None:
    np.testing.assert_array_equal(_scales(lambda step, _: step**2, np.zeros(2)), [0.0, 0.0])


@pytest.mark.parametrize("terms", [1, 3])
def test_costs_of_several_are_those_of_each(terms: int) -> None:
    state = at_optimum(terms)
    regression = Regression(state.model, state.whitening)
    drawn = likely_draws(state, np.random.default_rng(2), 40)
    each = [regression.cost(x) for x in drawn]
    np.testing.assert_allclose(regression.costs(drawn), each, rtol=1e-9)
    assert regression.costs(drawn[:0]).shape == (0,)


def test_what_constants_leave_open_is_added() -> None:
    """By the covariance of the draws; where a direction has less than at the optimum nothing is taken off."""
    state = at_optimum(1)
    sd = np.sqrt(np.diag(state.covariance))
    more = np.outer(sd, sd) * np.diag([3.0, *[0.0] * (sd.size - 2), -0.5])
    rng = np.random.default_rng(1)
    known = likely_draws(state, rng, COUNT)
    drawn = beside_constants(replace(state, spread=state.covariance + more), known, rng)
    np.testing.assert_array_equal(beside_constants(state, known, rng), known)
    power = np.var(drawn, axis=0) / sd**2
    assert power[0] == pytest.approx(4.0, rel=0.2)
    assert power[1:] == pytest.approx(1.0, rel=0.2)
