"""New times and gains of an element at new orders, its response held or moved at a few frequencies.

With ``D(s) = 1 + sum_i c_i s^order_i``, ``c_i = T_i^order_i``, and A the matrix of ``s_k^order_i``, after a
column of ones, at terms + 1 real frequencies s_k: the response ``gain / D(s_k)`` is multiplied by
``exp(gain_step - step_k)`` when

    (y_0, y) = A'^-1 diag(exp(step)) A (1, c),   c' = y / y_0,   gain' = gain exp(gain_step) / y_0,

whatever the new orders in A'. The homography from c to c' has the Jacobian
``|det A| exp(sum_k step_k) / (|det A'| y_0^(terms + 1))``; the opposite steps reverse it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Array, Flags, Index, Matrix, Vector
from lcopa_bayes.inference.posterior import Posterior


@final
@dataclass(frozen=True, eq=False)
class Element:
    """Columns of an element among the sampled coordinates; all its times are sampled, by logarithm."""

    times: Index
    orders: Index
    """Empty when the orders are fixed."""
    fixed_orders: Vector
    """Orders [-]; empty when they are sampled."""
    gains: tuple[tuple[int, bool], ...]
    """Sampled gains of the paths that use it: column, and whether sampled by logarithm."""

    @property
    def columns(self) -> Index:
        """All columns."""
        gains = np.array([column for column, _ in self.gains], dtype=np.intp)
        return np.concatenate([self.times, self.orders, gains])

    def log_level(self, z: Matrix, log_frequencies: Matrix) -> Matrix:
        """log D at each frequency, (batch, terms + 1)."""
        matrix, strengths = self._parts(z, log_frequencies)
        return np.asarray(np.log(np.einsum("bki,bi->bk", matrix, strengths)))

    def followed(
        self, z: Matrix, proposed: Matrix, log_frequencies: Matrix, step: Matrix
    ) -> tuple[Matrix, Vector]:
        """`proposed` with times and gains of the homography from `z`, and the log of its Jacobian.

        `proposed` (batch, dimension) gives the new orders and, where sampled by logarithm, the gains
        with their step added; gains sampled as they are have gain_step 0 and `proposed` as in `z`.
        Where orders leave (0, 2] or do not decrease, or a strength comes out negative, the Jacobian is 0
        (log -inf) and the coordinates are those of `z`.
        """
        was, now = self._order(z), self._order(proposed)
        possible: Flags = np.all((now > 0) & (now <= 2), axis=1) & np.isfinite(proposed).all(axis=1)
        possible &= np.all(np.diff(now, axis=1) < 0, axis=1)
        out = np.where(possible[:, None], proposed, z)
        now = self._order(out)
        before, strengths = self._parts(z, log_frequencies)
        after, _ = self._parts(out, log_frequencies)
        log_det, new_log_det = np.linalg.slogdet(before)[1], np.linalg.slogdet(after)[1]
        possible &= np.isfinite(log_det) & np.isfinite(new_log_det)
        after[~possible] = np.eye(after.shape[1])
        response = np.einsum("bki,bi->bk", before, strengths) * np.exp(step)
        solved = np.linalg.solve(after, response[:, :, None])[:, :, 0]
        possible &= np.all(np.isfinite(solved) & (solved > 0), axis=1)
        logs = np.log(np.where(possible[:, None], solved, 1.0))
        level, times = logs[:, 0], (logs[:, 1:] - logs[:, :1]) / now
        log_jacobian = log_det - new_log_det + step.sum(axis=1) - logs.shape[1] * level
        # between volumes of c and of log T: dc = c order dlog T
        log_jacobian += (was * z[:, self.times] + np.log(was)).sum(axis=1)
        log_jacobian -= (now * times + np.log(now)).sum(axis=1)
        out[:, self.times] = times
        for column, by_logarithm in self.gains:
            if by_logarithm:
                out[:, column] -= level
            else:
                out[:, column] *= np.exp(-level)
                log_jacobian -= level
        out[~possible] = z[~possible]
        return out, np.where(possible, log_jacobian, -np.inf)

    def _order(self, z: Matrix) -> Matrix:
        return z[:, self.orders] if self.orders.size else np.tile(self.fixed_orders, (z.shape[0], 1))

    def _parts(self, z: Matrix, log_frequencies: Matrix) -> tuple[Array, Matrix]:
        """A, (batch, terms + 1, terms + 1), and (1, c), (batch, terms + 1)."""
        orders = self._order(z)
        powers = np.exp(log_frequencies[:, :, None] * orders[:, None, :])
        matrix = np.concatenate([np.ones((*log_frequencies.shape, 1)), powers], axis=2)
        strengths = np.exp(orders * z[:, self.times])
        return matrix, np.concatenate([np.ones((z.shape[0], 1)), strengths], axis=1)


def elements(posterior: Posterior) -> tuple[Element, ...]:
    """Every element whose times are all sampled and whose orders are all sampled or all fixed."""
    table, column = posterior.table, {k: c for c, k in enumerate(posterior.sampled)}
    out = []
    for e, slot in enumerate(table.layout.elements):
        times, orders = ([table.at(kind, e, k) for k in range(slot.terms)] for kind in ("time", "order"))
        free = [k in column for k in orders]
        if not all(k in column for k in times) or any(free) != all(free):
            continue
        gains = [
            table.at("gain", i, j)
            for i, row in enumerate(table.layout.element_of)
            for j, element in enumerate(row)
            if element == e
        ]
        out.append(
            Element(
                np.array([column[k] for k in times], dtype=np.intp),
                np.array([column[k] for k in orders if k in column], dtype=np.intp),
                np.array([table.rows[k].value for k in orders if k not in column]),
                tuple((column[k], table.rows[k].log_scale) for k in gains if k in column),
            )
        )
    return tuple(out)
