"""The plant with effects as a curve through all samples."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.effectsearch.basemodel import BaseModel
from lcopa_bayes.effectsearch.whitening import stacked
from lcopa_bayes.inference.effects import Effected, Placed, effected
from lcopa_bayes.model.effects.effect import Effect, ForceEffect


@final
@dataclass(frozen=True, eq=False)
class ExtendedModel:
    """Coordinates are those of the base model, then every effect's coefficients over their prior sd."""

    base: BaseModel
    effected: Effected
    exact: bool = True
    """Whether the plant's tangents are those with the effects in place; otherwise those of the plant alone,
    fifty times cheaper and good enough to descend with."""

    @classmethod
    def of(
        cls,
        base: BaseModel,
        x: Vector,
        effects: tuple[Effect, ...] = (),
        *,
        taken: Mapping[str, float] | None = None,
    ) -> ExtendedModel:
        """With the effects' scales taken from the base fit at `x`; `taken` gives each record's place in the
        campaign
        [-], by default evenly from -1/2 to 1/2."""
        names = [one.record.name for one in base.posterior.samples]
        epochs = np.array([taken[name] for name in names]) if taken else None
        return cls(base, effected(base.posterior, base.values(x), effects, epochs))

    def having(self, *effects: Effect) -> ExtendedModel:
        """The same plant and scales with these effects."""
        return replace(self, effected=self.effected.with_effects(effects))

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects, in the order of their coefficients."""
        return self.effected.effects

    @property
    def plant_size(self) -> int:
        """Number of coordinates of the plant [-]."""
        return len(self.base.names)

    @cached_property
    def scale(self) -> Vector:
        """Prior sd of each coefficient, in its unit."""
        return np.array([one.coefficient.scale for one in self.effected.coefficients])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of plant parameters and coefficients."""
        return (*self.base.names, *(one.name for one in self.effected.coefficients))

    @property
    def centre(self) -> Vector:
        """Prior mean of each coordinate; NaN where flat."""
        return np.concatenate([self.base.centre, np.zeros(self.scale.size)])

    @property
    def spread(self) -> Vector:
        """Prior sd of each coordinate."""
        return np.concatenate([self.base.spread, np.ones(self.scale.size)])

    @property
    def bounds(self) -> tuple[Vector, Vector]:
        """Ends of the support of each coordinate."""
        low, high = self.base.bounds
        signed = [0.0 if one.coefficient.one_signed else -np.inf for one in self.effected.coefficients]
        return np.concatenate([low, signed]), np.concatenate([high, np.full(len(signed), np.inf)])

    def bounds_about(self, x: Vector) -> tuple[Vector, Vector]:
        """The same about coordinates: orders whose terms cannot be exchanged also stay in their sequence."""
        low, high = (ends.copy() for ends in self.bounds)
        n = self.plant_size
        low[:n], high[:n] = self.base.bounds_about(x[:n])
        return low, high

    def canonical(self, x: Vector) -> Vector:
        """Coordinates of the same curve, terms in the sequence in which they are reported."""
        return np.concatenate([self.base.canonical(x[: self.plant_size]), x[self.plant_size :]])

    def split(self, x: Vector) -> tuple[Vector, Vector]:
        """Table values and coefficients of coordinates."""
        n = self.plant_size
        return self.base.values(x[:n]), x[n:] * self.scale

    def dead_time(self, x: Vector) -> float:
        """Shortest delay at coordinates [time unit]."""
        return self.base.dead_time(x[: self.plant_size])

    def predict(self, x: Vector) -> Vector:
        """Stacked responses, (n,) [response unit]; UnstableError where there are none."""
        if not self.effects:
            return self.base.predict(x)
        values, psi = self.split(x)
        return stacked(self.base.posterior.samples, self.effected.responses(values, psi))

    def tangents(self, x: Vector) -> tuple[Vector, Matrix]:
        """Stacked responses, (n,), and their derivatives in the coordinates, (n, k)."""
        if not self.effects:
            return self.base.tangents(x)
        values, psi = self.split(x)
        samples, n = self.base.posterior.samples, self.plant_size
        if self.exact:
            slopes = [np.moveaxis(one, 2, 0) for one in self.effected.jacobian(values, psi)]
            plant = self._in_coordinates(stacked(samples, slopes), x[:n], values)
        else:
            plant = self.base.tangents(x[:n])[1].T
        return self.predict(x), np.vstack([plant, self._coefficient_slopes(values, psi)]).T

    def signature(self, x: Vector, effect: Effect) -> tuple[Matrix, tuple[Placed, ...]]:
        """Derivatives in the coefficients of one more effect over their prior sd where it vanishes, (n, k)
        [response unit], at coordinates of this model, and what the coefficients are.

        Without the forces that depend on the response, where this model has any: they take fifty times as
        long and change a signature little.
        """
        kept = tuple(e for e in self.effects if not isinstance(e, ForceEffect))
        more = self.having(*kept, effect)
        placed, old = self.effected.coefficients, self.effected.effects
        own = [k for k, one in enumerate(placed) if old[one.effect] in kept]
        coordinates = np.concatenate([x[: self.plant_size], x[self.plant_size :][own]])
        new = more.scale.size - len(own)
        values, psi = more.split(np.concatenate([coordinates, np.zeros(new)]))
        return more._coefficient_slopes(values, psi)[len(own) :].T, more.effected.coefficients[-new:]

    def _coefficient_slopes(self, values: Vector, psi: Vector) -> Matrix:
        slopes = [np.moveaxis(one, 2, 0) for one in self.effected.signature(values, psi)]
        return stacked(self.base.posterior.samples, slopes) * self.scale[:, None]

    def _in_coordinates(self, slopes: Matrix, x: Vector, values: Vector) -> Matrix:
        """Slopes in table values (rows, n) as slopes in the search coordinates (k, n)."""
        table, least = self.base.posterior.table, self.base.least
        raw = least.values(x, self.base.template)
        _, source = table.sorted_with_source(raw[None])
        moved = slopes[source[0]][least.columns]
        logs = [values[source[0][k]] if table.rows[k].log_scale else 1.0 for k in least.columns]
        return np.asarray(moved * np.array(logs)[:, None])
