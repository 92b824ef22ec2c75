"""A posterior's model with effects: responses, signatures and Jacobians in the table's values.

    model = effected(problem.posterior, values, [OddCurvature(), Vibration(frequency=0.1)])
    model.responses(values, psi)    # list per record, (samples, axes); at model.vanishing the base model's
    model.signature(values)         # list per record, (samples, axes, psi): derivative at psi = 0
    model.jacobian(values, psi)     # list per record, (samples, axes, rows of the table)
    model.coefficients              # name, unit, prior scale, sign, effect and record of every psi

An effect instance holds its internal constants; ``CubicStiffness.grid(model.ranges)`` lists those worth
trying and `lcopa_bayes.model.effects.catalogue` the classes by name. For records held out,
``model.over(model, samples, epochs)`` is the same with other records.
Samples an axis misses are filled too: choose with ``samples[r].axes[a].index``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.inference.simulation import Simulation
from lcopa_bayes.model.effects.effect import Coefficient, Effect, Ranges
from lcopa_bayes.model.effects.jacobian import Number, coefficient_slopes, plant_slopes, slopes
from lcopa_bayes.model.effects.passage import Plant
from lcopa_bayes.model.effects.scales import ranges_of
from lcopa_bayes.model.effects.simulator import Latest, Simulator
from lcopa_bayes.model.forward import ForwardModel

_STEP = 1e-4
"""Step of a constant, over its value or, where it lies between 0 and 1, over 1 [-]."""


@final
@dataclass(frozen=True)
class Placed:
    """One entry of psi."""

    name: str
    """``<effect>.<coefficient>``, with ``[<record>]`` when it belongs to one."""
    coefficient: Coefficient
    effect: int
    """Position of its effect."""
    record: int | None
    """Position of its record; None when it acts on all."""


@final
@dataclass(frozen=True, eq=False)
class Effected:
    """Base model plus effects over a set of records."""

    table: ParameterTable
    simulator: Simulator
    records: tuple[str, ...]
    offsets: tuple[int, ...] | None
    """Position in the table's records of each record; None: offsets are left out (held-out records)."""

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects."""
        return self.simulator.effects

    @property
    def ranges(self) -> Ranges:
        """Scales of the base fit."""
        return self.simulator.ranges

    @property
    def vanishing(self) -> Vector:
        """psi at which every effect vanishes."""
        return np.zeros(self.simulator.size)

    @cached_property
    def coefficients(self) -> tuple[Placed, ...]:
        """What every entry of psi is."""
        out = []
        for e, effect in enumerate(self.effects):
            own = effect.coefficients(self.ranges)
            if effect.card.per_record:
                out += [
                    Placed(f"{effect.name}.{one.name}[{record}]", one, e, r)
                    for r, record in enumerate(self.records)
                    for one in own
                ]
            else:
                out += [Placed(f"{effect.name}.{one.name}", one, e, None) for one in own]
        return tuple(out)

    def with_effects(self, effects: Sequence[Effect]) -> Effected:
        """The same records and scales with other effects."""
        return replace(self, simulator=replace(self.simulator, effects=tuple(effects)))

    def over(self, model: ForwardModel, samples: Sequence[Samples], epochs: Vector) -> Effected:
        """The same plant and effects over records held out; their offsets are left out."""
        times = tuple(one.times for one in samples)
        simulator = replace(self.simulator, model=model, times=times, epochs=epochs, still=Latest())
        return replace(
            self, simulator=simulator, records=tuple(one.record.name for one in samples), offsets=None
        )

    def with_ranges(self, ranges: Ranges) -> Effected:
        """The same at other scales."""
        return replace(self, simulator=replace(self.simulator, ranges=ranges, still=Latest()))

    def on(self, model: ForwardModel) -> Effected:
        """The same on other blocks."""
        simulator = replace(self.simulator, model=model, step_responses=Latest(), still=Latest())
        return replace(self, simulator=simulator)

    def plant(self, values: Vector) -> Plant:
        """The plant of the table's values, (rows,)."""
        return plant_of(self.table, values, self.offsets, len(self.records))

    def responses(self, values: Vector, psi: Vector) -> list[Matrix]:
        """Responses at the sample times, per record (samples, axes) [response unit].

        Raises UnstableError where an effect leaves no bounded response.
        """
        return self.simulator.responses(self.plant(values), psi)

    def signature(self, values: Vector, psi: Vector | None = None, *, last: bool = False) -> list[Matrix]:
        """Derivative in psi (default: where it vanishes), per record (samples, axes, size of psi); in the
        coefficients of the `last` effect only, if so."""
        at = self.vanishing if psi is None else psi
        return coefficient_slopes(self.simulator, self.plant(values), at, last=last)

    def jacobian(self, values: Vector, psi: Vector | None = None) -> list[Matrix]:
        """Derivative in the table's values, per record (samples, axes, rows); 0 for noise parameters.

        Exact without effects; see `model.effects.jacobian.plant_slopes` for what is differenced.
        """
        at = self.vanishing if psi is None else psi
        return self._by_row(plant_slopes(self.simulator, self.plant(values), at))

    def slopes(self, values: Vector, psi: Vector) -> tuple[list[Matrix], list[Matrix]]:
        """`jacobian` and `signature`, by fewer simulations than one after the other."""
        by_number, by_coefficient = slopes(self.simulator, self.plant(values), psi)
        return self._by_row(by_number), by_coefficient

    def _by_row(self, slopes: Sequence[Mapping[Number, Matrix]]) -> list[Matrix]:
        """Slopes in the numbers of the plant as those in the table's values."""
        table, out = self.table, []
        for r, slope in enumerate(slopes):
            jacobian = np.zeros((*next(iter(slope.values())).shape, len(table.rows)))
            for k, row in enumerate(table.rows):
                first, second = row.place
                if (row.kind, first, second) in slope:
                    jacobian[..., k] = slope[row.kind, first, second]
                elif row.kind == "offset" and self.offsets is not None and second in (-1, self.offsets[r]):
                    jacobian[:, first, k] = 1.0
            out.append(jacobian)
        return out


