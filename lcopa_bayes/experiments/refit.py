"""A record of the virtual bench under a drive, and the study fitted to it by least squares."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from lcopa_bayes.bench.command import Command
from lcopa_bayes.bench.device import Device
from lcopa_bayes.calibration import simulation
from lcopa_bayes.core.arrays import Flags, Matrix, Vector
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import PriorSettings
from lcopa_bayes.experiments.information import Bench, effected_model
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.inference.simulation import Simulation
from lcopa_bayes.model.grid import Mesh

_CONVERGED = 1e-11
"""Relative tolerances of a fit [-]."""
_EVALUATIONS = 400
_AT_BOUND = 1e-3
"""Closer to an end of the search than this, on its coordinate, an estimate leans on it."""


@dataclass(frozen=True, eq=False)
class Trial:
    """One record of one drive, with noise of its own, fitted."""

    bench: Bench
    clean: Record
    truth: Vector
    """Table values of the study, each in its row's unit, (rows,)."""
    names: tuple[str, ...]
    seed: tuple[int, ...]

    def __call__(self) -> tuple[Vector, Flags]:
        """Relative errors, and which estimates lean on a bound."""
        problem, values, rng = self.bench.problem, self.truth, np.random.default_rng(self.seed)
        again = refit(problem, _noisy(problem, self.clean, values, rng), self.bench)
        result = _solve(again, _moved(problem, again, values))
        return _errors(problem, again, result, values, self.names), _leaning(again, result, self.names)


@dataclass(frozen=True, eq=False)
class EffectedDevice:
    """A plant with effects, simulated by the model itself: no device of the virtual bench has them."""

    problem: Problem
    values: Vector
    """Table values, (rows,)."""

    @property
    def drive_axes(self) -> tuple[Axis, ...]:
        """Axes of the drive."""
        return self.problem.study.drive_axes

    @property
    def response_axes(self) -> tuple[Axis, ...]:
        """Axes of the response."""
        return self.problem.study.response_axes

    @property
    def time_unit(self) -> str:
        """Unit of all times."""
        return self.problem.study.time_unit

    def response(self, command: Command, time: ArrayLike, *, exposure: float = 0.0) -> Matrix:
        """Responses at `time`, (times, axes) [response unit], on blocks as narrow as those of the fit."""
        times: Vector = np.asarray(time, dtype=float)
        table, posterior = self.problem.posterior.table, self.problem.posterior
        assert table.effects is not None
        step = min(one.mesh.lattice.step for one in posterior.model.experiments)
        blocks = max(2, round(float(times[-1]) / step))
        mesh = Mesh.of_samples(times, 0.0, blocks=blocks, exposure=exposure)
        model = effected_model(table.layout, table.effects, command, mesh, times)
        moved = Simulation(table, model).responses(self.values[None])[0][:, 0].T
        levels = [table.offset(self.values[None], i, 0)[0] for i in range(moved.shape[1])]
        return np.asarray(moved + levels)


def device_of(problem: Problem, values: Vector) -> Device | EffectedDevice:
    """The plant of table values as a device of the virtual bench."""
    table, study = problem.posterior.table, problem.study
    if table.effects is not None:
        return EffectedDevice(problem, values)
    return simulation.device_of(table, values, 0, time_unit=study.time_unit)


def _noisy(problem: Problem, clean: Record, values: Vector, rng: np.random.Generator) -> Record:
    """The record with the study's noise at these values."""
    posterior, response = problem.posterior, clean.response.copy()
    sampled = ~np.isnan(response[:, 0])
    gaps = np.ones(int(sampled.sum()))
    for axis in range(response.shape[1]):
        parameters = posterior.noise_parameters(values[None], axis)
        response[sampled, axis] += posterior.noise.draw(parameters, gaps, rng)[0]
    axes = (clean.drive_axes, clean.response_axes)
    return Record(clean.name, clean.time, clean.drive, response, *axes, clean.time_unit)


def refit(problem: Problem, record: Record, bench: Bench) -> Problem:
    """The study with the new record in place of its own, under the same priors and as finely resolved."""
    study, table = problem.study, problem.posterior.table
    priors = {}
    for row in table.rows:
        if row.kind != "offset" and "[" not in row.name:
            prior = row.prior
            priors[row.name] = (
                PriorSettings(row.name, fixed=row.value)
                if prior is None
                else PriorSettings(row.name, dist=prior.dist, parameters=prior.parameters)
            )
    model = replace(study.model, blocks=bench.blocks, orders="free", terms=_terms(table))
    effects = problem.stated_effects
    alone = replace(study, fit=(record,), held_out=(), model=model, priors=priors, effects=effects)
    return problem_of(alone)


def _terms(table: ParameterTable) -> int | dict[str, int]:
    elements = table.layout.elements
    return elements[0].terms if len(elements) == 1 else {slot.name: slot.terms for slot in elements}


def _moved(before: Problem, problem: Problem, values: Vector) -> Vector:
    """Table values of the refitted study from those of the study; offsets from its first record."""
    old, new = before.posterior.table, problem.posterior.table
    out = np.empty(len(new.rows))
    for k, row in enumerate(new.rows):
        if row.kind == "offset":
            out[k] = old.offset(values[None], row.place.first, 0)[0] if row.free else row.value
        else:  # what differs from record to record is nothing on this one
            out[k] = values[old.names.index(row.name)] if row.name in old.names else 0.0
    return out


def _solve(problem: Problem, start: Vector) -> Vector:
    """Table values of the least-squares solution next to a start, whose noise parameters stay.

    Converged until the sum of squares is known to 1e-11: along the nearly blind directions of such plants
    looser tolerances stop at the start, and the scatter of the estimates comes out too small.
    """
    least = LeastSquares(problem.posterior)
    low, high = least.bounds
    near = np.clip(least.coordinates(start), low, high)  # a start only
    result = least_squares(
        *least.functions(start, near),
        bounds=(low, high),
        x_scale="jac",
        ftol=_CONVERGED,
        xtol=_CONVERGED,
        gtol=_CONVERGED,
        max_nfev=_EVALUATIONS,
    )
    return np.asarray(problem.posterior.table.canonical(least.values(result.x, start)[None])[0])


def _errors(
    before: Problem, problem: Problem, result: Vector, values: Vector, names: tuple[str, ...]
) -> Vector:
    table, old = problem.posterior.table, before.posterior.table
    out = []
    for name in names:
        estimate, true = result[table.names.index(name)], values[old.names.index(name)]
        if old.rows[old.names.index(name)].kind == "time":
            out.append(np.log(estimate / true))
        else:
            out.append((estimate - true) / abs(true))
    return np.array(out)


def _leaning(problem: Problem, result: Vector, names: tuple[str, ...]) -> Flags:
    """Whether each parameter is at an end of its search, (parameters,)."""
    least, table = LeastSquares(problem.posterior), problem.posterior.table
    low, high = least.bounds
    at = least.coordinates(result)
    close = np.minimum(at - low, high - at) < _AT_BOUND
    leaning = {table.names[k]: bool(one) for k, one in zip(least.columns, close, strict=True)}
    return np.array([leaning[name] for name in names])
