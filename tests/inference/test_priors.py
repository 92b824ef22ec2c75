"""Prior densities: closed forms against scipy, draws against distribution functions."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy import stats

from lcopa_bayes.data.settings import PriorSettings
from lcopa_bayes.inference.priors import Prior

numbers = st.floats(-1e3, 1e3)
scales = st.floats(1e-3, 1e3)
GRID = np.linspace(-3e3, 3e3, 501)


def agrees(prior: Prior, x: np.ndarray) -> None:
    exact = getattr(stats, prior.dist)(**prior.parameters).logpdf(x)
    assert_allclose(prior.log_density(x), exact, rtol=1e-10, atol=1e-10)


@given(numbers, scales)
def test_closed_norm_is_scipys(loc, scale):
    agrees(Prior("norm", {"loc": loc, "scale": scale}), np.append(GRID, loc))
    agrees(Prior("norm", {"loc": loc}), np.array([loc - 1, loc, loc + 2]))


@given(numbers, scales)
def test_closed_uniform_is_scipys(loc, scale):
    inside = loc + scale * np.array([1e-6, 0.3, 1 - 1e-6])
    agrees(Prior("uniform", {"loc": loc, "scale": scale}), np.append(GRID, inside))


@given(st.floats(1e-6, 1e3), st.floats(1.001, 1e6))
def test_closed_loguniform_is_scipys(a, ratio):
    x = np.concatenate([GRID, a * ratio ** np.array([1e-6, 0.4, 1 - 1e-6]), [0.0, -a]])
    agrees(Prior("loguniform", {"a": a, "b": a * ratio}), x)


@given(st.floats(0.01, 10.0), st.floats(1e-9, 1e9))
def test_closed_lognorm_is_scipys(sd, scale):
    x = np.concatenate([GRID, scale * np.exp(sd * np.array([-9.0, 0.0, 0.1, 9.0])), [0.0, -scale, np.inf]])
    agrees(Prior("lognorm", {"s": sd, "scale": scale}), x)
    agrees(Prior("lognorm", {"s": sd}), x)


@pytest.mark.parametrize(
    ("dist", "parameters"),
    [
        ("lognorm", {"s": 0.5, "scale": 3.0}),
        ("lognorm", {"s": 0.5, "scale": 3.0, "loc": -1.0}),
        ("gamma", {"a": 2.0, "scale": 10.0}),
        ("loguniform", {"a": 1.0, "b": 9.0, "loc": -4.0}),
        ("uniform", {}),
    ],
)
def test_other_distributions_are_scipys_with_support_and_draws(dist, parameters):
    prior, exact = Prior(dist, parameters), getattr(stats, dist)(**parameters)
    agrees(prior, np.linspace(-5, 20, 101))
    assert prior.support == exact.support()
    drawn = prior.draw(4000, np.random.default_rng(0))
    assert stats.kstest(drawn, exact.cdf).pvalue > 1e-3
    assert np.array_equal(drawn, prior.draw(4000, np.random.default_rng(0)))


def test_a_prior_is_a_value():
    given_parameters = {"loc": 1.0, "scale": 2.0}
    prior = Prior("norm", given_parameters)
    given_parameters["loc"] = 5.0
    assert prior == Prior("norm", {"loc": 1.0, "scale": 2.0}) == pickle.loads(pickle.dumps(prior))
    assert prior != Prior("norm", {"loc": 5.0, "scale": 2.0})
    assert str(prior) == "norm(loc=1, scale=2)"
    with pytest.raises(TypeError):
        prior.parameters["loc"] = 0.0  # type: ignore[index]


def test_integers_of_any_length_are_numbers():
    """A study file may hold them, and scipy takes none beyond a machine word."""
    far = {"a": 1, "b": 10**20}
    prior, settings = Prior("loguniform", far), PriorSettings("time_1", dist="loguniform", parameters=far)
    assert prior.support == (1.0, 1e20) == settings.frozen().support()
    assert prior.log_density(np.array([1e10])) == pytest.approx(settings.frozen().logpdf(1e10))
