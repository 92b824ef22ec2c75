"""Least squares of a model under known noise, by the optimiser of a fit, and what an optimum is worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple, final

import numpy as np

from lcopa_bayes.core.arrays import Flags, Matrix, Vector
from lcopa_bayes.core.covariance import covariance_of
from lcopa_bayes.core.crew import ALONE, Crew
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.whitening import Whitening

_LOG_2PI = float(np.log(2 * np.pi))
GAIN = 1e-3
"""A step that gains less ends a descent [nat]."""
_GLANCE = 6
"""Evaluations of the response from each of several starts [-]."""
_EVALUATIONS = 60
_PORTION = 32
"""Plants whose responses are computed at once [-]."""
_AT_END = 1e-3
"""Closer to an end of its support than this share of it, a coordinate is at its bound [-]."""
_AT_ONE = 1e-7
"""Room that is left to a coordinate that has a value [prior sd]."""
_WALLS = 8
"""Descents between walls that move with the orders they separate, at most [-]."""
_PUSHED = 0.3
"""Slope of the cost per standard deviation from which such a coordinate is held by its bound [nat]."""
_HELD_BACK = 3.0
"""Standard deviations by which it would go beyond it that are more than chance [-]."""


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
    """Names of the coordinates that an end of their support holds back by more than chance explains: a delay
    of 0 is at one where there is none."""
    converged: bool
    effective: float
    """Independent samples [-]."""
    stuck: Flags
    """Coordinates held by an end of their support against the data, (k,)."""

    @property
    def power(self) -> float:
        """Squared residual [response unit^2]."""
        return float(self.residual @ self.residual)

    @property
    def moving(self) -> Matrix:
        """The whitened tangents, zero for coordinates that are stuck, (n, k)."""
        return np.where(self.stuck, 0.0, self.jacobian)

    @cached_property
    def covariance(self) -> Matrix:
        """Laplace covariance of the coordinates, (k, k)."""
        return covariance_of(self.information)

    @property
    def sd(self) -> Vector:
        """Laplace standard deviation of each coordinate."""
        return np.sqrt(np.diag(self.covariance))


@final
@dataclass(frozen=True, eq=False)
class Regression:
    """A model fitted to the stacked samples under a fixed whitening."""

    model: ExtendedModel
    whitening: Whitening

    @cached_property
    def _prior(self) -> tuple[Vector, Vector]:
        """Mean and precision of the normal priors; precision 0 where flat."""
        flat = np.isnan(self.model.centre)
        return np.where(flat, 0.0, self.model.centre), np.where(flat, 0.0, 1 / self.model.spread**2)

    def cost(self, x: Vector) -> float:
        """Half the squared whitened residual and normal priors [nat]; infinite without a bounded response."""
        try:
            predicted = self.model.predict(x)
        except ArithmeticError:  # an effect of this size leaves no bounded response
            return np.inf
        if not np.isfinite(predicted).all():
            return np.inf
        return self._cost(x, self.whitening(self.whitening.observed - predicted))

    def costs(self, many: Matrix) -> Vector:
        """The same at coordinates (batch, k), (batch,); several at once take a fraction of the time."""
        portions = (many[k : k + _PORTION] for k in range(0, len(many), _PORTION))
        return np.concatenate([np.empty(0), *map(self._costs, portions)])

    def costs_inside(self, many: Matrix) -> Vector:
        """The same, infinite beyond the support."""
        inside = self.model.inside(many)
        out = np.full(len(many), np.inf)
        out[inside] = self.costs(many[inside])
        return out

    def _costs(self, many: Matrix) -> Vector:
        residual = self.whitening.observed - self.model.predictions(many)
        out, finite = np.full(len(many), np.inf), np.isfinite(residual).all(axis=1)
        pairs = zip(many[finite], self.whitening(residual[finite]), strict=True)
        out[finite] = [self._cost(x, white) for x, white in pairs]
        return out

    def _cost(self, x: Vector, white: Vector) -> float:
        mean, precision = self._prior
        with np.errstate(over="ignore"):  # as far from the records as that nothing is likely
            return float(0.5 * (white @ white) + 0.5 * (precision * (x - mean) ** 2).sum())

    def reached(self, start: Vector, *, most: int = _EVALUATIONS, gain: float = GAIN) -> tuple[Vector, bool]:
        """Coordinates of a local optimum within the support, its terms in the sequence of the report, and
        whether it was reached within so many evaluations.

        ArithmeticError when the response at the start is not finite or not bounded.
        """
        x, cost = self._begun(start)
        least, enough = self.model.least(self.whitening.held), 2 * gain / self.whitening.size
        for _ in range(_WALLS):
            low, high = self.model.bounds_about(x)
            width = np.where(np.isfinite(high - low), high - low, 1.0)
            search = least.search(x, self.model.template, _wider(low, high), evaluations=most, enough=enough)
            before, x = cost, np.clip(search.x, low, high)
            cost = float(search.cost)
            near = np.minimum(x - low, high - x) < _AT_END * width
            inner = (low != self.model.bounds[0]) | (high != self.model.bounds[1])
            if not (near & inner).any() or before - cost < gain:
                break  # else a wall between two orders moves with them
        return self.model.canonical(x), bool(search.status > 0)

    def _begun(self, start: Vector) -> tuple[Vector, float]:
        """A start inside its bounds, and its cost; FloatingPointError where that is not finite."""
        x = np.clip(start, *self.model.bounds_about(start))  # a start only
        cost = self.cost(x)
        if not np.isfinite(cost):
            raise FloatingPointError("the simulated response is not finite")
        return x, cost

    def along(self, k: int, value: float, start: Vector, *, most: int, gain: float) -> Vector:
        """Coordinates of the optimum among those whose coordinate `k` has a `value`, after at most so many
        evaluations from a start; errors as of `reached`."""
        x = start.copy()
        x[k] = value
        x, _ = self._begun(x)
        least, enough = self.model.least(self.whitening.held), 2 * gain / self.whitening.size
        low, high = self.model.bounds_about(x)
        ends, room = _wider(low, high), _AT_ONE * self.model.spread[k]
        ends[0][k], ends[1][k] = value - room, value + room
        search = least.search(x, self.model.template, ends, evaluations=most, enough=enough)
        found: Vector = np.clip(search.x, low, high)
        found[k] = value
        return found

    def descend(self, start: Vector, *, most: int = _EVALUATIONS, gain: float = GAIN) -> Optimum:
        """The optimum of `reached`, described."""
        x, converged = self.reached(start, most=most, gain=gain)
        return self.at(x, converged=converged)

    def at(self, x: Vector, *, converged: bool = True) -> Optimum:
        """The description of a point."""
        predicted, tangents = self.model.tangents(x)
        if not (np.isfinite(predicted).all() and np.isfinite(tangents).all()):
            raise FloatingPointError("the simulated response is not finite")
        residual = self.whitening.observed - predicted
        both = self.whitening(np.vstack([residual, tangents.T]))
        white, jacobian = both[0], np.ascontiguousarray(both[1:].T)
        low, high = self.model.bounds
        spread, cost = self.model.spread, self._cost(x, white)
        if not np.isfinite(cost):
            raise FloatingPointError("the residual is too large to be squared")
        slope = self._slope(x, white, jacobian)
        information = jacobian.T @ jacobian + np.diag(1 / spread**2)
        ends = self.model.bounds_about(x)
        near = np.minimum(x - low, high - x) < _AT_END * np.where(np.isfinite(high - low), high - low, 0.0)
        room = _AT_END * np.where(np.isfinite(high - low), high - low, spread)
        pushed = slope / np.sqrt(np.diag(information))
        stuck = ((x < ends[0] + room) & (pushed < -_PUSHED)) | ((x > ends[1] - room) & (pushed > _PUSHED))
        beyond = np.abs(slope) * np.sqrt(np.diag(covariance_of(information))) > _HELD_BACK
        level = cost + 0.5 * white.size * _LOG_2PI + self.whitening.log_scale
        scaled = np.linalg.slogdet(information * np.outer(spread, spread))[1]
        return Optimum(
            x,
            residual,
            white,
            white - jacobian @ _solved(information, slope, ~stuck),
            jacobian,
            tangents,
            information,
            cost,
            float(-level - 0.5 * scaled),
            tuple(np.array(self.model.names)[(near | stuck) & beyond].tolist()),
            converged,
            self.whitening.effective,
            stuck,
        )

    def _slope(self, x: Vector, white: Vector, jacobian: Matrix) -> Vector:
        mean, precision = self._prior
        return np.asarray(jacobian.T @ white - precision * (x - mean))

    def gradient(self, at: Optimum) -> Vector:
        """Of the log density at a described point, (k,) [nat / coordinate]."""
        return self._slope(at.x, at.white, at.jacobian)

    def glanced(
        self, starts: Sequence[Vector], *, gain: float = GAIN, enough: float = -np.inf, crew: Crew = ALONE
    ) -> tuple[Glance, ...]:
        """Where a few evaluations from each of several starts end, by rising cost; from the first alone where
        that is `enough` [nat].

        ArithmeticError when no start has a finite response.
        """
        first = _glance(gain, self, starts[0]) if enough > -np.inf else None
        if first is not None and first.cost <= enough:
            return (first,)
        others = starts[1:] if enough > -np.inf else starts
        every = [first, *crew.sharing(self).each(partial(_glance, gain), others)]
        out = [one for one in every if one is not None]
        if not out:
            raise FloatingPointError("the simulated response is not finite at any start")
        return tuple(sorted(out, key=lambda one: one.cost))

    def followed(
        self, glances: Sequence[Glance], *, gain: float = GAIN, crew: Crew = ALONE
    ) -> tuple[Vector, bool]:
        """`reached` from the best of several glances: the best two are taken to the end."""
        ends = list(crew.sharing(self).each(partial(_end, gain), list(glances[:2])))
        return min(ends, key=lambda one: self.cost(one[0])) if len(ends) > 1 else ends[0]

    def best(self, starts: Sequence[Vector], crew: Crew = ALONE) -> Optimum:
        """The optimum reached from the best of several starts, described; errors as of `glanced`."""
        x, converged = self.followed(self.glanced(starts, crew=crew), crew=crew)
        return self.at(x, converged=converged)


def _wider(low: Vector, high: Vector) -> tuple[Vector, Vector]:
    """Bounds further apart: an order may be held by both its neighbours."""
    width = np.where(np.isfinite(high - low), high - low, 1.0)
    return low - 1e-9 * width, high + 1e-9 * width


@final
class Glance(NamedTuple):
    """Where a few evaluations from a start end."""

    cost: float
    """[nat]."""
    x: Vector
    converged: bool
    """Whether that is an optimum."""


def _glance(gain: float, regression: Regression, start: Vector) -> Glance | None:
    """A glance from a start; None where the response there is not finite."""
    try:
        x, converged = regression.reached(start, most=_GLANCE, gain=gain)
    except ArithmeticError:
        return None
    return Glance(regression.cost(x), x, converged)


def _end(gain: float, regression: Regression, glance: Glance) -> tuple[Vector, bool]:
    return (glance.x, True) if glance.converged else regression.reached(glance.x, gain=gain)


def _solved(matrix: Matrix, right: Vector, free: Flags) -> Vector:
    """Solution of a symmetric system for the free coordinates, zero for the others; by least squares where it
    is singular."""
    out = np.zeros(right.size)
    if free.any():
        inner = matrix[np.ix_(free, free)]
        scale = np.sqrt(np.maximum(np.diag(inner), 1e-300))
        out[free] = (
            np.linalg.lstsq(inner / np.outer(scale, scale), right[free] / scale, rcond=1e-14)[0] / scale
        )
    return out
