"""Noise of the loop: its law by samples at rest, and evidence in closed form."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.effectsearch.noise import scatter_evidence
from lcopa_bayes.effectsearch.noiselaw import Law, laws, plausible
from lcopa_bayes.effectsearch.signature import Projection, Scale, Signature, log_bayes_factors, survival
from lcopa_bayes.inference.defaultpriors import Scales
from lcopa_bayes.inference.noise import WhiteAR1
from lcopa_bayes.inference.observations import Observed
from lcopa_bayes.model.effects.catalogue import catalogue

GAPS = st.lists(st.sampled_from([1.0, 1.0, 1.0, 2.5, 7.0]), min_size=1, max_size=9).map(np.array)


def dense(law, gaps):
    """Covariance of samples under a law."""
    at = np.cumsum(gaps)
    correlated = law.sigma_ar**2 * law.rho ** np.abs(at[:, None] - at)
    return law.sigma**2 * np.eye(gaps.size) + correlated


@given(st.floats(0.0, 1.0), st.floats(0.05, 0.99), GAPS)
@settings(max_examples=40, deadline=None)
def test_whitening_is_the_inverse_of_the_covariance(share, rho, gaps):
    law = Law(0.3 * np.sqrt(1 - share), 0.3 * np.sqrt(share), rho)
    white = law.whiten(np.eye(gaps.size), gaps).T
    np.testing.assert_allclose(white @ dense(law, gaps) @ white.T, np.eye(gaps.size), atol=1e-8)


def scales(n):
    """Of a record whose drive moves at once."""
    time = np.arange(float(n))
    drive = (time > 0).astype(float)[:, None]
    return Scales.of([Record("r", time, drive, drive, (Axis("u", "V"),), (Axis("y", "V"),), "ms")])


def pieces_of(law, count, n, seed):
    rng = np.random.default_rng(seed)
    drawn = WhiteAR1().draw(np.tile(law.parameters, (count, 1)), np.ones(n), rng)
    return [Observed(np.arange(n), one + rng.normal(), np.ones(n)) for one in drawn]


@pytest.mark.parametrize("truth", [Law(2e-4), Law(0.0, 2e-4, 0.8), Law(1.5e-4, 2e-4, 0.9)])
def test_the_noise_is_recovered(truth):
    """By 1280 samples in pieces about their own levels: its scale, and what decides about slow effects, its
    power at low frequencies."""
    posterior = plausible(pieces_of(truth, 16, 80, 1), scales(400))
    found = laws(posterior.draw(400, np.random.default_rng(0)))

    def slow(law):
        return law.sd * np.sqrt(1 - law.share + law.share * (1 + law.rho) / (1 - law.rho))

    assert Law.of(posterior).sd == pytest.approx(truth.sd, rel=0.1)
    logs = np.log([slow(law) for law in found])
    assert abs(np.median(logs) - np.log(slow(truth))) < 3.5 * logs.std()
    assert logs.std() < 0.3


def test_a_single_sample_has_no_noise_scale():
    with pytest.raises(ValueError, match="two samples"):
        plausible([Observed(np.arange(1), np.ones(1), np.ones(1))], scales(400))


def test_evidence_is_that_of_the_normal_densities():
    rng = np.random.default_rng(3)
    signature, residual = rng.normal(size=(12, 2)), rng.normal(size=12)
    direct = multivariate_normal.logpdf(residual, cov=np.eye(12) + signature @ signature.T)
    direct -= multivariate_normal.logpdf(residual, cov=np.eye(12))
    assert log_bayes_factors(signature, residual[:, None])[0] == pytest.approx(direct, rel=1e-10)


def test_projection_is_evidence_with_the_tangents_integrated_out():
    """Two methods: marginal densities with J in the covariance, or projected signatures and residual."""
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


def _known(residual):
    """A noise scale that is known."""
    return Scale(1e12, float(residual.size), np.array([residual @ residual]))


@pytest.mark.parametrize("size", [0.0, 5.0, 60.0])
def test_known_noise_scale_gives_the_evidence_of_normal_densities_over_widths_of_the_prior(size):
    rng = np.random.default_rng(6)
    columns = 0.3 * rng.normal(size=(30, 2))
    residual = rng.normal(size=30) + size * columns[:, 0]
    found = _signature(columns)
    shares = 0.1 ** np.arange(4)
    each = [log_bayes_factors(4.0**k * columns, residual[:, None])[0] for k in range(4)]
    direct = np.log(np.average(np.exp(np.array(each) - max(each)), weights=shares)) + max(each)
    evidence = found.evidence(found.span.T @ residual[:, None], _known(residual))[0]
    assert evidence == pytest.approx(direct, abs=1e-3)


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
    found = _signature(columns).amplitude(residual, _known(residual))
    np.testing.assert_allclose(found, direct, atol=1e-5)


@pytest.mark.parametrize("size", [0.0, 20.0])
def test_coefficients_take_off_the_residual_what_they_promise(size):
    rng = np.random.default_rng(8)
    columns = rng.normal(size=(30, 3))
    residual = rng.normal(size=30) + size * columns[:, 1]
    found, known = _signature(columns), _known(residual)
    left = residual - columns @ found.amplitude(residual, known)
    taken = 0.5 * (residual @ residual - left @ left)
    assert found.drop(residual, known) == pytest.approx(taken, rel=1e-5)


def test_an_effect_much_larger_than_its_prior_is_not_shrunk_to_it():
    rng = np.random.default_rng(7)
    columns = 0.05 * rng.normal(size=(400, 1))
    residual = rng.normal(size=400) + 30.0 * columns[:, 0]
    error = 1.0 / np.linalg.norm(columns)
    assert abs(_signature(columns).amplitude(residual, _known(residual))[0] - 30.0) < 3 * error


def test_outliers_are_told_from_noise_and_from_a_smooth_residual():
    rng = np.random.default_rng(8)
    white = rng.normal(size=3000)
    spoiled = white.copy()
    spoiled[::300] += 12.0
    smooth = white + 3.0 * np.sin(np.arange(3000) / 50.0)
    assert scatter_evidence(spoiled) > 20
    assert scatter_evidence(white) < 3
    assert scatter_evidence(smooth) < 3
