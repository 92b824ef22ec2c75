"""Residual tests: calibrated on white noise, alarmed by what is left of memory."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import signal, stats
from small import TRUTH, draws_of, problem, record, row_values

from lcopa_bayes.results.prediction import Band
from lcopa_bayes.results.residuals import Residual, ljung_box, residuals

KNOWN = TRUTH | {"rho": 0.6, "nu": 4.0, "sigma": 0.1}


def residual_of(values: np.ndarray, noise: str = "white", time: np.ndarray | None = None) -> Residual:
    """Of a record whose median response is 1 and whose samples are 1 + `values`."""
    posterior = problem(record(camera=0.6), noise=noise).posterior
    draws = draws_of(posterior.table, np.tile(row_values(posterior.table, KNOWN), (4, 1)))
    n = values.size
    time = np.arange(n) * 0.5 if time is None else time
    five, four = np.ones((5, n)), np.ones((4, n))
    band = Band("r", "y", "rad", False, time, 1.0 + values, five, five, four, four, "", 0, 4, 1.0)
    (found,) = residuals(draws, [band], posterior.noise, 0.5)
    return found


def white(n: int, seed: int) -> np.ndarray:
    return 0.1 * np.random.default_rng(seed).normal(size=n)


def autoregressive(n: int, seed: int, rho: float) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=n)
    noise[1:] *= np.sqrt(1 - rho**2)
    return 0.1 * signal.lfilter([1.0], [1.0, -rho], noise)


def autocorrelation(values: np.ndarray, lags: int) -> np.ndarray:
    centred = values - values.mean()
    return np.array([centred[k:] @ centred[:-k] for k in range(1, lags + 1)]) / (centred @ centred)


def test_p_values_are_uniform_on_white_noise():
    p = [ljung_box(autocorrelation(white(400, seed), 20), 400, fitted=0) for seed in range(200)]
    assert stats.kstest(p, "uniform").pvalue > 1e-3


def test_p_values_are_uniform_on_whitened_noise_with_one_fitted_correlation():
    p = []
    for seed in range(200):
        values = autoregressive(400, seed, 0.6)
        rho = autocorrelation(values, 1)[0]
        innovations = values[1:] - rho * values[:-1]
        p.append(ljung_box(autocorrelation(innovations, 20), 399, fitted=1))
    assert stats.kstest(p, "uniform").pvalue > 1e-3


def test_p_values_are_small_on_correlated_noise():
    p = [residual_of(autoregressive(200, seed, 0.5)).p_white for seed in range(5)]
    assert max(p) < 1e-3


@pytest.mark.parametrize("n", [20, 200, 201])
def test_spectrum_of_any_residual_is_one_on_average(n):
    found = residual_of(white(n, 0))
    assert found.frequency.size == found.spectrum.size == n // 2
    assert found.frequency[-1] <= 1.0  # half of two samples per time unit
    expected = 1.0 if n % 2 == 0 else n / (n - 1)
    assert found.spectrum.mean() == pytest.approx(expected, rel=1e-9)


def test_spectrum_of_white_noise_is_flat():
    spectra = np.array([residual_of(white(128, seed)).spectrum[:-1] for seed in range(100)])
    low, high = spectra[:, :31].mean(), spectra[:, 32:].mean()
    assert abs(low - high) < 4 * np.sqrt(2 / 3100)
    spectra = np.array([residual_of(autoregressive(128, seed, 0.5)).spectrum[:-1] for seed in range(5)])
    assert spectra[:, :31].mean() > 2 * spectra[:, 32:].mean()


def test_autocorrelation_and_rms_are_those_of_the_definition():
    values = autoregressive(60, 1, 0.3)
    found = residual_of(values)
    assert_allclose(found.autocorrelation, autocorrelation(values, 20), atol=1e-12)
    assert_allclose(found.values, values, atol=1e-12)
    assert_allclose(found.innovations, values / 0.1, atol=1e-9)
    assert found.rms == pytest.approx(np.sqrt(np.mean(values**2)))
    assert found.white_band == pytest.approx(stats.norm.ppf(0.975) / np.sqrt(60), rel=1e-3)
    lagged = residual_of(white(400, 0)).autocorrelation
    assert lagged.size == 40
    assert np.abs(lagged).max() < 4 / np.sqrt(400)


def test_correlated_noise_is_whitened_by_its_own_model_over_uneven_gaps():
    rng = np.random.default_rng(4)
    steps = 0.5 * rng.integers(1, 4, size=600)
    time = np.cumsum(steps)
    link = 0.6 ** (steps / 0.5)
    values = 0.1 * rng.normal(size=600)
    for k in range(1, 600):
        values[k] = link[k] * values[k - 1] + np.sqrt(1 - link[k] ** 2) * values[k]
    assert residual_of(values, "ar1", time).p_white > 0.01
    assert residual_of(values, "white", time).p_white < 1e-4
    assert stats.kstest(residual_of(values, "ar1", time).innovations, "norm").pvalue > 1e-3


def test_student_residuals_are_scaled_and_short_records_are_left_out():
    values = white(50, 2)
    assert_allclose(residual_of(values, "student").innovations, values / 0.1, atol=1e-9)
    with pytest.raises(ValueError, match="not enough values"):
        residual_of(white(8, 0))
    assert np.isfinite(residual_of(white(9, 0)).p_white)
