"""Power-series algebra on a circle: what triangular Toeplitz matrices do, at the cost of a few FFTs.

A lower triangular Toeplitz matrix acts on block means as multiplication by the power series of its
first column. Sampled at roots of unity on a circle of radius r < 1 a product is a product and a
quotient a quotient. Wrapping around brings in ``r^length`` of later coefficients; undoing the scale
amplifies rounding by ``r^-n``. With twice the length both stay below 2e-9 of the largest coefficient
(worst of 5000 random elements; 1e-12 is typical), provided the series does not grow.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lcopa_bayes.core.arrays import Array, Vector

Spectrum = NDArray[np.complex128]
"""Values of power series on the circle, (..., length // 2 + 1)."""

_WRAP = 1e-13
"""r^length: weight of the coefficients that wrap around [-]."""


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

    def spectrum(self, coefficients: Array) -> Spectrum:
        """Values on the circle of the series with these coefficients, (..., n)."""
        return np.asarray(fft.rfft(coefficients * self._decay, self.length))

    def coefficients(self, spectrum: Spectrum) -> Array:
        """The first n coefficients, (..., n)."""
        return np.asarray(fft.irfft(spectrum, self.length)[..., : self.n] * self._growth)
