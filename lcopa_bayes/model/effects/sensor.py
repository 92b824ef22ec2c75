"""Linear filters between the deflection and the reading."""

from __future__ import annotations

from functools import lru_cache
from typing import ClassVar, final

import numpy as np
from scipy.signal import lfilter

from lcopa_bayes.core.arrays import Matrix, Vector, frozen
from lcopa_bayes.model.effects.effect import (
    Card,
    Coefficient,
    Ranges,
    Scene,
    SensorEffect,
    of_devices,
    single,
)

_CUBIC = np.linalg.inv(np.vander(np.array([-1.0, 0.0, 1.0, 2.0]), increasing=True))
"""Coefficients of the Lagrange polynomials on the blocks -1, 0, 1, 2, one per column."""
_SERIES = 24
"""Terms of the moments' series, good to 1e-16 up to an exponent of 2."""


@final
class SensorLag(SensorEffect):
    """First-order lag of sensor or read-out."""

    card: ClassVar[Card] = Card(
        name="sensor_lag",
        place="output",
        formula="y -> y / (1 + Ts s)",
        source="amplifier or read-out, 0.05 to 0.5 ms",
        reveals="pseudo-random drive; a test of the sensor with a fast source",
        mistaken_for="delay and order together (97 % of it)",
        linear=True,
        always=True,
        delays=True,
    )

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """Ts of every device [time unit]."""
        return of_devices(ranges, single("Ts", 2 * ranges.period, "time", one_signed=True))

    def filtered(self, y: Matrix, scene: Scene, psi: Vector) -> Matrix:
        """Exact for cubics through four blocks. Ts below 0 has no meaning: NaN."""
        out = np.empty(y.shape)
        for device, lag in enumerate(psi):
            own = scene.ranges.devices == device
            out[own] = self._lagging(y[own], scene.grid.step, float(lag))
        return out

    def _lagging(self, y: Matrix, step: float, lag: float) -> Matrix:
        """Readings (axes, blocks) of one device."""
        if lag == 0.0:
            return y
        if lag < 0.0:
            return np.full(y.shape, np.nan)
        rate = step / lag
        weights = _moments(rate) @ _CUBIC
        padded = np.pad(y, ((0, 0), (2, 1)))
        padded[:, -1] = 2 * y[:, -1] - y[:, -2] if y.shape[1] > 1 else y[:, -1]
        n = y.shape[1]
        fed = sum(weights[k] * padded[:, k : k + n] for k in range(4))
        return np.asarray(lfilter([1.0], [1.0, -np.exp(-rate)], fed, axis=1))


def _moments(rate: float) -> Vector:
    """``int_0^1 rate e^(-rate (1 - s)) s^k ds`` for k = 0..3."""
    if rate < 2.0:  # the recurrence below would cancel
        powers = np.arange(4.0)
        term, total = np.ones(4), np.zeros(4)
        for j in range(_SERIES):  # int (1-s)^j s^k = j! k! / (j+k+1)!
            term = 1.0 / (powers + 1.0) if j == 0 else term * -rate / (powers + 1.0 + j)
            total += term
        return rate * total
    moments = [1.0 - np.exp(-rate)]
    for k in range(1, 4):
        moments.append(1.0 - k / rate * moments[-1])
    return np.array(moments)


@final
class Exposure(SensorEffect):
    """Camera samples that are means over the exposure before them."""

    card: ClassVar[Card] = Card(
        name="exposure",
        place="output",
        formula="y -> (1 - e^(-Te s)) / (Te s) y",
        source="exposure of the camera, up to its period",
        reveals="pseudo-random drive near the sampling limit",
        mistaken_for="delay of Te/2, to second order",
        linear=True,
        always=True,
        delays=True,
    )

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """Te [time unit]."""
        return single("Te", ranges.period, "time", one_signed=True)

    def filtered(self, y: Matrix, scene: Scene, psi: Vector) -> Matrix:
        """Gauss quadrature with one node more than the exposure has blocks, at least four."""
        blocks = float(psi[0]) / scene.grid.step
        nodes, weights = _gauss(4 + int(abs(blocks)))
        return _delayed(y, blocks * (1 + nodes) / 2, weights / 2)


@lru_cache
def _gauss(count: int) -> tuple[Vector, Vector]:
    """Nodes and weights of Gauss quadrature over -1 to 1, (count,) each [-]."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return frozen(nodes, name="nodes"), frozen(weights, name="weights")


def _delayed(y: Matrix, blocks: Vector, weights: Vector) -> Matrix:
    """Weighted sum of ``y``, (axes, blocks), at so many `blocks` before, one of them less than a block away,
    by cubics through four blocks: 0 before the first, and as at the last one after it."""
    latest = np.floor(blocks).astype(int) + 2
    parts = weights[:, None] * ((latest - 1 - blocks)[:, None] ** np.arange(4.0) @ _CUBIC)
    before, after = int(latest.max()), 3 - int(latest.min())
    taps = np.zeros(before + after + 1)
    np.add.at(taps, after + latest[:, None] - np.arange(4), parts)
    padded = np.pad(np.pad(y, ((0, 0), (before, 0))), ((0, 0), (0, after)), mode="edge")
    return np.stack([np.convolve(own, taps, "valid") for own in padded])
