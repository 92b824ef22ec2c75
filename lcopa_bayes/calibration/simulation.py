"""A study's records measured again on the virtual bench, at a given truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lcopa_bayes.bench.command import Command
from lcopa_bayes.bench.device import Device
from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.data.record import Record
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.model.effects.effect import UnstableError
from lcopa_bayes.results.prediction import responses

_FINER = 4
"""How many times narrower the blocks are on which effects are simulated [-]."""


def command_of(record: Record) -> Command:
    """The drive of a record: a value holds from its row to the next, and the plant rests before the first."""
    changed = np.flatnonzero((record.drive[1:] != record.drive[:-1]).any(axis=1)) + 1
    return Command(record.time[changed], record.drive[changed], record.drive[0])


def device_of(table: ParameterTable, truth: Vector, record: int, *, time_unit: str) -> Device:
    """The plant with the table values `truth`, (rows,), and the offsets it has on a fit record.

    Terms of equal orders are added up.
    """
    layout = table.layout
    paths = tuple(tuple(path.merged() for path in row) for row in table.paths(truth))
    offsets = tuple(float(table.offset(truth[None], i, record)[0]) for i in range(len(layout.responses)))
    return Device(paths, layout.drives, layout.responses, offsets, time_unit)


def exact_responses(problem: Problem, truth: Vector) -> list[Matrix]:
    """Responses of every fit record at its sample times without noise, (samples, axes) [response unit].

    Accuracy: that of `Device.response`; what the bench cannot do so accurately raises its error. With
    effects, which a device does not have, by the model on blocks four times narrower; UnstableError where
    there is no bounded response.
    """
    study, posterior = problem.study, problem.posterior
    if posterior.simulation is not None:
        return _simulated(problem.refined(_FINER), truth)
    return [
        device_of(posterior.table, truth, r, time_unit=study.time_unit).response(
            command_of(samples.record), samples.times, exposure=study.exposure
        )
        for r, samples in enumerate(posterior.samples)
    ]


def _simulated(problem: Problem, truth: Vector) -> list[Matrix]:
    posterior, values = problem.posterior, truth[None]
    out = []
    for r, one in enumerate(responses(posterior.table, posterior.model, values)):
        name = posterior.samples[r].record.name
        if not np.isfinite(one).all():
            raise UnstableError(problem.study.effects.use, name, "no bounded response at this truth")
        levels = [posterior.table.offset(values, axis, r)[0] for axis in range(one.shape[0])]
        out.append(one[:, 0].T + levels)
    return out


def measured(
    problem: Problem, truth: Vector, exact: Sequence[Matrix], rng: np.random.Generator
) -> tuple[Record, ...]:
    """The fit records with the `exact` responses and noise of the study's noise model at the truth.

    Drives, times and missing cells are those of the study.
    """
    posterior, values = problem.posterior, truth[None]
    out = []
    for samples, clean in zip(posterior.samples, exact, strict=True):
        record = samples.record
        rows = np.searchsorted(record.time, samples.times)
        response = np.full(record.response.shape, np.nan)
        for axis, observed in enumerate(samples.axes):
            noise = posterior.noise.draw(posterior.noise_parameters(values, axis), observed.gaps, rng)[0]
            response[rows[observed.index], axis] = clean[observed.index, axis] + noise
        axes = (record.drive_axes, record.response_axes)
        out.append(Record(record.name, record.time, record.drive, response, *axes, record.time_unit))
    return tuple(out)


def model_gap(problem: Problem, truth: Vector, exact: Sequence[Matrix]) -> float:
    """Root sum of squares, over all samples, of forward model minus bench at the truth [noise scale].

    It bounds how many posterior standard deviations the discretisation of the model can shift anything.
    """
    posterior, values = problem.posterior, truth[None]
    modelled = responses(posterior.table, posterior.model, values)
    total = 0.0
    for r, (samples, clean) in enumerate(zip(posterior.samples, exact, strict=True)):
        for axis, observed in enumerate(samples.axes):
            offset = posterior.table.offset(values, axis, r)
            gap = modelled[r][axis][0][observed.index] + offset - clean[observed.index, axis]
            parameters = posterior.noise_parameters(values, axis)
            total += float(np.sum(posterior.noise.standard(gap[None], parameters, observed.gaps) ** 2))
    return float(np.sqrt(total))
