"""Differences of predictions between candidates, with errors that know that neighbours err together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lcopa_bayes.arrays import Index, Vector

BLOCKS = 10
"""Stretches of each axis of each predicted part whose sums tell the error of a total [-]."""
Card = Mapping[str, Any]


def difference(one: Card, other: Card) -> tuple[float, float]:
    """Total of log predictive densities of one less another, with its standard error [nat]."""
    gap = np.array(one["pointwise"]["log_density"]) - np.array(other["pointwise"]["log_density"])
    where = stretches(one["pointwise"])
    return float(gap.sum()), total_sd(np.array([gap[where == block].sum() for block in np.unique(where)]))


def total_sd(sums: Vector) -> float:
    """Standard error of a total from the spread of the sums of its stretches [nat]."""
    return float(np.sqrt(sums.size) * np.std(sums, ddof=1)) if sums.size > 1 else float("nan")


def stretches(pointwise: Mapping[str, Sequence[Any]]) -> Index:
    """Number of the stretch each predicted sample belongs to: samples next to each other err together."""
    series = [f"{part}\0{axis}" for part, axis in zip(pointwise["part"], pointwise["axis"], strict=True)]
    out = np.zeros(len(series), dtype=np.intp)
    count = 0
    for name in dict.fromkeys(series):
        at = np.flatnonzero(np.array([one == name for one in series]))
        for piece in np.array_split(at, min(BLOCKS, at.size)):
            out[piece] = count
            count += 1
    return out
