"""What a fit says of samples it is not shown: each record, or each fifth of a single one, left out in turn.

Closed form of the linearised model. With whitened residual r and tangents J at the optimum, information
``H = J' J + prior`` and group k, the optimum without the group is one Gauss-Newton step away,
``x - (H - J_k' J_k)^-1 J_k' r_k``, and its predictive density follows without a refit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lcopa_bayes.core.arrays import Index, Matrix, Vector
from lcopa_bayes.effectsearch.regression import Optimum
from lcopa_bayes.effectsearch.whitening import Whitening

PARTS = 5
"""Parts of a single record that are left out in turn [-]."""
_STRETCHES = 10
"""Stretches of successive samples in each part [-]."""


def groups(whitening: Whitening) -> list[Index]:
    """Positions in the stack: of each record; of a single one every fifth of 50 stretches of successive
    samples, all axes alike.

    One fifth in one piece would take away the only step of a record, and nothing predicts a step not seen.
    """
    records: dict[int, list[Index]] = {}
    for part in whitening.parts:
        records.setdefault(part.record, []).append(np.arange(part.rows.start, part.rows.stop))
    if len(records) > 1:
        return [np.concatenate(axes) for axes in records.values()]
    (axes,) = records.values()
    cut = [np.array_split(rows, PARTS * _STRETCHES) for rows in axes]
    return [np.concatenate([stretch for each in cut for stretch in each[k::PARTS]]) for k in range(PARTS)]


def in_turn(records: int) -> str:
    """In words, what is left out of that many records."""
    if records > 1:
        return "leaving records out in turn"
    return f"leaving each of {PARTS} parts of the only record out in turn"


def log_scores(optimum: Optimum, chosen: Sequence[Index]) -> Vector:
    """Log predictive density of each group given the others, without the constant of the noise [nat]."""
    whole = np.linalg.slogdet(optimum.information)[1]
    out = []
    for rows in chosen:
        tangents, residual = optimum.jacobian[rows], optimum.settled[rows]
        rest = optimum.information - tangents.T @ tangents
        pull = tangents.T @ residual
        power = residual @ residual + pull @ np.linalg.solve(rest, pull)
        out.append(-0.5 * power + 0.5 * (np.linalg.slogdet(rest)[1] - whole))
    return np.array(out)


def shifts(optimum: Optimum, chosen: Sequence[Index]) -> list[tuple[Vector, Matrix]]:
    """For each group, how far the optimum moves when it is left out, and the covariance there."""
    out = []
    for rows in chosen:
        tangents, residual = optimum.jacobian[rows], optimum.settled[rows]
        covariance: Matrix = np.linalg.inv(optimum.information - tangents.T @ tangents).astype(float)
        out.append((-covariance @ (tangents.T @ residual), covariance))
    return out
