"""Coordinates that follow the response: an element by its ratios at a few real frequencies.

Orders and time constants of an element trade off along curved ridges on which the response hardly
moves. With ``D(s) = 1 + sum_i c_i s^order_i``, ``c_i = T_i^order_i``, at real s the ratios
``D(s_k) / D(s_0)``, k = 1..terms, fix the element once its orders are given, whatever its gain; and given
ratios and orders the c_i solve a linear system. Moves that hold the ratios follow the ridge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np

from lcopa_bayes.arrays import Index, Matrix, Vector
from lcopa_bayes.inference.posterior import Posterior


class Shape(NamedTuple):
    """An element at given frequencies, for a batch."""

    log_ratios: Matrix
    """log D(s_k) / D(s_0), (batch, terms)."""
    log_level: Vector
    """log D(s_0), (batch,)."""
    log_volume: Vector
    """log |d log ratios / d log times|, (batch,)."""


@final
@dataclass(frozen=True, eq=False)
class ElementColumns:
    """Where an element stands among the sampled coordinates; its times are sampled by logarithm."""

    number: int
    """Which of the layout's elements it is."""
    times: Index
    orders: Index
    gains: tuple[tuple[int, bool], ...]
    """Sampled gains of the paths that use it: column, and whether sampled by logarithm."""
    reach: tuple[Vector, Vector]
    """Smallest and largest log time a redraw proposes for each term."""

    @property
    def terms(self) -> int:
        """Number of viscous terms."""
        return int(self.times.size)

    def shape(self, z: Matrix, frequencies: Vector) -> Shape:
        """Shape of coordinates (batch, dimension) at `frequencies` (terms + 1,) [1 / time unit]."""
        orders = z[:, self.orders]
        strength = np.exp(orders * z[:, self.times])
        powers = frequencies[None, :, None] ** orders[:, None, :]
        level = 1.0 + (powers * strength[:, None, :]).sum(axis=2)
        steep = powers[:, 1:] / level[:, 1:, None] - powers[:, :1] / level[:, :1, None]
        volume = np.linalg.slogdet(steep * (strength * orders)[:, None, :])[1]
        return Shape(np.log(level[:, 1:] / level[:, :1]), np.log(level[:, 0]), volume)

    def log_times(self, log_ratios: Matrix, orders: Matrix, frequencies: Vector) -> Matrix:
        """Log time constants with these ratios at these orders, (batch, terms); NaN where there are none."""
        ratios = np.exp(log_ratios)
        powers = frequencies[None, :, None] ** orders[:, None, :]
        system = powers[:, 1:] - ratios[:, :, None] * powers[:, :1]
        strength = np.full(orders.shape, np.nan)
        regular = np.abs(np.linalg.det(system)) > 0
        strength[regular] = np.linalg.solve(system[regular], (ratios - 1.0)[regular, :, None])[:, :, 0]
        usable = np.isfinite(strength) & (strength > 0)
        logs: Matrix = np.log(np.where(usable, strength, 1.0)) / orders
        return np.where(usable, logs, np.nan)


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
        priors = [table.rows[k].prior for k in times]
        reach = np.log([prior.frozen.ppf((1e-4, 1 - 1e-4)) for prior in priors if prior is not None])
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
