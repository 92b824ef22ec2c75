"""Table rows of declared effects: coefficients, internal constants, and the plants of table values."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.inference.kinds import COEFFICIENTS, CONSTANTS
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.model.effects.declared import Declared
from lcopa_bayes.model.effects.effect import Constant, DriveEffect, Effect
from lcopa_bayes.model.effects.passage import Plant
from lcopa_bayes.model.forward import Dynamics


@final
@dataclass(frozen=True, eq=False)
class EffectRows:
    """What the rows of a table are for the effects of a set of records."""

    table: ParameterTable
    declared: Declared

    @cached_property
    def scaled(self) -> frozenset[int]:
        """Rows that have a column: gains where responses are linear in them, coefficients that only add."""
        rows = self.table.rows
        gains = self.table.of_kind("gain") if self.declared.affine else []
        return frozenset([*gains, *(k for k, row in enumerate(rows) if row.adds_to is not None)])

    @cached_property
    def coefficients(self) -> list[list[int]]:
        """Table rows of the coefficients of each effect, those of one record after those of another."""
        return self._rows(COEFFICIENTS)

    @cached_property
    def constants(self) -> list[list[int]]:
        """Table rows of the internal constants of each effect."""
        return self._rows(CONSTANTS)

    def _rows(self, kinds: tuple[str, ...]) -> list[list[int]]:
        rows = self.table.rows
        out = []
        for e in range(len(self.declared.kinds)):
            mine = [k for k, row in enumerate(rows) if row.kind in kinds and row.place.first == e]
            out.append(sorted(mine, key=lambda k: rows[k].place.second))
        return out

    def effects(self, values: Vector) -> tuple[Effect, ...]:
        """The effects with the internal constants of table values, (rows,)."""
        return tuple(
            kind.with_constants(own, values[rows].tolist())
            for kind, own, rows in zip(self.declared.kinds, self._internal, self.constants, strict=True)
        )

    @cached_property
    def _internal(self) -> list[tuple[Constant, ...]]:
        """Internal constants of each effect, whose ends are those of a grid of instances."""
        return [kind.internal(self.declared.ranges) for kind in self.declared.kinds]

    def psi(self, values: Vector) -> Vector:
        """Coefficients as a simulator of the records takes them; those of another record are 0."""
        parts = []
        for e, (kind, rows) in enumerate(zip(self.declared.kinds, self.coefficients, strict=True)):
            if not kind.card.per_record:
                parts.append(values[rows])
                continue
            count = self.counts[e]
            for place in self.declared.fitted:
                own = [] if place is None else rows[place * count : (place + 1) * count]
                parts.append(values[own] if own else np.zeros(count))
        return np.concatenate(parts) if parts else np.empty(0)

    @cached_property
    def counts(self) -> list[int]:
        """Coefficients of each effect, or of one record of it [-]."""
        ranges = self.declared.ranges
        instances = (
            kind.with_constants(own, [one.low for one in own])
            for kind, own in zip(self.declared.kinds, self._internal, strict=True)
        )
        return [len(instance.coefficients(ranges)) for instance in instances]

    def dynamics(self, values: Matrix) -> Dynamics:
        """What shapes the responses at canonical table values, (batch, rows), lags of the drive included."""
        dynamics = self.table.dynamics(values)
        for effect, rows in zip(self.effects(values[0]), self.coefficients, strict=True):
            if isinstance(effect, DriveEffect) and effect.lags:
                dynamics = dynamics.later(effect.lag(self.declared.ranges, values[:, rows].T))
        return dynamics

    def plant(self, values: Vector) -> Plant:
        """The plant of canonical table values, (rows,), without offsets."""
        batch = values[None]
        offsets = np.zeros((len(self.declared.times), len(self.table.layout.responses)))
        return Plant(self.table.gains(batch)[0], self.table.dynamics(batch), offsets)

    def unscaled(self, values: Vector) -> tuple[Plant, Vector]:
        """`plant`, and `psi` without the coefficients that have a column."""
        still = values.copy()
        still[[k for k in self.scaled if self.table.rows[k].kind != "gain"]] = 0.0
        return self.plant(values), self.psi(still)
