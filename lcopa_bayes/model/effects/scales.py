"""The scales of a base fit that make effects comparable between devices."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lcopa_bayes.core.arrays import Index, Vector
from lcopa_bayes.model.blockpulses import Circle
from lcopa_bayes.model.effects.effect import Ranges, devices_of
from lcopa_bayes.model.effects.passage import Plant
from lcopa_bayes.model.forward import Experiment, ForwardModel, deflections
from lcopa_bayes.model.layout import Layout
from lcopa_bayes.model.powerseries import Integrals, transfer

_BLOCKS = 2048


def own_drives(layout: Layout) -> Index:
    """Drive that each response axis belongs to: by name, else by position."""
    own = [layout.own_response(j) for j in range(len(layout.drives))]
    last = len(layout.drives) - 1
    return np.array([own.index(i) if i in own else min(i, last) for i in range(len(layout.responses))])


def ranges_of(model: ForwardModel, plant: Plant, times: Sequence[Vector]) -> Ranges:
    """Scales of a base fit; a drive or a response that never moves has scale 1 in its unit.

    Drives of one unit share a driver, and responses of one unit a device: their scales are the largest of
    any, those of responses in proportion to what their own drives hold, so that one coefficient says the
    same of every axis, however far the records drove each. `times` are the sample times of every record.
    """
    direct = own_drives(model.layout)
    seen = np.max([_largest(experiment) for experiment in model.experiments], axis=0)
    drive = _of_unit(seen, [axis.unit for axis in model.layout.drives])
    units = model.unit_responses(plant.dynamics)
    response = np.zeros(len(model.layout.responses))
    for experiment, read in zip(model.experiments, units, strict=True):
        moved = deflections(model.layout, experiment.rest, plant.gains[None], read)
        response = np.maximum(response, np.abs(moved).max(axis=(1, 2)))
    held = np.abs(plant.gains[np.arange(direct.size), direct]) * drive[direct]
    if (held > 0).all():
        response = held * _of_unit(response / held, [axis.unit for axis in model.layout.responses])
    meshes = [experiment.mesh for experiment in model.experiments]
    spans = np.array([mesh.grid.n * mesh.grid.step for mesh in meshes])
    apart = np.concatenate([np.diff(one) for one in times])
    span = float(spans.max())
    return Ranges(
        np.where(drive > 0, drive, 1.0),
        np.where(response > 0, response, 1.0),
        float(np.median(apart)) if apart.size else span,
        span,
        _speed(plant, model.layout.element_of[0][int(direct[0])], span),
        direct,
        tuple(axis.name for axis in model.layout.responses),
        devices_of([axis.unit for axis in model.layout.responses]),
    )


def _of_unit(values: Vector, units: Sequence[str]) -> Vector:
    """The largest value among those of each one's unit."""
    return np.array([max(v for v, u in zip(values, units, strict=True) if u == unit) for unit in units])


def _largest(experiment: Experiment) -> Vector:
    """Largest magnitude of every drive [drive unit]."""
    pairs = zip(experiment.drives, experiment.rest, strict=True)
    return np.array([np.abs([rest, *(rest + drive.values)]).max() for drive, rest in pairs])


def _speed(plant: Plant, element: int, span: float) -> float:
    """Time to half of the deflection that a step reaches within `span` [time unit]."""
    step, circle = span / _BLOCKS, Circle(_BLOCKS)
    times, orders = plant.dynamics.times[element], plant.dynamics.orders[element]
    spectrum = transfer(times / step, Integrals(orders, _BLOCKS), circle)[0]
    response = circle.coefficients(spectrum * circle.spectrum(np.ones(_BLOCKS)))
    return float((np.argmax(np.abs(response) >= 0.5 * abs(response[-1])) + 1) * step)
