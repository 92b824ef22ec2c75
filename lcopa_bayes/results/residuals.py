"""What the model leaves: residual, autocorrelation and spectrum against the white band."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from scipy import signal, stats

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.estimate import attributes
from lcopa_bayes.inference.noise import Noise
from lcopa_bayes.results.prediction import Band
from lcopa_bayes.sampling.draws import Draws

_LAGS = 40
"""Lags of the autocorrelation shown."""
_TESTED_LAGS = 20
"""Lags of the Ljung-Box test."""
WHITE_P = 0.01
"""Below this p-value the whitened residual is not white."""


@final
@dataclass(frozen=True, eq=False)
class Residual:
    """Residual of one axis of one record at the posterior median response."""

    record: str
    axis: str
    unit: str
    held_out: bool
    time: Vector
    """(n,) [time unit]."""
    values: Vector
    """Observed minus median response, (n,) [response unit]."""
    innovations: Vector
    """Whitened by the fitted noise model, (n,) [-]."""
    autocorrelation: Vector
    """Of the innovations, from lag 1 [-]."""
    frequency: Vector
    """[cycles per time unit], of samples taken as equidistant."""
    spectrum: Vector
    """Periodogram of the innovations over its white expectation [-]."""
    p_white: float
    """p-value of the Ljung-Box test over the first lags [-] (Ljung and Box 1978, Biometrika 65)."""

    @property
    def white_band(self) -> float:
        """95 % band of an autocorrelation of white noise, +- [-]."""
        return float(1.96 / np.sqrt(self.innovations.size))

    @property
    def rms(self) -> float:
        """Root mean square [response unit]."""
        return float(np.sqrt(np.mean(self.values**2)))

    def test(self) -> dict[str, Any]:
        """Size and test of whiteness as plain values."""
        return attributes(self, "record", "axis", "held_out", "p_white", "rms")


def residuals(draws: Draws, bands: Sequence[Band], noise: Noise, period: float) -> list[Residual]:
    """Residuals behind the bands; `period` [time unit] is the sampling period noise correlates in."""
    axes = [axis.name for axis in draws.table.layout.responses]
    return [
        _residual(band, draws, axes.index(band.axis), noise, period) for band in bands if band.time.size > 8
    ]


def _residual(band: Band, draws: Draws, axis: int, noise: Noise, period: float) -> Residual:
    values = band.observed - band.plant[2]
    gaps = np.concatenate(([1.0], np.diff(band.time) / period))
    middle = np.median(draws.flat, axis=0)
    parameters = middle[[draws.table.at(name, axis) for name in noise.names]][None]
    innovations = noise.standard(values[None], parameters, gaps)[0]
    centred = innovations - innovations.mean()
    n = centred.size
    full = signal.correlate(centred, centred, method="fft")[n - 1 :]
    autocorrelation = full[1 : min(_LAGS, n // 3) + 1] / full[0]
    rate = 1.0 / float(np.median(np.diff(band.time)))
    frequency, power = signal.periodogram(centred, fs=rate)
    return Residual(
        record=band.record,
        axis=band.axis,
        unit=band.unit,
        held_out=band.held_out,
        time=band.time,
        values=values,
        innovations=innovations,
        autocorrelation=autocorrelation,
        frequency=frequency[1:],
        spectrum=power[1:] / (2 * centred.var() / rate),
        p_white=ljung_box(autocorrelation, n, fitted=noise.memory),
    )


def ljung_box(autocorrelation: Vector, n: int, *, fitted: int) -> float:
    """p-value that `n` samples with these autocorrelations (from lag 1) are white."""
    lags = min(_TESTED_LAGS, autocorrelation.size)
    k = np.arange(1, lags + 1)
    statistic = n * (n + 2) * np.sum(autocorrelation[:lags] ** 2 / (n - k))
    return float(stats.chi2.sf(statistic, max(1, lags - fitted)))
