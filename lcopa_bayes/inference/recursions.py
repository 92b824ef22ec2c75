"""Recursions over the samples of a record: correlated noise as it is drawn and whitened, for many laws."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self, final

import numpy as np
from scipy.linalg.lapack import dpttrf, dpttrs

from lcopa_bayes.core.arrays import Array, Matrix, Vector

_HEAD, _STEADY = 64, 1e-15
"""Samples after which innovation variances of equally spaced samples have mostly settled, and the relative
change from one sample to the next below which they have [-]."""
_FEW = 8
"""Columns from which a product of matrices is faster than scalar products [-]."""


@final
@dataclass(frozen=True, eq=False)
class Filter:
    """Whitening of samples under laws of white noise with a correlated part, ready for any columns.

    By the prediction errors of the scalar Kalman filter of the correlated part.
    ``w_t = y_t - rho**g_t y_{t-1}`` has a tridiagonal covariance for any gaps g, so that its LDL' factors are
    the filter: D holds the innovation variances, and the forward substitution is the recursion of the
    innovations.
    """

    link: Matrix
    """Correlation with the previous sample, (batch, n - 1), or (batch, 1) where all gaps are equal."""
    variances: Vector
    """Innovation variances of the whole batch in one row, (batch n,)."""
    lower: Vector
    """What the next sample takes of an innovation, (batch n - 1,)."""
    samples: int

    @classmethod
    def of(cls, parameters: Matrix, gaps: Vector) -> Self:
        """Of laws (batch, 3): standard deviations of both parts, and the correlation over a gap of 1, at any
        number of samples; FloatingPointError where an innovation has no variance."""
        if not gaps.size:  # LAPACK's wrappers want one
            return cls(np.empty((len(parameters), 0)), np.empty(0), np.empty(0), 0)
        return cls(*factors(parameters, gaps), gaps.size)

    def __call__(self, columns: Array) -> Array:
        """Whitened columns (batch, k, n)."""
        batch, k, n = len(self.link), columns.shape[1], self.samples
        if not n:
            return np.empty((batch, k, 0))
        work = differences(columns, self.link, (k, batch, n))
        # LAPACK solves L D L' x = w for the whole batch at once; innovations are D L' x
        solved = dpttrs(self.variances, self.lower, work.reshape(k, batch * n).T, overwrite_b=1)[0].T
        out = solved.copy()
        out[:, :-1] += self.lower * solved[:, 1:]
        out *= self.scales
        return np.asarray(out.reshape(k, batch, n).swapaxes(0, 1))

    @cached_property
    def scales(self) -> Vector:
        """Innovation standard deviations of the whole batch in one row, (batch n,)."""
        return np.sqrt(self.variances)

    @property
    def log_scales(self) -> Matrix:
        """Their logarithms, (batch, n)."""
        return 0.5 * np.log(self.variances).reshape(len(self.link), self.samples)


def factors(parameters: Matrix, gaps: Vector) -> tuple[Matrix, Vector, Vector]:
    """Correlation with the previous sample, (batch, n - 1), or (batch, 1) where samples are equally
    spaced; of the whole batch in one row, innovation variances, (batch n,), and what the next sample
    takes of an innovation, (batch n - 1,)."""
    white, correlated, rho = parameters[:, :1] ** 2, parameters[:, 1:2] ** 2, parameters[:, 2:]
    with np.errstate(divide="ignore"):  # no correlation: minus infinity, whose exponential is zero
        steps = np.log(rho) * (gaps[1:2] if equal(gaps) else gaps[1:])
    link = np.exp(steps)
    if steps.shape[1] == 1 and gaps.size > 2 * _HEAD:
        _, variances, lower = factors(parameters, gaps[:_HEAD])
        head = variances.reshape(-1, _HEAD)
        if (np.abs(head[:, -1] - head[:, -2]) <= _STEADY * head[:, -1]).all():
            rest = gaps.size - _HEAD
            innovations = np.append(lower, 0.0).reshape(-1, _HEAD)
            innovations[:, -1] = innovations[:, -2]
            variances, lower = (
                np.concatenate([each, np.repeat(each[:, -1:], rest, axis=1)], axis=1)
                for each in (head, innovations)
            )
            lower[:, -1] = 0.0
            return link, variances.ravel(), lower.ravel()[:-1]
    diagonal = np.empty((parameters.shape[0], gaps.size))
    diagonal[:, :1] = correlated + white
    diagonal[:, 1:] = white * (1 + link**2) - correlated * np.expm1(2 * steps)
    beside = np.zeros(diagonal.shape)  # zero from one member of the batch to the next
    beside[:, :-1] = -white * link
    off = beside.ravel()[: max(1, diagonal.size - 1)]  # LAPACK's wrapper wants one where there is none
    variances, lower, failed = dpttrf(diagonal.ravel(), off, 1, 1)
    if failed:
        raise FloatingPointError(f"noise without a positive innovation variance among {parameters}")
    return link, variances, lower


def equal(gaps: Vector) -> bool:
    """Whether samples are equally spaced; the first gap is not used."""
    return bool((gaps[2:] == gaps[1:2]).all())


def scalar_products(a: Array, b: Array) -> Array:
    """Of columns (batch, k, n) of one with columns of another, (batch, k, k)."""
    if a.shape[1] < _FEW:
        return np.asarray(np.vecdot(a[:, :, None], b[:, None]))
    return np.asarray(a @ b.swapaxes(1, 2))


def differences(columns: Array, link: Matrix, shape: tuple[int, int, int]) -> Array:
    """What each sample of columns (batch, k, n) adds to `link` times the one before, (k, batch, n)."""
    work, taken = np.empty(shape), columns.swapaxes(0, 1)
    work[..., 0] = taken[..., 0]
    np.multiply(link, taken[..., :-1], out=work[..., 1:])
    np.subtract(taken[..., 1:], work[..., 1:], out=work[..., 1:])
    return work


def correlated(innovations: Matrix, link: Matrix) -> Matrix:
    """Innovations (batch, n) added up, each to `link` (batch, n - 1), or (batch, 1), times the sum before."""
    out, links = np.ascontiguousarray(innovations.T), np.ascontiguousarray(link.T)
    links = np.broadcast_to(links, (max(0, len(out) - 1), out.shape[1]))
    part = np.empty(out.shape[1:])
    for k, factor in enumerate(links):
        np.multiply(factor, out[k], out=part)
        out[k + 1] += part
    return out.T
