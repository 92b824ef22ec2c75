"""Where a search for the optima of a plant with effects begins: the plant's own optima, and effects that
nearly vanish."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.inference.kinds import COEFFICIENTS, CONSTANTS
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.model.effects.effect import UnstableError

_PLANTS = 3
"""Optima of the plant alone from which effects are started [-]."""
_TRIED = 48
"""Sets of internal constants whose slopes are compared [-]."""
_KEPT = 3
"""Sets of them that are descended from [-]."""
_HARDLY = 1e-2
"""Size of a coefficient that cannot be negative where it should vanish [prior scale]."""


def effect_starts(posterior: Posterior, alone: Sequence[Vector], rng: np.random.Generator) -> list[Vector]:
    """Table values with every effect nearly vanishing, beside the best optima of the plant `alone`,
    (rows,) each.

    Internal constants that are free are drawn from their priors; those are kept whose effects take up most of
    the residual to first order, what the plant can imitate of them aside.
    """
    rows = posterior.table.rows
    plant = [k for k, row in enumerate(rows) if row.kind not in (*COEFFICIENTS, *CONSTANTS)]
    free = [k for k, row in enumerate(rows) if row.kind in CONSTANTS and row.free]
    out: list[Vector] = []
    for values in alone[:_PLANTS]:
        start = np.array([row.value for row in rows])
        start[plant] = values
        for k, row in enumerate(rows):
            if row.kind in COEFFICIENTS and row.prior is not None:
                small = _HARDLY * row.prior.sd if row.kind == "magnitude" else 0.0
                start[k] = small if row.prior.support[0] <= small else float(row.prior.frozen.median())
        out += _with_constants(posterior, start, free, rng) if free else [start]
    return out


def _with_constants(
    posterior: Posterior, start: Vector, free: list[int], rng: np.random.Generator
) -> list[Vector]:
    """The start with constants that promise most."""
    rows = posterior.table.rows
    tried = np.tile(start, (_TRIED, 1))
    for k in free:
        tried[:, k] = rows[k].draw(_TRIED, rng)
    gains = np.array([_gain(posterior, values) for values in tried])
    order = np.argsort(-gains, kind="stable")
    return [tried[k] for k in order[:_KEPT]]


def _gain(posterior: Posterior, values: Vector) -> float:
    """Squared whitened residual that the effects take up to first order beyond the plant [-]."""
    least, kinds = LeastSquares(posterior, exact=False), [row.kind for row in posterior.table.rows]
    try:
        residual, jacobian = least.residual(least.coordinates(values), values)
    except UnstableError:
        return -np.inf
    own = [p for p, k in enumerate(least.columns) if kinds[k] in COEFFICIENTS]
    plant = [p for p, k in enumerate(least.columns) if kinds[k] not in (*COEFFICIENTS, *CONSTANTS)]
    unexplained = residual - _fitted(jacobian[:, plant], residual)
    whole = residual - _fitted(jacobian[:, [*plant, *own]], residual)
    return float(unexplained @ unexplained - whole @ whole)


def _fitted(columns: Matrix, target: Vector) -> Vector:
    return np.asarray(columns @ np.linalg.lstsq(columns, target, rcond=None)[0])
