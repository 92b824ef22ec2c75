"""White measurement noise plus a correlated part."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, final

import numpy as np
from scipy.linalg.lapack import dpttrf, dpttrs

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.inference.noisemodel import (
    SLIGHT,
    GaussianNoise,
    products,
    root_mean_square,
)
from lcopa_bayes.inference.priors import Prior

if TYPE_CHECKING:
    from lcopa_bayes.inference.defaultpriors import Scales


@final
class WhiteAR1(GaussianNoise):
    """White measurement noise plus a correlated part that is Gaussian and stationary.

    `sigma` is the standard deviation of the white part, `sigma_ar` that of the correlated part, whose
    correlation over a gap of g sampling periods is ``rho**g``. Whitened by the prediction errors of the
    scalar Kalman filter of the correlated part. ``w_t = y_t - rho**g_t y_{t-1}`` has a tridiagonal covariance
    for any gaps, so that its LDL' factors are the filter: D holds the innovation variances, and the
    forward substitution is the recursion of the innovations.
    """

    kind = "white+ar1"
    names = ("sigma", "sigma_ar", "rho")
    memory = 2

    def whiten(self, columns: Array, parameters: Matrix, gaps: Vector) -> tuple[Array, Vector]:
        """Whitened columns (batch, k, n) and the sum over samples of log innovation sd, (batch,)."""
        batch, k, n = np.broadcast_shapes(columns.shape, (parameters.shape[0], 1, gaps.size))
        if n == 0:
            return np.empty((batch, k, 0)), np.zeros(parameters.shape[0])
        link, variances, lower = self._factors(np.broadcast_to(parameters, (batch, 3)), gaps)
        work = np.empty((k, batch, n))
        taken = columns.swapaxes(0, 1)
        work[..., 0] = taken[..., 0]
        np.multiply(link, taken[..., :-1], out=work[..., 1:])
        np.subtract(taken[..., 1:], work[..., 1:], out=work[..., 1:])
        # LAPACK solves L D L' x = w for the whole batch at once; innovations are D L' x
        solved = dpttrs(variances, lower, work.reshape(k, batch * n).T, overwrite_b=1)[0].T
        out = solved.copy()
        out[:, :-1] += lower * solved[:, 1:]
        out *= np.sqrt(variances)
        logs = 0.5 * np.log(variances).reshape(batch, n).sum(axis=1)
        return out.reshape(k, batch, n).swapaxes(0, 1), logs[: parameters.shape[0]]

    def adjoint(self, columns: Matrix, parameters: Vector, gaps: Vector) -> Matrix:
        """Adjoint of `whiten` at one parameter set (3,): columns (k, n), same shape [1 / response unit]."""
        link, variances, lower = self._factors(parameters[None], gaps)
        work = columns * np.sqrt(variances)
        work[:, 1:] += lower[: gaps.size - 1] * work[:, :-1]
        out = np.asarray(dpttrs(variances, lower, work.T)[0].T)
        return np.concatenate([out[:, :-1] - link[0] * out[:, 1:], out[:, -1:]], axis=1)

    def log_scales(self, parameters: Matrix, gaps: Vector) -> Matrix:
        """Log innovation sd of each sample, (batch, n)."""
        variances = self._factors(parameters, gaps)[1] if gaps.size else np.empty(0)
        return 0.5 * np.log(variances).reshape(parameters.shape[0], gaps.size)

    def draw(self, parameters: Matrix, gaps: Vector, rng: np.random.Generator) -> Matrix:
        """Noise for each parameter set, (batch, n) [response unit]."""
        sigma, sigma_ar, rho = (parameters[:, k : k + 1] for k in range(3))
        link = rho ** gaps[1:]
        out = sigma_ar * rng.standard_normal((parameters.shape[0], gaps.size))
        for k in range(1, gaps.size):
            out[:, k] = link[:, k - 1] * out[:, k - 1] + np.sqrt(1 - link[:, k - 1] ** 2) * out[:, k]
        return out + sigma * rng.standard_normal(out.shape)

    @staticmethod
    def priors(scales: Scales, axis: int) -> Mapping[str, Prior]:
        """Default prior of each parameter on a response axis."""
        return {
            "sigma": scales.sigma_white(axis),
            "sigma_ar": scales.sigma_ar(axis),
            "rho": scales.rho_short(),
        }

    @staticmethod
    def nearly_white(sd: float) -> Mapping[str, float]:
        """A correlated part of little power, so that it can grow."""
        return {"sigma": sd, "sigma_ar": SLIGHT * sd, "rho": 0.5}

    @classmethod
    def estimate(cls, residuals: Sequence[Vector]) -> Mapping[str, float]:
        """By the autocovariances at lags 0, 1 and 2, where these are those of such noise."""
        power, first, second = (products(residuals, lag) for lag in (0, 1, 2))
        count = sum(residual.size for residual in residuals)
        if not 0 < second < first < power or first**2 >= second * power:
            return cls.nearly_white(root_mean_square(residuals))
        correlated = first**2 / second
        return {
            "sigma": float(np.sqrt((power - correlated) / count)),
            "sigma_ar": float(np.sqrt(correlated / count)),
            "rho": second / first,
        }

    @staticmethod
    def _factors(parameters: Matrix, gaps: Vector) -> tuple[Matrix, Vector, Vector]:
        """Correlation with the previous sample, (batch, n - 1); of the whole batch in one row, innovation
        variances, (batch n,), and what the next sample takes of an innovation, (batch n - 1,)."""
        white, correlated, rho = parameters[:, :1] ** 2, parameters[:, 1:2] ** 2, parameters[:, 2:]
        with np.errstate(divide="ignore"):  # no correlation: minus infinity, whose exponential is zero
            steps = np.log(rho) * gaps[1:]
        link = np.exp(steps)
        diagonal = np.empty((parameters.shape[0], gaps.size))
        diagonal[:, :1] = correlated + white
        diagonal[:, 1:] = white * (1 + link**2) - correlated * np.expm1(2 * steps)
        beside = np.zeros(diagonal.shape)  # zero from one member of the batch to the next
        beside[:, :-1] = -white * link
        off = beside.ravel()[: max(1, diagonal.size - 1)]  # LAPACK's wrapper wants one where there is none
        variances, lower, failed = dpttrf(diagonal.ravel(), off, 1, 1)
        if failed:
            raise FloatingPointError(f"noise without a positive innovation variance among {parameters}")
        return link, variances, lower
