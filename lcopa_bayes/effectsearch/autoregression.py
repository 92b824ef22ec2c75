"""Autoregressive Gaussian noise of any order: exact whitening, draws, autocovariance."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import final

import numpy as np
from scipy.signal import lfilter, lfiltic

from lcopa_bayes.core.arrays import Array, Matrix, Vector, frozen

_UNIT_GAP = 1e-2
"""Gaps this close to one sampling period are one [sampling periods]."""
_UNEVEN = 0.5
"""Share of gaps away from their median beyond which a record has no sampling period [-]."""


@final
@dataclass(frozen=True, eq=False)
class Autoregression:
    """``x_t = sum_j phi_j x_{t-j} + innovation_sd * z_t``, stationary.

    Given by its partial autocorrelations: any values in (-1, 1) are a stationary process (Barndorff-Nielsen
    and Schou 1973, J. Multivariate Anal. 3), and those of order k are the best linear predictor from k
    samples, which makes whitening exact from the first sample on (Durbin-Levinson).
    """

    partial: Vector
    """Partial autocorrelations [-], (order,), within (-1, 1)."""
    innovation_sd: float
    """Standard deviation of the innovations [response unit], positive."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "partial", frozen(self.partial, name="partial"))
        if not (np.abs(self.partial) < 1).all() or not 0 < self.innovation_sd < np.inf:
            raise ValueError("partial autocorrelations must lie in (-1, 1) and the innovation be positive")

    @property
    def order(self) -> int:
        """Number of coefficients [-]."""
        return int(self.partial.size)

    @cached_property
    def predictors(self) -> tuple[Vector, ...]:
        """Coefficients of the best predictor from k samples, nearest first, for k = 0..order."""
        out = [np.empty(0)]
        for kappa in self.partial:
            last = out[-1]
            out.append(np.concatenate([last - kappa * last[::-1], [kappa]]))
        return tuple(out)

    @cached_property
    def scales(self) -> Vector:
        """Standard deviation of the error of each predictor [response unit], (order + 1,)."""
        shrink = np.cumprod(np.concatenate([1.0 / np.sqrt(1.0 - self.partial[::-1] ** 2), [1.0]])[:-1])
        return np.asarray(self.innovation_sd * np.concatenate([shrink[::-1], [1.0]]))

    @property
    def sd(self) -> float:
        """Stationary standard deviation [response unit]."""
        return float(self.scales[0])

    def whiten(self, columns: Array) -> Array:
        """Standardised prediction errors of columns (..., n), same shape [-]."""
        n, p = columns.shape[-1], self.order
        out = np.array(columns, dtype=float)
        for j, weight in enumerate(self.predictors[p] if n > p else (), start=1):
            out[..., p:] -= weight * columns[..., p - j : n - j]
        out /= self.innovation_sd
        for k in range(min(p, n)):
            past = columns[..., :k][..., ::-1] @ self.predictors[k] if k else 0.0
            out[..., k] = (columns[..., k] - past) / self.scales[k]
        return out

    def adjoint(self, columns: Array) -> Array:
        """Adjoint of `whiten`: ``whiten(a) . b = a . adjoint(b)`` for columns (..., n), same shape
        [1 / response unit]."""
        n, p = columns.shape[-1], self.order
        if n > p:
            scale = np.concatenate([self.scales[:p], np.full(n - p, self.innovation_sd)])
        else:
            scale = self.scales[:n]
        scaled = columns / scale
        out = np.array(scaled)
        for j, weight in enumerate(self.predictors[p] if n > p else (), start=1):
            out[..., p - j : n - j] -= weight * scaled[..., p:]
        for k in range(1, min(p, n)):
            out[..., :k] -= scaled[..., k : k + 1] * self.predictors[k][::-1]
        return out

    def log_scale(self, n: int) -> float:
        """Sum over n successive samples of log sd of the prediction error [nat]."""
        first = np.log(self.scales[: min(n, self.order)]).sum()
        return float(first + max(n - self.order, 0) * np.log(self.innovation_sd))

    def draw(self, count: int, n: int, rng: np.random.Generator) -> Matrix:
        """Stationary noise, (count, n) [response unit]."""
        z = rng.standard_normal((count, n))
        p, out = self.order, np.empty((count, n))
        for k in range(min(p, n)):
            past = out[:, :k][:, ::-1] @ self.predictors[k] if k else 0.0
            out[:, k] = past + self.scales[k] * z[:, k]
        if n > p:
            weights = np.concatenate([[1.0], -self.predictors[p]])
            state = np.zeros((count, p))
            for j in range(p):  # what the last p samples carry into the filter (transposed direct form)
                state[:, j] = out[:, p - 1 :: -1][:, : p - j] @ self.predictors[p][j:] if p else 0.0
            drawn = lfilter([1.0], weights, self.innovation_sd * z[:, p:], axis=1, zi=state) if p else None
            out[:, p:] = drawn[0] if drawn is not None else self.innovation_sd * z
        return out

    def correlated(self, lags: int) -> float:
        """Samples of a long stretch that count as one independent sample of a power [-], 1 or more.

        ``1 + 2 sum_k rho_k^2`` (Bayley and Hammersley 1946, J. R. Stat. Soc. Suppl. 8), rho_k the
        autocorrelation at lag k, summed over `lags` lags with weights ``1 - k / (lags + 1)``: the mean
        square of ``lags + 1`` samples scatters as that of so many times fewer independent ones.
        """
        rho = self.autocovariance(lags) / self.sd**2
        weights = 1.0 - np.arange(1, lags + 1) / (lags + 1)
        return float(1.0 + 2.0 * (weights * rho[1:] ** 2).sum())

    def autocovariance(self, lags: int) -> Vector:
        """Autocovariance at lags 0..lags [response unit^2]."""
        out = np.empty(lags + 1)
        out[0] = self.sd**2
        first = min(lags, self.order)
        for k in range(1, first + 1):
            out[k] = self.predictors[k] @ out[k - 1 :: -1][:k]
        if lags > first:
            weights = np.concatenate([[1.0], -self.predictors[self.order]])
            state = lfiltic([1.0], weights, out[first::-1][: self.order])
            out[first + 1 :] = lfilter([1.0], weights, np.zeros(lags - first), zi=state)[0]
        return out


def unbroken(gaps: Vector) -> list[slice]:
    """Stretches of samples one sampling period apart; `gaps` (n,) in periods, the first not used.

    Samples without a spacing of their own (logarithmic times, time stamps that jitter) are one stretch: their
    noise correlates from sample to sample, since no time could be counted in periods.
    """
    inner = gaps[1:]
    if inner.size and np.mean(np.abs(inner / np.median(inner) - 1.0) > _UNIT_GAP) > _UNEVEN:
        return [slice(0, gaps.size)]
    breaks = np.flatnonzero(np.abs(inner - 1.0) > _UNIT_GAP) + 1
    edges = [0, *breaks.tolist(), gaps.size]
    return [slice(a, b) for a, b in pairwise(edges) if b > a]
