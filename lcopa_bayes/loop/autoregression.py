"""Autoregressive Gaussian noise of any order: exact whitening, and its estimate from quiet samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import final

import numpy as np
from scipy.optimize import minimize
from scipy.signal import lfilter, lfiltic

from lcopa_bayes.arrays import Array, Matrix, Vector, frozen

_LARGEST_ORDER = 8
_PER_COEFFICIENT = 15
"""Samples that one coefficient needs at least [-]."""
_PATIENCE = 3
"""Orders tried beyond the best so far [-]."""
_UNIT_GAP = 1e-2
"""Gaps this close to one sampling period are one [sampling periods]."""


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
    """Stretches of samples one sampling period apart; `gaps` (n,) in periods, the first not used."""
    breaks = np.flatnonzero(np.abs(gaps[1:] - 1.0) > _UNIT_GAP) + 1
    edges = [0, *breaks.tolist(), gaps.size]
    return [slice(a, b) for a, b in pairwise(edges) if b > a]


@final
@dataclass(frozen=True, eq=False)
class Mode:
    """Most likely autoregression of one order."""

    partial: Vector
    """Partial autocorrelations [-], (order,)."""
    cost: float
    """Negative restricted log likelihood at the best innovation sd [nat]."""
    innovation_sd: float
    """[response unit]."""
    criterion: float
    """Corrected Akaike criterion [-]."""


@final
@dataclass(frozen=True, eq=False)
class NoisePieces:
    """Pieces of noise, each about a level of its own that is integrated out under a flat prior."""

    pieces: tuple[Vector, ...]
    """Each (n,), n > 1 [response unit]."""

    @classmethod
    def of(cls, pieces: Sequence[Vector]) -> NoisePieces:
        """Pieces of two samples and more; ValueError with fewer than three samples beyond their number."""
        kept = tuple(piece for piece in pieces if piece.size > 1)
        total = sum(piece.size for piece in kept)
        if total - len(kept) < 3:
            raise ValueError(f"{total} samples in {len(kept)} pieces cannot give the scale of the noise")
        return cls(kept)

    @cached_property
    def freedom(self) -> int:
        """Samples beyond the levels [-]."""
        return sum(piece.size - 1 for piece in self.pieces)

    @cached_property
    def _alike(self) -> list[Matrix]:
        """Pieces by length."""
        return [
            np.array([p for p in self.pieces if p.size == n]) for n in sorted({p.size for p in self.pieces})
        ]

    def cost(self, partial: Vector) -> tuple[float, float]:
        """Negative restricted log likelihood at the best innovation sd [nat], and that sd.

        With the sd integrated out under ``1 / sd`` it is the same up to a constant.
        """
        unit = Autoregression(np.clip(partial, -1 + 1e-9, 1 - 1e-9), 1.0)
        squares, levels, scales = 0.0, 0.0, 0.0
        for pieces in self._alike:
            number, n = pieces.shape
            white, ones = unit.whiten(pieces), unit.whiten(np.ones(n))
            power = float(ones @ ones)
            squares += float((white**2).sum()) - float(((white @ ones) ** 2).sum()) / power
            levels += 0.5 * number * np.log(power)
            scales += number * unit.log_scale(n)
        sd = float(np.sqrt(max(squares, 1e-300) / self.freedom))
        return self.freedom * np.log(sd) + scales + levels, sd

    def _stretched(self, x: Vector) -> float:
        """Cost of the inverse hyperbolic tangents of partial autocorrelations."""
        return self.cost(np.tanh(x))[0]

    @cached_property
    def modes(self) -> tuple[Mode, ...]:
        """The mode of every order from 0 to three beyond that of the least criterion, at most 8."""
        total, longest = sum(p.size for p in self.pieces), max(p.size for p in self.pieces)
        start, out, best = np.empty(0), [], 0
        for order in range(min(_LARGEST_ORDER, longest - 2, total // _PER_COEFFICIENT) + 1):
            if order:
                found = minimize(
                    self._stretched,
                    np.concatenate([start, [0.0]]),
                    method="BFGS",
                    options={"gtol": 1e-4, "maxiter": 60},
                )
                start = np.clip(
                    found.x, -6.0, 6.0
                )  # a start for the next order; 6 is a correlation of 0.99999
            cost, sd = self.cost(np.tanh(start))
            count = order + 1
            criterion = 2 * cost + 2 * count * total / max(total - count - 1, 1)
            out.append(Mode(np.tanh(start), cost, sd, criterion))
            if criterion < out[best].criterion - 1e-9:
                best = order
            elif order >= best + _PATIENCE:
                break
        return tuple(out)

    @property
    def estimate(self) -> Autoregression:
        """Restricted maximum likelihood, order by the corrected Akaike criterion: an order too small costs
        false alarms, one too large next to nothing."""
        best = min(self.modes, key=lambda one: one.criterion)
        return Autoregression(best.partial, best.innovation_sd)


def estimated(pieces: Sequence[Vector]) -> Autoregression:
    """Order and scale from pieces of noise (`NoisePieces`)."""
    return NoisePieces.of(pieces).estimate
