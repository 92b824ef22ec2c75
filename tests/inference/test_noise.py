"""Noise models against dense normal densities, scipy and the statistics of their own draws."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy import stats
from small import record

from lcopa_bayes.data.settings import NoiseKind
from lcopa_bayes.inference.kinds import KINDS
from lcopa_bayes.inference.noise import AR1, NOISES, Student, White, WhiteAR1
from lcopa_bayes.inference.observations import Samples, sampling_period
from lcopa_bayes.inference.recursions import Filter, equal

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
    reported = White().pointwise(residual, np.array([[0.4], [1.3]]), np.ones(30))
    assert_allclose(reported, stats.norm.logpdf(residual, scale=[[0.4], [1.3]]), rtol=1e-12)


@given(sigmas, st.floats(0.0, 0.995), gaps_lists)
def test_ar1_is_the_normal_density_of_its_dense_covariance(sigma, rho, gaps):
    residual = residual_of(gaps.size, sigma)
    reported = AR1().pointwise(residual, np.array([[sigma, rho]]), gaps)[0]
    covariance = dense(1.0, rho, gaps)
    low = np.linalg.cholesky(covariance)  # row k of its inverse is sample k given those before it
    white = np.linalg.solve(low, residual[0] / sigma)
    exact = stats.norm.logpdf(white) - np.log(sigma * np.diagonal(low))
    assert_allclose(reported, exact, rtol=1e-7, atol=1e-7)
    whole = stats.multivariate_normal(np.zeros(gaps.size), sigma**2 * covariance, allow_singular=True)
    assert_allclose(reported.sum(), whole.logpdf(residual[0]), rtol=1e-6, atol=1e-6)


def test_ar1_uses_the_gaps():
    residual, parameters = residual_of(6, 1.0), np.array([[1.0, 0.9]])
    near, far = (AR1().pointwise(residual, parameters, gap * np.ones(6)).sum() for gap in (1.0, 2.0))
    assert abs(near - far) > 0.1


@given(sigmas, st.floats(0.3, 200.0))
def test_student_is_scipys(sigma, nu):
    residual = residual_of(25, sigma)
    reported = Student().pointwise(residual, np.array([[sigma, nu]]), np.ones(25))
    assert_allclose(reported, stats.t.logpdf(residual, nu, scale=sigma), rtol=1e-10, atol=1e-10)


@given(gaps_lists, st.floats(0.0, 0.99), st.floats(-3, 3))
def test_whitening_is_linear_and_scales_add_up(gaps, rho, factor):
    parameters = np.array([[0.7, rho], [2.0, rho / 2]])
    columns = np.random.default_rng(gaps.size).normal(size=(2, 2, gaps.size))
    white, scale = AR1().whiten(columns, parameters, gaps)
    mixed, _ = AR1().whiten(columns[:, :1] + factor * columns[:, 1:], parameters, gaps)
    assert_allclose(mixed, white[:, :1] + factor * white[:, 1:], rtol=1e-9, atol=1e-9)
    assert_allclose(scale, AR1().log_scales(parameters, gaps).sum(axis=1), rtol=1e-12)


def mixed(sigma: float, sigma_ar: float, rho: float, gaps: np.ndarray) -> np.ndarray:
    """Dense covariance of white noise plus a correlated part."""
    return sigma**2 * np.eye(gaps.size) + dense(sigma_ar, rho, gaps)


SPACINGS = {
    "equal": np.ones(60),
    "missing samples": np.random.default_rng(1).choice([1.0, 1.0, 1.0, 2.0, 7.0], 60),
    "irregular": np.random.default_rng(2).uniform(0.05, 20.0, 60),
}
MIXTURES = [(0.3, 0.8, 0.97), (1e-3, 1.0, 0.999), (1.0, 1e-3, 0.5), (0.02, 0.5, 0.01), (2.0, 0.1, 0.9999)]


@pytest.mark.parametrize("gaps", SPACINGS.values(), ids=SPACINGS.keys())
def test_white_and_correlated_noise_is_whitened_by_the_factor_of_its_dense_covariance(gaps):
    """All parameter sets at once, several columns each: innovations, their scales, the joint density."""
    parameters, n = np.array(MIXTURES), gaps.size
    columns = np.random.default_rng(3).normal(size=(len(MIXTURES), 3, n))
    white, scale = WhiteAR1().whiten(columns, parameters, gaps)
    reported = WhiteAR1().pointwise(columns[:, 0], parameters, gaps)
    for row, values in enumerate(MIXTURES):
        covariance = mixed(*values, gaps)
        low = np.linalg.cholesky(covariance)
        assert_allclose(white[row], np.linalg.solve(low, columns[row].T).T, rtol=1e-9, atol=1e-9)
        assert_allclose(scale[row], np.log(np.diagonal(low)).sum(), rtol=1e-9, atol=1e-9)
        whole = stats.multivariate_normal(np.zeros(n), covariance).logpdf(columns[row, 0])
        assert_allclose(reported[row].sum(), whole, rtol=1e-9)


@given(st.floats(1e-3, 1e3), st.floats(1e-3, 1e3), st.floats(0.0, 0.995), gaps_lists, st.floats(1e-6, 1e3))
def test_each_sample_of_white_and_correlated_noise_has_its_density_given_those_before(s, c, rho, gaps, unit):
    residual = residual_of(gaps.size, max(s, c) * unit)
    reported = WhiteAR1().pointwise(residual, np.array([[s * unit, c * unit, rho]]), gaps)[0]
    low = np.linalg.cholesky(mixed(s, c, rho, gaps))
    exact = stats.norm.logpdf(np.linalg.solve(low, residual[0] / unit)) - np.log(unit * np.diagonal(low))
    assert_allclose(reported, exact, rtol=1e-7, atol=1e-7)


@given(sigmas, st.floats(0.0, 0.995), gaps_lists)
def test_white_and_correlated_noise_without_either_part_is_the_other(sigma, rho, gaps):
    columns = residual_of(gaps.size, sigma, batch=2)[None]
    alone = WhiteAR1().whiten(columns, np.array([[sigma, 0.0, rho]]), gaps)
    faint = WhiteAR1().whiten(columns, np.array([[1e-9 * sigma, sigma, rho]]), gaps)
    white, ar1 = (
        White().whiten(columns, np.array([[sigma]]), gaps),
        AR1().whiten(columns, np.array([[sigma, rho]]), gaps),
    )
    for found, exact in ((alone, white), (faint, ar1)):
        assert_allclose(found[0], exact[0], rtol=1e-9, atol=1e-9)
        assert_allclose(found[1], exact[1], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("columns", [1, 3, 9])
@pytest.mark.parametrize("gaps", [*SPACINGS.values(), np.ones(200)], ids=[*SPACINGS.keys(), "many"])
def test_scalar_products_are_those_of_the_whitened_columns(gaps, columns):
    """And those of the dense covariance; after many equal steps one correlation has settled, one has not."""
    parameters = np.array([[0.4, 0.9, 0.97], [0.02, 0.7, 0.3], [3.0, 0.01, 0.999]])
    data = np.random.default_rng(5).normal(size=(3, columns, gaps.size))
    for noise, own in ((White(), [0]), (AR1(), [0, 2]), (WhiteAR1(), [0, 1, 2])):
        products, logs = noise.products(data, parameters[:, own], gaps)
        white, wanted = noise.whiten(data, parameters[:, own], gaps)
        assert_allclose(logs, wanted, rtol=1e-12)
        assert_allclose(products, white @ white.swapaxes(1, 2), rtol=1e-10, atol=1e-12 * products.max())
    for one, found in zip(range(3), products, strict=True):
        covariance = mixed(*parameters[one], gaps)
        assert_allclose(found, data[one] @ np.linalg.solve(covariance, data[one].T), rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("settling", [0.02, 3.0])
def test_innovation_variances_settle_where_samples_are_equally_spaced(settling):
    """Against the factor of the dense covariance at every sample, before and after they have."""
    gaps, parameters = np.ones(150), np.array([[settling, 0.7, 0.9], [0.1, 0.5, 0.2]])
    scales = WhiteAR1().log_scales(parameters, gaps)
    for reported, own in zip(scales, parameters, strict=True):
        exact = np.log(np.diagonal(np.linalg.cholesky(mixed(*own, gaps))))
        assert_allclose(reported, exact, rtol=1e-11, atol=1e-11)


def test_samples_at_rounded_time_stamps_are_equally_spaced():
    assert equal(np.array([0.3, 1.0, 1.0, 1.0]))
    assert not equal(np.array([1.0, 1.0, 1.001, 1.0]))
    one = record(1, camera=0.2)
    late = one.time.copy()
    late[1:] += 1e-7 * np.random.default_rng(3).normal(size=late.size - 1)
    period = sampling_period([one])
    for time, rounded in ((late, True), (np.sinh(one.time / one.time[-1]), False)):
        gaps = Samples.of(replace(one, time=time), period).axes[0].gaps
        assert (gaps == np.round(gaps)).all() == rounded


def test_one_column_is_whitened_for_many_parameter_sets_and_many_columns_for_one():
    gaps, parameters = GAPS, np.array(MIXTURES)
    column = np.random.default_rng(0).normal(size=(1, 1, gaps.size))
    white, scales = WhiteAR1().whiten(column, parameters, gaps)
    for row, values in enumerate(parameters):
        one, scale = WhiteAR1().whiten(column, values[None], gaps)
        assert_allclose(white[row], one[0], rtol=1e-12)
        assert_allclose(scales[row], scale[0], rtol=1e-12)
    many = np.repeat(column, 3, axis=0)
    assert WhiteAR1().whiten(many, parameters[:1], gaps)[1].shape == (1,)
    assert_allclose(WhiteAR1().whiten(many, parameters[:1], gaps)[0][2], white[0], rtol=1e-12)


COUNT, GAPS = 20_000, np.array([1.0, 1.0, 0.3, 2.5, 1.0])


@pytest.mark.parametrize("rho", [0.0, 0.6, 0.95])
def test_ar1_draws_have_the_dense_covariance(rho):
    drawn = AR1().draw(np.tile([0.5, rho], (COUNT, 1)), GAPS, np.random.default_rng(3))
    exact = dense(0.5, rho, GAPS)
    variances = np.diagonal(exact)
    error = np.sqrt((np.outer(variances, variances) + exact**2) / COUNT)
    assert np.all(np.abs(drawn.mean(axis=0)) < 4 * np.sqrt(variances / COUNT))
    assert np.all(np.abs(drawn.T @ drawn / COUNT - exact) < 4 * error)


def test_white_and_correlated_draws_have_the_dense_covariance():
    values = (0.3, 0.5, 0.8)
    drawn = WhiteAR1().draw(np.tile(values, (COUNT, 1)), GAPS, np.random.default_rng(3))
    exact = mixed(*values, GAPS)
    variances = np.diagonal(exact)
    error = np.sqrt((np.outer(variances, variances) + exact**2) / COUNT)
    assert np.all(np.abs(drawn.mean(axis=0)) < 4 * np.sqrt(variances / COUNT))
    assert np.all(np.abs(drawn.T @ drawn / COUNT - exact) < 4 * error)
    assert (
        deviation_from_white(WhiteAR1().whiten(drawn[:, None], np.tile(values, (COUNT, 1)), GAPS)[0][:, 0])
        < 4
    )


@pytest.mark.parametrize(
    ("noise", "values"), [(White(), (0.3,)), (AR1(), (0.3, 0.7)), (WhiteAR1(), (0.2, 0.3, 0.9))]
)
def test_starting_values_come_from_the_autocovariances(noise, values):
    """Of 300 records of 400 samples; errors by the spread between them."""
    drawn = noise.draw(np.tile(values, (300, 1)), np.ones(400), np.random.default_rng(0))
    groups = [noise.estimate(list(part)) for part in np.split(drawn, 10)]
    for name, value in zip(noise.names, values, strict=True):
        each = np.array([found[name] for found in groups])
        assert abs(each.mean() - value) < 4 * each.std() / np.sqrt(10) + 0.01 * value


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
    assert {kind: noise.kind for kind, noise in NOISES.items()} == {
        k: k for k in ("white", "ar1", "white+ar1", "student")
    }
    assert set(NOISES) == set(get_args(NoiseKind))
    for noise in NOISES.values():
        assert KINDS[noise.names[0]].noise == "scale"
        assert (
            set(noise.nearly_white(0.4)) == set(noise.estimate([np.ones(3), np.ones(1)])) == set(noise.names)
        )
        parameters = np.full((3, len(noise.names)), 0.5)
        for n in (0, 1, 4):
            assert noise().pointwise(np.ones((3, n)), parameters, np.ones(n)).shape == (3, n)


def test_an_axis_without_samples_has_nothing_to_whiten():
    """Of any number of laws: records need not have samples of every axis."""
    laws = np.array([[0.3, 0.2, 0.6], [0.1, 0.4, 0.9]])
    filtered = Filter.of(laws, np.empty(0))
    assert filtered(np.empty((2, 3, 0))).shape == (2, 3, 0)
    white, scales = WhiteAR1().whiten(np.empty((1, 3, 0)), laws, np.empty(0))
    assert white.shape == (2, 3, 0)
    assert scales.tolist() == [0.0, 0.0]
