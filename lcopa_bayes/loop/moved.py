"""What an undeclared effect had done to the parameters the user came for."""

from __future__ import annotations

from typing import Any

import numpy as np

from lcopa_bayes.loop.loop import Loop

FAR = 2.0
"""Shifts beyond so many standard deviations are listed [-]."""


def moved(found: Loop) -> list[dict[str, Any]]:
    """Plant parameters that the effects moved by more than two standard deviations of the fit with them."""
    if not found.effects:
        return []
    before, after = found.before.state, found.after.state
    base, n = found.base.model, after.model.plant_size
    first, last = base.values(before.optimum.x), base.values(after.optimum.x[:n])
    sds = np.sqrt(np.diag(after.covariance))[:n]
    out = []
    rows = base.posterior.table.rows
    for position, k in enumerate(base.least.columns):
        shift = (after.optimum.x[position] - before.optimum.x[position]) / sds[position]
        if abs(shift) > FAR:
            row = rows[k]
            out.append(
                {
                    "name": row.name,
                    "unit": row.unit,
                    "before": first[k],
                    "after": last[k],
                    "shift_in_sd": shift,
                }
            )
    return sorted(out, key=lambda row: -abs(row["shift_in_sd"]))
