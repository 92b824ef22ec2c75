"""Damped Gauss-Newton with step halving, at a noise that is known, and what the optimum is worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Flags, Matrix, Vector
from lcopa_bayes.effectsearch.basemodel import Curve
from lcopa_bayes.effectsearch.whitening import Whitening

_LOG_2PI = float(np.log(2 * np.pi))
_GAIN = 1e-3
"""A step expected to gain less ends the descent [nat]."""
_HALVINGS = 6
_AT_END = 1e-3
"""Closer to an end of its support than this share of it, a coordinate is at its bound [-]."""


@final
@dataclass(frozen=True, eq=False)
class Optimum:
    """Where a descent ended."""

    x: Vector
    """Coordinates, (k,)."""
    residual: Vector
    """Observed minus modelled, stacked, (n,) [response unit]."""
    white: Vector
    """Whitened residual, (n,) [-]."""
    settled: Vector
    """The same after one more linear step, so that the gradient vanishes to rounding, (n,) [-]."""
    jacobian: Matrix
    """Whitened tangents, (n, k) [1 / coordinate]."""
    tangents: Matrix
    """Tangents before whitening, (n, k) [response unit / coordinate]."""
    information: Matrix
    """``J' J`` plus prior precision, (k, k)."""
    cost: float
    """Half the squared whitened residual, plus the normal priors' [nat]."""
    log_evidence: float
    """Laplace approximation of the log evidence; flat priors count by their width [nat]."""
    at_bound: tuple[str, ...]
    """Names of the coordinates at an end of their support."""
    converged: bool
    effective: float
    """Independent samples [-]."""
    stuck: Flags
    """Coordinates held by an end of their support against the data, (k,)."""

    @property
    def moving(self) -> Matrix:
        """The whitened tangents, zero for coordinates that are stuck, (n, k)."""
        return np.where(self.stuck, 0.0, self.jacobian)

    @cached_property
    def covariance(self) -> Matrix:
        """Laplace covariance of the coordinates, (k, k)."""
        return np.asarray(np.linalg.pinv(self.information, hermitian=True))

    @property
    def sd(self) -> Vector:
        """Laplace standard deviation of each coordinate."""
        return np.sqrt(np.diag(self.covariance))


