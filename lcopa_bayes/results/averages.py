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
    return np.concatenate(pooled_parts(values, weights)[0])


def pooled_parts(values: Sequence[Vector], weights: Vector) -> tuple[list[Vector], Vector]:
    """The `pooled` values of each part, in which one draw far out does not count, and the shares of the
    parts; a part that has less than one value is left out."""
    counts = np.round(_DRAWS * weights).astype(int)
    pairs = zip(values, counts, strict=True)
    parts = [_spread(one, (np.arange(n) + 0.5) / n) for one, n in pairs if n]
    return parts, counts[counts > 0] / counts.sum()


def parts_of_sd(values: Sequence[Vector], weights: Vector) -> tuple[float, float]:
    """Standard deviation within and between the components of a mixture, each given by equally probable
    values; NaN where a component with a weight is open. Their squares add up to the mixture's variance."""
    kept = [(one, weight) for one, weight in zip(values, weights, strict=True) if weight > 0]
    if not all(np.isfinite(one).all() for one, _ in kept):
        return np.nan, np.nan
    share = np.array([weight for _, weight in kept])
    means = np.array([one.mean() for one, _ in kept])
    within = float(share @ np.array([one.var() for one, _ in kept]))
    between = float(share @ (means - share @ means) ** 2)
    return float(np.sqrt(within)), float(np.sqrt(between))


def _spread(values: Vector, places: Array) -> Vector:
    method = "linear" if np.isfinite(values).all() else "higher"
    return np.asarray(np.quantile(values, places, method=method))  # type: ignore[call-overload]
