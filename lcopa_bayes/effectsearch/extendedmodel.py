"""The plant of a study with effects as a curve through all samples: predictions, tangents and descents."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Flags, Matrix, Vector
from lcopa_bayes.effectsearch.whitening import stacked
from lcopa_bayes.inference.declared import with_effects
from lcopa_bayes.inference.effects import Effected, Placed, effected
from lcopa_bayes.inference.kinds import CONSTANTS
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.posterior import Posterior, bounded
from lcopa_bayes.model.effects.effect import Effect, ForceEffect, Ranges

_MERGED = 1e-6
"""Orders closer than this are at the end of their support [-]."""
_UNIT = np.array([1.0, 0.0, 0.0])
"""Noise of unit scale, as `WhiteAR1` takes it."""


@final
@dataclass(frozen=True, eq=False)
class ExtendedModel:
    """A posterior with effects at the scales of a base fit, in the search coordinates of `LeastSquares`:
    logarithms of time constants, plain orders, delays, gains, offsets and coefficients."""

    plant: Posterior
    """The plant alone."""
    scaled: Effected | None = None
    """The effects at scales of a base fit; None before there is one."""
    exact: bool = True
    """Whether the plant's tangents are those with the effects in place; otherwise those of the plant alone,
    fifty times cheaper and good enough to descend with."""
    loose: frozenset[str] = frozenset()
    """Internal constants that are coordinates too if they have a prior, ``<effect>.<constant>``; the others
    are held."""
    wider: Mapping[str, float] = field(default_factory=dict)
    """Factor on the default prior sd of the coefficients of an effect, by its name, where it is not 1 [-]."""

    def at_scales(self, x: Vector, taken: Mapping[str, float]) -> ExtendedModel:
        """With the scales of effects taken from the base fit at `x`; `taken` gives each record's place in the
        campaign [-]."""
        epochs = np.array([taken[one.record.name] for one in self.plant.samples])
        return replace(self, scaled=effected(self.plant, self.values(x), (), epochs))

    def in_proportion(self, x: Vector) -> ExtendedModel:
        """With deflections of the response axes in proportion to those of the plant at `x`, their geometric
        mean unchanged.

        A base fit that lacks an effect has gains that are wrong on one axis more than on another, and one
        coefficient for all axes then fits none of them.
        """
        ranges, values = self.effected.ranges, self.values(x)[: len(self.plant.table.rows)]
        own = effected(self.plant, values).ranges.response
        factor = np.exp(np.mean(np.log(ranges.response / own)))
        return self.with_ranges(replace(ranges, response=factor * own))

    def with_ranges(self, ranges: Ranges) -> ExtendedModel:
        """With the effects at other scales."""
        return replace(self, scaled=self.effected.with_ranges(ranges))

    @property
    def effected(self) -> Effected:
        """The effects at scales of the base fit."""
        assert self.scaled is not None
        return self.scaled

    @cached_property
    def posterior(self) -> Posterior:
        """The plant with the effects, their scales those of the base fit."""
        if not self.effects:
            return self.plant
        simulator = self.effected.simulator
        return with_effects(
            self.plant, self.effects, simulator.ranges, simulator.epochs, free=self.loose, wider=self.wider
        )

    def least(self, held: tuple[Vector, ...] = ()) -> LeastSquares:
        """Residuals, derivatives and descents under noise of each axis as `WhiteAR1` takes it, by default
        white of unit scale."""
        axes = len(self.plant.table.layout.responses)
        return LeastSquares(self.posterior, exact=self.exact, held=held or (_UNIT,) * axes)

    @cached_property
    def _least(self) -> LeastSquares:
        return self.least()

    @cached_property
    def template(self) -> Vector:
        """Fixed values, (rows,); those of the noise do not count."""
        unit = self.posterior.noise.nearly_white(1.0)
        return np.array([unit.get(row.kind, row.value) for row in self.posterior.table.rows])

    def having(self, *effects: Effect) -> ExtendedModel:
        """The same plant and scales with these effects."""
        return replace(self, scaled=self.effected.with_effects(effects))

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects, in the order of their coefficients."""
        return self.scaled.effects if self.scaled else ()

    @property
    def upstream(self) -> bool:
        """Whether an effect acts before the reading, so that plants share little of their simulation."""
        simulation = self.posterior.simulation
        declared = None if simulation is None else simulation.declared
        return declared is not None and (declared.bending or declared.commanding)

    @property
    def columns(self) -> list[int]:
        """Table positions of the coordinates."""
        return self._least.columns

    @cached_property
    def plant_size(self) -> int:
        """Number of coordinates of the plant [-]."""
        return len(LeastSquares(self.plant).columns)

    @property
    def scale(self) -> Vector:
        """Prior sd of each coefficient, in its unit."""
        wider = [self.wider.get(effect.name, 1.0) for effect in self.effects]
        return np.array([one.coefficient.scale * wider[one.effect] for one in self.effected.coefficients])

    def sizes(self, x: Vector) -> tuple[tuple[Effect, Vector], ...]:
        """The effects, each with its coefficients at coordinates over their default prior sd [-]."""
        placed = self.effected.coefficients
        psi = x[self.plant_size :] / np.array([one.coefficient.scale for one in placed])
        owners = np.array([one.effect for one in placed], dtype=int)
        return tuple((effect, psi[owners == e]) for e, effect in enumerate(self.effects))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the coordinates, as in the table."""
        return tuple(self.posterior.table.names[k] for k in self.columns)

    @cached_property
    def _priors(self) -> tuple[Vector, Vector]:
        centre, spread = [], []
        for low, high, k in zip(*self.bounds, self.columns, strict=True):
            row = self.posterior.table.rows[k]
            assert row.prior is not None
            flat = (high - low) / np.sqrt(12) if np.isfinite(high - low) else row.prior.sd
            pair = (np.nan, flat) if row.log_scale else row.prior.normal or (np.nan, flat)
            centre.append(pair[0])
            spread.append(pair[1])
        return np.array(centre), np.array(spread)

    @property
    def centre(self) -> Vector:
        """Prior mean of each coordinate; NaN where the prior is treated as flat within its support."""
        return self._priors[0]

    @property
    def spread(self) -> Vector:
        """Prior sd of each coordinate."""
        return self._priors[1]

    @cached_property
    def bounds(self) -> tuple[Vector, Vector]:
        """Ends of the support of each coordinate."""
        return self._least.bounds

    def bounds_about(self, x: Vector) -> tuple[Vector, Vector]:
        """Bounds within which the orders of every element with unlike priors stay decreasing and terms
        resolved (`LeastSquares.bounds_around`), where merged orders stay apart."""
        low, high = self._least.bounds_around(self._least.values(x, self.template))
        for ends, other in zip((low, high), self.bounds, strict=True):
            merged = (ends != other) & (np.abs(x - ends) < _MERGED)
            ends[merged] = x[merged]
        return low, high

    def canonical(self, x: Vector) -> Vector:
        """Coordinates of the same plant, terms that can be exchanged by decreasing order."""
        raw = self._least.values(x, self.template)[None]
        source = self.posterior.table.sorted_with_source(raw)[1][0]
        out = x.copy()
        out[np.searchsorted(self.columns, source[self.columns])] = x
        return out

    def plants(self, x: Matrix) -> Matrix:
        """Table values of the plant alone at coordinates (batch, k), (batch, rows), in canonical order."""
        table = self.plant.table
        values = np.tile(self.template[: len(table.rows)], (len(x), 1))
        for position, k in enumerate(self.columns[: self.plant_size]):
            values[:, k] = table.rows[k].value_at(x[:, position])
        return table.canonical(values)

    @cached_property
    def responding(self) -> tuple[ExtendedModel, list[int]]:
        """The plant with its linear dynamics without a name, which are part of its response, and positions of
        their coordinates among these."""
        kept = [effect.card.dynamics for effect in self.effects]
        own = [k for k, one in enumerate(self.effected.coefficients) if kept[one.effect]]
        model = self.having(*(effect for effect in self.effects if effect.card.dynamics))
        return model, [*range(self.plant_size), *(self.plant_size + k for k in own)]

    def supported(self, x: Matrix) -> Flags:
        """Whether orders decrease and terms are resolved, of coordinates (batch, k), (batch,); terms that can
        be exchanged may be in any sequence."""
        return self.plant.table.supported(self.plants(x))

    def inside(self, x: Matrix) -> Flags:
        """Whether all of the support holds coordinates (batch, k), (batch,)."""
        low, high = self.bounds
        out: Flags = np.asarray(((x >= low) & (x <= high)).all(axis=1))
        out[out] = self.supported(x[out])
        return out

    def tabulated(self, x: Matrix) -> Matrix:
        """Table values at coordinates (batch, k), (batch, rows), terms in canonical order."""
        rows = [self._least.values(one, self.template) for one in x]
        return self.posterior.table.canonical(np.reshape(rows, (len(x), len(self.posterior.table.rows))))

    def values(self, x: Vector) -> Vector:
        """Table values of coordinates, (rows,), terms in canonical order."""
        return np.asarray(self.tabulated(x[None])[0])

    def coordinates(self, values: Vector) -> Vector:
        """Coordinates of table values."""
        return self._least.coordinates(values)

    def dead_time(self, x: Vector) -> float:
        """Shortest delay at coordinates [time unit]."""
        table, values = self.posterior.table, self.values(x)
        return min(float(values[table.at("delay", k)]) for k in range(len(table.layout.delays)))

    @property
    def delays(self) -> list[int]:
        """Positions of the delays among the coordinates."""
        rows = self.posterior.table.rows
        return [position for position, k in enumerate(self.columns) if rows[k].kind == "delay"]

    def delayed(self, x: Vector, share: float) -> Vector:
        """Coordinates, perhaps with those of further effects behind, with every delay longer by a share of it
        [-]."""
        out, rows = x.copy(), self.posterior.table.rows
        for position in self.delays:
            log = rows[self.columns[position]].log_scale
            out[position] += np.log1p(share) if log else share * x[position]
        return out

    def held(self, x: Vector) -> tuple[ExtendedModel, Vector]:
        """The model with its `loose` constants held at those of coordinates, and the other coordinates."""
        table, values = self.posterior.table, self.values(x)
        free = {table.names[k]: float(values[k]) for k in self.columns if table.rows[k].kind in CONSTANTS}
        effects: list[Effect] = []
        for effect in self.effects:
            own = {name: f"{effect.name}.{name}" for name in effect.constants}
            moved = {name: free[full] for name, full in own.items() if full in free}
            effects.append(replace(effect, **moved))
        fixed = [p for p, k in enumerate(self.columns) if table.rows[k].kind not in CONSTANTS]
        return replace(self.having(*effects), loose=frozenset()), x[fixed]

    @cached_property
    def observed(self) -> Vector:
        """Observed samples, stacked [response unit]."""
        return np.concatenate([one.values for record in self.plant.samples for one in record.axes])

    def predict(self, x: Vector) -> Vector:
        """Stacked responses, (n,) [response unit]; UnstableError where there are none."""
        return np.asarray(self.observed + self._least.misfit(x, self.template)[: self.plant.size])

    def predictions(self, many: Matrix) -> Matrix:
        """Stacked responses at coordinates (batch, k), (batch, n) [response unit]; infinite where there are
        none."""
        posterior = self.posterior
        values = self.tabulated(many)
        units = posterior.responses(values)
        parts = [
            observed.values - posterior.residual(axis, r, observed, values, units[r])
            for r, record in enumerate(posterior.samples)
            for axis, observed in enumerate(record.axes)
        ]
        out = np.concatenate(parts, axis=1)
        if posterior.simulation is not None:
            out[~bounded(units)] = np.inf
        return out

    def tangents(self, x: Vector) -> tuple[Vector, Matrix]:
        """Stacked responses, (n,), and their derivatives in the coordinates, (n, k)."""
        misfit, jacobian = self._least.residual(x, self.template)
        return self.observed + misfit[: self.plant.size], jacobian[: self.plant.size]

    def signature(self, x: Vector, effect: Effect) -> tuple[Matrix, tuple[Placed, ...]]:
        """Derivatives in the coefficients of one more effect over their prior sd where it vanishes, (n, k)
        [response unit], at coordinates of this model, and what the coefficients are.

        Without the forces that depend on the response, where this model has any: they take fifty times as
        long and change a signature little.
        """
        kept = tuple(e for e in self.effects if not isinstance(e, ForceEffect))
        more = self.effected.with_effects([*kept, effect])
        own = [k for k, one in enumerate(self.effected.coefficients) if self.effects[one.effect] in kept]
        values, new = self.values(x)[: len(self.plant.table.rows)], len(more.coefficients) - len(own)
        psi = np.concatenate([x[self.plant_size :][own], np.zeros(new)])
        scale = np.array([one.coefficient.scale for one in more.coefficients[-new:]])
        slopes = [np.moveaxis(one, 2, 0) for one in more.signature(values, psi, last=True)]
        raw = stacked(self.plant.samples, slopes)[len(own) :].T
        return raw * scale, more.coefficients[-new:]
