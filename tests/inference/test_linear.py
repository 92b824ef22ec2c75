"""Integrating linear parameters out, against the dense normal marginal and conditional."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from lcopa_bayes.inference.posterior import NormalEquations

LOG_2PI = np.log(2 * np.pi)


def equations(columns: np.ndarray, target: np.ndarray) -> NormalEquations:
    out = NormalEquations.of_columns(columns.shape[0], columns.shape[1])
    add(out, columns, target, list(range(columns.shape[1])))
    return out


def add(parts: NormalEquations, columns: np.ndarray, target: np.ndarray, place: list[int]) -> None:
    stacked = np.concatenate([columns, target[:, None]], axis=1)
    parts.add(stacked @ stacked.swapaxes(1, 2), place)


@pytest.fixture
def case() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return 3 * rng.normal(size=(4, 3, 15)), 2 * rng.normal(size=(4, 15))


def test_marginal_is_the_dense_normal_one(case):
    columns, target = case
    reported = equations(columns, target).log_marginal() - 0.5 * 15 * LOG_2PI
    for b in range(4):
        covariance = columns[b].T @ columns[b] + np.eye(15)
        exact = stats.multivariate_normal(np.zeros(15), covariance).logpdf(target[b])
        assert reported[b] == pytest.approx(exact, rel=1e-11)


def test_records_may_be_added_one_after_another_each_with_its_own_columns(case):
    columns, target = case
    parts = NormalEquations.of_columns(4, 3)
    add(parts, columns[:, [2, 0], :6], target[:, :6], [2, 0])  # the second column does not act here
    add(parts, columns[..., 6:], target[:, 6:], [0, 1, 2])
    whole = columns.copy()
    whole[:, 1, :6] = 0.0
    assert_allclose(parts.log_marginal(), equations(whole, target).log_marginal(), rtol=1e-12)
    assert_allclose(parts.mean(), equations(whole, target).mean(), rtol=1e-10)


def test_without_columns_only_the_square_is_left(case):
    _, target = case
    none = equations(np.empty((4, 0, 15)), target)
    assert_allclose(none.log_marginal(), -0.5 * (target**2).sum(axis=1), rtol=1e-13)
    assert none.mean().shape == none.draw(np.random.default_rng(0)).shape == (4, 0)


def test_draws_have_the_conditional_mean_and_covariance(case):
    columns, target = case
    count = 20_000
    one = equations(np.repeat(columns[:1], count, axis=0), np.repeat(target[:1], count, axis=0))
    covariance = np.linalg.inv(columns[0] @ columns[0].T + np.eye(3))
    mean = covariance @ columns[0] @ target[0]
    assert_allclose(one.mean()[0], mean, rtol=1e-10)
    drawn = one.draw(np.random.default_rng(1)) - mean
    variances = np.diagonal(covariance)
    error = np.sqrt((np.outer(variances, variances) + covariance**2) / count)
    assert np.all(np.abs(drawn.mean(axis=0)) < 4 * np.sqrt(variances / count))
    assert np.all(np.abs(drawn.T @ drawn / count - covariance) < 4 * error)


def test_columns_that_cannot_be_told_apart_leave_the_prior_on_their_difference():
    column = 1e4 * np.sin(np.arange(40.0))
    both = equations(np.stack([column, column])[None], (0.3 * column)[None])
    assert_allclose(both.mean()[0], 0.15, rtol=1e-6)
    total = 2 * column @ column + 1  # the other eigenvalue of the Gram matrix is 1
    square = 0.09 * column @ column
    exact = -0.5 * (square - 0.18 * (column @ column) ** 2 / total) - 0.5 * np.log(total)
    assert both.log_marginal()[0] == pytest.approx(exact, rel=1e-5)
