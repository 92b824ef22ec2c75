"""Log posterior density of plant and effects, what enters linearly integrated out."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.arrays import Index, Matrix, Vector
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
    def _nuisance(self) -> tuple[Matrix, Matrix, Vector]:
        """Whitened columns, inverse of their information, and the pull of their priors at the optimum."""
        model, optimum = self.state.model, self.state.optimum
        columns = optimum.jacobian[:, self.linear]
        precision = 1.0 / model.spread[self.linear] ** 2
        centre = model.centre[self.linear]
        pull = precision * (optimum.x[self.linear] - centre)
        inverse: Matrix = np.linalg.inv(columns.T @ columns + np.diag(precision)).astype(float)
        return columns, inverse, pull

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
        prior = self.log_prior(z)
        if prior == -np.inf:
            return -np.inf
        white = self.residual(z)
        if white is None:
            return -np.inf
        columns, inverse, pull = self._nuisance
        inner = columns.T @ white - pull
        power = float(white @ white - inner @ inverse @ inner)
        reference = self.quiet + 2 * self.state.optimum.cost
        freedom = self.quiet + self.state.whitening.effective
        value = prior - 0.5 * freedom * float(np.log1p((power - 2 * self.state.optimum.cost) / reference))
        if np.isnan(value):
            raise FloatingPointError(f"the log density of the loop is NaN at {z.tolist()}")
        return value

    def log_prior(self, z: Vector) -> float:
        """Of the sampled coordinates."""
        model = self.state.model
        low, high = (ends[self.sampled] for ends in model.bounds)
        if not ((z >= low) & (z <= high)).all():
            return -np.inf
        total, rows = 0.0, model.base.posterior.table.rows
        for position, value in zip(self.sampled, z, strict=True):
            if position >= model.plant_size:
                total -= 0.5 * value**2
                continue
            row = rows[model.base.least.columns[position]]
            plain = float(np.exp(value)) if row.log_scale else value
            total += float(row.log_prior(np.array([plain]))[0]) + (value if row.log_scale else 0.0)
        return total

    def completed(self, z: Vector, rng: np.random.Generator) -> Vector:
        """All coordinates, those integrated out drawn from their conditional."""
        x = self.state.optimum.x.copy()
        x[self.sampled] = z
        white = self.residual(z)
        if white is None:
            raise FloatingPointError("a draw has no bounded response")
        columns, inverse, pull = self._nuisance
        mean = inverse @ (columns.T @ white - pull)
        x[self.linear] += mean + np.linalg.cholesky(inverse) @ rng.standard_normal(self.linear.size)
        return x
