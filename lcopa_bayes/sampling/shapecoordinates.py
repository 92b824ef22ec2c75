"""Coordinates that follow the response: an element by its ratios at a few real frequencies.

Orders and time constants of an element trade off along curved ridges on which the response hardly
moves. With ``D(s) = 1 + sum_i c_i s^order_i``, ``c_i = T_i^order_i``, at real s the ratios
``D(s_k) / D(s_0)``, k = 1..terms, fix the element once its orders are given, whatever its gain; and given
ratios and orders the c_i solve a linear system. Moves that hold the ratios follow the ridge.

Where a term is negligible, or of so small an order that it acts as a spring, the ratios do not fix it.
There one term is held: it keeps its own time constant, and one ratio less fixes the others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, final

import numpy as np

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector
from lcopa_bayes.inference.posterior import Posterior


@final
class Shape(NamedTuple):
    """An element at given frequencies, for a batch."""

    log_ratios: Matrix
    """log D(s_k) / D(s_0), (batch, terms that follow)."""
    log_level: Vector
    """log D(s_0), (batch,)."""
    log_volume: Vector
    """log |d log ratios / d log times|, (batch,)."""


@final
@dataclass(frozen=True, eq=False)
class ElementColumns:
    """Columns of an element among the sampled coordinates; its times are sampled by logarithm."""

    number: int
    """Which of the layout's elements it is."""
    times: Index
    orders: Index
    gains: tuple[tuple[int, bool], ...]
    """Sampled gains of the paths that use it: column, and whether sampled by logarithm."""
    reach: tuple[Vector, Vector]
    """Smallest and largest log time a redraw proposes for each term."""
    held: int | None = None
    """Term that keeps its own time constant; None: all follow the ratios."""

    @property
    def terms(self) -> int:
        """Number of viscous terms."""
        return int(self.times.size)

    @property
    def following(self) -> Index:
        """Columns of the times that follow the ratios."""
        return self.times if self.held is None else np.delete(self.times, self.held)

    @property
    def ratios(self) -> int:
        """Number of ratios."""
        return int(self.following.size)

    def holding(self, term: int) -> ElementColumns:
        """The same element with one term held."""
        return replace(self, held=term)

    def shape(self, z: Matrix, frequencies: Vector) -> Shape:
        """Shape of coordinates (batch, dimension) at `frequencies` (ratios + 1,) [1 / time unit]."""
        orders = z[:, self.orders]
        strength = np.exp(orders * z[:, self.times])
        powers = frequencies[None, :, None] ** orders[:, None, :]
        level = 1.0 + (powers * strength[:, None, :]).sum(axis=2)
        steep = powers[:, 1:] / level[:, 1:, None] - powers[:, :1] / level[:, :1, None]
        steep = self._followers(steep * (strength * orders)[:, None, :])
        volume = np.linalg.slogdet(steep)[1]
        return Shape(np.log(level[:, 1:] / level[:, :1]), np.log(level[:, 0]), volume)

    def log_times(
        self, log_ratios: Matrix, orders: Matrix, frequencies: Vector, held_log_time: Vector | None = None
    ) -> Matrix:
        """Log times that follow, (batch, ratios), at these ratios and orders; NaN where there are none.

        `held_log_time` (batch,) is that of the held term, None without one.
        """
        ratios = np.exp(log_ratios)
        powers = frequencies[None, :, None] ** orders[:, None, :]
        rest = np.ones((len(orders), frequencies.size))
        if self.held is not None and held_log_time is not None:
            with np.errstate(over="ignore"):
                rest += np.exp(orders[:, self.held] * held_log_time)[:, None] * powers[:, :, self.held]
        with np.errstate(invalid="ignore", over="ignore"):
            system = self._followers(powers[:, 1:] - ratios[:, :, None] * powers[:, :1])
            wanted = ratios * rest[:, :1] - rest[:, 1:]
        strength = np.full(wanted.shape, np.nan)
        regular = np.flatnonzero(np.isfinite(wanted).all(axis=1) & np.isfinite(system).all(axis=(1, 2)))
        regular = regular[np.abs(np.linalg.det(system[regular])) > 0]
        strength[regular] = np.linalg.solve(system[regular], wanted[regular, :, None])[:, :, 0]
        usable = np.isfinite(strength) & (strength > 0)
        logs: Matrix = np.log(np.where(usable, strength, 1.0)) / self._followers(orders)
        return np.where(usable, logs, np.nan)

    def _followers(self, by_term: Array) -> Array:
        """The entries, along the last axis, of the terms that follow."""
        return by_term if self.held is None else np.delete(by_term, self.held, axis=-1)


def element_columns(posterior: Posterior) -> tuple[ElementColumns, ...]:
    """Columns of every element whose times and orders are all sampled, times by logarithm."""
    table = posterior.table
    column = {k: position for position, k in enumerate(posterior.sampled)}
    out = []
    for e, slot in enumerate(table.layout.elements):
        times = [table.at("time", e, k) for k in range(slot.terms)]
        orders = [table.at("order", e, k) for k in range(slot.terms)]
        if not all(k in column for k in times + orders):
            continue
        gains = [
            table.at("gain", i, j)
            for i, row in enumerate(table.layout.element_of)
            for j, element in enumerate(row)
            if element == e
        ]
        reach = np.log([table.rows[k].quantiles((1e-4, 1 - 1e-4)) for k in times])
        out.append(
            ElementColumns(
                e,
                np.array([column[k] for k in times]),
                np.array([column[k] for k in orders]),
                tuple((column[k], table.rows[k].log_scale) for k in gains if k in column),
                (reach[:, 0], reach[:, 1]),
            )
        )
    return tuple(out)
