"""Laws of noise with white and correlated parts, and which of them samples leave plausible."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.inference.defaultpriors import Scales
from lcopa_bayes.inference.noise import WhiteAR1
from lcopa_bayes.inference.observations import Observed, PlausibleNoise, mixed_shapes

_CORRELATIONS = 120
"""Correlations of noise without a white part that are tried [-]."""
_ANGLES = 0.5 * np.pi * (np.arange(_CORRELATIONS) + 0.5) / _CORRELATIONS
"""Arcsines of them, evenly spaced [rad]."""
_EVEN = np.cos(_ANGLES)
"""Weights by which correlations are evenly distributed [-]."""
_SHORTER = 0.5
"""Share of the likeliest law's memory below which a residual's own is another [-]."""
_NEAR = 1e-17
"""Probability, over the largest, of laws that a fit is not taken to have hidden [-]."""


@final
@dataclass(frozen=True)
class Law:
    """Stationary white noise plus a correlated part; either may vanish."""

    sigma: float
    """Standard deviation of the white part [response unit]."""
    sigma_ar: float = 0.0
    """Standard deviation of the correlated part [response unit]."""
    rho: float = 0.0
    """Its correlation one sampling period apart [-]."""

    @classmethod
    def of(cls, posterior: PlausibleNoise) -> Law:
        """The likeliest."""
        return cls(*posterior.estimate.tolist())

    @property
    def parameters(self) -> Vector:
        """As `WhiteAR1` takes them, (3,)."""
        return np.array([self.sigma, self.sigma_ar, self.rho])

    @property
    def sd(self) -> float:
        """Standard deviation [response unit]."""
        return float(np.hypot(self.sigma, self.sigma_ar))

    @property
    def share(self) -> float:
        """Correlated part of the power [-]."""
        return (self.sigma_ar / self.sd) ** 2

    def whiten(self, columns: Array, gaps: Vector) -> Array:
        """Standardised prediction errors of columns (..., n), same shape [-]; `gaps` in sampling periods."""
        flat = columns.reshape(1, -1, gaps.size)
        return np.reshape(WhiteAR1().whiten(flat, self.parameters[None], gaps)[0], columns.shape)

    def correlated(self, lags: int) -> float:
        """Samples of a long stretch that count as one independent sample of a power [-], 1 or more.

        ``1 + 2 sum_k rho_k^2`` (Bayley and Hammersley 1946, J. R. Stat. Soc. Suppl. 8), rho_k the
        autocorrelation at lag k, summed over `lags` lags with weights ``1 - k / (lags + 1)``: the mean
        square of ``lags + 1`` samples scatters as that of so many times fewer independent ones.
        """
        k = np.arange(1, lags + 1)
        squares = self.share**2 * self.rho ** (2.0 * k)
        return float(1.0 + 2.0 * ((1.0 - k / (lags + 1)) * squares).sum())


def plausible(pieces: Sequence[Observed], scales: Scales) -> PlausibleNoise:
    """Posterior of the noise given pieces of it; one of a single sample says nothing.

    To equal parts noise of a single correlation, under Jeffreys' prior ``1 / sqrt(1 - rho^2)`` (Berger and
    Yang 1994, Econometric Theory 10; under a flat one noise of correlation near 1 raises more alarms than
    stated), and white noise with a correlated part that a record holds twenty times, as a fit has it.
    """
    pieces = [piece for piece in pieces if piece.values.size > 1]
    return PlausibleNoise.of(pieces, *_shapes(scales))


def plausible_in_residual(
    pieces: Sequence[tuple[Observed, Matrix]],
    precision: Matrix,
    scales: Scales,
    alone: PlausibleNoise,
    dependence: float,
) -> PlausibleNoise:
    """The same beside what a fit took up of the noise, of its residuals and regressors
    (`PlausibleNoise.of_residual`); `alone`, by the residuals alone, whose samples per independent one are
    `dependence`: their own memory is not exceeded by far (`own_correlation`).

    Noise of a single correlation has a flat prior of it here: a residual about regressors leaves correlations
    near 1 open, whose noise would be of any size.
    """
    longest = max(piece.values.size for piece, _ in pieces)
    rho = own_correlation(dependence, Law.of(alone), longest)
    if rho is not None:
        return PlausibleNoise.of_residual(pieces, precision, np.array([[0.0, 1.0, rho]]), np.zeros(1))
    shapes, log_prior = _shapes(scales)
    log_prior[:_CORRELATIONS] = np.log(_EVEN / _EVEN.sum())
    near = alone.weights > _NEAR * alone.weights.max()
    return PlausibleNoise.of_residual(pieces, precision, shapes[near], log_prior[near])


def _shapes(scales: Scales) -> tuple[Matrix, Vector]:
    """Parameters of unit variance, (grid, 3), and the logarithms of their prior."""
    alone = np.column_stack([np.zeros(_CORRELATIONS), np.ones(_CORRELATIONS), np.sin(_ANGLES)])
    mixed, log_prior = mixed_shapes(scales.correlations)
    log_prior -= np.log(np.exp(log_prior).sum())
    even = np.full(_CORRELATIONS, -np.log(_CORRELATIONS))
    return np.vstack([alone, mixed]), np.concatenate([even, log_prior])


def own_correlation(own: float, likeliest: Law, samples: int) -> float | None:
    """Correlation of noise with a memory of `own` samples per independent one, where the likeliest law of a
    residual of so many samples remembers much longer; else None.

    From sample to sample a smooth misfit looks like a random walk; its own autocorrelations sum up to less.
    """
    if own >= _SHORTER * likeliest.correlated(samples):
        return None
    return float(single_correlation(own - 1))


def single_correlation(beyond: Array | float) -> Array:
    """Correlation of noise without a white part of which 1 and so many samples count as an independent one of
    a power [-]: ``sum_k rho^2k = (1 + rho^2) / (1 - rho^2)`` over all lags."""
    return np.asarray(np.sqrt(beyond / (np.asarray(beyond) + 2)))


def laws(drawn: Matrix) -> list[Law]:
    """Drawn parameters, (draws, 3), one by one."""
    return [Law(*row) for row in drawn.tolist()]
