"""The posterior: prior and likelihood of the parameter table given the fit records."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias, final

import numpy as np
from scipy.special import expit, log_expit, logit

from lcopa_bayes.core.arrays import Array, Flags, Matrix, Vector
from lcopa_bayes.inference.noise import LOG_2PI, GaussianNoise, Noise
from lcopa_bayes.inference.observations import Observed, Samples
from lcopa_bayes.inference.parameter import Parameter
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.inference.simulation import Simulated, Simulation
from lcopa_bayes.model.forward import ForwardModel

Units: TypeAlias = "Array | Simulated"
"""Responses of one record that linear parameters scale."""
_PORTION = 128
"""Parameter sets evaluated at once: what one portion holds stays in the processor's cache."""


def portions(values: Matrix) -> list[Matrix]:
    """Parameter sets, (batch, rows), as many of them as are evaluated at once."""
    return [values[first : first + _PORTION] for first in range(0, len(values), _PORTION)]


@final
@dataclass(frozen=True, eq=False)
class Posterior:
    """Log density of the sampled coordinates, a batch at a time.

    Gains and offsets with normal priors enter linearly: under Gaussian noise they are integrated out
    exactly and drawn afterwards (`complete`); with effects (`ForwardModel.effects`) those that still do. The
    remaining free parameters are sampled, some by their logarithm (`Parameter.log_scale`).
    """

    table: ParameterTable
    model: ForwardModel
    samples: tuple[Samples, ...]
    noise: Noise
    surrogate: Callable[[Matrix], Sequence[Simulated]] | None = None
    """What stands for the responses of a plant with effects; None: they are simulated."""

    @cached_property
    def linear(self) -> tuple[int, ...]:
        """Table positions of the parameters that are integrated out."""
        if not isinstance(self.noise, GaussianNoise):
            return ()
        return tuple(k for k, row in enumerate(self.table.rows) if self._is_linear(k, row))

    @cached_property
    def simulation(self) -> Simulation | None:
        """The model with effects; None without."""
        return None if self.model.effects is None else Simulation(self.table, self.model)

    def responses(self, values: Matrix) -> Sequence[Units]:
        """Unit responses of every fit record at canonical values, or with effects what stands for them."""
        if self.surrogate is not None:
            return self.surrogate(values)
        if self.simulation is not None:
            return self.simulation(values)
        return self.model.unit_responses(self.table.dynamics(values))

    @cached_property
    def sampled(self) -> tuple[int, ...]:
        """Table positions of the sampled coordinates."""
        return tuple(k for k, row in enumerate(self.table.rows) if row.free and k not in self.linear)

    @property
    def dimension(self) -> int:
        """Number of sampled coordinates."""
        return len(self.sampled)

    @property
    def size(self) -> int:
        """Number of observed samples."""
        return sum(axis.values.size for samples in self.samples for axis in samples.axes)

    @cached_property
    def _logs(self) -> Flags:
        return np.array([self.table.rows[k].log_scale for k in self.sampled], dtype=bool)

    @cached_property
    def _logits(self) -> Flags:
        return np.array([self.table.rows[k].logit_scale for k in self.sampled], dtype=bool)

    @cached_property
    def _template(self) -> Vector:
        """Fixed values; NaN for what is free."""
        return np.array([row.value for row in self.table.rows])

    def values(self, coordinates: Matrix) -> Matrix:
        """Canonical table values, (batch, rows), NaN where integrated out."""
        values = np.tile(self._template, (coordinates.shape[0], 1))
        natural = coordinates.copy()
        with np.errstate(over="ignore"):  # what is proposed as infinite lies outside every prior
            natural[:, self._logs] = np.exp(coordinates[:, self._logs])
        natural[:, self._logits] = expit(coordinates[:, self._logits])
        values[:, self.sampled] = natural
        return self.table.canonical(values)

    def coordinates(self, values: Matrix) -> Matrix:
        """Sampled coordinates of table values, (batch, dimension)."""
        out = values[:, self.sampled]
        out[:, self._logs] = np.log(out[:, self._logs])
        out[:, self._logits] = logit(out[:, self._logits])
        return out

    def log_prior(self, coordinates: Matrix) -> Vector:
        """Log prior density of the sampled coordinates, (batch,); the only source of -inf."""
        values = self.values(coordinates)
        total = np.where(self.table.supported(values), self._log_order_level, -np.inf)
        for k in self.sampled:
            total = total + self.table.rows[k].log_prior(values[:, k])
        steep = coordinates[:, self._logits]
        jacobian = coordinates[:, self._logs].sum(axis=1) + (log_expit(steep) + log_expit(-steep)).sum(axis=1)
        return np.asarray(total + jacobian)

    @cached_property
    def _log_order_level(self) -> float:
        # sampled unordered, an exchangeable element covers each ordered point in every permutation
        return self.table.log_support - self.table.log_permutations

    def log_density(self, coordinates: Matrix, *, heat: float = 1.0) -> Vector:
        """Log of prior times likelihood^heat, (batch,); FloatingPointError with the values where NaN."""
        total = self.log_prior(coordinates)
        inside = np.flatnonzero(total > -np.inf)
        if inside.size:
            values = self.values(coordinates[inside])
            total[inside] += heat * self.log_likelihood(values)
            if np.isnan(total).any():
                row = values[np.flatnonzero(np.isnan(total[inside]))[0]]
                at = ", ".join(f"{n} = {v:.6g}" for n, v in zip(self.table.names, row, strict=True))
                raise FloatingPointError(f"the log density is NaN at {at}")
        return total

    def log_likelihood(self, values: Matrix) -> Vector:
        """Log likelihood of canonical values, linear parameters integrated out, (batch,)."""
        return np.asarray(self.log_likelihoods(values).sum(axis=0))

    def log_likelihoods(self, values: Matrix) -> Matrix:
        """The same of each response axis, (axes, batch)."""
        if values.shape[0] > _PORTION:
            return np.concatenate([self.log_likelihoods(some) for some in portions(values)], axis=1)
        units = self.responses(values)
        out = np.zeros((len(self.table.layout.responses), values.shape[0]))
        for axis, total in enumerate(out):
            if isinstance(self.noise, GaussianNoise):
                equations, log_scale, count = self.equations(axis, values, units)
                total += equations.log_marginal() - log_scale - 0.5 * count * LOG_2PI
            else:
                for r, samples in enumerate(self.samples):
                    residual = self.residual(axis, r, samples.axes[axis], values, units[r])
                    noise = self.noise_parameters(values, axis)
                    total += self.noise.pointwise(residual, noise, samples.axes[axis].gaps).sum(axis=1)
        if self.simulation is not None:  # without a bounded response nothing is likely
            out[:, ~bounded(units)] = -np.inf
        return out

    def noise_parameters(self, values: Matrix, axis: int) -> Matrix:
        """Noise parameters of a response axis, (batch, names)."""
        return values[:, [self.table.at(name, axis) for name in self.noise.names]]

    def complete(self, coordinates: Matrix, rng: np.random.Generator | None) -> Matrix:
        """Canonical table values with the linear parameters drawn from their exact conditional.

        With `rng` None they are set to their conditional mean.
        """
        values = self.values(coordinates)
        if not self.linear:
            return values
        units = self.responses(values)
        for axis in range(len(self.table.layout.responses)):
            equations, _, _ = self.equations(axis, values, units)
            block = self.blocks[axis]
            standard = equations.mean() if rng is None else equations.draw(rng)
            mean, sd = self._moments(block)
            values[:, block] = mean + sd * standard
        return values

    def pointwise(self, values: Matrix) -> list[list[Matrix]]:
        """Log likelihood of each sample given those before it, [record][axis] (batch, n)."""
        units = self.responses(values)
        out = [
            [
                self.noise.pointwise(
                    self.residual(axis, r, observed, values, units[r]),
                    self.noise_parameters(values, axis),
                    observed.gaps,
                )
                for axis, observed in enumerate(samples.axes)
            ]
            for r, samples in enumerate(self.samples)
        ]
        if self.simulation is not None:
            for density in (axis for record in out for axis in record):
                density[~bounded(units)] = -np.inf
        return out

    def joint_log_likelihood(self, values: Matrix) -> Vector:
        """Log likelihood of canonical values, linear parameters included, (batch,) [nat]."""
        out = []
        for some in portions(values):
            records = self.pointwise(some)
            out.append(np.sum([axis.sum(axis=1) for record in records for axis in record], axis=0))
        return np.concatenate(out)

    @cached_property
    def blocks(self) -> list[list[int]]:
        """Linear parameters of each response axis."""
        axes = range(len(self.table.layout.responses))
        return [[k for k in self.linear if self.table.rows[k].response == axis] for axis in axes]

    def _moments(self, block: Sequence[int]) -> tuple[Vector, Vector]:
        """Prior means and standard deviations of linear parameters."""
        priors = [self.table.rows[k].prior for k in block]
        frozen = [prior.frozen for prior in priors if prior is not None]
        return np.array([p.mean() for p in frozen]), np.array([p.std() for p in frozen])

    @cached_property
    def scaled(self) -> list[tuple[Vector, Vector]]:
        """Prior means and standard deviations of the linear parameters of each response axis."""
        return [self._moments(block) for block in self.blocks]

    def equations(
        self, axis: int, values: Matrix, units: Sequence[Units]
    ) -> tuple[NormalEquations, Vector, int]:
        """Normal equations of a response axis, sum of log innovation sd, and number of samples."""
        assert isinstance(self.noise, GaussianNoise)
        batch, block = values.shape[0], self.blocks[axis]
        mean, sd = self.scaled[axis]
        equations = NormalEquations.of_columns(batch, len(block))
        parameters = self.noise_parameters(values, axis)
        log_scale, count = np.zeros(batch), 0
        centre = values.copy()
        centre[:, block] = mean
        for r, samples in enumerate(self.samples):
            observed = samples.axes[axis]
            if observed.values.size == 0:
                continue
            acting = [(p, self.column(k, axis, r, observed, units[r])) for p, k in enumerate(block)]
            columns = [(p, column) for p, column in acting if column is not None]
            stacked = np.empty((batch, len(columns) + 1, observed.values.size))
            for slot, (p, column) in enumerate(columns):
                np.multiply(sd[p], column, out=stacked[:, slot])
            stacked[:, -1] = self.residual(axis, r, observed, centre, units[r])
            products, scale = self.noise.products(stacked, parameters, observed.gaps)
            equations.add(products, [p for p, _ in columns])
            log_scale += scale
            count += observed.values.size
        return equations, log_scale, count

    def column(self, k: int, axis: int, r: int, observed: Observed, units: Units) -> Array | None:
        """What a unit of a linear parameter adds to a record; None where it does not act."""
        row = self.table.rows[k]
        if row.kind == "offset":
            return np.ones((1, observed.values.size)) if row.place.second in (-1, r) else None
        if isinstance(units, Simulated):
            whole = units.columns.get(k)
            return None if whole is None else whole[:, observed.chosen]
        drive = row.place.second
        rest = self.model.experiments[r].rest[drive]
        if not self.model.experiments[r].drives[drive].moves:
            return np.full((1, observed.values.size), rest) if rest != 0.0 else None
        unit = units[self.table.layout.unit_of[axis][drive]][:, observed.chosen]
        return np.asarray(unit + rest) if rest != 0.0 else unit

    def residual(self, axis: int, r: int, observed: Observed, values: Matrix, units: Units) -> Matrix:
        """Observed minus modelled, (batch, n) [response unit]."""
        out = np.tile(observed.values, (values.shape[0], 1))
        if isinstance(units, Simulated):
            out -= units.base[axis][:, observed.chosen]
        for k in self.acting[axis]:
            column = self.column(k, axis, r, observed, units) if values[:, k].any() else None
            if column is not None:
                out -= values[:, k, None] * column
        return out

    @cached_property
    def acting(self) -> list[list[int]]:
        """Gains and offsets of each response axis; with effects what they leave linear."""
        acting = self.table.of_kind("gain") + self.table.of_kind("offset")
        if self.simulation is not None:
            acting = [*sorted(self.simulation.rows.scaled), *self.table.of_kind("offset")]
        axes = range(len(self.table.layout.responses))
        return [[k for k in acting if self.table.rows[k].response == axis] for axis in axes]

    def _is_linear(self, k: int, row: Parameter) -> bool:
        scaled = row.kind == "gain" if self.simulation is None else k in self.simulation.rows.scaled
        return (scaled or row.kind == "offset") and row.prior is not None and row.prior.dist == "norm"

    @cached_property
    def without_effects(self) -> Posterior:
        """The same of the plant alone; the noise stays."""
        return replace(self, table=self.table.without_effects, model=self.model.plain, surrogate=None)


