"""The plant of a study as a curve through all samples: predictions and tangents, without any noise model."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, final

import numpy as np

from lcopa_bayes.core.arrays import Flags, Matrix, Vector
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.noise import White
from lcopa_bayes.inference.posterior import Posterior

_MERGED = 1e-6
"""Orders closer than this are at the end of their support [-]."""


class Curve(Protocol):
    """What the loop fits: a smooth map from coordinates to the stacked samples of the fit records."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, one per coordinate."""

    @property
    def centre(self) -> Vector:
        """Prior mean of each coordinate; NaN where the prior is flat."""

    @property
    def spread(self) -> Vector:
        """Prior sd of each coordinate."""

    @property
    def bounds(self) -> tuple[Vector, Vector]:
        """Ends of the support of each coordinate."""

    def bounds_about(self, x: Vector) -> tuple[Vector, Vector]:
        """The same about coordinates: orders whose terms cannot be exchanged also stay in their sequence."""

    def canonical(self, x: Vector) -> Vector:
        """Coordinates of the same curve, terms in the sequence in which they are reported."""

    def predict(self, x: Vector) -> Vector:
        """Stacked responses at coordinates, (n,) [response unit]."""

    def tangents(self, x: Vector) -> tuple[Vector, Matrix]:
        """Stacked responses, (n,), and their derivatives in the coordinates, (n, k)."""


@final
@dataclass(frozen=True, eq=False)
class BaseModel:
    """The plant alone, in the search coordinates of `LeastSquares`: logarithms of time constants, plain
    orders,
    delays, gains and offsets."""

    posterior: Posterior

    @cached_property
    def least(self) -> LeastSquares:
        """Exact residuals and derivatives, with noise of unit scale."""
        return LeastSquares(replace(self.posterior, noise=White()))

    @property
    def time_unit(self) -> str:
        """Unit of all times."""
        return self.posterior.samples[0].record.time_unit

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free plant parameters."""
        return tuple(self.posterior.table.names[k] for k in self.least.columns)

    @cached_property
    def template(self) -> Vector:
        """Fixed values, unit noise scale, (rows,); of the noise only that counts."""
        table = self.posterior.table
        unit = self.posterior.noise.nearly_white(1.0)
        return np.array([unit.get(row.kind, row.value) for row in table.rows])

    @cached_property
    def _priors(self) -> tuple[Vector, Vector]:
        centre, spread = [], []
        low, high = self.least.bounds
        for position, k in enumerate(self.least.columns):
            row = self.posterior.table.rows[k]
            assert row.prior is not None
            normal = row.prior.dist == "norm" and not row.log_scale
            width = high[position] - low[position]
            flat = width / np.sqrt(12) if np.isfinite(width) else float(row.prior.frozen.std())
            centre.append(float(row.prior.frozen.mean()) if normal else np.nan)
            spread.append(float(row.prior.frozen.std()) if normal else flat)
        return np.array(centre), np.array(spread)

    @property
    def centre(self) -> Vector:
        """Prior mean of each coordinate; NaN where the prior is treated as flat within its support."""
        return self._priors[0]

    @property
    def spread(self) -> Vector:
        """Prior sd of each coordinate."""
        return self._priors[1]

    @property
    def bounds(self) -> tuple[Vector, Vector]:
        """Ends of the support of each coordinate."""
        return self.least.bounds

    def bounds_about(self, x: Vector) -> tuple[Vector, Vector]:
        """Bounds within which the orders of every element with unlike priors stay decreasing and terms
        resolved: a free neighbour comes no closer than the middle, and merged orders stay apart; a term
        crosses 1 in its order, or the shortest resolved time, only where the other allows it."""
        low, high = self.least.bounds_around(self.least.values(x, self.template))
        plain = self.bounds
        for ends, other in ((low, plain[0]), (high, plain[1])):
            merged = (ends != other) & (np.abs(x - ends) < _MERGED)
            ends[merged] = x[merged]
        table, shortest = self.posterior.table, np.log(self.posterior.table.resolution or 1.0)
        for t, o in table.limited:
            time = self.least.columns.index(t)
            order = self.least.columns.index(o) if table.rows[o].free else None
            steep = (table.rows[o].value if order is None else x[order]) > 1.0
            if steep or x[time] > shortest + _MERGED:
                low[time] = max(low[time], shortest)
            elif order is not None:
                high[order] = min(high[order], 1.0)
        return low, high

    def canonical(self, x: Vector) -> Vector:
        """Coordinates of the same plant, terms that can be exchanged by decreasing order."""
        raw = self.least.values(x, self.template)[None]
        source = self.posterior.table.sorted_with_source(raw)[1][0]
        places = np.searchsorted(self.least.columns, source[self.least.columns])
        out = x.copy()
        out[places] = x
        return out

    def supported(self, x: Matrix, *, every: bool = True) -> Flags:
        """Whether orders decrease and terms are resolved, of coordinates (batch, k), (batch,).

        Unless `every`, terms that can be exchanged may be in any sequence.
        """
        table = self.posterior.table
        values = np.tile(self.template, (len(x), 1))
        for position, k in enumerate(self.least.columns):
            values[:, k] = np.exp(x[:, position]) if table.rows[k].log_scale else x[:, position]
        return table.supported(values if every else table.canonical(values))

    @property
    def log_support(self) -> float:
        """What the support of terms adds to the log of a prior density of terms in any sequence [nat]."""
        return self.posterior.table.log_support

    def values(self, x: Vector) -> Vector:
        """Table values of coordinates, (rows,), terms in canonical order."""
        raw = self.least.values(x, self.template)
        return np.asarray(self.posterior.table.canonical(raw[None])[0])

    def dead_time(self, x: Vector) -> float:
        """Shortest delay at coordinates [time unit]."""
        table, values = self.posterior.table, self.values(x)
        return min(float(values[table.at("delay", k)]) for k in range(len(table.layout.delays)))

    def coordinates(self, values: Vector) -> Vector:
        """Coordinates of table values."""
        return self.least.coordinates(values)

    @cached_property
    def observed(self) -> Vector:
        """Observed samples, stacked [response unit]."""
        return np.concatenate([one.values for record in self.posterior.samples for one in record.axes])

    def predict(self, x: Vector) -> Vector:
        """Stacked responses, (n,) [response unit]."""
        posterior, values = self.posterior, self.values(x)[None]
        units = posterior.model.unit_responses(posterior.table.dynamics(values))
        left = [
            posterior.residual(axis, r, observed, values, units[r])[0]
            for r, samples in enumerate(posterior.samples)
            for axis, observed in enumerate(samples.axes)
        ]
        return np.asarray(self.observed - np.concatenate(left))

    def tangents(self, x: Vector) -> tuple[Vector, Matrix]:
        """Stacked responses and their exact derivatives."""
        misfit, jacobian = self.least.residual(x, self.template)
        n = self.posterior.size
        return self.observed + misfit[:n], jacobian[:n]
