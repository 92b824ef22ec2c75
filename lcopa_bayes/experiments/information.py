"""Fisher information of a drive about the plant, from exact derivatives by the fast algebra.

A record of the virtual bench under a drive, and the study fitted to it by least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil
from typing import NamedTuple, final

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from lcopa_bayes.bench.command import Command
from lcopa_bayes.core.arrays import Array, Flags, Matrix, Vector
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.data.record import Record
from lcopa_bayes.data.settings import PriorSettings
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.effects import effect_slopes
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.noise import GaussianNoise, Student
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.inference.simulation import Simulation
from lcopa_bayes.model.blockpulses import Circle
from lcopa_bayes.model.effects.declared import Declared
from lcopa_bayes.model.forward import Experiment, ForwardModel
from lcopa_bayes.model.grid import Mesh
from lcopa_bayes.model.layout import Layout
from lcopa_bayes.model.stepresponse import StepResponse, step_response
from lcopa_bayes.model.superposition import Superposition, blocks_of, phases

_NOTHING = 1e-11
"""Share of a slope that is not constant below which a resting response makes up for all of it [-]."""


@final
class Prepared(NamedTuple):
    """An element at one set of values."""

    response: StepResponse
    """With its derivatives."""
    superposition: Superposition
    """Its readings, shared by all drives."""


@final
@dataclass(frozen=True, eq=False)
class Bench:
    """A record of `time` [time unit], sampled every `period`, that is still to be taken.

    Slopes are in the logarithm of time constants and in the plain value of every other parameter, made
    white by the study's noise; the record's resting response is unknown where the study's is, and is
    projected out. Costs, per set of values, a step response and its slopes, and per drive their
    superposition: all in O(samples log samples). Accuracy: as `model.stepresponse`.
    """

    problem: Problem
    time: float
    """[time unit]."""
    period: float
    """[time unit]."""

    @cached_property
    def columns(self) -> tuple[int, ...]:
        """Table positions of the free plant parameters, offsets left out."""
        rows = self.problem.posterior.table.rows
        return tuple(
            k
            for k, row in enumerate(rows)
            if row.free and not row.noise and row.kind != "offset" and "[" not in row.name
        )

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(self.problem.posterior.table.names[k] for k in self.columns)

    @cached_property
    def step(self) -> float:
        """Width of a block [time unit]: that of the fit."""
        return min(one.mesh.lattice.step for one in self.problem.posterior.model.experiments)

    @cached_property
    def blocks(self) -> int:
        """Blocks at which the record resolves what the fit did."""
        return max(2, ceil(float(self.sample_times[-1]) / self.step * (1 - 1e-6)))

    @cached_property
    def sample_times(self) -> Vector:
        """Times of the camera's samples, the first at 0, (samples,) [time unit]."""
        return np.asarray(self.period * np.arange(max(2, round(self.time / self.period))), dtype=float)

    @cached_property
    def mesh(self) -> Mesh:
        """Blocks, and how samples are read from them."""
        exposure = self.problem.study.exposure
        return Mesh.of_samples(self.sample_times, 0.0, blocks=self.blocks, exposure=exposure)

    @cached_property
    def circle(self) -> Circle:
        """Where series are evaluated."""
        return Circle(blocks_of(self.mesh.lattice, 0.0))

    def sizes(self, values: Vector) -> Vector:
        """What a slope is multiplied by to be relative to the parameter's size, (parameters,)."""
        rows = self.problem.posterior.table.rows
        return np.array([1.0 if rows[k].kind == "time" else abs(values[k]) for k in self.columns])

    def elements(self, values: Vector) -> list[Prepared]:
        """Step responses of the elements at table values, with their slopes; shared by all drives."""
        dynamics = self.problem.posterior.table.dynamics(values[None])
        step = self.mesh.lattice.step
        return [
            Prepared(
                step_response(times, orders, self.circle, step, slopes="all"), Superposition(self.circle)
            )
            for times, orders in zip(dynamics.times, dynamics.orders, strict=True)
        ]

    def gram(self, values: Vector, elements: Sequence[Prepared], command: Command) -> Matrix:
        """Fisher information of one record under `command`, (parameters, parameters)."""
        out = np.zeros((len(self.columns), len(self.columns)))
        for slopes in self.slopes(values, elements, command):
            out += slopes @ slopes.T
        return out

    def slopes(self, values: Vector, elements: Sequence[Prepared], command: Command) -> list[Matrix]:
        """White derivatives of every response axis, each (parameters, samples).

        With effects by `inference.effects`; what differs from record to record is left out.
        UnstableError where there is no bounded response.
        """
        table = self.problem.posterior.table
        if table.effects is not None:
            return self._with_effects(table.effects, values, command)
        units = [
            self._unit(values, elements[unit.element], unit.delay, _drive(command, unit.drive))
            for unit in table.layout.units
        ]
        out = []
        for axis in range(len(table.layout.responses)):
            rows = np.zeros((len(table.rows), self.sample_times.size))
            for drive, number in enumerate(table.layout.unit_of[axis]):
                at, (unit, *slopes) = table.at("gain", axis, drive), units[number]
                rows[at] += unit + command.rest[drive]
                for k, slope in zip(table.shaping(number), slopes, strict=True):
                    rows[k] += values[at] * slope
            out.append(self._whitened(rows[list(self.columns)], values, axis))
        return out

    def _with_effects(self, effects: Declared, values: Vector, command: Command) -> list[Matrix]:
        table = self.problem.posterior.table
        model = effected_model(table.layout, effects, command, self.mesh, self.sample_times)
        slopes = effect_slopes(Simulation(table, model), values)[0]
        logs = table.of_kind("time")
        slopes[..., logs] *= values[logs]
        return [
            self._whitened(slopes[:, axis, list(self.columns)].T, values, axis)
            for axis in range(slopes.shape[1])
        ]

    def _unit(self, values: Vector, element: Prepared, slot: int, drive: AxisDrive) -> Matrix:
        """A unit response and its slopes in log times, orders and delay, (2 terms + 2, samples)."""
        response, superposition = element
        out = np.zeros((response.coarse.shape[0] + 1, self.sample_times.size))
        if not drive.moves:
            return out
        lattice, later = self.mesh.lattice, slice(self.mesh.reading.first, None)
        delays = values[None, self.problem.posterior.table.at("delay", slot)]
        changes = phases(drive, lattice.step)
        out[:-1, later] = superposition(response, changes, lattice, delays, (0, slot))[:, 0]
        by_block = superposition(response.alone, changes, lattice, delays, (0, slot), "slope")
        out[-1, later] = -by_block[0, 0] / lattice.step
        return out

    def _whitened(self, rows: Matrix, values: Vector, axis: int) -> Matrix:
        """Rows in noise standard deviations, without what a resting response can make up for."""
        posterior = self.problem.posterior
        noise, parameters = posterior.noise, posterior.noise_parameters(values[None], axis)
        stacked: Array = np.concatenate([rows, np.ones((1, rows.shape[1]))])
        if isinstance(noise, GaussianNoise):
            white = noise.whiten(stacked[None], parameters, np.ones(rows.shape[1]))[0][0]
        else:
            sigma, nu = parameters[0]
            white = stacked * np.sqrt(Student.information(nu)) / sigma
        table = posterior.table
        offsets = [table.rows[k] for k in table.of_kind("offset")]
        if not any(row.free and row.place.first == axis for row in offsets):
            return np.asarray(white[:-1])
        level = white[-1] / np.linalg.norm(white[-1])
        varying = white[:-1] - np.outer(white[:-1] @ level, level)
        before, after = (np.linalg.norm(part, axis=1) for part in (white[:-1], varying))
        varying[after <= _NOTHING * before] = 0.0  # what remains of a constant is rounding
        return np.asarray(varying)


