"""Fisher information of a drive about the plant, from exact derivatives by the fast algebra."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil
from typing import NamedTuple, final

import numpy as np

from lcopa_bayes.bench.command import Command
from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.effects import effect_slopes
from lcopa_bayes.inference.noise import GaussianNoise, Student
from lcopa_bayes.inference.simulation import Simulation
from lcopa_bayes.model.effects.declared import Declared
from lcopa_bayes.model.forward import Experiment, ForwardModel
from lcopa_bayes.model.grid import Mesh
from lcopa_bayes.model.layout import Layout
from lcopa_bayes.model.powerseries import Circle
from lcopa_bayes.model.stepresponse import StepResponse, step_response
from lcopa_bayes.model.superposition import Superposition, blocks_of, phases

_NOTHING = 1e-11
"""Share of a slope that is not constant below which a resting response makes up for all of it [-]."""


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
        left = white[:-1] - np.outer(white[:-1] @ level, level)
        before, after = (np.linalg.norm(part, axis=1) for part in (white[:-1], left))
        left[after <= _NOTHING * before] = 0.0  # what is left of a constant is rounding
        return np.asarray(left)


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
