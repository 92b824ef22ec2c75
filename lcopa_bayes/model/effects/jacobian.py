"""Derivatives of the responses with effects, in the coefficients and in what the plant is made of."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector
from lcopa_bayes.model.effects.effect import DriveEffect
from lcopa_bayes.model.effects.passage import Moved, Plant
from lcopa_bayes.model.effects.simulator import Simulator
from lcopa_bayes.model.forward import Dynamics

COEFFICIENT_STEP = 1e-3
"""Step of a coefficient, in prior standard deviations [-]."""


def difference(
    at: Callable[[float], list[Matrix]], step: float, *, upward: bool, here: list[Matrix] | None = None
) -> list[Matrix]:
    """Derivative of ``at(0)`` per unit, per record: second order, central or to one side."""
    if upward:
        base = at(0.0) if here is None else here
        triples = zip(base, at(step), at(2 * step), strict=True)
        return [(-3 * a + 4 * b - c) / (2 * step) for a, b, c in triples]
    return [(a - b) / (2 * step) for a, b in zip(at(step), at(-step), strict=True)]


def coefficient_slopes(simulator: Simulator, plant: Plant, psi: Vector) -> list[Matrix]:
    """Derivative of the responses in psi, per record (samples, axes, coefficients) [response unit / unit].

    A difference through the simulator itself, of second order with `COEFFICIENT_STEP` prior standard
    deviations, to one side where a one-signed coefficient would turn negative; of first order, exact but
    for what other effects bend, where the effect is `linear`. Coefficients of one record are moved in all
    records at once: records do not see each other's.
    """
    records = len(simulator.model.experiments)
    here = simulator.finished(simulator.moved(plant, psi), psi)
    out = [np.zeros((*y.shape, simulator.size)) for y in here]
    first = 0
    for effect in simulator.effects:
        told = effect.coefficients(simulator.ranges)
        for k, coefficient in enumerate(told):
            repeats = records if effect.card.per_record else 1
            columns = first + k + len(told) * np.arange(repeats)
            step = COEFFICIENT_STEP * coefficient.scale

            def at(change: float, columns: Index = columns) -> list[Matrix]:
                moved = psi.copy()
                moved[columns] += change
                return simulator.finished(simulator.moved(plant, moved), moved)

            if effect.linear:
                slopes = [(b - a) / step for a, b in zip(here, at(step), strict=True)]
            else:
                upward = coefficient.one_signed and bool(psi[columns].min() < step)
                slopes = difference(at, step, upward=upward, here=here)
            for r, slope in enumerate(slopes):
                out[r][..., columns[r if effect.card.per_record else 0]] = slope
        first += len(told) * (records if effect.card.per_record else 1)
    return out


@final
@dataclass(frozen=True, eq=False)
class PlantSlopes:
    """Derivatives of one record's responses; leading dimensions are (samples, axes)."""

    gains: Array
    """(samples, axes, responses, drives) [drive unit]."""
    times: tuple[Array, ...]
    """Per element (samples, axes, terms) [response unit per time unit]."""
    orders: tuple[Array, ...]
    """Per element (samples, axes, terms) [response unit]."""
    delays: Array
    """(samples, axes, slots) [response unit per time unit]."""


_RELATIVE = 1e-5
"""Step of a plant's number in units of its scale [-]; with a solver good to 1e-12 both errors are 1e-7."""


def plant_slopes(simulator: Simulator, plant: Plant, psi: Vector) -> list[PlantSlopes]:
    """Derivatives of the responses in gains, times, orders and delays, per record.

    Exact without effects. What acts on elements, forces or before the sensor is differenced to one side
    (1e-5 of each number); of everything else only the part that does not pass through the plant.
    """
    if not simulator.effects:
        return _linear_slopes(simulator, plant, psi)
    upstream = simulator.bends(psi)
    delayed = any(isinstance(effect, DriveEffect) for effect in simulator.effects)  # commands may use it
    base = simulator.moved(plant, psi)
    here = simulator.finished(base, psi)
    exact = _linear_slopes(simulator, plant, psi)
    out = [_like(slope) for slope in exact]
    for kind, place, step in _entries(simulator, plant):
        other = _shifted(plant, kind, place, step)
        if upstream or (kind == "delays" and delayed):
            moved = simulator.moved(other, psi)
        else:
            scenes = simulator.scenes(other, psi)
            moved = [
                Moved(scene, y.deflection + step * _entry(slope, kind, place))
                for scene, y, slope in zip(scenes, base, exact, strict=True)
            ]
        for r, there in enumerate(simulator.finished(moved, psi)):
            _entry(out[r], kind, place)[...] = (there - here[r]) / step
    return out


