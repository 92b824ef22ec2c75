"""Responses of a batch of plants with effects, split into what the table's linear parameters scale.

Where every response axis stays linear in its gains, a record is ``base + sum gain_ij column_ij``, and gains
can be integrated out as without effects; otherwise the base holds the gains too. So it is with coefficients
that only add a fixed shape in time. Plants share the calls of `model.effects.simulator` where effects that
act before the reading take many; without any all share one call of the forward model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, final

import numpy as np

from lcopa_bayes.core.arrays import Array, Flags, Index, Matrix, Vector
from lcopa_bayes.inference.effectrows import EffectRows
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.model.effects.declared import Declared
from lcopa_bayes.model.effects.effect import (
    DriveEffect,
    Effect,
    ForceEffect,
    ParallelEffect,
    ReadoutEffect,
    Scene,
    UnstableError,
)
from lcopa_bayes.model.effects.passage import Moved, Plant, forced
from lcopa_bayes.model.effects.simulator import UPSTREAM, Simulator
from lcopa_bayes.model.forward import ForwardModel, deflections

_ACCURACY = 1e-9
"""Accuracy of responses under forces over their scale [-]: slopes are not taken from them (`effects`), and
noise is some thousand times as large."""
_ABREAST = 64
"""Plants whose responses on blocks are kept at once [-]."""


@final
class Simulated(NamedTuple):
    """One record under a batch of plants."""

    base: Array
    """Response without its `columns`, (axes, batch, samples) [response unit]."""
    columns: Mapping[int, Matrix]
    """What a unit of a table row adds to its response axis, (batch, samples); none for what does not act."""
    bounded: Flags
    """Plants that have a bounded response, (batch,); the others are 0 throughout."""


@final
@dataclass(frozen=True, eq=False)
class Simulation:
    """The model of a table with the effects of a forward model."""

    table: ParameterTable
    model: ForwardModel

    @property
    def declared(self) -> Declared:
        """The effects."""
        assert self.model.effects is not None
        return self.model.effects

    @cached_property
    def rows(self) -> EffectRows:
        """What the rows of the table are for them."""
        return EffectRows(self.table, self.declared)

    def simulator(self, effects: tuple[Effect, ...]) -> Simulator:
        """What simulates one plant with these effects."""
        declared = self.declared
        return Simulator(self.model.plain, effects, declared.ranges, declared.epochs, declared.times)

    def __call__(self, values: Matrix) -> list[Simulated]:
        """Every record at canonical table values, (batch, rows)."""
        declared, batch, layout = self.declared, len(values), self.table.layout
        shared = None
        if not (declared.bending or declared.commanding):
            shared = self.model.plain.unit_responses(self.rows.dynamics(values))
        bounded = np.ones(batch, dtype=bool)
        out = [
            Simulated(
                np.zeros((len(layout.responses), batch, times.size)),
                {k: np.zeros((batch, times.size)) for k in self.rows.scaled if self._acts(k, r)},
                bounded,
            )
            for r, times in enumerate(declared.times)
        ]
        pending = np.arange(0 if declared.forced else batch)
        if declared.forced:
            self._forced(values, out)
        elif self._scales_commands(values):
            pending = self._commanded(values, out)
        for some in np.array_split(pending, max(1, -(-pending.size // _ABREAST))):
            self._each(values, some.tolist(), shared, out)
        for record in out:
            for each in (*record.base, *record.columns.values()):
                each[~bounded] = 0.0
        return out

    def responses(self, values: Matrix) -> list[Array]:
        """Responses without offsets, per record (axes, batch, samples) [response unit]; NaN where there is no
        bounded one."""
        out = []
        for record in self(values):
            total = record.base.copy()
            for k, column in record.columns.items():
                total[self.table.rows[k].response] += values[:, k, None] * column
            total[:, ~record.bounded] = np.nan
            out.append(total)
        return out

    def disturbed(self, values: Matrix, rng: np.random.Generator) -> list[Array]:
        """`responses` of one other record, whose own coefficients are unknown.

        They are drawn as large as those of the fit records: normal about 0, of their root mean square.
        """
        declared, out = self.declared, values.copy()
        for kind, rows, count in zip(declared.kinds, self.rows.coefficients, self.rows.counts, strict=True):
            if kind.card.per_record:
                fitted = values[:, rows].reshape(len(values), -1, count)
                size = np.sqrt(np.mean(fitted**2, axis=1))
                out[:, rows[:count]] = size * rng.standard_normal(size.shape)
        own = replace(self.model, effects=replace(declared, fitted=(0,) * len(declared.fitted)))
        return Simulation(self.table, own).responses(out)

    def _acts(self, k: int, r: int) -> bool:
        """Whether a scaled row acts on a record."""
        row = self.table.rows[k]
        if row.kind == "gain":
            experiment, drive = self.model.experiments[r], row.place.second
            return experiment.drives[drive].moves or experiment.rest[drive] != 0.0
        return self.declared.fitted[r] == row.place.second // self.rows.counts[row.place.first]

    def _each(
        self, values: Matrix, some: Sequence[int], shared: list[Array] | None, out: list[Simulated]
    ) -> None:
        """Write the responses of some plants, each with effects of its own."""
        simulators: dict[tuple[Effect, ...], Simulator] = {}
        alike: dict[tuple[Effect, ...], list[int]] = {}
        effects = {b: self.rows.effects(values[b]) for b in some}
        for b, every in effects.items():
            simulators[every] = self.simulator(every)
            alike.setdefault(tuple(one for one in every if isinstance(one, UPSTREAM)), []).append(b)
        for own in alike.values():
            together = self._moved(simulators[effects[own[0]]], values[own])
            for number, b in enumerate(own):
                simulator = simulators[effects[b]]
                units = None if shared is None else [each[:, b : b + 1] for each in shared]
                try:
                    moved = together[number] if together else self._unread(simulator, values[b], units)
                    self._one(simulator, values[b], moved, b, out)
                except UnstableError:
                    out[0].bounded[b] = False

    def _moved(self, simulator: Simulator, values: Matrix) -> list[list[list[Moved]]]:
        """Of each plant, the records of every part of its response up to its reading, where elements and the
        sensor alone bend them, of many at once; none elsewhere, or where one has no bounded response."""
        apart = any(isinstance(effect, (DriveEffect, ForceEffect)) for effect in simulator.effects)
        if apart or not self.declared.bending:
            return []
        pairs = [self.rows.unscaled(row) for row in values]
        cases = [(part, psi) for plant, psi in pairs for part in self._parts(plant)]
        try:
            moved = simulator.moved_together(cases)
        except UnstableError:
            return []
        size = len(cases) // len(values)
        return [moved[first : first + size] for first in range(0, len(moved), size)]

    def _parts(self, plant: Plant) -> list[Plant]:
        """Plants whose readings make up the response of one: where it is linear in its gains, those with unit
        gains of one drive each."""
        if not self.declared.affine:
            return [plant]
        responses, drives = plant.gains.shape
        return [replace(plant, gains=np.tile(unit, (responses, 1))) for unit in np.eye(drives)]

    def _forced(self, values: Matrix, out: list[Simulated]) -> None:
        """Write the responses of plants under forces, all at once."""
        declared, axes, bounded = self.declared, len(self.table.layout.responses), out[0].bounded
        gains, commanded = self.table.gains(values), values if declared.commanding else values[:0]
        dynamics = self.table.dynamics(values) if declared.commanding else self.rows.dynamics(values)
        pairs = ((self.simulator(self.rows.effects(row)), row) for row in commanded)
        each = [one.commanded(self.rows.plant(row), self.rows.psi(row)) for one, row in pairs]
        forces = []
        for kind, rows, constants in zip(
            declared.kinds, self.rows.coefficients, self.rows.constants, strict=True
        ):
            if issubclass(kind, ForceEffect):
                psi = np.repeat(values[:, rows].T, axes, axis=1)[..., None]
                own = [np.repeat(values[:, k], axes)[:, None] for k in constants]
                forces.append((kind(*(c if np.ptp(c) else float(c[0, 0]) for c in own)), psi))
        simulator, plant = self.simulator(self.rows.effects(values[0])), self.rows.plant(values[0])
        scenes = [simulator.scene(r, plant) for r in range(len(out))]
        records = forced(self.model.plain, scenes, gains, dynamics, forces, _ACCURACY, each)
        for record, (deflection, failures) in zip(out, records, strict=True):
            bounded[list(failures)] = False
            record.base[...] = deflection
        if not all(issubclass(kind, (DriveEffect, ForceEffect)) for kind in declared.kinds):
            for b in np.flatnonzero(bounded).tolist():
                simulator = self.simulator(self.rows.effects(values[b]))
                self._finished(simulator, values[b], b, out)

    def _scales_commands(self, values: Matrix) -> bool:
        """Whether all plants share one effect on the commands that is proportional to its coefficient, and
        nothing else acts but on what is read."""
        drive = [k for k in self.declared.kinds if issubclass(k, DriveEffect)]
        if len(drive) != 1 or self.declared.bending or not drive[0].linear or drive[0].card.per_record:
            return False
        e = self.declared.kinds.index(drive[0])
        others = [k for k in self.declared.kinds if k is not drive[0]]
        read = all(issubclass(k, ReadoutEffect) and not k.affine for k in others)
        same = not np.ptp(values[:, self.rows.constants[e]], axis=0).any()
        return read and same and len(self.rows.coefficients[e]) == 1

    def _commanded(self, values: Matrix, out: list[Simulated]) -> Index:
        """Write the responses of plants under commands that change in proportion to one coefficient."""
        layout, gains = self.table.layout, self.table.gains(values)
        dynamics = self.table.dynamics(values)
        e = next(k for k, kind in enumerate(self.declared.kinds) if issubclass(kind, DriveEffect))
        unit, at = values[0].copy(), self.rows.coefficients[e][0]
        unit[[k for rows in self.rows.coefficients for k in rows]] = 0.0
        unit[at] = 1.0
        simulator = self.simulator(self.rows.effects(values[0]))
        there = simulator.driven(simulator.scenes(self.rows.plant(unit), self.rows.psi(unit)))
        plain, size = self.model.plain, values[:, at, None]
        if not _as_exact(plain, there):
            return np.arange(len(values))
        pairs = zip(plain.unit_responses(dynamics), there.unit_responses(dynamics), strict=True)
        for r, (before, after) in enumerate(pairs):
            rests = plain.experiments[r].rest, there.experiments[r].rest
            for i, row in enumerate(layout.unit_of):
                for j, u in enumerate(row):
                    column = rests[0][j] + before[u]
                    column += size * (rests[1][j] + after[u] - column)
                    k = self.table.at("gain", i, j)
                    if not self.declared.affine:
                        out[r].base[i] += gains[:, i, j, None] * column
                    elif k in out[r].columns:
                        out[r].columns[k][...] = column
        if len(self.declared.kinds) > 1:
            for b, row in enumerate(values):
                self._finished(self.simulator(self.rows.effects(row)), row, b, out)
        return np.arange(0)

    def _finished(self, simulator: Simulator, row: Vector, b: int, out: list[Simulated]) -> None:
        """What comes after the reading, on responses of one plant that are there already."""
        plant, psi = self.rows.unscaled(row)
        scenes = simulator.scenes(plant, psi)
        moved = [Moved(scene, record.base[:, b].T) for scene, record in zip(scenes, out, strict=True)]
        for record, y in zip(out, simulator.finished(moved, psi), strict=True):
            record.base[:, b] = y.T
        self._added(simulator, plant, b, out)

    def _one(
        self, simulator: Simulator, row: Vector, moved: list[list[Moved]], b: int, out: list[Simulated]
    ) -> None:
        """Write one plant's responses from those of its parts up to their reading."""
        plant, psi = self.rows.unscaled(row)
        if not self.declared.affine:
            for record, y in zip(out, simulator.finished(moved[0], psi), strict=True):
                record.base[:, b] = y.T
        else:
            none = np.zeros_like(plant.gains)
            rest = [Moved(replace(scene, gains=none), np.zeros_like(y)) for scene, y in moved[0]]
            base = simulator.finished(rest, psi)
            for record, y in zip(out, base, strict=True):
                record.base[:, b] = y.T
            for j, part in enumerate(moved):
                for record, y, nothing in zip(out, simulator.finished(part, psi), base, strict=True):
                    for i in range(len(plant.gains)):
                        k = self.table.at("gain", i, j)
                        if k in record.columns:
                            record.columns[k][b] = (y - nothing)[:, i]
        self._added(simulator, plant, b, out)

    def _unread(self, simulator: Simulator, row: Vector, units: list[Array] | None) -> list[list[Moved]]:
        """Of one plant, the records of every part of its response up to its reading, by its unit responses
        where they are known."""
        plant, psi = self.rows.unscaled(row)
        if self.declared.bending:
            return [simulator.moved(part, psi) for part in self._parts(plant)]
        scenes = simulator.scenes(plant, psi)
        units = units or simulator.driven(scenes).unit_responses(plant.dynamics)
        return [
            [
                Moved(
                    replace(scene, gains=part.gains),
                    deflections(self.table.layout, scene.rest, part.gains[None], each)[:, 0].T,
                )
                for scene, each in zip(scenes, units, strict=True)
            ]
            for part in self._parts(plant)
        ]

    def _added(self, simulator: Simulator, plant: Plant, b: int, out: list[Simulated]) -> None:
        """Columns of the coefficients that only add."""
        for e, rows in enumerate(self.rows.coefficients):
            effect, count = simulator.effects[e], self.rows.counts[e]
            if not (isinstance(effect, ParallelEffect) and effect.additive):
                continue
            if rows[0] not in self.rows.scaled:
                continue
            for r, place in enumerate(self.declared.fitted):
                if place is None:
                    continue
                scene: Scene = simulator.scene(r, plant)
                for k in range(count):
                    unit = np.zeros(count)
                    unit[k] = 1.0
                    at = rows[place * count + k]
                    out[r].columns[at][b] = effect.added(scene, unit)[:, self.table.rows[at].response]


def _as_exact(before: ForwardModel, after: ForwardModel) -> bool:
    """Whether more changes of a drive are simulated as exactly: too many phases are shared out to blocks."""
    pairs = zip(before.experiments, after.experiments, strict=True)
    return all(
        len(a) <= len(b) for one, other in pairs for a, b in zip(one.phases, other.phases, strict=True)
    )
