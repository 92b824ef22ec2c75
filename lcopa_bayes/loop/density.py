"""Log posterior density of plant and effects, what enters linearly integrated out."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector
from lcopa_bayes.loop.scores import State


@final
@dataclass(frozen=True, eq=False)
class LoopDensity:
    """Density of the coordinates that are sampled, at the noise of a state.

    Offsets, and coefficients that belong to one record, are integrated out about the optimum (exact for
    offsets, linearised for coefficients); so is the scale of the noise under ``1 / variance`` with `quiet`
    further samples. Both together are exact where the priors of what is integrated out are wide, or narrow,
    against what the samples say of it.
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

    @cached_property
    def determined(self) -> float:
        """Coordinates integrated out that the samples determine, and not their priors [-]."""
        return float(np.einsum("nk,kl,nl->", self.columns, self.inverse, self.columns, optimize=True))

    @cached_property
    def freedom(self) -> float:
        """Degrees of freedom of the noise scale given the sampled coordinates [-]."""
        return self.quiet + self.state.whitening.effective - self.determined

    def pulled(self, white: Vector) -> Vector:
        """Slope of the log density in the coordinates integrated out, from a whitened residual."""
        return np.asarray(white @ self.columns - self.pull)

    def residual(self, z: Vector) -> Vector | None:
        """Whitened residual at sampled coordinates, the others at the optimum; None without a response."""
        x = self.state.optimum.x.copy()
        x[self.sampled] = z
        model = self.state.model
        if not model.base.supported(x[None, : model.plant_size], every=False)[0]:
            return None
        try:
            predicted = model.predict(x)
        except ArithmeticError:  # no bounded response: the likelihood is zero there
            return None
        return self.state.whitening(self.state.whitening.observed - predicted)

    def __call__(self, z: Vector) -> float:
        """Log density up to a constant, -inf outside the priors; FloatingPointError where NaN."""
        return self.with_conditional(z)[0]

    def with_conditional(self, z: Vector) -> tuple[float, Vector]:
        """Log density, and what `completed` needs there to draw what is integrated out, (linear + 1,): how
        far those coordinates lie from the optimum at the nominal noise, and the squared whitened residual
        that they leave [-]."""
        prior = float(self.log_priors(z[None])[0])
        white = self.residual(z) if prior > -np.inf else None
        if white is None:
            return -np.inf, np.zeros(self.linear.size + 1)
        inner = self.pulled(white)
        shift = self.inverse @ inner
        power = float(white @ white - inner @ shift)
        value = prior + float(self.log_likelihood(np.array(power)))
        if np.isnan(value):
            raise FloatingPointError(f"the log density of the loop is NaN at {z.tolist()}")
        return value, np.append(shift, power)

    def log_likelihood(self, power: Array) -> Array:
        """Of the squared whitened residual less what the coordinates integrated out take of it."""
        cost = self.state.optimum.cost
        return np.asarray(-0.5 * self.freedom * np.log1p((power - 2 * cost) / (self.quiet + 2 * cost)))

    def log_priors(self, z: Matrix, *, ordered: bool = True) -> Vector:
        """Of the sampled coordinates (batch, k), (batch,); -inf outside their support and where orders do not
        decrease. Unless `ordered`, terms that can be exchanged may be in any sequence."""
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
        x = np.tile(self.state.optimum.x[: model.plant_size], (len(z), 1))
        plant = self.sampled < model.plant_size
        x[:, self.sampled[plant]] = held[:, plant]
        inside &= model.base.supported(x, every=ordered)
        return np.where(inside, total, -np.inf)

    def completed(self, z: Matrix, conditional: Matrix, rng: np.random.Generator) -> Matrix:
        """All coordinates (batch, all) of sampled ones (batch, k) and what `with_conditional` gave there,
        (batch, linear + 1): the noise scale, then those integrated out given it, are drawn from their
        conditionals."""
        x = np.tile(self.state.optimum.x, (len(z), 1))
        x[:, self.sampled] = z
        if not self.linear.size:
            return x
        shift, power = conditional[:, :-1], conditional[:, -1:]
        variance = (self.quiet + power) / rng.chisquare(self.freedom, power.shape)
        spread = self.state.model.spread[self.linear]
        known, axes = np.linalg.eigh(np.outer(spread, spread) * (self.columns.T @ self.columns))
        pull = self.pull * spread @ axes
        # at the nominal noise the shift is (data - pull) / (known + 1): from it, that at another variance
        data = (shift / spread) @ axes * (known + 1.0) + pull
        precision = known / variance + 1.0
        standard = (data / variance - pull) / precision
        standard += rng.standard_normal(shift.shape) / np.sqrt(precision)
        x[:, self.linear] += standard @ axes.T * spread
        return x
