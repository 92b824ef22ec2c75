"""Legendre wavelets as printed: exact matrices, their overlaps, and what they change (nothing)."""

from __future__ import annotations

from dataclasses import replace
from math import gamma

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.integrate import quad

from lcopa_bayes.model.blockpulses import Circle, integration_matrix
from lcopa_bayes.model.literature import PAPER
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.model.powerseries import Integrals, transfer
from lcopa_bayes.paper.numericsclaims import (
    WaveletBasis,
    block_pulse_response,
    form_cost,
    wavelet_response,
)

XX = PAPER.plant.xx


def test_the_sampled_matrix_of_four_written_out():
    one, two = np.sqrt(1.5) * np.sqrt(2), np.sqrt(1.5) * 2  # sqrt(3/2) 2^(k/2)
    by_hand = [
        [1, 1, 1, 1],
        [-0.75 * one, -0.25 * one, 0.25 * one, 0.75 * one],
        [-0.5 * two, 0.5 * two, 0, 0],
        [0, 0, -0.5 * two, 0.5 * two],
    ]
    assert_allclose(WaveletBasis(4).psi, by_hand, atol=1e-15)


@pytest.mark.parametrize("n", [2, 4, 32, 128])
def test_the_basis_is_complete_at_its_nodes(n):
    basis = WaveletBasis(n)
    assert basis.psi.shape == (n, n)
    assert np.linalg.matrix_rank(basis.psi) == n
    values = np.random.default_rng(3).standard_normal(n)
    assert_allclose(values @ basis.inverse @ basis.psi, values, atol=1e-12)


def test_overlaps_between_levels_have_their_closed_form():
    basis = WaveletBasis(32)
    level = np.array([-1] + [k for k in range(1, 6) for _ in range(2 ** (k - 1))])
    place = np.array([0] + [p for k in range(1, 6) for p in range(2 ** (k - 1))])
    for i in range(32):
        for j in range(32):
            nested = level[i] > 0 and level[j] >= level[i] and place[j] >> (level[j] - level[i]) == place[i]
            mirrored = level[j] > 0 and level[i] >= level[j] and place[i] >> (level[i] - level[j]) == place[j]
            expected = 2 ** (-1.5 * abs(level[i] - level[j])) if nested or mirrored else 0.0
            expected = 1.0 if i == j else expected
            assert basis.gram[i, j] == pytest.approx(expected, abs=1e-13)
    assert basis.largest_overlap == pytest.approx(2**-1.5, abs=1e-13)
    assert WaveletBasis(2).largest_overlap == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize(("i", "j"), [(1, 2), (1, 6), (2, 5), (3, 4), (0, 7), (7, 7)])
def test_overlaps_by_quadrature(i, j):
    basis = WaveletBasis(8)

    def product(t: float) -> float:
        at = basis.functions(np.array([t]))[:, 0]
        return float(at[i] * at[j])

    pieces = (quad(product, k / 8, (k + 1) / 8)[0] for k in range(8))
    assert basis.gram[i, j] == pytest.approx(sum(pieces), abs=1e-12)


def test_inner_products_are_not_the_coefficients_of_the_expansion():
    basis = WaveletBasis(64)
    ramp = (np.arange(64) + 0.5) / 64
    projected = basis.psi @ ramp / 64  # <f, psi> of Eq. 38 by the midpoint rule
    assert np.abs(projected @ basis.psi - ramp).max() > 0.2
    assert_allclose(ramp @ basis.inverse @ basis.psi, ramp, atol=1e-13)


@pytest.mark.parametrize("order", [0.0, 0.4, 1.0, 1.8])
def test_integrals_of_constants_are_exact(order):
    n, span = 32, 5.0
    basis, edges = WaveletBasis(n), span / n * np.arange(n + 1)
    constant = np.eye(n)[0]
    means = np.diff(edges ** (order + 1)) / gamma(order + 2) / (span / n)
    assert_allclose(constant @ basis.integration(order, span) @ basis.psi, means, rtol=1e-10)


@pytest.mark.parametrize("blocks", [0, 1, 5, 31, 32, 40])
def test_delayed_integrals(blocks):
    n, span = 32, 4.0
    basis = WaveletBasis(n)
    values = np.random.default_rng(1).standard_normal(n)
    late = np.concatenate((np.zeros(blocks), values))[:n]
    expected = integration_matrix(0.6, n, span / n) @ late
    delayed = values @ basis.inverse @ basis.shift(blocks) @ basis.integration(0.6, span) @ basis.psi
    assert_allclose(delayed, expected, atol=1e-12)
    either = basis.integration(0.6, span) @ basis.shift(blocks)
    assert_allclose(basis.shift(blocks) @ basis.integration(0.6, span), either, atol=1e-12)


# first time constants of 1 to 6 ms, longer than the longest block (0.8 ms): below about 0.3 blocks the
# block-pulse scheme itself runs away, and series that grow are beyond the fast algebra
ELEMENTS = st.tuples(
    st.floats(1.1, 2.0), st.floats(0.5, 1.0), st.floats(0.05, 0.45), st.floats(3.0, 20.0), st.integers(0, 40)
)


@given(ELEMENTS, st.sampled_from([32, 128]))
@settings(max_examples=25, deadline=None)
def test_wavelet_block_pulse_and_fast_forms_agree(element, n):
    alpha, beta, gamma_, eta, blocks = element
    span, k, b, orders, etas = 25.0, 3.0, 0.2, (alpha, beta, gamma_), (eta, 8.0, 1.0)
    path = TransferPath(b, 0.0, etas, orders, k)
    drive = np.cos(np.arange(n) * 0.2)
    plain = block_pulse_response(path, drive, span, blocks)
    scale = np.abs(plain).max()
    wavelet = wavelet_response(path, drive, WaveletBasis(n), span, blocks)
    assert_allclose(wavelet, plain, atol=1e-9 * max(scale, 1e-300))
    circle = Circle(n)
    late = np.concatenate((np.zeros(blocks), drive))[:n]
    quotient = transfer(np.array([path.times]) * n / span, Integrals(np.array([orders]), n), circle)
    fast = b / k * circle.coefficients(quotient * circle.spectrum(late))[0]
    assert_allclose(fast, plain, atol=1e-9 * b / k)


def test_the_steady_state_of_the_paper_path():
    path = replace(XX, orders=(2.0, 1.0, 0.5))
    response = wavelet_response(path, np.full(256, 1.5), WaveletBasis(256), 25.0, 31)
    assert_allclose(response[:31], 0.0, atol=1e-15)
    assert response[-1] == pytest.approx(1.5 * XX.gain / XX.stiffness, rel=0.05)


@pytest.mark.parametrize("n", [16, 64])
def test_costs_and_differences_are_measured(n):
    cost = form_cost(XX, 1.5, 25.0, n, repeats=2)
    assert cost.n == n
    assert cost.difference < 1e-11
    assert cost.largest_overlap == pytest.approx(2**-1.5, abs=1e-12)
    assert cost.ratio > 0
