"""Evidence that a residual is scattered otherwise than by Gaussian noise: a few samples far outside."""

from __future__ import annotations

import numpy as np
from scipy.special import logsumexp

from lcopa_bayes.core.arrays import Vector

_SHARES = (1e-3, 5e-3, 3e-2)
"""Shares of outliers tried [-]."""
_WIDTHS = (6.0, 30.0)
"""Standard deviations of an outlier over that of the noise tried [-]."""


def scatter_evidence(white: Vector) -> float:
    """Log Bayes factor of a mixture of N(0, s^2) and rare wide outliers against N(0, s^2) [nat].

    Averaged over shares and widths, each s at its best. Samples are taken against the mean of their two
    neighbours, so that a smooth residual is no outlier; every other sample makes these differences nearly
    independent, and the evidence is the mean of both halves.
    """
    apart = white[1:-1] - 0.5 * (white[:-2] + white[2:])
    return 0.5 * (_mixture(apart[::2]) + _mixture(apart[1::2]))


def _mixture(apart: Vector) -> float:
    scale = float(np.sqrt(np.mean(apart**2))) if apart.size else 0.0
    core = min(scale, float(np.median(np.abs(apart))) / 0.6744897501960817) if apart.size else 0.0
    if core == 0.0:
        return 0.0
    plain = -0.5 * (apart / scale) ** 2 - np.log(scale)
    z2 = (apart / core) ** 2
    found = []
    for share in _SHARES:
        for width in _WIDTHS:
            inner = np.log1p(-share) - 0.5 * z2
            outer = np.log(share / width) - 0.5 * z2 / width**2
            found.append(float((np.logaddexp(inner, outer) - np.log(core) - plain).sum()))
    return float(logsumexp(found) - np.log(len(found)))