def effected_model(
    layout: Layout, effects: Declared, command: Command, mesh: Mesh, times: Vector
) -> ForwardModel:
    """Model of one record under a command, with effects and without what differs from record to record."""
    drives = tuple(_drive(command, axis) for axis in range(len(layout.drives)))
    experiment = Experiment("next", mesh, drives, command.rest)
    over = replace(effects, epochs=np.zeros(1), times=(times,), fitted=(None,))
    return ForwardModel(layout, (experiment,), over)


def _drive(command: Command, axis: int) -> AxisDrive:
    """Deviation from rest of one axis of a command."""
    moved = command.jumps[:, axis] != 0
    return AxisDrive(command.times[moved], command.values[moved, axis] - command.rest[axis])


_CONVERGED = 1e-11
"""Relative tolerances of a fit [-]."""
_EVALUATIONS = 400
_AT_BOUND = 1e-3
"""Closer to an end of the search than this, on its coordinate, an estimate leans on it."""


@final
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


def with_effects(
    problem: Problem, values: Vector, command: Command, time: ArrayLike, *, exposure: float = 0.0
) -> Matrix:
    """Responses at `time` of a plant with effects, (times, axes) [response unit], by the model itself on
    blocks as narrow as those of the fit: no device of the virtual bench has its effects."""
    times: Vector = np.asarray(time, dtype=float)
    table, posterior = problem.posterior.table, problem.posterior
    assert table.effects is not None
    step = min(one.mesh.lattice.step for one in posterior.model.experiments)
    blocks = max(2, round(float(times[-1]) / step))
    mesh = Mesh.of_samples(times, 0.0, blocks=blocks, exposure=exposure)
    model = effected_model(table.layout, table.effects, command, mesh, times)
    moved = Simulation(table, model).responses(values[None])[0][:, 0].T
    return np.asarray(moved + [table.offset(values[None], i, 0)[0] for i in range(moved.shape[1])])


def _noisy(problem: Problem, clean: Record, values: Vector, rng: np.random.Generator) -> Record:
    """The record with the study's noise at these values."""
    posterior, response = problem.posterior, clean.response.copy()
    sampled = ~np.isnan(response[:, 0])
    gaps = np.ones(int(sampled.sum()))
    for axis in range(response.shape[1]):
        parameters = posterior.noise_parameters(values[None], axis)
        response[sampled, axis] += posterior.noise.draw(parameters, gaps, rng)[0]
    return replace(clean, response=response)


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
