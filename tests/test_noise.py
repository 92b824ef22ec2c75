"""Noise models against dense normal densities, scipy and the statistics of their own draws."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy import stats

from lcopa_bayes.inference.noise import AR1, NOISES, Student, White

gaps_lists = st.lists(st.floats(0.05, 20.0), min_size=1, max_size=12).map(np.array)
sigmas = st.floats(1e-6, 1e3)


def dense(sigma: float, rho: float, gaps: np.ndarray) -> np.ndarray:
    at = np.concatenate(([0.0], np.cumsum(gaps[1:])))
    return sigma**2 * rho ** np.abs(at[:, None] - at)


def residual_of(n: int, scale: float, batch: int = 1) -> np.ndarray:
    return scale * np.random.default_rng(n).normal(size=(batch, n))


@given(sigmas, gaps_lists)
def test_ar1_without_memory_is_white(sigma, gaps):
    residual = residual_of(gaps.size, sigma)
    ar1, white = np.array([[sigma, 0.0]]), np.array([[sigma]])
    assert_allclose(
        AR1().pointwise(residual, ar1, gaps), White().pointwise(residual, white, gaps), rtol=1e-12, atol=1e-12
    )
    for a, b in zip(
        AR1().whiten(residual[None], ar1, gaps), White().whiten(residual[None], white, gaps), strict=True
    ):
        assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_white_is_the_normal_density():
    residual = residual_of(30, 0.4, batch=2)
    told = White().pointwise(residual, np.array([[0.4], [1.3]]), np.ones(30))
    assert_allclose(told, stats.norm.logpdf(residual, scale=[[0.4], [1.3]]), rtol=1e-12)


@given(sigmas, st.floats(0.0, 0.995), gaps_lists)
def test_ar1_is_the_normal_density_of_its_dense_covariance(sigma, rho, gaps):
    residual = residual_of(gaps.size, sigma)
    told = AR1().pointwise(residual, np.array([[sigma, rho]]), gaps)[0]
    covariance = dense(1.0, rho, gaps)
    low = np.linalg.cholesky(covariance)  # row k of its inverse is sample k given those before it
    white = np.linalg.solve(low, residual[0] / sigma)
    exact = stats.norm.logpdf(white) - np.log(sigma * np.diagonal(low))
    assert_allclose(told, exact, rtol=1e-7, atol=1e-7)
    whole = stats.multivariate_normal(np.zeros(gaps.size), sigma**2 * covariance, allow_singular=True)
    assert_allclose(told.sum(), whole.logpdf(residual[0]), rtol=1e-6, atol=1e-6)


def test_ar1_uses_the_gaps():
    residual, parameters = residual_of(6, 1.0), np.array([[1.0, 0.9]])
    near, far = (AR1().pointwise(residual, parameters, gap * np.ones(6)).sum() for gap in (1.0, 2.0))
    assert abs(near - far) > 0.1


@given(sigmas, st.floats(0.3, 200.0))
def test_student_is_scipys(sigma, nu):
    residual = residual_of(25, sigma)
    told = Student().pointwise(residual, np.array([[sigma, nu]]), np.ones(25))
    assert_allclose(told, stats.t.logpdf(residual, nu, scale=sigma), rtol=1e-10, atol=1e-10)


@given(gaps_lists, st.floats(0.0, 0.99), st.floats(-3, 3))
def test_whitening_is_linear_and_scales_add_up(gaps, rho, factor):
    parameters = np.array([[0.7, rho], [2.0, rho / 2]])
    columns = np.random.default_rng(gaps.size).normal(size=(2, 2, gaps.size))
    white, scale = AR1().whiten(columns, parameters, gaps)
    mixed, _ = AR1().whiten(columns[:, :1] + factor * columns[:, 1:], parameters, gaps)
    assert_allclose(mixed, white[:, :1] + factor * white[:, 1:], rtol=1e-9, atol=1e-9)
    assert_allclose(scale, AR1().log_scales(parameters, gaps).sum(axis=1), rtol=1e-12)


COUNT, GAPS = 20_000, np.array([1.0, 1.0, 0.3, 2.5, 1.0])


@pytest.mark.parametrize("rho", [0.0, 0.6, 0.95])
def test_ar1_draws_have_the_dense_covariance(rho):
    drawn = AR1().draw(np.tile([0.5, rho], (COUNT, 1)), GAPS, np.random.default_rng(3))
    exact = dense(0.5, rho, GAPS)
    variances = np.diagonal(exact)
    error = np.sqrt((np.outer(variances, variances) + exact**2) / COUNT)
    assert np.all(np.abs(drawn.mean(axis=0)) < 4 * np.sqrt(variances / COUNT))
    assert np.all(np.abs(drawn.T @ drawn / COUNT - exact) < 4 * error)


def deviation_from_white(white: np.ndarray) -> float:
    """Largest entry of the sample covariance less the identity, in Monte Carlo standard errors."""
    n = white.shape[1]
    excess = white.T @ white / white.shape[0] - np.eye(n)
    return float(np.abs(excess / np.sqrt((1 + np.eye(n)) / white.shape[0])).max())


def test_whitened_draws_are_white_and_only_with_their_own_correlation():
    own, other = (np.tile([0.5, rho], (COUNT, 1)) for rho in (0.6, 0.5))
    drawn = AR1().draw(own, GAPS, np.random.default_rng(4))[:, None]
    assert deviation_from_white(AR1().whiten(drawn, own, GAPS)[0][:, 0]) < 4
    assert deviation_from_white(AR1().whiten(drawn, other, GAPS)[0][:, 0]) > 8


def test_white_and_student_draws_follow_their_distributions():
    rng = np.random.default_rng(5)
    white = White().draw(np.full((COUNT // 5, 1), 0.3), GAPS, rng).ravel()
    assert stats.kstest(white, stats.norm(scale=0.3).cdf).pvalue > 1e-3
    student = Student().draw(np.tile([0.3, 2.5], (COUNT // 5, 1)), GAPS, rng).ravel()
    assert stats.kstest(student, stats.t(2.5, scale=0.3).cdf).pvalue > 1e-3
    assert stats.kstest(student, stats.norm(scale=0.3).cdf).pvalue < 1e-6


def test_every_noise_is_known_by_its_kind():
    assert {kind: noise.kind for kind, noise in NOISES.items()} == {k: k for k in ("white", "ar1", "student")}
    for noise in NOISES.values():
        parameters = np.full((3, len(noise.names)), 0.5)
        for n in (0, 1, 4):
            assert noise().pointwise(np.ones((3, n)), parameters, np.ones(n)).shape == (3, n)
