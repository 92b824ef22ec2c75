"""The modes beside that of a lightly damped plant: half a period earlier or later, with the other sign."""

from __future__ import annotations

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.inference.spareterms import possible

_RINGING = 1.75
"""Order of a term above which every swing of its element is more than half as large as the one before [-]."""
_LEAST = 1e-3
"""Half periods that a delay of more than half of one becomes where it would be negative [-]."""


def half_a_period_away(posterior: Posterior, values: Vector) -> list[Vector]:
    """Starts in which one delay of table values, (rows,), is half a period of an element behind it shorter or
    longer; none of a plant that does not ring.

    From one swing to the next a response changes its sign: with a gain of the other sign a delay that is half
    a period off follows most of them, and between the two lie delays that follow none. An element ``1 +
    (T s)^order`` with an order near 2 has a period of ``2 pi T``.
    """
    table, layout, out = posterior.table, posterior.table.layout, list[Vector]()
    slots = {(unit.delay, unit.element) for unit in layout.units}
    for delay, element in sorted(slots):
        row = table.at("delay", delay)
        if row not in posterior.sampled:
            continue
        for time, order in zip(*table.terms[element], strict=True):
            if values[order] <= _RINGING:
                continue
            half = np.pi * values[time]
            for moved in (values[row] - half, values[row] + half):
                if moved > -0.5 * half:
                    start = values.copy()
                    start[row] = max(moved, _LEAST * half)
                    out.append(start)
    return possible(posterior, out)
