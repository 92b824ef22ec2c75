"""Least squares from several starts at once, of a plant without effects.

A response of one plant costs hardly less than those of several together, and descents are many where a
posterior may have several modes. They follow Levenberg and Marquardt with the slopes of `expansion`, in the
coordinates of `LeastSquares`, linear parameters eliminated at every step (Kaufman 1975, BIT 15).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, final

import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.inference.expansion import expanded
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.posterior import Posterior

_DAMPING = (1e-2, 1e-9, 1e6)
"""Damping at the start, least and most, relative to the curvature [-]."""
_AGREEING, _CLOSE = 0.25, 0.75
"""Gains over those promised above which damping stays, and above which it falls [-]."""
_LESS, _MORE = 0.1, 4.0
"""Factors on a damping that falls and on one that grows [-]."""
_FREE = 1.0
"""Largest damping at which a step that promises little shows an optimum [-]."""
_FASTER, _HOPELESS = 100.0, 50.0
"""How many times faster than a step promises a descent may go on, and how far below the best of its batch it
then stays where it cannot matter [-, nat]."""


@final
class _Place(NamedTuple):
    """Plants and what a descent knows there, (batch, ...)."""

    values: Matrix
    """Table values, (batch, rows)."""
    level: Vector
    """Log likelihood and normal priors [nat]."""
    gradient: Matrix
    """In the search coordinates, (batch, size)."""
    information: Array
    """(batch, size, size)."""


@final
@dataclass(frozen=True, eq=False)
class Descents:
    """Descents of a posterior's plant parameters at fixed noise parameters."""

    posterior: Posterior

    @cached_property
    def _problem(self) -> LeastSquares:
        return LeastSquares(self.posterior)

    @cached_property
    def _columns(self) -> list[int]:
        """Table positions of the sampled plant parameters."""
        return [k for k in self._problem.columns if k in self.posterior.sampled]

    def solve(self, values: Matrix, *, steps: int, enough: float) -> Matrix:
        """Table values where descents from others end, (batch, rows): after so many `steps` at most, or where
        one gains less than `enough` of the sum of squares of the noise, or those that remain promise too
        little to come near the best of the batch."""
        at = self._at(values.copy())
        damping, gained = np.full(len(values), _DAMPING[0]), np.full(len(values), np.inf)
        moving, least = np.arange(len(values)), enough * 0.5 * self.posterior.size
        for remaining in range(steps, 0, -1):
            here = _Place(*(part[moving] for part in at))
            proposed, promised = self._proposed(here, damping[moving])
            likely = np.minimum(promised, gained[moving])
            hopeless = here.level + _FASTER * remaining * likely + _HOPELESS < at.level.max()
            going = ~hopeless & ((promised >= least) | (damping[moving] > _FREE)) & (gained[moving] >= least)
            moving, promised = moving[going], promised[going]
            if not moving.size:
                break
            new = self._at(proposed[going])
            gain = new.level - at.level[moving]
            better, agreeing = gain > 0.0, gain > _AGREEING * promised
            for old, now in zip(at, new, strict=True):
                old[moving[better]] = now[better]
            gained[moving[agreeing]] = gain[agreeing]
            change = np.select([gain > _CLOSE * promised, agreeing], [_LESS, 1.0], _MORE)
            damping[moving] = np.clip(change * damping[moving], *_DAMPING[1:])
        return at.values

    def _at(self, values: Matrix) -> _Place:
        """What a descent knows at canonical table values."""
        rows, columns = self.posterior.table.rows, self._columns
        expansion = expanded(self.posterior, values, columns)
        steepness = np.ones((len(values), len(columns)))
        for position, k in enumerate(columns):
            if rows[k].log_scale and rows[k].kind != "time":  # slopes of times are in their logarithms
                steepness[:, position] = values[:, k]
        level = expansion.log_likelihood.copy()
        gradient = steepness * expansion.gradient
        information = steepness[:, :, None] * expansion.information * steepness[:, None, :]
        for k, mean, sd in self._problem.normal:
            if k in columns:
                position, apart = columns.index(k), (values[:, k] - mean) / sd
                level -= 0.5 * apart**2
                gradient[:, position] -= apart / sd
                information[:, position, position] += 1 / sd**2
        level[~np.isfinite(gradient).all(axis=1) | ~np.isfinite(information).all(axis=(1, 2))] = -np.inf
        return _Place(values, level, gradient, information)

    def _proposed(self, here: _Place, damping: Vector) -> tuple[Matrix, Vector]:
        """Canonical table values one step on, within the bounds around each place, and the gain that the
        slopes promise there, (batch,) [nat]."""
        rows, problem = self.posterior.table.rows, self._problem
        chosen = [problem.columns.index(k) for k in self._columns]
        ends = np.array([problem.bounds_around(one) for one in here.values])[:, :, chosen]
        x = np.array([problem.coordinates(one) for one in here.values])[:, chosen]
        step = _step(here, damping, ends[:, 0] - x, ends[:, 1] - x)
        out = here.values.copy()
        for position, k in enumerate(self._columns):
            out[:, k] = rows[k].value_at(x[:, position] + step[:, position])
        bent = (here.information @ step[..., None])[..., 0]
        gain = (step * (here.gradient - 0.5 * bent)).sum(axis=1)
        return self.posterior.table.canonical(out), gain


def _step(here: _Place, damping: Vector, low: Matrix, high: Matrix) -> Matrix:
    """Damped steps, (batch, size), from `low` to `high`; what would leave these ends there, and the others
    follow."""
    scale = np.sqrt(np.maximum(np.diagonal(here.information, axis1=1, axis2=2), 1e-300))
    curved = here.information / scale[:, :, None] / scale[:, None, :]
    curved += damping[:, None, None] * np.eye(scale.shape[1])
    slope = here.gradient / scale
    step = np.linalg.solve(curved, slope[..., None])[..., 0] / scale
    held = (step < low) | (step > high)
    if held.any():
        ends = np.where(held, np.clip(step, low, high), 0.0)
        slope = np.where(held, 0.0, slope - (curved @ (ends * scale)[..., None])[..., 0])
        free = ~held
        curved = curved * (free[:, :, None] & free[:, None, :]) + np.eye(scale.shape[1]) * held[:, :, None]
        step = np.where(held, ends, np.linalg.solve(curved, slope[..., None])[..., 0] / scale)
    return np.clip(step, low, high)
