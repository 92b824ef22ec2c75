"""A chart of the posterior: coordinates without bounds in which its ridges are close to straight.

Elements are given by their shape at fixed frequencies (`shapecoordinates`) in place of their time constants,
gains by their ratio to the element's level, and what lies between two finite ends by its probit, a scale
below a largest one by that of their ratio: a density that is highest at an end has a tail there like that of
a normal one. In the chart a few ellipsoids cover a posterior that is thin and curved in the sampled
coordinates.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

import numpy as np
from scipy.special import log_ndtr, ndtr, ndtri, ndtri_exp
from scipy.stats import norm

from lcopa_bayes.core.arrays import Flags, Matrix, Vector
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.moves import Terrain

_PORTION = 256
"""Draws whose density one process computes at once [-]."""
_DEAR = 16
"""The same of responses with effects, a few hundred of which all processes share [-]."""
Mapped = Callable[..., Iterable[Any]]
"""A map of a function over tasks, here or in other processes."""


@final
@dataclass(frozen=True, eq=False)
class Chart:
    """A smooth change of the sampled coordinates, one to one on terms by decreasing order."""

    terrain: Terrain
    low: Vector
    """Lower end of each sampled coordinate, (dimension,); infinite where it is open."""
    high: Vector
    """Upper end, (dimension,)."""

    @classmethod
    def of(cls, posterior: Posterior) -> Chart:
        """Chart of a posterior; its bounds are those of the priors."""
        ends = np.array([posterior.table.rows[k].sampled_domain for k in posterior.sampled]).reshape(-1, 2)
        return cls(Terrain.of(posterior), ends[:, 0], ends[:, 1])

    @cached_property
    def _bounded(self) -> Flags:
        """Columns charted by their probit; times and gains of charted elements follow the shape."""
        bounded = np.isfinite(self.low) & np.isfinite(self.high)
        for element in self.terrain.elements:
            bounded[element.following] = False
            bounded[[column for column, _ in element.gains]] = False
        return np.asarray(bounded)

    @cached_property
    def _limited(self) -> Flags:
        """Columns with an upper end alone: logarithms of scales, charted by the probit of the scale over its
        largest."""
        return np.asarray(np.isneginf(self.low) & np.isfinite(self.high))

    @cached_property
    def _frequencies(self) -> list[Vector]:
        ends = np.log(self.terrain.slowest), np.log(self.terrain.fastest)
        return [np.exp(np.linspace(*ends, element.ratios + 1)) for element in self.terrain.elements]

    def charted(self, z: Matrix) -> tuple[Matrix, Vector]:
        """Chart of sampled coordinates (batch, dimension), and log |d chart / d coordinates|, (batch,).

        Exchangeable terms are sorted first. Infinite where a coordinate is at an end of its range.
        """
        z = self.terrain.sorted(z)
        y, log_volume = z.copy(), np.zeros(len(z))
        for element, frequencies in zip(self.terrain.elements, self._frequencies, strict=True):
            shape = element.shape(z, frequencies)
            y[:, element.following] = shape.log_ratios
            log_volume += shape.log_volume
            for column, by_logarithm in element.gains:
                if by_logarithm:
                    y[:, column] -= shape.log_level
                else:
                    y[:, column] *= np.exp(-shape.log_level)
                    log_volume -= shape.log_level
        width = (self.high - self.low)[self._bounded]
        with np.errstate(divide="ignore"):
            y[:, self._bounded] = ndtri((z[:, self._bounded] - self.low[self._bounded]) / width)
            y[:, self._limited] = ndtri_exp(np.minimum(z[:, self._limited] - self.high[self._limited], 0.0))
        log_volume -= self._log_steepness(y)
        return y, log_volume

    def usable(self, z: Matrix) -> tuple[Matrix, Matrix, Vector]:
        """Sampled coordinates that have a finite chart, with it and its log volume."""
        y, log_volume = self.charted(z)
        finite = np.isfinite(y).all(axis=1) & np.isfinite(log_volume)
        return z[finite], y[finite], log_volume[finite]

    def uncharted(self, y: Matrix) -> tuple[Matrix, Flags]:
        """Sampled coordinates of charted coordinates, and which points of the chart have any, (batch,)."""
        z = y.copy()
        width = (self.high - self.low)[self._bounded]
        z[:, self._bounded] = self.low[self._bounded] + width * ndtr(y[:, self._bounded])
        z[:, self._limited] = self.high[self._limited] + log_ndtr(y[:, self._limited])
        exists: Flags = np.asarray(
            ((z > self.low) & (z < self.high)).all(axis=1, where=self._bounded | self._limited)
        )
        exists &= self.terrain.in_order(z)
        for element, frequencies in zip(self.terrain.elements, self._frequencies, strict=True):
            safe = np.where(exists[:, None], z[:, element.orders], 1.0)
            times = element.log_times(y[:, element.following], safe, frequencies)
            exists &= np.isfinite(times).all(axis=1)
            z[:, element.following] = np.where(exists[:, None], times, 0.0)
            level = element.shape(z, frequencies).log_level
            for column, by_logarithm in element.gains:
                z[:, column] = y[:, column] + level if by_logarithm else y[:, column] * np.exp(level)
        return z, np.asarray(exists & np.isfinite(z).all(axis=1))

    def _log_steepness(self, y: Matrix) -> Vector:
        """Log of the product of d coordinate / d probit, (batch,)."""
        probits, limited = y[:, self._bounded], y[:, self._limited]
        width = (self.high - self.low)[self._bounded]
        steep = (np.log(width / np.sqrt(2 * np.pi)) - 0.5 * probits**2).sum(axis=1)
        return np.asarray(steep + (norm.logpdf(limited) - log_ndtr(limited)).sum(axis=1))


def charted_density(posterior: Posterior, chart: Chart, y: Matrix, mapped: Mapped = map) -> Vector:
    """Log posterior density of charted coordinates, (batch,); -inf where the chart has no point.

    `mapped` does portions of a batch, here or in other processes.
    """
    z, exists = chart.uncharted(y)
    out = np.full(len(y), -np.inf)
    if exists.any():
        _, log_volume = chart.charted(z[exists])
        density = posterior.log_density(z[exists]) if mapped is map else spread(posterior, z[exists], mapped)
        out[exists] = density + posterior.table.log_permutations - log_volume
    return out


def spread(posterior: Posterior, z: Matrix, mapped: Mapped) -> Vector:
    """Log density of sampled coordinates portion by portion, (batch,)."""
    size = _PORTION if posterior.simulation is None or posterior.surrogate is not None else _DEAR
    portions = np.array_split(z, max(1, len(z) // size))
    return np.concatenate(list(mapped(posterior.log_density, portions)))
