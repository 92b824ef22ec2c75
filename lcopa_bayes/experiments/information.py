"""Fisher information of a drive about the plant, from exact derivatives by the fast algebra.

A record of the virtual bench under a drive, and the study fitted to it by least squares.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil
from typing import final

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from lcopa_bayes.bench.command import Command
from lcopa_bayes.calibration.replica import measured
from lcopa_bayes.core.arrays import Array, Flags, Matrix, Vector
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.data.record import Record
from lcopa_bayes.data.settings import PriorSettings
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.effects import effect_slopes
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.noise import GaussianNoise, Student
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.inference.simulation import Simulation
from lcopa_bayes.model.forward import Experiment, ForwardModel, StepResponses
from lcopa_bayes.model.grid import Mesh

_NOTHING = 1e-11
"""Share of a slope that is not constant below which a resting response makes up for all of it [-]."""


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
    def logarithmic(self) -> Flags:
        """Whether each parameter is sampled by its logarithm, (parameters,)."""
        rows = self.problem.posterior.table.rows
        return np.array([rows[k].log_scale for k in self.columns], dtype=bool)

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

    def sizes(self, values: Vector) -> Vector:
        """What a slope is multiplied by to be relative to the parameter's size, (parameters,)."""
        rows = self.problem.posterior.table.rows
        return np.array([1.0 if rows[k].kind == "time" else abs(values[k]) for k in self.columns])

    def gram(self, values: Vector, command: Command, known: StepResponses) -> Matrix:
        """Fisher information of one record under `command`, (parameters, parameters)."""
        out = np.zeros((len(self.columns), len(self.columns)))
        for slopes in self.slopes(values, command, known):
            out += slopes @ slopes.T
        return out

    def slopes(self, values: Vector, command: Command, known: StepResponses) -> list[Matrix]:
        """White derivatives of every response axis, each (parameters, samples).

        `known` are step responses at these values under other commands; those that lack are added. With
        effects by `inference.effects`; what differs from record to record is left out. UnstableError where
        there is no bounded response.
        """
        table = self.problem.posterior.table
        model = self.model(self.mesh, self.sample_times, command)
        if model.effects is None:
            [(units, unit_slopes)] = model.unit_slopes(table.dynamics(values[None]), known)
            rows = np.zeros((len(table.layout.responses), len(table.rows), self.sample_times.size))
            for axis, own in enumerate(rows):
                for drive, unit in enumerate(table.layout.unit_of[axis]):
                    at = table.at("gain", axis, drive)
                    own[at] += units[unit, 0] + command.rest[drive]
                    for k, slope in zip(table.shaping(unit), unit_slopes[unit][:, 0], strict=True):
                        own[k] += values[at] * slope
        else:
            rows = effect_slopes(Simulation(table, model), values)[0].transpose(1, 2, 0)
            logs = table.of_kind("time")
            rows[:, logs] *= values[logs, None]
        return [self._whitened(own[list(self.columns)], values, axis) for axis, own in enumerate(rows)]

    def model(self, mesh: Mesh, times: Vector, command: Command) -> ForwardModel:
        """What simulates a record under a command, read at `times`, without what differs from record to
        record."""
        table = self.problem.posterior.table
        drives = tuple(_drive(command, axis) for axis in range(len(table.layout.drives)))
        over = table.effects and replace(table.effects, epochs=np.zeros(1), times=(times,), fitted=(None,))
        return ForwardModel(table.layout, (Experiment("next", mesh, drives, command.rest),), over)

    def responses(
        self, values: Vector, command: Command, time: ArrayLike, *, exposure: float = 0.0
    ) -> Matrix:
        """Responses at `time` of a plant with effects, (times, axes) [response unit], by the model itself on
        blocks as narrow as those of the fit: no device of the virtual bench has its effects."""
        times: Vector = np.asarray(time, dtype=float)
        table, blocks = self.problem.posterior.table, max(2, round(float(times[-1]) / self.step))
        mesh = Mesh.of_samples(times, 0.0, blocks=blocks, exposure=exposure)
        moved = Simulation(table, self.model(mesh, times, command)).responses(values[None])[0][:, 0].T
        return np.asarray(moved + [table.offset(values[None], i, 0)[0] for i in range(moved.shape[1])])

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
        samples = Samples.of(self.clean, self.bench.period)
        again = refit(problem, measured(problem, values, samples, samples.matrix(), rng), self.bench)
        result = _solve(again, _moved(problem, again, values))
        return _errors(problem, again, result, values, self.names), _leaning(again, result, self.names)


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
    terms = table.layout.terms
    return terms if len(terms) > 1 else next(iter(terms.values()))


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
