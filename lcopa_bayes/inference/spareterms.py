"""The mode beside another that a term more than records need makes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.inference.posterior import Posterior

_CONSTANT, _BARELY = 0.1, 0.02
"""Order below which a term is nearly a constant, and that of one which is to become one [-]."""
_BESIDE = (0.9, 0.3)
"""Order and time of a constant that is to become a term, over those of the term before [-]."""


def beside_spare_terms(posterior: Posterior, near: Matrix) -> list[Vector]:
    """Starts in the mode beside that of the best, which a term more than records need makes, unless one of
    the optima `near` it, (count, rows) best first, is in it.

    Of order 0 the last term of an element is a constant: it doubles the gains and stretches the times of the
    terms before it. Where it is one already, it becomes a term beside the one before.
    """
    table, out, best = posterior.table, list[Vector](), near[0]
    for times, orders in table.terms:
        last = orders[-1]
        constant = near[:, last] < _CONSTANT
        if constant.any() and not constant.all():
            continue
        low, high = table.rows[last].sampled_domain
        if len(orders) < 2 or table.rows[last].prior is None or not low < _CONSTANT < high:
            continue
        if best[last] < _CONSTANT:
            starts = [best.copy()]
            starts[0][last] = _BESIDE[0] * best[orders[-2]]
            starts[0][times[-1]] = _BESIDE[1] * best[times[-2]]
        else:  # the last term, or the fastest, which slower ones outlive
            starts = []
            for omitted in {len(orders) - 1, int(np.argmin(best[times]))}:
                kept = [k for k in range(len(orders)) if k != omitted]
                values = best.copy()
                values[orders[:-1]], values[times[:-1]] = best[orders][kept], best[times][kept]
                values[last], values[times[-1]] = low + _BARELY, best[times[omitted]]
                starts.append(values)
        out += possible(posterior, starts)
    return out


def possible(posterior: Posterior, starts: Sequence[Vector]) -> list[Vector]:
    """Those of some table values, (rows,) each, that have a density."""
    if not starts:
        return []
    density = posterior.log_density(posterior.coordinates(np.array(starts)))
    return [one for one, level in zip(starts, density, strict=True) if np.isfinite(level)]
