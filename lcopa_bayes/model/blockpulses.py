"""Fractional integration of block pulses: weights, their derivative in the order, dense matrices.

Power-series algebra on a circle: what triangular Toeplitz matrices do, at the cost of a few FFTs.

A lower triangular Toeplitz matrix acts on block means as multiplication by the power series of its
first column. Sampled at roots of unity on a circle of radius r < 1 a product is a product and a
quotient a quotient. Wrapping around brings in ``r^length`` of later coefficients; undoing the scale
amplifies rounding by ``r^-n``. With twice the length both stay below 2e-9 of the largest coefficient
(worst of 5000 random elements; 1e-12 is typical), provided the series does not grow; the last of 100 000
coefficients are good to 5e-8.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import final

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.linalg import toeplitz
from scipy.special import digamma, gamma

from lcopa_bayes.core.arrays import Array, Matrix, Vector

_DIRECT = 16
"""Second differences are taken directly below this index and from their series above it, where
direct subtraction would cancel all but ``2 log10(p)`` digits."""
_SERIES_TERMS = 6
"""Terms of the series: the first omitted one is below 1e-16 of the leading one (``0.01 * 16**-12``)."""


@lru_cache(maxsize=64)
def _tail_basis(n: int) -> tuple[Vector, Matrix]:
    """``log m`` and the powers ``m**(-2k)``, k = 0.., for m = _DIRECT .. n-1."""
    m = np.arange(_DIRECT, n, dtype=float)
    return np.log(m), m ** (-2.0 * np.arange(_SERIES_TERMS)[:, None])


def _series_coefficients(q: Vector) -> Matrix:
    """``2 binomial(q, 2k)``, k = 1.., (batch, terms)."""
    j = np.arange(2 * _SERIES_TERMS)
    return np.asarray(2 * np.cumprod((q[:, None] - j) / (j + 1), axis=1)[:, 1::2], dtype=float)


def _series_coefficient_slopes(q: Vector) -> Matrix:
    """Derivatives of `_series_coefficients` in q; same shape."""
    j = np.arange(2 * _SERIES_TERMS)
    factors = (q[:, None] - j) / (j + 1)
    # of a product the sum over its factors of the products before and after each, none of them divided by
    value, slope, slopes = np.ones_like(q), np.zeros_like(q), np.empty(factors.shape)
    for k, factor in enumerate(factors.T):
        slope = slope * factor + value / (k + 1)
        value = value * factor
        slopes[:, k] = slope
    return 2 * slopes[:, 1::2]


def integration_weights(orders: Vector, n: int, step: float) -> Matrix:
    r"""First column of the block-pulse matrix of :math:`I^a`, for a batch of orders.

    ``w[0] = step^a / Gamma(a+2)``, ``w[p] = w[0] ((p+1)^(a+1) - 2 p^(a+1) + (p-1)^(a+1))``
    (Ta et al. 2026, Eqs. 44, 45).

    Parameters: orders (batch,) [-], >= 0; n blocks of width `step` [time unit].
    Returns: (batch, n) [time unit^order]. Accuracy: 1e-13 of ``w[0] max(1, n^(a-1))``.
    """
    q = orders + 1
    out = np.empty((orders.size, n))
    out[:, 0] = 1.0
    head = min(n, _DIRECT)
    powers = np.arange(head + 1, dtype=float) ** q[:, None]
    out[:, 1:head] = powers[:, 2:] - 2 * powers[:, 1:-1] + powers[:, :-2]
    if n > _DIRECT:
        log_m, basis = _tail_basis(n)
        tail = np.multiply((q - 2)[:, None], log_m, out=out[:, _DIRECT:])
        np.exp(tail, out=tail)
        tail *= _series_coefficients(q) @ basis
    out *= (step**orders / gamma(orders + 2))[:, None]
    return out


def integration_weights_and_slopes(orders: Vector, n: int, step: float) -> tuple[Matrix, Matrix]:
    """`integration_weights` to the last bit, and their derivatives in the order, [time unit^order] too.

    Accuracy of the derivatives: 1e-12 of ``w[0] max(1, n^(a-1)) max(1, |log step|)``.
    """
    weights = integration_weights(orders, n, step)
    q = orders + 1
    out = np.empty((orders.size, n))
    out[:, 0] = 0.0
    head = min(n, _DIRECT)
    p = np.arange(head + 1, dtype=float)
    log_p = np.log(np.maximum(p, 1.0))  # p = 0 contributes 0 to p^q log p for q > 0
    powers = p ** q[:, None] * log_p
    out[:, 1:head] = powers[:, 2:] - 2 * powers[:, 1:-1] + powers[:, :-2]
    scale = (step**orders / gamma(orders + 2))[:, None]
    out[:, :head] *= scale
    if n > _DIRECT:
        # of the product of a power and a series, whose value is known
        log_m, basis = _tail_basis(n)
        tail = np.multiply((q - 2)[:, None], log_m, out=out[:, _DIRECT:])
        np.exp(tail, out=tail)
        tail *= _series_coefficient_slopes(q) @ basis
        tail *= scale
        tail += weights[:, _DIRECT:] * log_m
    out += weights * (np.log(step) - digamma(orders + 2))[:, None]
    return weights, out


def integration_matrix(order: float, n: int, step: float) -> Matrix:
    r"""Block-pulse matrix of the fractional integral (Ta et al. 2026, Eqs. 44, 45, transposed).

    ``P @ f`` approximates the block means of :math:`I^a f` on n blocks of width `step`.

    Parameters: order [-] >= 0, n > 0, step [time unit] > 0; otherwise ValueError.
    Returns: (n, n), lower triangular Toeplitz, [time unit^order]; the identity at order 0.
    Accuracy: exact for constants. ``P(a) @ P(b) = P(a+b)`` holds only to O(step).
    """
    if not (order >= 0 and n > 0 and step > 0):
        raise ValueError(f"need order >= 0, n > 0, step > 0; got {order}, {n}, {step}")
    return lower_toeplitz(integration_weights(np.array([order]), n, step)[0])


def lower_toeplitz(column: Array) -> Matrix:
    """Lower triangular Toeplitz matrix with this first column."""
    return toeplitz(column, np.zeros_like(column))


Spectrum = NDArray[np.complex128]
"""Values of power series on the circle, (..., length // 2 + 1)."""

_WRAP = 1e-13
"""r^length: weight of the coefficients that wrap around [-]."""


@final
@dataclass(frozen=True)
class Circle:
    """Evaluation points for series of `n` coefficients."""

    n: int

    @cached_property
    def length(self) -> int:
        """Number of points on the circle."""
        return fft.next_fast_len(2 * self.n, real=True)

    @cached_property
    def _decay(self) -> Vector:
        return np.asarray(np.exp(np.log(_WRAP) / self.length * np.arange(self.n)))

    @cached_property
    def _growth(self) -> Vector:
        return 1.0 / self._decay

    @cached_property
    def difference(self) -> Spectrum:
        """``1 - z`` on the circle, (length // 2 + 1,)."""
        angle = 2 * np.pi / self.length * np.arange(self.length // 2 + 1)
        return np.asarray(1.0 - np.exp(np.log(_WRAP) / self.length - 1j * angle))

    @cached_property
    def running(self) -> Spectrum:
        """``1 / (1 - z)`` on the circle: sums up the coefficients of a series."""
        return np.asarray(1.0 / self.difference)

    @cached_property
    def bend(self) -> Spectrum:
        """``(1 - z)^3 (2 - z)`` on the circle: ``1 - z`` times the square of a derivative, exact to the third
        order, of blocks in the past alone."""
        return np.asarray(self.difference**3 * (1.0 + self.difference))

    @cached_property
    def smoothing(self) -> Spectrum:
        """``1 + (1 - z)^2 (2 - z) / 12`` on the circle, no zero inside: the factor by which integrals of
        block pulses are too large, whatever their order; more depends on the order (`leftover`)."""
        return np.asarray(1.0 + self.difference**2 * (1.0 + self.difference) / 12.0)

    @cached_property
    def smoothed(self) -> Spectrum:
        """`difference` times `smoothing`."""
        return np.asarray(self.difference * self.smoothing)

    def spectrum(self, coefficients: Array) -> Spectrum:
        """Values on the circle of the series with these coefficients, (..., n)."""
        return np.asarray(fft.rfft(coefficients * self._decay, self.length))

    def coefficients(self, spectrum: Spectrum) -> Array:
        """The first n coefficients, (..., n)."""
        return np.asarray(fft.irfft(spectrum, self.length)[..., : self.n] * self._growth)
