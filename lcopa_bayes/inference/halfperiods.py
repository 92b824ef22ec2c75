"""The modes beside that of a lightly damped plant: half a period earlier or later, with the other sign."""

from __future__ import annotations

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.inference.spareterms import possible

_RINGING = 1.75
"""Order of a term above which every swing of its element is more than half as large as the one before [-]."""
_LEAST = 1e-3
"""A delay that would become negative becomes so many half periods, if it is more than half a one [-]."""


def half_a_period_away(posterior: Posterior, values: Vector) -> list[Vector]:
    """Starts in which one delay of table values, (rows,), is half a period of an element behind it shorter or
    longer; none of a plant that does not ring.

    From one swing to the next a response changes its sign: with a gain of the other sign a delay that is half
    a period off follows most of them, and between the two lie delays that follow none. An element ``1 +
    (T s)^order`` with an order near 2 has a period of ``2 pi T``.
    """
    table, layout, out = posterior.table, posterior.table.layout, list[Vector]()
    for path in layout.paths:
        row = table.at("delay", layout.delay_of[path.response][path.drive])
        times, orders = table.terms[layout.element_of[path.response][path.drive]]
        for time, order in zip(times, orders, strict=True) if row in posterior.sampled else ():
            half = np.pi * values[time] if values[order] > _RINGING else 0.0
            for delay in {values[row] - half, values[row] + half} - {values[row]}:
                if delay > -0.5 * half:
                    start = values.copy()
                    start[row] = max(delay, _LEAST * half)
                    out.append(start)
    return possible(posterior, out)
