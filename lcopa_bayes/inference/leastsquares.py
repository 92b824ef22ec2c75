"""Output-error least squares of the plant at fixed noise, with the exact Jacobian."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import final

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.inference.effects import Effected, effect_slopes, effected_at
from lcopa_bayes.inference.noise import GaussianNoise, White
from lcopa_bayes.inference.noisefit import NoiseFit
from lcopa_bayes.inference.observations import Observed
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.inference.recursions import Filter
from lcopa_bayes.model.effects.effect import Effect, UnstableError

_EDGE = 1e-6
"""Distance kept from the ends of a parameter's domain, relative to the domain or to 1."""
_EVALUATIONS = 30
"""Most responses with effects that a descent takes [-]."""
_ENOUGH = 1e-7
"""Relative gain of the sum of squares that ends such a descent [-]: 5e-4 nat of ten thousand samples."""
_TAIL = 1e-9
"""Prior mass beyond either end of the search on a logarithmic scale [-]."""


@final
@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Output-error least squares of a posterior's plant parameters at fixed noise parameters.

    Works in the sampled coordinates of the plant (logarithms of time constants) and the plain values
    of gains and offsets, with the exact Jacobian; normal priors enter as extra rows, the support of
    the others as bounds.
    """

    posterior: Posterior
    exact: bool = True
    """Whether slopes of the plant are those with the effects in place."""
    held: tuple[Vector, ...] = ()
    """Parameters of `WhiteAR1` of each response axis, (3,), in place of the posterior's noise; or none."""
    begun: bool = False
    """Whether a descent with effects keeps the slopes that it begins with: near an optimum they hardly
    change, and cost several times what a response does."""

    @cached_property
    def columns(self) -> list[int]:
        """Table positions of the free plant parameters."""
        rows = self.posterior.table.rows
        return [k for k, row in enumerate(rows) if row.free and not row.noise]

    @cached_property
    def bounds(self) -> tuple[Vector, Vector]:
        """Lower and upper ends of the search coordinates."""
        low, high = [], []
        for k in self.columns:
            row = self.posterior.table.rows[k]
            a, b = row.domain
            if row.log_scale and row.prior is not None:  # along a flat direction logarithms run to infinity
                a, b = np.log(row.quantiles((_TAIL, 1 - _TAIL)))
            edge = _EDGE * (b - a if np.isfinite(b - a) else 1.0)
            low.append(a + edge)
            high.append(b - edge)
        return np.array(low), np.array(high)

    @property
    def prior_precision(self) -> Vector:
        """Of uniform laws between the bounds; 0 for coordinates without: no direction is wider than its
        prior."""
        width = self.bounds[1] - self.bounds[0]
        return np.where(np.isfinite(width), 12.0 / np.where(width > 0, width, 1.0) ** 2, 0.0)

    def bounds_around(self, values: Vector) -> tuple[Vector, Vector]:
        """Bounds that also keep orders decreasing where terms cannot be exchanged, and terms resolved.

        An order stays on its own side of the middle between its start and a free neighbour's, and of
        the value of a fixed neighbour. A term crosses 1 in its order, or the shortest resolved time, only
        where the other allows it.
        """
        low, high = (ends.copy() for ends in self.bounds)
        table = self.posterior.table
        for terms, exchangeable in zip(table.terms, table.exchangeable, strict=True):
            for upper, lower in () if exchangeable else pairwise(terms.orders):
                free = table.rows[upper].free, table.rows[lower].free
                wall = values[upper] if not free[0] else values[lower]
                wall = (values[upper] + values[lower]) / 2 if all(free) else wall
                for k, ends, choose in ((upper, low, max), (lower, high, min)):
                    if k in self.columns:
                        limit = float(table.rows[k].coordinate(wall))
                        position = self.columns.index(k)
                        ends[position] = choose(ends[position], limit)
        for t, o in table.limited:
            if values[o] > 1.0 or values[t] > table.resolution * (1.0 + _EDGE):
                position = self.columns.index(t)
                low[position] = max(low[position], float(table.rows[t].coordinate(table.resolution)))
            elif table.rows[o].free:
                position = self.columns.index(o)
                high[position] = min(high[position], 1.0)
        return low, high

    def coordinates(self, values: Vector) -> Vector:
        """Search coordinates of table values."""
        rows = self.posterior.table.rows
        return np.array([rows[k].coordinate(values[k]) for k in self.columns])

    def values(self, x: Vector, template: Vector) -> Vector:
        """Table values of search coordinates, the rest from `template`; not sorted."""
        out = template.copy()
        rows = self.posterior.table.rows
        for position, k in enumerate(self.columns):
            out[k] = rows[k].value_at(x[position])
        return out

    def misfit(self, x: Vector, template: Vector) -> Vector:
        """The residual of `residual` alone; infinite where effects leave no bounded response."""
        posterior, table = self.posterior, self.posterior.table
        raw = self.values(x, template)
        values = table.sorted_with_source(raw[None], every=True)[0]
        prior, parts = self._prior_rows(raw)[1], []
        try:
            for axis, observed, misfit in self._misfits(values):
                parts.append(self._whiten(misfit[None], values, axis, observed.gaps)[0])
        except UnstableError:
            return np.full(posterior.size + prior.size, np.inf)
        return np.concatenate([*parts, prior])

    def _misfits(self, values: Matrix) -> Iterator[tuple[int, Observed, Vector]]:
        """Response axis, samples and misfit (model minus data) of every axis of every record; UnstableError
        where effects leave no bounded response."""
        posterior = self.posterior
        if posterior.simulation is not None and posterior.surrogate is None:
            model = self._effected_at(values[0])
            responses = model.responses(values[0], posterior.simulation.rows.psi(values[0]))
            for response, samples in zip(responses, posterior.samples, strict=True):
                for axis, observed in enumerate(samples.axes):
                    yield axis, observed, response[observed.index, axis] - observed.values
            return
        units = posterior.responses(values)
        for r, samples in enumerate(posterior.samples):
            for axis, observed in enumerate(samples.axes):
                yield axis, observed, -posterior.residual(axis, r, observed, values, units[r])[0]

    @cached_property
    def _latest(self) -> dict[tuple[Effect, ...], Effected]:
        """The plant with the constants it was asked for last, so that slopes at a place where the response is
        known simulate only what is new."""
        return {}

    def _effected_at(self, values: Vector) -> Effected:
        assert self.posterior.simulation is not None
        key = self.posterior.simulation.rows.effects(values)
        if key not in self._latest:
            self._latest.clear()
            self._latest[key] = effected_at(self.posterior.simulation, values)
        return self._latest[key]

    def residual(self, x: Vector, template: Vector) -> tuple[Vector, Matrix]:
        """Whitened residual (model minus data, then prior rows) and its exact Jacobian in `x`.

        `template` (rows,) gives fixed values and noise parameters. With effects slopes are those of
        `effects.effect_slopes`; UnstableError where these leave no bounded response.
        """
        posterior, table = self.posterior, self.posterior.table
        raw = self.values(x, template)
        values, source = table.sorted_with_source(raw[None], every=True)
        own = source[0][self.columns]  # position among sorted values of each search coordinate
        rows, prior = self._prior_rows(raw)
        misfits = np.concatenate([np.empty(posterior.size), prior])
        jacobian = np.zeros((len(own), misfits.size)).T  # a column of a long record is one piece of memory
        jacobian[posterior.size :] = rows[:, self.columns]
        start = 0
        blocks = self.plain_slopes(values) if posterior.simulation is None else self._effected(values)
        for axis, observed, block, misfit in blocks:
            part = slice(start, start + observed.values.size)
            start = part.stop
            # offsets of other records and paths of other axes do not act
            acting = np.flatnonzero(np.any(block[:, own], axis=0))
            stacked = np.concatenate([block.T[own[acting]], misfit[None]])
            *slopes, misfits[part] = self._whiten(stacked, values, axis, observed.gaps)
            for column, slope in zip(acting, slopes, strict=True):
                jacobian[part, column] = slope
        for column, k in zip(jacobian[: posterior.size].T, self.columns, strict=True):
            row = table.rows[k]  # time slopes are in the logarithm already, other log scales are not
            if row.log_scale and row.kind != "time":
                column *= raw[k]
        return misfits, jacobian

    def plain_slopes(self, values: Matrix) -> Iterator[tuple[int, Observed, Matrix, Vector]]:
        """Response axis, samples, slopes in the table's rows (times in their logarithms) and misfit (model
        minus data) of every axis of every record, of the plant without effects at canonical table values
        (1, rows)."""
        posterior, table = self.posterior, self.posterior.table
        slopes = posterior.model.unit_slopes(table.dynamics(values))
        for r, samples in enumerate(posterior.samples):
            units, unit_slopes = slopes[r]
            for axis, observed in enumerate(samples.axes):
                block = np.zeros((len(table.rows), observed.values.size)).T
                misfit = -posterior.residual(axis, r, observed, values, units)[0]
                for k in posterior.acting[axis]:
                    column = posterior.column(k, axis, r, observed, units)
                    if column is not None:
                        block[:, k] = column[0]
                for drive, unit in enumerate(table.layout.unit_of[axis]):
                    gain = values[0, table.at("gain", axis, drive)]
                    slopes_here = gain * unit_slopes[unit][:, 0, observed.index]
                    for k, slope in zip(table.shaping(unit), slopes_here, strict=True):
                        block[:, k] += slope
                yield axis, observed, block, misfit

    def _effected(self, values: Matrix) -> Iterator[tuple[int, Observed, Matrix, Vector]]:
        """The same with effects."""
        posterior, table = self.posterior, self.posterior.table
        assert posterior.simulation is not None
        model = self._effected_at(values[0])
        slopes = effect_slopes(posterior.simulation, values[0], exact=self.exact, model=model)
        times = table.of_kind("time")
        for each in slopes:
            each[..., times] *= values[0, times]
        misfits = self._misfits(values)
        for each, samples in zip(slopes, posterior.samples, strict=True):
            for _, (axis, observed, misfit) in zip(samples.axes, misfits, strict=False):
                yield axis, observed, each[observed.index, axis], misfit

    def _whiten(self, columns: Matrix, values: Matrix, axis: int, gaps: Vector) -> Matrix:
        if self.held:
            return np.asarray(self._filter(axis, gaps)(columns[None])[0])
        noise = self.posterior.noise if isinstance(self.posterior.noise, GaussianNoise) else White()
        parameters = self.posterior.noise_parameters(values, axis)
        white: Matrix = noise.whiten(columns[None], parameters, gaps)[0][0]
        return white

    def _filter(self, axis: int, gaps: Vector) -> Filter:
        """That of the held noise of an axis at the samples of a record."""
        key = axis, id(gaps)  # the posterior keeps them
        if key not in self._filters:
            self._filters[key] = Filter.of(self.held[axis][None], gaps)
        return self._filters[key]

    @cached_property
    def _filters(self) -> dict[tuple[int, int], Filter]:
        return {}

    def _prior_rows(self, raw: Vector) -> tuple[Matrix, Vector]:
        """Standardised normal priors as residual rows."""
        rows, prior = np.zeros((len(self.normal), raw.size)), np.zeros(len(self.normal))
        for number, (k, mean, sd) in enumerate(self.normal):
            rows[number, k] = 1 / sd
            prior[number] = (raw[k] - mean) / sd
        return rows, prior

    @cached_property
    def normal(self) -> list[tuple[int, float, float]]:
        """Table position, mean and standard deviation of what has a normal prior in search coordinates."""
        rows = self.posterior.table.rows
        laws = [(k, rows[k].prior) for k in self.columns if not rows[k].log_scale]
        found = [(k, law.normal) for k, law in laws if law is not None]
        return [(k, *normal) for k, normal in found if normal is not None]

    def solve(
        self, values: Vector, *, evaluations: int | None = None, enough: float | None = None
    ) -> tuple[Vector, Matrix]:
        """From a start to a local minimum: table values and the Jacobian there; limits as `search`.

        UnstableError where effects leave no bounded response at the start.
        """
        bounds = self.bounds_around(values)
        start = np.clip(self.coordinates(values), *bounds)
        optimum = self.search(start, values, bounds, evaluations=evaluations, enough=enough)
        solution = self.posterior.table.canonical(self.values(optimum.x, values)[None])[0]
        return solution, np.asarray(optimum.jac)

    def search(
        self,
        start: Vector,
        template: Vector,
        bounds: tuple[Vector, Vector],
        *,
        evaluations: int | None = None,
        enough: float | None = None,
    ) -> OptimizeResult:
        """From search coordinates within `bounds` to a local minimum: `scipy.optimize.least_squares` with at
        most so many `evaluations` of the response, ended by a relative gain of the sum of squares of less
        than `enough`. UnstableError where effects leave no bounded response at the start."""
        plain = self.posterior.simulation is None
        if not plain:
            table = self.posterior.table
            raw = self.values(start, template)
            list(self._misfits(table.sorted_with_source(raw[None], every=True)[0]))
        return least_squares(
            *self.functions(template, start),
            bounds=bounds,
            x_scale="jac",
            max_nfev=evaluations or (100 if plain else _EVALUATIONS),
            ftol=enough or (1e-8 if plain else _ENOUGH),
        )

    def functions(
        self, values: Vector, start: Vector
    ) -> tuple[Callable[[Vector], Vector], Vector, Callable[[Vector], Matrix]]:
        """Residual, start and Jacobian as `scipy.optimize.least_squares` takes them; fixed values and noise
        parameters from `values`. With effects slopes cost most: they are taken only where they are asked for.
        """
        if self.posterior.simulation is None:
            return apart(lambda x: self.residual(x, values), start)
        if self.begun:
            slopes = self.residual(start, values)[1]
            return lambda x: self.misfit(x, values), start, lambda x: slopes
        return lambda x: self.misfit(x, values), start, lambda x: self.residual(x, values)[1]

    def noise_fits(self, values: Vector) -> list[NoiseFit]:
        """Posterior of the noise parameters of each response axis given the residual of a plant."""
        return self.noise_fits_of(values[None])[0]

    def noise_fits_of(self, values: Matrix) -> list[list[NoiseFit]]:
        """The same of each plant of a batch."""
        posterior, table = self.posterior, self.posterior.table
        units, axes = posterior.responses(values), range(len(table.layout.responses))
        misfits = [
            [
                posterior.residual(axis, r, samples.axes[axis], values, units[r])
                for r, samples in enumerate(posterior.samples)
            ]
            for axis in axes
        ]
        return [
            [
                NoiseFit(
                    posterior.noise,
                    tuple(table.rows[table.at(name, axis)] for name in posterior.noise.names),
                    [misfit[plant] for misfit in misfits[axis]],
                    [samples.axes[axis].gaps for samples in posterior.samples],
                )
                for axis in axes
            ]
            for plant in range(len(values))
        ]

    def with_noise_of(self, values: Matrix) -> Matrix:
        """The same plants, (batch, rows), with noise parameters fitted to their residuals, where these are
        free."""
        table, out = self.posterior.table, values.copy()
        for plant, fits in zip(out, self.noise_fits_of(values), strict=True):
            for axis, fit in enumerate(fits):
                where = [table.at(name, axis) for name in self.posterior.noise.names]
                plant[where] = fit.best(plant[where])
        return out

    def with_noise(self, values: Vector) -> Vector:
        """The same of one plant, (rows,)."""
        return np.asarray(self.with_noise_of(values[None])[0])


def apart(
    both: Callable[[Vector], tuple[Vector, Matrix]], start: Vector
) -> tuple[Callable[[Vector], Vector], Vector, Callable[[Vector], Matrix]]:
    """Residual, start and Jacobian as `scipy.optimize.least_squares` takes them, from a function that gives
    both at once: it is evaluated once for each place."""
    memory: dict[bytes, tuple[Vector, Matrix]] = {}

    def at(x: Vector) -> tuple[Vector, Matrix]:
        key = x.tobytes()
        if key not in memory:
            memory.clear()
            memory[key] = both(x)
        return memory[key]

    return (lambda x: at(x)[0]), start, (lambda x: at(x)[1])