@final
@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Linear parameters that are integrated out: ``y = X b + white noise`` for a batch of X.

    b is standardised, so that its prior is N(0, I).

    ``gram = X'X + I`` (batch, p, p), ``moment = X'y`` (batch, p), ``square = y'y`` (batch,).
    """

    gram: Array
    moment: Matrix
    square: Vector

    @classmethod
    def of_columns(cls, batch: int, p: int) -> NormalEquations:
        """Before any data: the prior alone."""
        return cls(np.tile(np.eye(p), (batch, 1, 1)), np.zeros((batch, p)), np.zeros(batch))

    def add(self, products: Array, place: list[int]) -> None:
        """Add scalar products of whitened columns at `place` and, last, of their target with each other,
        (batch, k + 1, k + 1)."""
        rows = np.array(place, dtype=int)
        if rows.size:
            self.gram[:, rows[:, None], rows] += products[:, :-1, :-1]
            self.moment[:, rows] += products[:, :-1, -1]
        self.square[:] += products[:, -1, -1]

    def log_marginal(self) -> Vector:
        """Log of the Gaussian integral over b, without the white noise's normalisation, (batch,)."""
        if self.moment.shape[1] == 0:
            return -0.5 * self.square
        factor = np.linalg.cholesky(self.gram)
        bent = np.linalg.solve(factor, self.moment[..., None])[..., 0]
        half_log_det = np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
        return np.asarray(-0.5 * (self.square - np.einsum("bp,bp->b", bent, bent)) - half_log_det)

    def mean(self) -> Matrix:
        """Conditional mean of b, (batch, p)."""
        return np.asarray(np.linalg.solve(self.gram, self.moment[..., None])[..., 0])

    def draw(self, rng: np.random.Generator) -> Matrix:
        """One draw of b for each member of the batch, (batch, p)."""
        factor = np.linalg.cholesky(self.gram)
        noise = rng.standard_normal(self.moment.shape)
        return np.asarray(self.mean() + np.linalg.solve(factor.swapaxes(1, 2), noise[..., None])[..., 0])


def bounded(units: Sequence[Units]) -> Flags:
    """Plants with a bounded response, (batch,), of responses with effects."""
    out: Flags = np.all([one.bounded for one in units if isinstance(one, Simulated)], axis=0)
    return out
