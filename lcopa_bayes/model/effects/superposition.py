"""Sums of one shape over all changes of a drive."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.signal import fftconvolve

from lcopa_bayes.core.arrays import Array, Vector
from lcopa_bayes.data.drive import AxisDrive

_MANY = 64
"""Changes above which a convolution is worth while [-]."""
_ROUNDING = 1e-4
"""How far printed times may lie from an even grid [periods]."""


def summed(
    times: Vector, drive: AxisDrive, delay: float, jumps: Vector, shape: Callable[[Array], Array]
) -> Vector:
    """``sum_k jumps_k shape(t - t_k - delay)``, (samples,); shape is 0 before 0.

    Many changes under evenly spaced samples are one convolution: a change between two samples is then shared
    by them, which is of second order in the sampling period and exact for changes at samples. Samples fewer
    than the changes are too coarse for that, and are summed one change at a time.
    """
    if _MANY < drive.times.size <= times.size and _even(times):
        return _convolved(times, drive.times, delay, jumps, shape)
    out = np.zeros(times.size)
    for at, jump in zip(drive.times + delay, jumps, strict=True):
        if jump != 0.0:
            first = int(np.searchsorted(times, at))
            out[first:] += jump * shape(times[first:] - at)
    return out


def _even(times: Vector) -> bool:
    """Whether samples are evenly spaced."""
    even = np.linspace(times[0], times[-1], times.size)
    return bool(np.abs(times - even).max() < _ROUNDING * (times[-1] - times[0]) / (times.size - 1))


def _convolved(
    times: Vector, changes: Vector, delay: float, jumps: Vector, shape: Callable[[Array], Array]
) -> Vector:
    period = (times[-1] - times[0]) / (times.size - 1)
    place = (changes - times[0]) / period
    place = np.where(np.abs(place - np.round(place)) < _ROUNDING, np.round(place), place)
    below = np.floor(place).astype(np.intp)
    begin = min(int(below[0]), 0)
    dense = np.zeros(max(int(below[-1]) + 2, times.size) - begin)
    np.add.at(dense, below - begin, jumps * (1 - (place - below)))
    np.add.at(dense, below + 1 - begin, jumps * (place - below))
    lags = np.arange(dense.size) * period - delay
    kernel = np.zeros(lags.size)
    kernel[lags >= 0] = shape(lags[lags >= 0])
    return np.asarray(fftconvolve(kernel, dense)[-begin : times.size - begin])


def jumps_of(drive: AxisDrive) -> Vector:
    """Change of the drive at each instant [drive unit]."""
    return np.diff(drive.values, prepend=0.0)
