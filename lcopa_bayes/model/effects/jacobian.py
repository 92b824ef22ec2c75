"""Derivatives of the responses with effects, in the coefficients and in the numbers of the plant.

They exist wherever the response is bounded: where it is not on one side of a number, as beside the largest
coefficient that a plant endures, the difference is to the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TypeAlias, final

import numpy as np

from lcopa_bayes.core.arrays import Index, Matrix, Vector
from lcopa_bayes.model.effects.effect import DriveEffect, ParallelEffect, ReadoutEffect, UnstableError
from lcopa_bayes.model.effects.passage import Moved, Plant
from lcopa_bayes.model.effects.simulator import Simulator
from lcopa_bayes.model.forward import Dynamics

Number: TypeAlias = tuple[str, int, int]
"""A number of the plant: "gain" by response and drive, "time" or "order" by element and term, "delay" by slot
and 0."""
COEFFICIENT_STEP = 1e-3
"""Step of a coefficient, in prior standard deviations [-]."""
_RELATIVE = 1e-5
"""Step of a plant's number in units of its scale [-]; with a solver good to 1e-12 both errors are 1e-7."""


@final
@dataclass(frozen=True, eq=False)
class _Difference:
    """A difference in one coefficient, of one record or of all at once."""

    columns: Index
    """Its places among all coefficients, one per record if it has one in each."""
    per_record: bool
    steps: Vector
    """[Unit of the coefficient]."""
    weights: Vector
    """Of the response without a step and of those with each [1 / unit]."""

    def cases(self, psi: Vector) -> list[Vector]:
        """Coefficients with each step."""
        out = np.repeat(psi[None], self.steps.size, axis=0)
        out[:, self.columns] += self.steps[:, None]
        return list(out)

    def to_one_side(self, simulator: Simulator, plant: Plant, psi: Vector) -> _Difference:
        """The same, or where a response is not bounded there of first order to one side."""
        step, sides = float(np.abs(self.steps).min()), np.array([-1.0, 1.0])
        back, on = (replace(self, steps=np.array([one]), weights=sides / one) for one in (-step, step))
        for difference in (self, back):
            with suppress(UnstableError):
                simulator.moved_together([(plant, each) for each in difference.cases(psi)])
                return difference
        return on


def coefficient_slopes(
    simulator: Simulator, plant: Plant, psi: Vector, *, last: bool = False
) -> list[Matrix]:
    """Derivative of the responses in psi, per record (samples, axes, coefficients) [response unit / unit]; in
    the coefficients of the `last` effect only, if so, and zero in the others.

    A difference through the simulator itself, of second order with `COEFFICIENT_STEP` prior standard
    deviations, to one side where a one-signed coefficient would turn negative; of first order, exact but
    for what other effects bend, where the effect is `linear`. Coefficients of one record are moved in all
    records at once: records do not see each other's. What a parallel effect adds to a reading that no other
    effect bends is the slope itself. Raises UnstableError where the response there is not bounded.
    """
    differences = _differences(simulator, psi, last=last)
    cases = _cases(plant, psi, differences)
    try:
        moved = simulator.moved_together(cases)
    except UnstableError:
        differences = [one.to_one_side(simulator, plant, psi) for one in differences]
        cases = _cases(plant, psi, differences)
        moved = simulator.moved_together(cases)
    return _by_coefficient(simulator, differences, cases, moved)


def slopes(
    simulator: Simulator, plant: Plant, psi: Vector
) -> tuple[list[dict[Number, Matrix]], list[Matrix]]:
    """`plant_slopes` and `coefficient_slopes`, at once where something acts before the reading: what forces
    take is mostly time per block, whatever the number of plants."""
    if simulator.bends(psi):
        numbers, differences = list(_numbers(simulator, plant)), _differences(simulator, psi)
        with suppress(UnstableError):  # else each on its own, to the side where there is a response
            cases, others = _cases(plant, psi, differences), _with_each(plant, psi, numbers)[1:]
            moved = simulator.moved_together([*cases, *others])
            steps, changed = moved[: len(cases)], moved[len(cases) :]
            by_number = _by_number(simulator, psi, numbers, [moved[0], *changed])
            return by_number, _by_coefficient(simulator, differences, cases, steps)
    return plant_slopes(simulator, plant, psi), coefficient_slopes(simulator, plant, psi)


