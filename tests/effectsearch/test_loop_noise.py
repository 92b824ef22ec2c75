"""Noise of the loop: autoregression, whitening, quiet samples, and evidence in closed form."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import toeplitz
from scipy.stats import multivariate_normal

from lcopa_bayes.effectsearch.autoregression import Autoregression, unbroken
from lcopa_bayes.effectsearch.noisepieces import estimated
from lcopa_bayes.effectsearch.scatter import scatter_evidence
from lcopa_bayes.effectsearch.scoreevidence import Projection, log_bayes_factors, survival
from lcopa_bayes.effectsearch.signature import Scale, Signature
from lcopa_bayes.model.effects.catalogue import catalogue

PARTIAL = st.lists(st.floats(-0.95, 0.95), max_size=5).map(np.array)


@given(PARTIAL, st.floats(1e-3, 1e3))
@settings(max_examples=40, deadline=None)
def test_whitening_is_the_inverse_of_the_covariance(partial, sd):
    process, n = Autoregression(partial, sd), 9
    covariance = toeplitz(process.autocovariance(n - 1))
    white = process.whiten(np.eye(n)).T
    np.testing.assert_allclose(white @ covariance @ white.T, np.eye(n), atol=1e-8)
    assert process.log_scale(n) == pytest.approx(np.linalg.slogdet(covariance)[1] / 2, abs=1e-7)


def test_first_order_autocovariance_is_exact():
    process = Autoregression(np.array([0.6]), 0.5)
    np.testing.assert_allclose(process.autocovariance(3), 0.25 / (1 - 0.36) * 0.6 ** np.arange(4), rtol=1e-12)


def test_order_and_scale_are_recovered():
    truth = Autoregression(np.array([0.6, -0.4, 0.3]), 2e-4)
    rng = np.random.default_rng(1)
    pieces = [1.0 + rng.normal() + truth.draw(1, 80, rng)[0] for _ in range(16)]
    found = estimated(pieces)
    assert found.order >= 3
    np.testing.assert_allclose(found.partial[:3], truth.partial, atol=4 / np.sqrt(16 * 80))
    assert found.sd == pytest.approx(truth.sd, rel=0.1)


def test_white_noise_needs_no_coefficient_most_of_the_time():
    rng = np.random.default_rng(2)
    orders = [estimated([rng.normal(size=60) for _ in range(6)]).order for _ in range(12)]
    assert np.mean(np.array(orders) == 0) > 0.5


def test_a_constant_has_no_noise_scale():
    with pytest.raises(ValueError, match="cannot give the scale"):
        estimated([np.array([1.0])])


def test_missing_samples_break_a_stretch():
    assert unbroken(np.array([1.0, 1, 1, 3, 1])) == [slice(0, 3), slice(3, 5)]


def test_evidence_is_that_of_the_normal_densities():
    rng = np.random.default_rng(3)
    signature, residual = rng.normal(size=(12, 2)), rng.normal(size=12)
    direct = multivariate_normal.logpdf(residual, cov=np.eye(12) + signature @ signature.T)
    direct -= multivariate_normal.logpdf(residual, cov=np.eye(12))
    assert log_bayes_factors(signature, residual[:, None])[0] == pytest.approx(direct, rel=1e-10)


def test_projection_is_evidence_with_the_tangents_integrated_out():
    """Both roads: marginal densities with J in the covariance, or projected signatures and residual."""
    rng = np.random.default_rng(4)
    tangents = 1e4 * rng.normal(size=(15, 3))
    signature, data = rng.normal(size=(15, 2)), rng.normal(size=15)
    base = np.eye(15) + tangents @ tangents.T
    direct = multivariate_normal.logpdf(data, cov=base + signature @ signature.T)
    direct -= multivariate_normal.logpdf(data, cov=base)
    project = Projection(tangents)
    found = log_bayes_factors(project(signature), project(data)[:, None])[0]
    assert found == pytest.approx(direct, rel=1e-4)


def test_what_the_base_model_imitates_does_not_survive():
    rng = np.random.default_rng(5)
    tangents = 1e6 * rng.normal(size=(20, 2))
    project = Projection(tangents)
    inside, outside = tangents[:, :1] * 1e-6, np.eye(20)[:, :1]
    assert survival(inside, project(inside)) < 1e-5
    assert survival(outside, project(outside)) > 0.5


def _signature(columns, one_signed=False):
    return Signature.of(next(iter(catalogue().values())).__new__, columns, 1.0, one_signed)


def test_angles_between_signatures():
    axes = np.eye(6)
    first, both, apart = _signature(axes[:, :1]), _signature(axes[:, :2]), _signature(axes[:, 3:4])
    tilted = _signature(3.0 * (axes[:, :1] + axes[:, 3:4]))
    assert first.cosine(both) == pytest.approx(1.0)
    assert first.cosine(apart) == pytest.approx(0.0, abs=1e-6)
    assert first.cosine(tilted) == apart.cosine(tilted) == pytest.approx(np.sqrt(0.5), rel=1e-6)


def test_known_noise_scale_gives_the_plain_evidence():
    rng = np.random.default_rng(6)
    columns, residual = rng.normal(size=(30, 2)), rng.normal(size=30)
    signature = _signature(columns)
    scale = Scale(1e12, 30.0, np.array([residual @ residual]))
    found = signature.evidence(signature.span.T @ residual[:, None], scale)[0]
    assert found == pytest.approx(log_bayes_factors(columns, residual[:, None])[0], abs=1e-4)


def test_a_half_normal_prior_prefers_its_own_sign():
    column = np.ones((50, 1))
    signature = _signature(column, one_signed=True)
    scale = Scale(1e12, 50.0, np.array([50.0]))
    up, down = (signature.evidence(signature.span.T @ (s * np.ones((50, 1))), scale)[0] for s in (0.5, -0.5))
    plain = _signature(column).evidence(signature.span.T @ (0.5 * np.ones((50, 1))), scale)[0]
    assert up == pytest.approx(plain + np.log(2), abs=0.01)
    assert down < up - 5


def test_amplitude_is_the_ridge_solution():
    rng = np.random.default_rng(7)
    columns, residual = rng.normal(size=(30, 3)), rng.normal(size=30)
    direct = np.linalg.solve(np.eye(3) + columns.T @ columns, columns.T @ residual)
    np.testing.assert_allclose(_signature(columns).amplitude(residual), direct, atol=1e-5)


def test_outliers_are_told_from_noise_and_from_a_smooth_residual():
    rng = np.random.default_rng(8)
    white = rng.normal(size=3000)
    spoiled = white.copy()
    spoiled[::300] += 12.0
    smooth = white + 3.0 * np.sin(np.arange(3000) / 50.0)
    assert scatter_evidence(spoiled) > 20
    assert scatter_evidence(white) < 3
    assert scatter_evidence(smooth) < 3
