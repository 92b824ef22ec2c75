"""Log posterior density of plant and effects, what enters linearly integrated out."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.arrays import Array, Index, Matrix, Vector
from lcopa_bayes.loop.scores import State


@final
@dataclass(frozen=True, eq=False)
class LoopDensity:
    """Density of the coordinates that are sampled, at the noise of a state.

    Offsets, and coefficients that belong to one record, are integrated out about the optimum (exact for
    offsets,
    linearised for coefficients); so is the scale of the noise under ``1 / variance`` with `quiet` further
    samples.
    """

    state: State
    quiet: float
    """Samples the noise scale is known from [-]."""

    @cached_property
    def linear(self) -> Index:
        """Coordinates that are integrated out."""
        model = self.state.model
        rows, columns = model.base.posterior.table.rows, model.base.least.columns
        normal = ~np.isnan(model.base.centre)
        out = [p for p, k in enumerate(columns) if rows[k].kind == "offset" and normal[p]]
        told = model.effected.coefficients
        out += [model.plant_size + k for k, one in enumerate(told) if one.record is not None]
        return np.array(out, dtype=int)

    @cached_property
    def sampled(self) -> Index:
        """Coordinates that are sampled."""
        return np.setdiff1d(np.arange(self.state.optimum.x.size), self.linear)

    @cached_property
    def columns(self) -> Matrix:
        """Whitened tangents of the coordinates integrated out, at the optimum, (n, linear)."""
        return self.state.optimum.jacobian[:, self.linear]

    @cached_property
    def pull(self) -> Vector:
        """Pull of their priors at the optimum, (linear,)."""
        model = self.state.model
        return np.asarray((self.state.optimum.x - model.centre)[self.linear] / model.spread[self.linear] ** 2)

    @cached_property
    def inverse(self) -> Matrix:
        """Covariance of the coordinates integrated out given the others, (linear, linear)."""
        precision = np.diag(1.0 / self.state.model.spread[self.linear] ** 2)
        inverse: Matrix = np.linalg.inv(self.columns.T @ self.columns + precision).astype(float)
        return inverse

    def pulled(self, white: Vector) -> Vector:
        """Slope of the log density in the coordinates integrated out, from a whitened residual."""
        return np.asarray(white @ self.columns - self.pull)

    def residual(self, z: Vector) -> Vector | None:
        """Whitened residual at sampled coordinates, the others at the optimum; None without a response."""
        x = self.state.optimum.x.copy()
        x[self.sampled] = z
        try:
            predicted = self.state.model.predict(x)
        except ArithmeticError:  # no bounded response: the likelihood is zero there
            return None
        return self.state.whitening(self.state.whitening.observed - predicted)

    def __call__(self, z: Vector) -> float:
        """Log density up to a constant, -inf outside the priors; FloatingPointError where NaN."""
        return self.told(z)[0]

    def told(self, z: Vector) -> tuple[float, Vector]:
        """Log density, and how far the coordinates integrated out lie from the optimum on average there."""
        prior, nowhere = float(self.log_priors(z[None])[0]), np.zeros(self.linear.size)
        white = self.residual(z) if prior > -np.inf else None
        if white is None:
            return -np.inf, nowhere
        inner = self.pulled(white)
        shift = self.inverse @ inner
        value = prior + float(self.log_likelihood(white @ white - inner @ shift))
        if np.isnan(value):
            raise FloatingPointError(f"the log density of the loop is NaN at {z.tolist()}")
        return value, shift

    def log_likelihood(self, power: Array) -> Array:
        """Of the squared whitened residual less what the coordinates integrated out take of it."""
        cost = self.state.optimum.cost
        freedom = self.quiet + self.state.whitening.effective
        return np.asarray(-0.5 * freedom * np.log1p((power - 2 * cost) / (self.quiet + 2 * cost)))

    def log_priors(self, z: Matrix) -> Vector:
        """Of the sampled coordinates (batch, k), (batch,); -inf outside their support."""
        model = self.state.model
        low, high = (ends[self.sampled] for ends in model.bounds)
        inside = np.logical_and(z >= low, z <= high).all(axis=1)
        total, rows = np.zeros(len(z)), model.base.posterior.table.rows
        held = np.where(
            np.reshape(inside, (-1, 1)), z, self.state.optimum.x[self.sampled]
        )  # no overflow outside
        for position, value in zip(self.sampled, held.T, strict=True):
            if position >= model.plant_size:
                total -= 0.5 * value**2
                continue
            row = rows[model.base.least.columns[position]]
            total += row.log_prior(np.exp(value)) + value if row.log_scale else row.log_prior(value)
        return np.where(inside, total, -np.inf)

    def completed(self, z: Matrix, shifts: Matrix, rng: np.random.Generator) -> Matrix:
        """All coordinates (batch, all) of sampled ones (batch, k) and the shifts told there, (batch, linear):
        those integrated out are drawn from their conditional."""
        x = np.tile(self.state.optimum.x, (len(z), 1))
        x[:, self.sampled] = z
        noise = rng.standard_normal(shifts.shape)
        x[:, self.linear] += shifts + noise @ np.linalg.cholesky(self.inverse).T
        return x
