"""Noise parameters that fit given residuals best, and how well these know them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from scipy.optimize import minimize
from scipy.special import log_expit

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.inference.noise import GaussianNoise, Noise
from lcopa_bayes.inference.parameter import Parameter

_TAIL = 1e-9
"""Prior mass beyond either end of the search [-]."""
_EDGE = 1e-6
"""Distance kept from the ends of the search, relative to its width [-]."""
_SHIFT = 1e-5
"""Shift of the differences that give a gradient [natural log or logit]."""
_STEP = 0.05
"""Step of the differences that give the curvature [natural log or logit]."""


@final
@dataclass(frozen=True, eq=False)
class NoiseFit:
    """Posterior of the free noise parameters of one response axis given its residuals.

    Works in the sampled coordinates: logarithms of scales, logits of correlations.
    """

    noise: Noise
    rows: tuple[Parameter, ...]
    """One per name of the noise."""
    residuals: Sequence[Vector]
    """Of each record, (n,) [response unit]."""
    gaps: Sequence[Vector]
    """Of each record, (n,) [sampling periods]."""

    @cached_property
    def free(self) -> tuple[int, ...]:
        """Positions of the free parameters among `rows`."""
        return tuple(k for k, row in enumerate(self.rows) if row.free)

    @cached_property
    def ends(self) -> tuple[Vector, Vector]:
        """Ends of the search: where all but 2e-9 of the mass of each prior lies."""
        low, high = [], []
        for k in self.free:
            row = self.rows[k]
            at = row.coordinate(row.quantiles((_TAIL, 1 - _TAIL)))
            edge = _EDGE * (at[1] - at[0])
            low.append(at[0] + edge)
            high.append(at[1] - edge)
        return np.array(low), np.array(high)

    def values(self, x: Matrix, template: Vector, moving: Sequence[int] | None = None) -> Matrix:
        """Noise parameters at coordinates of those that move, by default all free ones, (batch, names); the
        others from `template`."""
        out = np.tile(template, (len(x), 1))
        for column, k in enumerate(self.free if moving is None else moving):
            out[:, k] = self.rows[k].value_at(x[:, column])
        return out

    def log_likelihood(self, values: Matrix) -> Vector:
        """Log likelihood of noise parameters (batch, names) up to a constant, (batch,)."""
        total = np.zeros(len(values))
        for residuals, gaps in self._alike:
            if isinstance(self.noise, GaussianNoise):
                seen = np.broadcast_to(residuals, (len(values), *residuals.shape))
                squares, scales = self.noise.products(seen, values, gaps)
                total -= 0.5 * np.trace(squares, axis1=1, axis2=2) + len(residuals) * scales
            else:
                for residual in residuals:
                    seen = np.broadcast_to(residual, (len(values), residual.size))
                    total += self.noise.pointwise(seen, values, gaps).sum(axis=1)
        return total

    @cached_property
    def _alike(self) -> list[tuple[Matrix, Vector]]:
        """Residuals of records with the same gaps, (records, n), and these: they are filtered together."""
        alike: dict[bytes, list[int]] = {}
        for number, gaps in enumerate(self.gaps):
            alike.setdefault(np.asarray(gaps, dtype=float).tobytes(), []).append(number)
        return [(np.stack([self.residuals[k] for k in own]), self.gaps[own[0]]) for own in alike.values()]

    def log_density(self, x: Matrix, template: Vector) -> Vector:
        """Log density of the coordinates up to a constant, (batch,)."""
        values = self.values(x, template)
        total = self.log_likelihood(values)
        for column, k in enumerate(self.free):
            row, at = self.rows[k], x[:, column]
            total += row.log_prior(values[:, k])
            total += at if row.log_scale else log_expit(at) + log_expit(-at) if row.logit_scale else 0.0
        return total

    def best(self, template: Vector) -> Vector:
        """Noise parameters of the largest density, (names,), the fixed ones from `template`.

        The better end of two searches: from moments of the residuals, and from nearly white noise.
        """
        power = sum(float(residual @ residual) for residual in self.residuals)
        if not self.free or power == 0.0:
            return template
        sd = float(np.sqrt(power / sum(residual.size for residual in self.residuals)))
        optima = [
            _highest(lambda x: self.log_density(x, template), self._start(estimates), self.ends)
            for estimates in (self.noise.estimate(self.residuals), self.noise.nearly_white(sd))
        ]
        x = max(optima, key=lambda one: one[1])[0]
        return np.asarray(self.values(x[None], template)[0])

    def likeliest(self, template: Vector, moving: Sequence[int], ends: tuple[Vector, Vector]) -> Vector:
        """Noise parameters at the maximum of the likelihood that `template` leads to, (names,).

        Those that are `moving` change, between the `ends` of their coordinates (moving,).
        """
        start = np.array([self.rows[k].coordinate(template[k]) for k in moving])
        x, _ = _highest(
            lambda x: self.log_likelihood(self.values(x, template, moving)), np.clip(start, *ends), ends
        )
        return np.asarray(self.values(x[None], template, moving)[0])

    def covariance(self, values: Vector) -> Matrix:
        """Inverse curvature of the log density at values (names,) in the coordinates of the free parameters;
        no direction is wider than a uniform density over the search."""
        low, high = self.ends
        x = np.array([self.rows[k].coordinate(values[k : k + 1])[0] for k in self.free])
        step = np.minimum(_STEP, (high - low) / 8)
        x = np.clip(x, low + 2 * step, high - 2 * step)  # the curvature beside a bound stands for that at it
        steps = np.concatenate([np.diag(step), -np.diag(step)])
        size, corners = len(x), (x + steps[:, None] + steps).reshape(-1, len(x))
        at = self.log_density(corners, values).reshape(2 * size, 2 * size)
        bent = at[:size, size:] + at[size:, :size] - at[:size, :size] - at[size:, size:]
        bent /= 4 * np.outer(step, step)
        sizes, directions = np.linalg.eigh((bent + bent.T) / 2)
        sizes = np.maximum(sizes, 12 / np.square(high - low).max(initial=0.0))
        return np.asarray(directions / sizes @ directions.T)

    def _start(self, estimates: Mapping[str, float]) -> Vector:
        """Coordinates of starting values, moved inside the ends of the search."""
        out = []
        for column, k in enumerate(self.free):
            row, ends = self.rows[k], [end[column] for end in self.ends]
            value = np.array([estimates[self.noise.names[k]]])
            inside = row.domain[0] < value[0] < row.domain[1]
            at = row.coordinate(value)[0] if inside else ends[int(value[0] >= row.domain[1])]
            out.append(float(np.clip(at, *ends)))
        return np.array(out)


def _highest(
    density: Callable[[Matrix], Vector], start: Vector, ends: tuple[Vector, Vector]
) -> tuple[Vector, float]:
    """Where a log density of coordinates (batch, size) is highest between `ends`, and its value there."""
    low, high = ends
    shift = _SHIFT * np.eye(start.size)

    def cost(x: Vector) -> tuple[float, Vector]:
        points = np.concatenate([x[None], np.minimum(x + shift, high), np.maximum(x - shift, low)])
        at = -density(points)
        plus, minus = np.split(points[1:], 2)
        return float(at[0]), (at[1 : x.size + 1] - at[x.size + 1 :]) / np.diagonal(plus - minus)

    bounds = list(zip(low, high, strict=True))
    optimum = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds)
    return optimum.x, -float(optimum.fun)
