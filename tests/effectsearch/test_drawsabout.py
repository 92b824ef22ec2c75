"""Draws about an optimum: those of a normal posterior where it is one, and none that the records reject where
it is not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2
from test_loop_unseen import campaign, fitted

from lcopa_bayes.bench.inversion import unit_step
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import ModelSettings, PriorSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.basemodel import fitted_base
from lcopa_bayes.effectsearch.drawsabout import (
    beside_constants,
    draws_about,
    likely_draws,
    under_plausible_noise,
)
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.sidednormal import _scales
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


@pytest.mark.parametrize(("width", "end", "expected"), [(1.0, 0.03, 1.0), (0.1, 0.15, 0.1), (0.1, 0.0, 0.5)])
def test_a_scale_is_read_inside_the_support(width: float, end: float, expected: float) -> None:
    """However near its end is, since draws beyond it are not taken; where all is beyond, the normal one."""
    (scale,) = _scales(
        lambda step, _: np.where(step > end, np.inf, 0.5 * (step / width) ** 2),
        np.full(1, max(expected, 0.5)),
    )
    assert scale == pytest.approx(expected)


def test_near_an_end_of_the_support_they_are_normal_ones_inside_it() -> None:
    """A delay at its least value, by an optimum that a steep slope does not hold there: of the normal draws
    those inside, not all of them nearer to the optimum."""
    study = campaign("coloured", 0)
    _, state = fitted(study)
    x, sd = state.optimum.x, np.sqrt(np.diag(state.covariance))
    low, high = state.model.bounds
    assert not state.optimum.stuck.any()
    assert x[3] - low[3] < 1e-3 * sd[3]
    normal = np.random.default_rng(5).multivariate_normal(x, state.covariance, 20 * COUNT)
    inside = normal[((normal >= low) & (normal <= high)).all(axis=1)]
    slope = (state.optimum.jacobian.T @ state.optimum.white)[3]
    weights = np.exp(-np.abs(slope) * (inside[:, 3] - low[3]))  # by the slope at the end
    drawn = likely_draws(state, np.random.default_rng(1), COUNT)
    mean = weights @ inside / weights.sum()
    expected = np.sqrt(weights @ (inside - mean) ** 2 / weights.sum())
    np.testing.assert_allclose(drawn.std(axis=0) / expected, 1.0, atol=0.25)


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


def test_deviations_are_stretched_each_by_one_of_those_that_are_plausible() -> None:
    """And stay as they are where that leads out of the support, or where the noise is known."""
    state = at_optimum(1)
    drawn = likely_draws(state, np.random.default_rng(1), 200)
    assert state.stretches is None
    np.testing.assert_array_equal(under_plausible_noise(state, drawn, np.random.default_rng(2)), drawn)
    own, x = replace(state), state.optimum.x
    vars(own)["stretches"] = np.array([2.0, 3.0])[:, None, None] * np.eye(x.size)
    moved = under_plausible_noise(own, drawn, np.random.default_rng(2))
    factor = np.round(((moved - x) / np.where(drawn == x, np.nan, drawn - x))[1:], 9)
    assert set(factor[:, 0]) == {2.0, 3.0}
    assert (factor == factor[:, :1]).all()
    vars(own)["stretches"] = np.full((1, x.size, x.size), 1e9)
    np.testing.assert_array_equal(under_plausible_noise(own, drawn, np.random.default_rng(2))[1:], drawn[1:])


def test_draws_hold_the_truth_where_the_residual_alone_tells_the_noise() -> None:
    """Gain and lag of clean campaigns of noise of correlation 0.9 and no sample at rest; the delay is 0."""
    levels = []
    for seed in range(12):
        _, state = fitted(campaign("coloured", seed))
        columns = [state.model.names.index(name) for name in ("gain", "time_1")]
        rows = [state.model.posterior.table.rows[state.model.columns[k]] for k in columns]
        truth = [row.coordinate(value) for row, value in zip(rows, (2.0, 8.0), strict=True)]
        drawn = draws_about(state, np.random.default_rng(1), 200)[:, columns]
        levels.append(np.mean(drawn < truth, axis=0))
    off = np.abs(np.array(levels) - 0.5)
    assert np.mean(off < 0.45) > 0.75  # 0.58 by draws under the residual's own noise that shrink at the end
    assert 0.35 < np.mean(off < 0.25) < 0.75