def _entries(simulator: Simulator, plant: Plant) -> Iterator[tuple[str, tuple[int, ...], float]]:
    """Kind, place and difference step of every number of the plant."""
    ranges, dynamics = simulator.ranges, plant.dynamics
    for i, j in np.ndindex(plant.gains.shape):
        yield "gains", (i, j), _RELATIVE * float(ranges.response[i] / ranges.drive[j])
    for e, times in enumerate(dynamics.times):
        for k in range(times.shape[1]):
            yield "times", (e, k), _RELATIVE * float(times[0, k])
            yield "orders", (e, k), _RELATIVE
    for d in range(dynamics.delays.shape[1]):
        yield "delays", (d,), _RELATIVE * ranges.speed


def _entry(slope: PlantSlopes, kind: str, place: tuple[int, ...]) -> Array:
    """The (samples, axes) array of a number."""
    if kind == "gains":
        return slope.gains[:, :, place[0], place[1]]
    if kind == "delays":
        return slope.delays[:, :, place[0]]
    part: tuple[Array, ...] = getattr(slope, kind)
    return part[place[0]][:, :, place[1]]


def _shifted(plant: Plant, kind: str, place: tuple[int, ...], change: float) -> Plant:
    """The plant with one number changed."""
    if kind == "gains":
        gains = plant.gains.copy()
        gains[place] += change
        return replace(plant, gains=gains)
    d = plant.dynamics
    parts = {"times": list(d.times), "orders": list(d.orders), "delays": [d.delays]}
    element, column = (0, place[0]) if kind == "delays" else place
    changed = parts[kind][element].copy()
    changed[0, column] += change
    parts[kind][element] = changed
    return replace(
        plant, dynamics=Dynamics(tuple(parts["times"]), tuple(parts["orders"]), parts["delays"][0])
    )


def _like(slope: PlantSlopes) -> PlantSlopes:
    return PlantSlopes(
        np.zeros_like(slope.gains),
        tuple(np.zeros_like(part) for part in slope.times),
        tuple(np.zeros_like(part) for part in slope.orders),
        np.zeros_like(slope.delays),
    )


def _linear_slopes(simulator: Simulator, plant: Plant, psi: Vector) -> list[PlantSlopes]:
    """Exact derivatives of the linear plant under the commands that act."""
    model = simulator.driven(simulator.scenes(plant, psi))
    layout, out = model.layout, []
    for experiment, (units, slopes) in zip(model.experiments, model.unit_slopes(plant.dynamics), strict=True):
        axes, drives = plant.gains.shape
        head = (units.shape[2], axes)
        counts = [slot.terms for slot in layout.elements]
        made = PlantSlopes(
            np.zeros((*head, axes, drives)),
            tuple(np.zeros((*head, terms)) for terms in counts),
            tuple(np.zeros((*head, terms)) for terms in counts),
            np.zeros((*head, len(layout.delays))),
        )
        for i, row in enumerate(layout.unit_of):
            for j, unit in enumerate(row):
                element, delay = layout.element_of[i][j], layout.delay_of[i][j]
                gain, terms = plant.gains[i, j], counts[element]
                by_log_time, by_order, by_delay = np.split(slopes[unit][:, 0].T, [terms, 2 * terms], axis=1)
                made.gains[:, i, i, j] = experiment.rest[j] + units[unit, 0]
                made.times[element][:, i] += gain * by_log_time / plant.dynamics.times[element][0]
                made.orders[element][:, i] += gain * by_order
                made.delays[:, i, delay] += gain * by_delay[:, 0]
        out.append(made)
    return out
