"""Simultaneous bands: a whole curve lies within one throughout with the probability it states.

A sup-t band is the pointwise one inflated until the largest deviation over all points has the wanted quantile
(Montiel Olea and Plagborg-Moller 2019, J. Appl. Econometrics 34). Here the shape of the band comes from one
half of the draws and its size from the other half, by the order statistic that makes the probability exact
for exchangeable draws whatever the shape (split conformal prediction: Lei et al. 2018, JASA 113). Shape and
size from the same draws would cover too little when points are many and draws few: 0.87 in place of 0.90 for
1000 independent points and 200 draws.
"""

from __future__ import annotations

from math import ceil
from typing import NamedTuple, final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector

POINTWISE = "pointwise"
"""Kind of a band: at each time by itself it holds the response with its probability; a whole curve lies
within it throughout with a smaller one."""
SIMULTANEOUS = "simultaneous"
"""Kind of a band: it holds the whole curve, at all times at once, with its probability."""
LEVELS = (0.5, 0.9)
"""Probabilities inside the bands [-]."""
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
"""Of the pointwise bands and their median."""
QUANTILE_NAMES = ("05", "25", "50", "75", "95")
"""What columns of tables call them."""


@final
class Bands(NamedTuple):
    """Bands of one curve over its points."""

    pointwise: Matrix
    """5, 25, 50, 75, 95 % quantiles, (5, n)."""
    simultaneous: Matrix
    """Lower end at 90 and 50 %, upper end at 50 and 90 %, (4, n)."""

    @classmethod
    def of(cls, curves: Matrix) -> Bands:
        """Bands of curves (draws, n)."""
        quantiles = pointwise(curves)
        return cls(quantiles, simultaneous(curves, quantiles))


def named(name: str, bands: Bands) -> dict[str, Vector]:
    """Columns of a table: the ends of the bands by kind and percentage."""
    columns = {f"{name}_{POINTWISE}_{q}": row for q, row in zip(QUANTILE_NAMES, bands.pointwise, strict=True)}
    rows = zip(("05", "25", "75", "95"), bands.simultaneous, strict=True)
    return columns | {f"{name}_{SIMULTANEOUS}_{q}": row for q, row in rows}


def pointwise(curves: Matrix) -> Matrix:
    """5, 25, 50, 75 and 95 % quantiles of curves (draws, n) at each point, (5, n) [unit of the curves]."""
    return np.asarray(np.quantile(curves, QUANTILES, axis=0))


def simultaneous(curves: Matrix, quantiles: Matrix) -> Matrix:
    """Ends of the simultaneous 50 and 90 % bands of curves (draws, n) around their median.

    Parameters: `quantiles` (5, n) as `pointwise` gives them; a simultaneous band is nowhere narrower.
    Returns: lower end at 90 %, lower at 50 %, upper at 50 %, upper at 90 %, (4, n) [unit of the curves].
    ValueError for fewer than four draws.
    """
    if curves.shape[0] < 4:
        raise ValueError(f"a simultaneous band needs four draws or more; got {curves.shape[0]}")
    middle = quantiles[2]
    shaping, sizing = curves[::2] - middle, curves[1::2] - middle
    below, above = (_deviation(np.maximum(side, 0.0)) for side in (-shaping, shaping))
    reach = np.sort(np.maximum(_largest(sizing, above), _largest(-sizing, below)))
    ends = {}
    for level, (low, high) in zip(LEVELS, ((1, 3), (0, 4)), strict=True):
        size = reach[min(ceil((reach.size + 1) * level), reach.size) - 1]
        ends[level] = (
            np.minimum(quantiles[low], middle - _scaled(size, below)),
            np.maximum(quantiles[high], middle + _scaled(size, above)),
        )
    half, most = (ends[level] for level in LEVELS)
    return np.stack([np.minimum(most[0], half[0]), half[0], half[1], np.maximum(most[1], half[1])])


def _deviation(side: Matrix) -> Vector:
    """Root mean square of one side of the deviations, (n,): positive wherever a single draw departs."""
    return np.asarray(np.sqrt(np.mean(side**2, axis=0)))


def _largest(side: Matrix, scale: Vector) -> Vector:
    """Largest deviation of each curve over the scale, (draws,); infinite where one departs and none did."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(side > 0.0, side / scale, 0.0)
    return np.asarray(ratio.max(axis=1))


def _scaled(size: float, scale: Vector) -> Vector:
    """`size` times the scale; where the scale is 0 nothing departs."""
    with np.errstate(invalid="ignore"):
        return np.where(scale > 0.0, size * scale, 0.0)
