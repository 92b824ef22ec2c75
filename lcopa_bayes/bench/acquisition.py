"""Measuring on the virtual bench: refresh, camera, noise, and the record they leave."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, sqrt
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import lfilter

from lcopa_bayes.bench.command import Command
from lcopa_bayes.bench.device import Responsive
from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.rules import POSITIVE, Rule, Ruled, is_number
from lcopa_bayes.data.record import Record
from lcopa_bayes.model.literature import PAPER

_SAME = 1e-9
"""A change closer than this part of a camera period to a sample is at that sample."""


_NOT_NEGATIVE = Rule("at least 0 and finite", lambda value: is_number(value) and value >= 0)
_DEVIATIONS = Rule(
    "at least 0 and finite", lambda value: all(map(_NOT_NEGATIVE.holds, np.atleast_1d(np.asarray(value))))
)
_CORRELATION = Rule("a number between -1 and 1", lambda value: is_number(value) and -1 < value < 1)


@dataclass(frozen=True)
class Bench(Ruled):
    """How a device is driven and watched, with times in the unit of the device; InputError with all that is
    wrong."""

    refresh: Annotated[float, _NOT_NEGATIVE] = 0.0
    """Period of the drive refresh [ms]; commands act at its next multiple; 0: at once."""
    camera: Annotated[float, POSITIVE] = 0.1
    """Period of the camera [ms]."""
    exposure: Annotated[float, _NOT_NEGATIVE] = 0.0
    """Each sample is the mean over this time up to its own [ms], at most a camera period; 0: none."""
    noise_sd: Annotated[float | tuple[float, ...], _DEVIATIONS] = 0.0
    """Stationary standard deviation of a sample [response unit], one for all response axes or one each."""
    noise_correlation: Annotated[float, _CORRELATION] = 0.0
    """rho [-], correlation of successive camera samples (AR(1)); 0: white. Axes are independent."""

    def contradictions(self) -> list[str]:
        """An exposure longer than the camera period."""
        wrong = self.exposure > self.camera
        return [f"`exposure` must be at most the camera period; got {self.exposure}"] if wrong else []

    def noise(self, n: int, n_responses: int, rng: np.random.Generator) -> Matrix:
        """Stationary AR(1) noise, ``e_k = rho e_(k-1) + sd sqrt(1 - rho^2) z_k``, (n, n_responses).

        Raises InputError when `noise_sd` has neither one entry nor one per response.
        """
        sd = np.atleast_1d(np.asarray(self.noise_sd, dtype=float))
        if sd.size not in (1, n_responses):
            raise InputError(f"`noise_sd` needs 1 or {n_responses} entries, one per response; got {sd.size}")
        rho = self.noise_correlation
        innovations: Array = sqrt(1 - rho**2) * rng.standard_normal((n, n_responses))
        innovations[:1] /= sqrt(1 - rho**2)  # the first sample is already stationary
        return np.asarray(sd * lfilter([1.0], [1.0, -rho], innovations, axis=0))


PAPER_BENCH = Bench(
    refresh=1 / PAPER.records.refresh_rate,
    camera=1 / PAPER.records.camera_rate,
    noise_sd=PAPER.records.fractional_rmse,
)
"""Ta et al. 2026, Section 5.1: refresh 1 kHz, camera 10 kHz; noise as large as the fit error reported."""


def truth(device: Responsive, bench: Bench, command: Command, *, duration: float, name: str) -> Record:
    """The record without noise.

    Rows: one before everything, a camera period before time 0 or before the first change if that is
    earlier, with the resting drive and no response; the camera samples ``0, camera, 2 camera, ...``
    below `duration` [ms]; and, wherever the command changes between samples, a row at that instant
    without a response. The drive column is the drive as commanded: the refresh is the device's
    business. Raises InputError for a duration that holds no sample.
    """
    if not bench.camera <= duration < inf:
        raise InputError(f"`duration` must be finite and at least a camera period; got {duration}")
    camera = _rounded(bench.camera * np.arange(np.ceil(duration / bench.camera - _SAME)))
    changes = command.times[command.times < duration - _SAME * bench.camera]
    nearest = bench.camera * np.round(changes / bench.camera)
    apart = (np.abs(changes - nearest) > _SAME * bench.camera) | (nearest < -_SAME)
    time = np.union1d(camera, changes[apart])
    time = np.insert(time, 0, _rounded(time[:1] - bench.camera))
    drive = command.at(time + _SAME * bench.camera)

    response = np.full((time.size, len(device.response_axes)), np.nan)
    obeyed = command.refreshed(bench.refresh)
    sampled = np.searchsorted(time, camera)
    response[sampled] = device.response(obeyed, camera, exposure=bench.exposure)
    return Record(name, time, drive, response, device.drive_axes, device.response_axes, device.time_unit)


def simulate(
    device: Responsive,
    bench: Bench,
    command: Command,
    *,
    duration: float,
    name: str,
    rng: np.random.Generator,
) -> Record:
    """`truth` with the noise of the bench on every camera sample; rows and errors as there."""
    clean = truth(device, bench, command, duration=duration, name=name)
    response = np.array(clean.response)
    sampled = ~np.isnan(response[:, 0])
    response[sampled] += bench.noise(int(sampled.sum()), response.shape[1], rng)
    return Record(
        name, clean.time, clean.drive, response, clean.drive_axes, clean.response_axes, clean.time_unit
    )


def _rounded(time: ArrayLike) -> Vector:
    """Without the digits that binary rounding adds to multiples of a decimal period."""
    return np.round(np.asarray(time, dtype=float), 12)
