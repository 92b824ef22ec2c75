"""Covariances of parameters with units of their own: no result depends on the units.

A delay in seconds of a device that settles in microseconds has 1e14 times the information of an order. What
is small beside the largest number of such a matrix is not rounding; beside its own diagonal it is.
"""

from __future__ import annotations

import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix

_LEAST = 1e-12
"""Variance along any direction, beside the largest, of parameters in their own sd [-]."""


def covariance_of(information: Array) -> Array:
    """Pseudo-inverse of symmetric matrices (..., k, k), in which every parameter is scaled to information 1.

    Parameters without information get no variance, as directions without it.
    """
    diagonal = np.diagonal(information, axis1=-2, axis2=-1)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    both = scale[..., :, None] * scale[..., None, :]
    return np.asarray(both * np.linalg.pinv(both * information, hermitian=True))


def root_of(covariance: Matrix) -> Matrix:
    """A factor R with R R' the covariance (k, k), regular unless a variance is 0."""
    sd = np.sqrt(np.diag(covariance))
    scale = np.where(sd > 0.0, sd, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray(sd[:, None] * vectors * np.sqrt(np.maximum(values, _LEAST * values.max())))