def plant_of(table: ParameterTable, values: Vector, offsets: Sequence[int] | None, records: int) -> Plant:
    """The plant of a table's values, (rows,)."""
    batch = table.canonical(values[None])
    axes = range(len(table.layout.responses))
    shifts = np.zeros((records, len(axes)))
    if offsets is not None:
        shifts = np.array([[table.offset(batch, i, r)[0] for i in axes] for r in offsets])
    return Plant(table.gains(batch)[0], table.dynamics(batch), shifts)


def effected(
    posterior: Posterior, values: Vector, effects: Sequence[Effect] = (), epochs: Vector | None = None
) -> Effected:
    """The fit records of a posterior with effects; scales are taken from the base fit `values`.

    `epochs` [-]: place of each record in the campaign, by default evenly from -1/2 to 1/2.
    """
    names = tuple(one.record.name for one in posterior.samples)
    n, fit = len(names), tuple(range(len(names)))
    evenly = np.linspace(-0.5, 0.5, n) if n > 1 else np.zeros(1)
    at = evenly if epochs is None else epochs
    times = tuple(one.times for one in posterior.samples)
    ranges = ranges_of(posterior.model, plant_of(posterior.table, values, fit, n), times)
    simulator = Simulator(posterior.model, tuple(effects), ranges, at, times)
    return Effected(posterior.table, simulator, names, fit)


def effect_slopes(
    simulation: Simulation, values: Vector, *, exact: bool = True, model: Effected | None = None
) -> list[Array]:
    """Per record (samples, axes, rows), in the table's units, at canonical values (rows,).

    `model` is that of `effected_at`, where it is there already.

    Coefficients by differences through the simulator (`model.effects.jacobian`), constants by central ones
    over 1e-4. The plant's rows as there; unless `exact` those of the plant alone, fifty times cheaper and
    good enough to descend with. Raises UnstableError where there is no bounded response.
    """
    model, psi = model or effected_at(simulation, values), simulation.rows.psi(values)
    if exact:
        out, by_coefficient = model.slopes(values, psi)
    else:
        plant = model.with_effects(())
        out, by_coefficient = plant.jacobian(values, plant.vanishing), model.signature(values, psi)
    rows = [k for each in simulation.rows.coefficients for k in each]
    if rows:
        for whole, slope in zip(out, by_coefficient, strict=True):
            whole[..., rows] = slope
    for e, constants in enumerate(simulation.rows.constants):
        for position, k in enumerate(constants):
            if simulation.table.rows[k].free:
                for whole, slope in zip(out, _by_constant(model, values, psi, (e, position, k)), strict=True):
                    whole[..., k] = slope
    return out


def effected_at(simulation: Simulation, values: Vector) -> Effected:
    """The plant with the internal constants of table values, (rows,), and offsets."""
    declared = simulation.declared
    names = tuple(one.name for one in simulation.model.experiments)
    offsets = tuple(-2 if place is None else place for place in declared.fitted)
    return Effected(simulation.table, simulation.simulator(simulation.rows.effects(values)), names, offsets)


def _by_constant(model: Effected, values: Vector, psi: Vector, at: tuple[int, int, int]) -> list[Matrix]:
    """Derivative in one internal constant: effect, its position there, row of the table."""
    effect, position, k = at
    row = model.table.rows[k]
    step = _STEP * (1.0 if row.kind == "fraction" else float(values[k]))
    ends = [values[k] - step, values[k] + step]
    if row.kind == "fraction":
        ends = [max(ends[0], 0.0), min(ends[1], 1.0)]
    name = list(model.effects[effect].constants)[position]
    sides = []
    for end in ends:
        effects = list(model.effects)
        effects[effect] = replace(effects[effect], **{name: end})
        sides.append(model.with_effects(effects).responses(values, psi))
    return [(b - a) / (ends[1] - ends[0]) for a, b in zip(*sides, strict=True)]
