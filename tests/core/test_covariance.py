"""Covariances do not depend on the units of parameters."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lcopa_bayes.core.covariance import covariance_of, root_of

TANGENTS = np.random.default_rng(1).normal(size=(9, 4))
INFORMATION = TANGENTS.T @ TANGENTS


@given(st.lists(st.integers(-40, 40), min_size=4, max_size=4))
def test_units_scale_a_covariance(powers):
    """Powers of two up to 1e12 to either side: the inverse in good units is the truth."""
    unit = np.exp2(np.array(powers))
    found = covariance_of(INFORMATION * np.outer(unit, unit))
    np.testing.assert_allclose(found * np.outer(unit, unit), np.linalg.inv(INFORMATION), rtol=1e-9)
    root = root_of(found)
    np.testing.assert_allclose(root @ root.T, found, rtol=1e-9)


def test_plain_pseudo_inverse_loses_what_this_keeps():
    unit = np.array([1e9, 1.0, 1.0, 1.0])
    plain = np.linalg.pinv(INFORMATION * np.outer(unit, unit), hermitian=True)
    assert plain[1, 1] < 0.5 * covariance_of(INFORMATION * np.outer(unit, unit))[1, 1]


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_what_has_no_information_has_no_variance(unit):
    scale = np.array([unit, 1.0, 1.0])
    one = np.diag([0.0, 1.0, 4.0]) * np.outer(scale, scale)
    np.testing.assert_allclose(covariance_of(one), np.diag([0.0, 1.0, 0.25]), atol=1e-15)
    level = np.outer([1, 1, 0], [1, 1, 0]) * np.outer(scale, scale)  # two parameters, one direction
    held = covariance_of(level) * np.outer(scale, scale)
    np.testing.assert_allclose(held, np.outer([1, 1, 0], [1, 1, 0]) / 4, rtol=1e-9)


def test_batches_are_single_matrices():
    both = np.stack((INFORMATION, np.eye(4)))
    np.testing.assert_allclose(covariance_of(both)[1], np.eye(4))
    np.testing.assert_allclose(covariance_of(both)[0], covariance_of(INFORMATION))
