"""Importance weights smoothed by a generalised Pareto tail or tempered, and diagnostics of their reliability.

Vehtari, Simpson, Gelman, Yao and Gabry 2024, JMLR 25. The only place that calls the library: its function
takes the logarithm of the *inverse* weights, as of likelihoods that are to be taken away.
"""

from __future__ import annotations

from math import log10

import numpy as np
from arviz_stats.base import array_stats  # type: ignore[attr-defined]
from scipy.special import logsumexp

from lcopa_bayes.core.arrays import Vector

LARGEST_K = 0.7
"""Largest Pareto k of usable importance weights [-] (Vehtari et al. 2024)."""
FEWEST_EFFECTIVE = 100.0
"""Effective draws below which importance weights are not used [-]."""
_FEWEST_DRAWS = 50
"""Draws without which there is no tail to fit."""
_EQUAL = 1e-12
"""Range of the largest log weights below which they are equal [nat]."""


def smoothed(log_weights: Vector, *, r_eff: float = 1.0) -> tuple[Vector, float]:
    """Normalised log weights with a smoothed upper tail, and the Pareto k of that tail.

    `log_weights` (draws,) are those of the target over the source, up to a constant [nat]; `r_eff` is the
    effective sample size of the draws over their number [-]. k is NaN, and nothing is smoothed, where the
    largest weights are equal or the draws too few for a tail.
    """
    if log_weights.size < _FEWEST_DRAWS or _bounded(log_weights):
        return np.asarray(log_weights - logsumexp(log_weights)), float("nan")
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):  # no finite tail: k is far above 1
        smoothed, k = array_stats.psislw(-log_weights, r_eff=r_eff)  # type: ignore[no-untyped-call]
    out = np.asarray(smoothed, dtype=float)
    return np.asarray(out - logsumexp(out)), float(k)


def usable_k(draws: int) -> float:
    """Largest Pareto k at which weights of so many draws are used [-] (Vehtari et al. 2024, Sec. 3.2.4)."""
    return min(LARGEST_K, 1 - 1 / log10(max(draws, 2)))


def effective(log_weights: Vector) -> float:
    """Effective sample size of normalised weights, ``1 / sum w^2`` [draws]."""
    return float(np.exp(-logsumexp(2 * log_weights)))


def _bounded(log_weights: Vector) -> bool:
    """Whether the largest weights are many and equal, as of a density with a plateau."""
    largest = np.sort(log_weights)[-max(5, log_weights.size // 50) :]
    return bool(largest[-1] - largest[0] <= _EQUAL)


def tempered(log_weights: Vector, wanted: float) -> Vector:
    """Normalised weights to the largest power up to 1 that leaves as many effective draws as are wanted; half
    of the draws with any weight where that is less."""
    wanted = min(wanted, 0.5 * np.count_nonzero(np.isfinite(log_weights)))
    power = 1.0
    while effective(power * log_weights - logsumexp(power * log_weights)) < wanted:
        power *= 0.9
    return np.asarray(np.exp(power * log_weights - logsumexp(power * log_weights)))