@final
@dataclass(frozen=True, eq=False)
class Regression:
    """A curve fitted to the stacked samples under a fixed whitening."""

    curve: Curve
    whitening: Whitening

    @cached_property
    def _prior(self) -> tuple[Vector, Vector]:
        """Mean and precision of the normal priors; precision 0 where flat."""
        centre = self.curve.centre
        flat = np.isnan(centre)
        return np.where(flat, 0.0, centre), np.where(flat, 0.0, 1 / self.curve.spread**2)

    def cost(self, x: Vector) -> float:
        """Half the squared whitened residual and normal priors [nat]; infinite without a bounded response."""
        try:
            predicted = self.curve.predict(x)
        except ArithmeticError:  # an effect of this size leaves no bounded response
            return np.inf
        if not np.isfinite(predicted).all():
            return np.inf
        return self._cost(x, self.whitening(self.whitening.observed - predicted))

    def _cost(self, x: Vector, white: Vector) -> float:
        mean, precision = self._prior
        return float(0.5 * (white @ white) + 0.5 * (precision * (x - mean) ** 2).sum())

    def descend(self, start: Vector, *, most: int = 40, gain: float = _GAIN) -> Optimum:
        """From a start to a local optimum within the support, its terms in the sequence of the report.

        ArithmeticError when the response at the start is not finite or not bounded.
        """
        x = np.clip(start, *self.curve.bounds_about(start))  # a start only
        damping, converged = 1e-4, False
        predicted, white, jacobian, tangents = self._rows(x)
        cost = self._cost(x, white)
        for _ in range(most):
            low, high = self.curve.bounds_about(x)
            mean, precision = self._prior
            slope = jacobian.T @ white - precision * (x - mean)
            information = jacobian.T @ jacobian + np.diag(precision + 1e-9 / self.curve.spread**2)
            free = np.flatnonzero(~_stuck(x, slope, low, high))
            if not free.size:
                converged = True
                break
            step = np.zeros_like(x)
            inner = information[np.ix_(free, free)]
            step[free] = _solved(inner + damping * np.diag(np.diag(inner)), slope[free])
            expected = float(slope @ step - 0.5 * step @ information @ step)
            if expected < gain and damping < 1e-1:
                converged = True
                break
            share, new, found = 1.0, x, np.inf
            for _ in range(_HALVINGS):
                new = np.clip(x + share * step, low, high)  # the step ends where the support does
                found = self.cost(new)
                if found < cost:
                    break
                share *= 0.5
            if not found < cost:
                if damping > 1e4:
                    converged = expected < 1.0
                    break
                damping = max(damping, 1e-6) * 30
                continue
            damping = max(damping * (0.2 if share == 1.0 else 3.0), 1e-8)
            x = new
            predicted, white, jacobian, tangents = self._rows(x)
            cost = self._cost(x, white)
        reported = self.curve.canonical(x)
        if not np.array_equal(reported, x):
            x = reported
            predicted, white, jacobian, tangents = self._rows(x)
        return self._described(x, predicted, white, jacobian, tangents, converged)

    def at(self, x: Vector) -> Optimum:
        """The description of a point, without moving."""
        return self._described(x, *self._rows(x), converged=True)

    def _rows(self, x: Vector) -> tuple[Vector, Vector, Matrix, Matrix]:
        predicted, tangents = self.curve.tangents(x)
        if not (np.isfinite(predicted).all() and np.isfinite(tangents).all()):
            raise FloatingPointError("the simulated response is not finite")
        residual = self.whitening.observed - predicted
        both = self.whitening(np.vstack([residual, tangents.T]))
        return predicted, both[0], np.ascontiguousarray(both[1:].T), tangents

    def _described(
        self,
        x: Vector,
        predicted: Vector,
        white: Vector,
        jacobian: Matrix,
        tangents: Matrix,
        converged: bool,
    ) -> Optimum:
        low, high = self.curve.bounds
        with np.errstate(invalid="ignore"):
            near = np.minimum(x - low, high - x) < _AT_END * np.where(
                np.isfinite(high - low), high - low, 0.0
            )
        spread, cost = self.curve.spread, self._cost(x, white)
        mean, precision = self._prior
        slope = jacobian.T @ white - precision * (x - mean)
        information = jacobian.T @ jacobian + np.diag(1 / spread**2)
        stuck = _stuck(x, slope, *self.curve.bounds_about(x))
        level = cost + 0.5 * white.size * _LOG_2PI + self.whitening.log_scale
        scaled = np.linalg.slogdet(information * np.outer(spread, spread))[1]
        return Optimum(
            x,
            self.whitening.observed - predicted,
            white,
            white - jacobian @ _solved_free(information, slope, ~stuck),
            jacobian,
            tangents,
            information,
            cost,
            float(-level - 0.5 * scaled),
            tuple(name for name, close in zip(self.curve.names, near | stuck, strict=True) if close),
            converged,
            self.whitening.effective,
            stuck,
        )

    def best(self, starts: Sequence[Vector], *, glance: int = 5, gain: float = _GAIN) -> Optimum:
        """The lowest optimum from several starts: a few steps from each, the best two taken to the end, which
        is where a step is expected to gain less than `gain` [nat].

        ArithmeticError when no start has a finite response.
        """
        looked: list[Optimum] = []
        for start in starts:
            try:
                looked.append(self.descend(start, most=glance if len(starts) > 1 else 40, gain=gain))
            except ArithmeticError:
                continue
        if not looked:
            raise FloatingPointError("the simulated response is not finite at any start")
        looked.sort(key=lambda one: one.cost)
        ended = [one if one.converged else self.descend(one.x, gain=gain) for one in looked[:2]]
        return min(ended, key=lambda one: one.cost)


def _stuck(x: Vector, slope: Vector, low: Vector, high: Vector) -> Flags:
    """Coordinates at an end of their support beyond which the cost falls."""
    return np.asarray(((x <= low) & (slope < 0)) | ((x >= high) & (slope > 0)))


def _solved_free(matrix: Matrix, right: Vector, free: Flags) -> Vector:
    """Solution for the free coordinates, zero for the others."""
    out = np.zeros(right.size)
    if free.any():
        out[free] = _solved(matrix[np.ix_(free, free)], right[free])
    return out


def _solved(matrix: Matrix, right: Vector) -> Vector:
    """Solution of a symmetric system, by least squares where it is singular."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    even = matrix / np.outer(scale, scale)
    try:
        return np.asarray(np.linalg.solve(even, right / scale) / scale)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(even, right / scale, rcond=1e-12)[0] / scale)
