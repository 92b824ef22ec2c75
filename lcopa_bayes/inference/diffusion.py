"""Diffusion as a sum of infinitely many lags: what a path through a wall or into a layer is.

    wall:   1 / cosh sqrt(s c)          layer:   tanh sqrt(s c) / sqrt(s c)

are the insulated face of a slab whose other face follows the drive, and the mean over the slab (Carslaw and
Jaeger 1959, Conduction of Heat in Solids, 3.4). Both have the time constants ``T / (2k + 1)^2``,
``T = 4 c / pi^2``, and weights in fixed proportions, so that one has no more coordinates than a lag, and an
onset that no few lags have: they follow a wall, which begins exponentially slowly, by a longer delay, and a
layer, which begins with the square root of time, by a shorter one.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Literal, get_args

import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.inference.lagsum import LagTable, cubic

Kind = Literal["lags", "wall", "layer"]
"""What the first component of a path is: a lag as all others, or diffusion through a wall or into a layer."""
KINDS: tuple[Kind, ...] = get_args(Kind)
_MODES = 60
"""Lags of a series; what the others add is in the last [-]."""
_TABULATED = 1 << 15
"""Places between which the response of a series is linear in the root of time [-]."""


def series(kind: Kind) -> tuple[Vector, Vector]:
    """Time constants over the slowest, and weights, which add up to 1, (modes,)."""
    if kind == "lags":
        return np.ones(1), np.ones(1)
    k = np.arange(_MODES)
    odd = 2 * k + 1
    weights = 4 / np.pi * (-1.0) ** k / odd if kind == "wall" else 8 / np.pi**2 / odd**2
    weights[-1] = 1 - weights[:-1].sum()
    return 1.0 / odd**2, weights


def rises(kind: Kind, since: Array, time: Array) -> Array:
    """Share of the steady response `since` the delay after a step, with the slowest time constant `time`, in
    the shape of both together; of diffusion to 1e-6."""
    if kind == "lags":
        return np.asarray(-np.expm1(-since / time))
    return np.interp(np.sqrt(since / time), *_tabulated(kind))


@cache
def _tabulated(kind: Kind) -> tuple[Vector, Vector]:
    """Roots of times over the slowest time constant, and the share of the steady response there: a layer
    begins with the root of time. After the last of them exp(-36) is left."""
    root = np.linspace(0.0, 6.0, _TABULATED)
    pairs = zip(*series(kind), strict=True)
    return root, np.sum([-weight * np.expm1(-(root**2) / ratio) for ratio, weight in pairs], axis=0)


def diffused(table: LagTable, kind: Kind) -> LagTable:
    """A table of lags whose paths begin with a component of this kind, tabulated at the same times.

    Lags shorter than those that are tabulated are the shortest of these, a small part of a sampling period.
    """
    if kind == "lags":
        return table
    of_lags = _interpolating(table.log_times, *series(kind))
    own = np.einsum("tu,pudk->ptdk", of_lags, table.responses[0], optimize=True)
    return replace(table, responses=np.stack([table.responses[0], own]))


def _interpolating(log_times: Vector, ratios: Vector, weights: Vector) -> Matrix:
    """Shares of the tabulated lags in a series with each tabulated time, (times, times)."""
    out, step = np.zeros((log_times.size, log_times.size)), log_times[1] - log_times[0]
    for row, slowest in zip(out, log_times, strict=True):
        at = np.maximum(slowest + np.log(ratios) - log_times[0], 0.0) / step
        first = np.clip(np.floor(at).astype(int) - 1, 0, log_times.size - 4)
        for node, share in enumerate(cubic(at - first)):
            np.add.at(row, first + node, weights * share)
    return out
