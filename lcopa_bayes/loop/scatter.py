"""Evidence that a residual is scattered otherwise than by Gaussian noise: a few samples far outside."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter
from scipy.special import logsumexp

from lcopa_bayes.arrays import Vector

_SHARES = (1e-3, 5e-3, 3e-2)
"""Shares of outliers tried [-]."""
_WIDTHS = (6.0, 30.0)
"""Standard deviations of an outlier over that of the noise tried [-]."""

_NEIGHBOURS = 5


def scatter_evidence(white: Vector) -> float:
    """Log Bayes factor of a mixture of N(0, 1) and rare wide outliers against N(0, s^2) [nat].

    Averaged over shares and widths. Each sample is taken against the median of itself and its four
    neighbours, so that a smooth residual is no outlier; both scales are the best ones (root mean square, median
    absolute value), so that noise merely larger than thought is none either.
    """
    white = white - median_filter(white, _NEIGHBOURS, mode="nearest")
    scale = float(np.sqrt(np.mean(white**2)))
    if scale == 0:
        return 0.0
    kept = np.abs(white[white != 0.0])  # a fifth of the samples are their own median
    core = min(scale, float(np.median(kept)) / 0.6744897501960817) if kept.size else 0.0
    plain = -0.5 * (white / scale) ** 2 - np.log(scale)
    if core == 0:
        return 0.0
    z2 = (white / core) ** 2
    found = []
    for share in _SHARES:
        for width in _WIDTHS:
            inner = np.log1p(-share) - 0.5 * z2
            outer = np.log(share / width) - 0.5 * z2 / width**2
            found.append(float((np.logaddexp(inner, outer) - np.log(core) - plain).sum()))
    return float(logsumexp(found) - np.log(len(found)))