def _adding(simulator: Simulator) -> dict[int, ParallelEffect]:
    """Effects, by position, whose slope is what they add to a reading that no other effect bends."""
    if any(isinstance(effect, ReadoutEffect) for effect in simulator.effects):
        return {}
    return {
        e: effect
        for e, effect in enumerate(simulator.effects)
        if isinstance(effect, ParallelEffect) and effect.linear
    }


def _differences(simulator: Simulator, psi: Vector, *, last: bool = False) -> list[_Difference]:
    """A difference in every coefficient, or in those of the last effect, that needs one."""
    effects, records, first = simulator.effects, len(simulator.model.experiments), 0
    adding, differences = _adding(simulator), list[_Difference]()
    for e, effect in enumerate(effects):
        coefficients = effect.coefficients(simulator.ranges)
        repeats = records if effect.card.per_record else 1
        left_out = e in adding or (last and e < len(effects) - 1)
        for k, coefficient in () if left_out else enumerate(coefficients):
            columns = first + k + len(coefficients) * np.arange(repeats)
            step = COEFFICIENT_STEP * coefficient.scale
            steps, weights = np.array([step]), np.array([-1.0, 1.0])
            if not effect.linear and coefficient.one_signed and psi[columns].min() < step:
                steps, weights = np.array([step, 2 * step]), np.array([-1.5, 2.0, -0.5])
            elif not effect.linear:
                steps, weights = np.array([step, -step]), np.array([0.0, 0.5, -0.5])
            differences.append(_Difference(columns, effect.card.per_record, steps, weights / step))
        first += len(coefficients) * repeats
    return differences


def _cases(plant: Plant, psi: Vector, differences: Sequence[_Difference]) -> list[tuple[Plant, Vector]]:
    """A plant with its coefficients, and with each step of all differences."""
    return [(plant, psi), *((plant, each) for one in differences for each in one.cases(psi))]


def _by_coefficient(
    simulator: Simulator,
    differences: Sequence[_Difference],
    cases: Sequence[tuple[Plant, Vector]],
    moved: Sequence[Sequence[Moved]],
) -> list[Matrix]:
    """Slopes per record, from the records of `_cases` up to their reading."""
    here = moved[0]
    pairs = zip(moved, cases, strict=True) if differences else ()
    read = [simulator.finished(own, psi) for own, (_, psi) in pairs]
    out = [np.zeros((*deflection.shape, simulator.size)) for _, deflection in here]
    base, place = read[:1], 1
    for one in differences:
        place, there = place + one.steps.size, read[place : place + one.steps.size]
        for r, responses in enumerate(zip(*base, *there, strict=True)):
            slope = sum(w * y for w, y in zip(one.weights, responses, strict=True))
            out[r][..., one.columns[r if one.per_record else 0]] = slope
    places = np.arange(simulator.size, dtype=float)
    for e, adds in _adding(simulator).items():
        for r, (scene, _) in enumerate(here):
            own = simulator.part(places, e, r).astype(int)
            for k, unit in zip(own, np.eye(own.size), strict=True):
                out[r][..., k] = adds.added(scene, unit)
    return out


def plant_slopes(simulator: Simulator, plant: Plant, psi: Vector) -> list[dict[Number, Matrix]]:
    """Derivatives of the responses in every number of the plant, per record (samples, axes) [response unit
    per unit of the number].

    Exact without effects. What acts on elements, forces or before the sensor is differenced to one side
    (1e-5 of each number); of everything else only the part that does not pass through the plant.
    """
    if not simulator.effects:
        return _linear_slopes(simulator, plant, psi)
    numbers = list(_numbers(simulator, plant))
    if simulator.bends(psi):
        try:
            moved = simulator.moved_together(_with_each(plant, psi, numbers))
        except UnstableError:
            numbers = [_bounded(simulator, plant, psi, *one) for one in numbers]
            moved = simulator.moved_together(_with_each(plant, psi, numbers))
    else:
        others = [_shifted(plant, number, step) for number, step in numbers]
        base, exact = simulator.moved(plant, psi), _linear_slopes(simulator, plant, psi)
        delayed = any(isinstance(effect, DriveEffect) for effect in simulator.effects)  # commands may use it
        each = (
            simulator.moved(other, psi)
            if number[0] == "delay" and delayed
            else [
                Moved(scene, y.deflection + step * slope[number])
                for scene, y, slope in zip(simulator.scenes(other, psi), base, exact, strict=True)
            ]
            for (number, step), other in zip(numbers, others, strict=True)
        )
        moved = [base, *each]
    return _by_number(simulator, psi, numbers, moved)


