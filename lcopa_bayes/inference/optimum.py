"""Least squares from many starts: where the posterior's hills stand before sampling begins."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from scipy.optimize import least_squares

from lcopa_bayes.arrays import Matrix, Vector
from lcopa_bayes.inference.noise import AR1, GaussianNoise, White
from lcopa_bayes.inference.posterior import Posterior

_SCREENED = 1024
"""Prior draws whose misfit is looked at."""
_DISTINCT = 0.5
"""Starts closer than this in every sampled coordinate count as one [natural log or parameter unit]."""
_EDGE = 1e-6
"""Distance kept from the ends of a parameter's domain, relative to the domain or to 1."""


@final
@dataclass(frozen=True, eq=False)
class Optimum:
    """A local least-squares solution."""

    values: Vector
    """Canonical table values, noise parameters estimated from the residual, (rows,)."""
    covariance: Matrix
    """Linearised covariance of the sampled coordinates, (dimension, dimension)."""
    log_density: float
    """Log posterior density of the sampled coordinates there [nat]."""


@final
@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Output-error least squares of a posterior's plant parameters at fixed noise parameters.

    Works in the sampled coordinates of the plant (logarithms of time constants) and the plain values
    of gains and offsets, with the exact Jacobian; normal priors enter as extra rows, the support of
    the others as bounds.
    """

    posterior: Posterior

    @cached_property
    def columns(self) -> list[int]:
        """Table positions of the free plant parameters."""
        rows = self.posterior.table.rows
        return [k for k, row in enumerate(rows) if row.free and row.kind not in ("sigma", "rho", "nu")]

    @cached_property
    def _bounds(self) -> tuple[Vector, Vector]:
        low, high = [], []
        for k in self.columns:
            row = self.posterior.table.rows[k]
            a, b = row.domain
            if row.log_scale:
                a, b = (np.log(max(a, 1e-300)), np.log(b))
            edge = _EDGE * (b - a if np.isfinite(b - a) else 1.0)
            low.append(a + edge)
            high.append(b - edge)
        return np.array(low), np.array(high)

    def coordinates(self, values: Vector) -> Vector:
        """Search coordinates of table values."""
        rows = self.posterior.table.rows
        return np.array([np.log(values[k]) if rows[k].log_scale else values[k] for k in self.columns])

    def values(self, x: Vector, template: Vector) -> Vector:
        """Table values of search coordinates, the rest from `template`; not sorted."""
        out = template.copy()
        rows = self.posterior.table.rows
        for position, k in enumerate(self.columns):
            out[k] = np.exp(x[position]) if rows[k].log_scale else x[position]
        return out

    def residual(self, x: Vector, template: Vector) -> tuple[Vector, Matrix]:
        """Whitened residual (model minus data, then prior rows) and its exact Jacobian in `x`.

        `template` (rows,) gives fixed values and noise parameters.
        """
        posterior, table = self.posterior, self.posterior.table
        raw = self.values(x, template)
        values, source = table.sorted_with_source(raw[None])
        jacobian = np.zeros((posterior.size, len(table.rows)))
        parts, start = [], 0
        slopes = posterior.model.unit_slopes(table.dynamics(values))
        for r, samples in enumerate(posterior.samples):
            units, unit_slopes = slopes[r]
            for axis, observed in enumerate(samples.axes):
                stop = start + observed.values.size
                block = jacobian[start:stop]
                misfit = -posterior.residual(axis, r, observed, values, units)[0]
                for k in posterior.acting[axis]:
                    column = posterior.column(k, axis, r, observed, units)
                    if column is not None:
                        block[:, k] = column[0]
                for drive, unit in enumerate(table.layout.unit_of[axis]):
                    gain = values[0, table.at("gain", axis, drive)]
                    element, delay, _ = table.layout.units[unit]
                    slope = gain * unit_slopes[unit][:, 0, observed.index]
                    terms = table.layout.elements[element].terms
                    for i in range(terms):
                        block[:, table.at("time", element, i)] += slope[i]
                        block[:, table.at("order", element, i)] += slope[terms + i]
                    block[:, table.at("delay", delay)] += slope[2 * terms]
                stacked = np.concatenate([block.T, misfit[None]])
                white = self._whiten(stacked, values, axis, observed.gaps)
                jacobian[start:stop] = white[:-1].T
                parts.append(white[-1])
                start = stop
        jacobian = jacobian[:, source[0]]  # derivatives by sorted position -> by search coordinate
        for k in self.columns:  # time slopes are in the logarithm already, other log scales are not
            row = table.rows[k]
            if row.log_scale and row.kind != "time":
                jacobian[:, k] *= raw[k]
            elif row.kind == "time" and not row.log_scale:
                jacobian[:, k] /= raw[k]
        rows, prior = self._prior_rows(raw)
        return (
            np.concatenate([*parts, prior]),
            np.concatenate([jacobian, rows])[:, self.columns],
        )

    def _whiten(self, columns: Matrix, values: Matrix, axis: int, gaps: Vector) -> Matrix:
        noise = self.posterior.noise if isinstance(self.posterior.noise, GaussianNoise) else White()
        parameters = self.posterior.noise_parameters(values, axis)
        return noise.whiten(columns[None], parameters, gaps)[0][0]

    def _prior_rows(self, raw: Vector) -> tuple[Matrix, Vector]:
        """Standardised normal priors as residual rows."""
        table = self.posterior.table
        rows, prior = [], []
        for k in self.columns:
            row = table.rows[k]
            if row.prior is not None and row.prior.dist == "norm" and not row.log_scale:
                mean, sd = row.prior.frozen.mean(), row.prior.frozen.std()
                unit = np.zeros(len(table.rows))
                unit[k] = 1 / sd
                rows.append(unit)
                prior.append((raw[k] - mean) / sd)
        return np.array(rows).reshape(-1, len(table.rows)), np.array(prior)

    def solve(self, values: Vector) -> tuple[Vector, Matrix]:
        """From a start to a local minimum: table values and the Jacobian there."""
        low, high = self._bounds
        start = np.clip(self.coordinates(values), low, high)
        memory: dict[bytes, tuple[Vector, Matrix]] = {}

        def both(x: Vector) -> tuple[Vector, Matrix]:
            key = x.tobytes()
            if key not in memory:
                memory.clear()
                memory[key] = self.residual(x, values)
            return memory[key]

        found = least_squares(
            lambda x: both(x)[0],
            start,
            lambda x: both(x)[1],
            bounds=(low, high),
            x_scale="jac",
            max_nfev=100,
        )
        return self.posterior.table.canonical(self.values(found.x, values)[None])[0], found.jac

    def with_noise(self, values: Vector) -> Vector:
        """The same plant with noise parameters estimated from its residual, where these are free."""
        posterior, table = self.posterior, self.posterior.table
        out = values.copy()
        units = posterior.model.unit_responses(table.dynamics(values[None]))
        for axis in range(len(table.layout.responses)):
            residuals = [
                posterior.residual(axis, r, samples.axes[axis], values[None], units[r])[0]
                for r, samples in enumerate(posterior.samples)
            ]
            power = sum(float(residual @ residual) for residual in residuals)
            count = sum(residual.size for residual in residuals)
            lagged = sum(float(residual[1:] @ residual[:-1]) for residual in residuals)
            estimates = {"sigma": np.sqrt(power / count), "rho": lagged / power if power else 0.0, "nu": 10.0}
            for name in posterior.noise.names:
                k = table.at(name, axis)
                if table.rows[k].free:
                    out[k] = _inside(estimates[name], table.rows[k].domain)
        return out


def _inside(value: float, domain: tuple[float, float]) -> float:
    """A starting value moved off the ends of its domain (starts only: never a density)."""
    low, high = domain
    margin = 1e-3 * (high - low) if np.isfinite(high - low) else 1e-3 * max(abs(low), 1e-9)
    return float(np.clip(value, low + margin, high - margin))


def find_optima(posterior: Posterior, rng: np.random.Generator, *, starts: int = 12) -> tuple[Optimum, ...]:
    """Local optima from the best of many prior draws, best first, duplicates removed.

    Screening and a first solve treat the residual as nearly white; a second solve uses the noise model with
    its parameters estimated from the first residual.
    """
    table, problem = posterior.table, LeastSquares(posterior)
    drawn = table.draw(_SCREENED, rng)
    for axis, scale in enumerate(_spread(posterior)):
        for name, value in (("sigma", 0.05 * scale), ("rho", 0.1), ("nu", 10.0)):
            if name in posterior.noise.names and table.rows[table.at(name, axis)].free:
                drawn[:, table.at(name, axis)] = value
    chosen = drawn[np.argsort(-_screen(posterior, drawn), kind="stable")]
    optima: list[Optimum] = []
    for values in _distinct(posterior, chosen, starts):
        values = posterior.complete(posterior.coordinates(values[None]), None)[0]
        for _ in range(2):
            values, jacobian = problem.solve(values)
            values = problem.with_noise(values)
        optima.append(_describe(posterior, problem, values, jacobian))
    optima.sort(key=lambda optimum: -optimum.log_density)
    kept: list[Optimum] = []
    for optimum in optima:
        close = (np.abs(_plain(posterior, optimum) - _plain(posterior, other)).max() < 1e-2 for other in kept)
        if np.isfinite(optimum.log_density) and not any(close):
            kept.append(optimum)
    return tuple(kept)


def _plain(posterior: Posterior, optimum: Optimum) -> Vector:
    return posterior.coordinates(optimum.values[None])[0]


def _screen(posterior: Posterior, values: Matrix) -> Vector:
    """Log likelihood of each draw, a chunk at a time."""
    chunks = np.array_split(values, max(1, values.shape[0] // 64))
    return np.concatenate([posterior.log_likelihood(chunk) for chunk in chunks])


def _spread(posterior: Posterior) -> list[float]:
    """Standard deviation of each response axis [response unit]."""
    axes = range(len(posterior.table.layout.responses))
    pooled = [np.concatenate([s.axes[axis].values for s in posterior.samples]) for axis in axes]
    return [float(values.std()) or 1.0 for values in pooled]


def _distinct(posterior: Posterior, ranked: Matrix, count: int) -> list[Vector]:
    """The first `count` rows that differ from each other."""
    kept: list[Vector] = []
    for values in ranked:
        here = posterior.coordinates(values[None])[0]
        if all(np.abs(here - posterior.coordinates(v[None])[0]).max() > _DISTINCT for v in kept):
            kept.append(values)
        if len(kept) == count:
            break
    return kept


def _describe(posterior: Posterior, problem: LeastSquares, values: Vector, jacobian: Matrix) -> Optimum:
    """Optimum with the covariance of the sampled coordinates; noise parameters by their own curvature."""
    coordinates = posterior.coordinates(values[None])
    information = jacobian.T @ jacobian
    widths = np.where(np.isfinite(problem._bounds[1] - problem._bounds[0]), 1.0, np.inf)
    information += np.diag(1.0 / np.minimum(widths, 1e9) ** 2)  # no direction wider than a unit prior
    plant = np.linalg.pinv(information, hermitian=True)
    covariance = np.zeros((posterior.dimension, posterior.dimension))
    where = {k: position for position, k in enumerate(problem.columns)}
    count = posterior.size / max(1, len(posterior.table.layout.responses))
    for a, k in enumerate(posterior.sampled):
        for b, other in enumerate(posterior.sampled):
            if k in where and other in where:
                covariance[a, b] = plant[where[k], where[other]]
        if k not in where:
            kind = posterior.table.rows[k].kind
            rho = values[k] if kind == "rho" else 0.0
            steep = (1 - rho**2 + 1e-4) / (rho * (1 - rho)) ** 2 if kind == "rho" else 0.0
            covariance[a, a] = {"sigma": 0.5 / count, "rho": steep / count, "nu": 0.25}[kind]
    if isinstance(posterior.noise, AR1):
        for a, k in enumerate(posterior.sampled):
            row = posterior.table.rows[k]
            if row.kind == "sigma":
                rho = values[posterior.table.at("rho", row.place.first)]
                covariance[a, a] *= (1 + rho) / max(1 - rho, 1e-3)
    return Optimum(values, covariance, float(posterior.log_density(coordinates)[0]))
