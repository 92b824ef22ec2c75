"""Numbers over several plants: mixtures whose parts are given by draws."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lcopa_bayes.core.arrays import Array, Vector

_DRAWS = 4000
"""Draws of all parts together [-]."""


def pooled(values: Sequence[Vector], weights: Vector) -> Vector:
    """Equally probable values of a mixture whose parts are given by equally probable values, perhaps
    infinite."""
    return np.concatenate(_pooled_parts(values, weights))


def parts_of_sd(values: Sequence[Vector], weights: Vector) -> tuple[float, float]:
    """Standard deviation within and between the components of a mixture, each given by equally probable
    values; NaN where a component with a weight is open. Their squares add up to the variance of the values
    that are `pooled`, which one draw far out does not decide."""
    if not all(np.isfinite(one).all() for one, weight in zip(values, weights, strict=True) if weight > 0):
        return np.nan, np.nan
    parts = _pooled_parts(values, weights)
    share = np.array([one.size for one in parts]) / sum(one.size for one in parts)
    means = np.array([one.mean() for one in parts])
    within = float(share @ np.array([one.var() for one in parts]))
    between = float(share @ (means - share @ means) ** 2)
    return float(np.sqrt(within)), float(np.sqrt(between))


def _pooled_parts(values: Sequence[Vector], weights: Vector) -> list[Vector]:
    """Values of each part, as many as its weight stands for; none of a part that stands for less than one."""
    counts = np.round(_DRAWS * weights).astype(int)
    pairs = zip(values, counts, strict=True)
    return [_spread(one, (np.arange(n) + 0.5) / n) for one, n in pairs if n]


def _spread(values: Vector, places: Array) -> Vector:
    method = "linear" if np.isfinite(values).all() else "higher"
    return np.asarray(np.quantile(values, places, method=method))  # type: ignore[call-overload]