def _by_number(
    simulator: Simulator,
    psi: Vector,
    numbers: Sequence[tuple[Number, float]],
    moved: Sequence[Sequence[Moved]],
) -> list[dict[Number, Matrix]]:
    """Slopes per record, from the records of a plant, and with each number changed, up to their reading."""
    here = simulator.finished(moved[0], psi)
    out: list[dict[Number, Matrix]] = [{} for _ in here]
    for (number, step), each in zip(numbers, moved[1:], strict=True):
        for r, there in enumerate(simulator.finished(each, psi)):
            out[r][number] = (there - here[r]) / step
    return out


def _with_each(
    plant: Plant, psi: Vector, numbers: Sequence[tuple[Number, float]]
) -> list[tuple[Plant, Vector]]:
    """A plant, and with each of some numbers changed, with its coefficients."""
    others = [_shifted(plant, number, step) for number, step in numbers]
    return [(each, psi) for each in (plant, *others)]


def _bounded(
    simulator: Simulator, plant: Plant, psi: Vector, number: Number, step: float
) -> tuple[Number, float]:
    """A number and its step, or where no response is bounded there the step to the other side."""
    try:
        simulator.moved_together([(_shifted(plant, number, step), psi)])
    except UnstableError:
        return number, -step
    return number, step


def _numbers(simulator: Simulator, plant: Plant) -> Iterator[tuple[Number, float]]:
    """Every number of the plant and its difference step."""
    ranges, dynamics = simulator.ranges, plant.dynamics
    for i, j in np.ndindex(plant.gains.shape):
        yield ("gain", i, j), _RELATIVE * float(ranges.response[i] / ranges.drive[j])
    for e, times in enumerate(dynamics.times):
        for k in range(times.shape[1]):
            yield ("time", e, k), _RELATIVE * float(times[0, k])
            yield ("order", e, k), _RELATIVE
    for d in range(dynamics.delays.shape[1]):
        yield ("delay", d, 0), _RELATIVE * ranges.speed


def _shifted(plant: Plant, number: Number, change: float) -> Plant:
    """The plant with one number changed."""
    kind, first, second = number
    if kind == "gain":
        gains = plant.gains.copy()
        gains[first, second] += change
        return replace(plant, gains=gains)
    d = plant.dynamics
    parts = {"time": list(d.times), "order": list(d.orders), "delay": [d.delays]}
    element, column = (0, first) if kind == "delay" else (first, second)
    changed = parts[kind][element].copy()
    changed[0, column] += change
    parts[kind][element] = changed
    return replace(plant, dynamics=Dynamics(tuple(parts["time"]), tuple(parts["order"]), parts["delay"][0]))


def _linear_slopes(simulator: Simulator, plant: Plant, psi: Vector) -> list[dict[Number, Matrix]]:
    """Exact derivatives of the linear plant under the commands that act."""
    model = simulator.driven(simulator.scenes(plant, psi))
    layout, out = model.layout, []
    numbers = [number for number, _ in _numbers(simulator, plant)]
    for experiment, (units, slopes) in zip(model.experiments, model.unit_slopes(plant.dynamics), strict=True):
        own = {number: np.zeros((units.shape[2], plant.gains.shape[0])) for number in numbers}
        for i, row in enumerate(layout.unit_of):
            for j, unit in enumerate(row):
                element, gain = layout.element_of[i][j], plant.gains[i, j]
                own["gain", i, j][:, i] = experiment.rest[j] + units[unit, 0]
                *shape, by_delay = slopes[unit][:, 0]
                terms = len(shape) // 2
                for k, (by_log_time, by_order) in enumerate(zip(shape[:terms], shape[terms:], strict=True)):
                    own["time", element, k][:, i] += gain * by_log_time / plant.dynamics.times[element][0, k]
                    own["order", element, k][:, i] += gain * by_order
                own["delay", layout.delay_of[i][j], 0][:, i] += gain * by_delay
        out.append(own)
    return out
