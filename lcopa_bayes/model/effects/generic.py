"""Classes without a mechanism, so that no name is forced on what no named effect explains."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Self, final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.model.effects.effect import (
    Card,
    Coefficient,
    ParallelEffect,
    Ranges,
    Scene,
    per_axis,
    single,
)
from lcopa_bayes.model.effects.parallel import falling, relaxation, relaxed

_LAGS = 6
_WAVES = 8
_POWERS = (2, 3)
_PARTS = (0.3, 1.0, 3.0)
"""Lags of the non-linear class, in response times [-]."""


@final
class UnmodelledLinear(ParallelEffect):
    """Any further linear response of an axis to a drive."""

    card: ClassVar[Card] = Card(
        name="unmodelled_linear",
        place="generic",
        formula="y_i += (ymax_i / umax_j) sum_k c_ijk u_j / (1 + T_k s) for every drive j, T_k from an "
        "eighth of the response time to the span",
        source="relaxation spectrum",
        reveals="any drive",
        mistaken_for="a named linear effect",
        dynamics=True,
    )

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """c_ijk [-] by response axis, drive and lag."""
        paths = [f"_{name}_{j + 1}" for name in ranges.names for j in range(ranges.drive.size)]
        return tuple(
            Coefficient(f"c{k + 1}{path if len(paths) > 1 else ''}", "-", 0.03)
            for path in paths
            for k in range(_LAGS)
        )

    def added(self, scene: Scene, psi: Vector) -> Matrix:
        """One exponential per change and lag."""
        ranges = scene.ranges
        out = np.zeros((scene.times.size, ranges.axes))
        lags = np.geomspace(ranges.speed / 8, ranges.span, _LAGS)
        for (i, j, k), c in np.ndenumerate(psi.reshape(ranges.axes, -1, _LAGS)):
            if c != 0.0:
                out[:, i] += c * ranges.response[i] / ranges.drive[j] * relaxed(scene, i, j, float(lags[k]))
        return out


@final
@dataclass(frozen=True)
class UnmodelledLag(ParallelEffect):
    """One more lag beside every path, or a zero of it: the least that a plant of too few terms lacks."""

    time: float
    """T [time unit]."""

    units = MappingProxyType({"time": "time"})
    estimated = single("c", 0.3)
    card: ClassVar[Card] = Card(
        name="unmodelled_lag",
        place="generic",
        formula="y_i += c K_ij u_j / (1 + T s) for every drive j, K the gains of the paths",
        source="partial fractions",
        reveals="any drive",
        mistaken_for="a named linear effect",
        dynamics=True,
    )

    @classmethod
    def grid(cls, ranges: Ranges) -> tuple[Self, ...]:
        """From a sampling period to a quarter of the longest record."""
        return tuple(cls(float(time)) for time in np.geomspace(ranges.period, 0.25 * ranges.span, 6))

    def added(self, scene: Scene, psi: Vector) -> Matrix:
        """One exponential per change."""
        out = np.zeros((scene.times.size, scene.ranges.axes))
        for (i, j), gain in np.ndenumerate(scene.gains):
            out[:, i] += psi[0] * gain * relaxed(scene, i, j, self.time)
        return out


@final
class UnmodelledSmooth(ParallelEffect):
    """Any slow addition to a record, whatever the drive does."""

    additive = True
    card: ClassVar[Card] = Card(
        name="unmodelled_smooth",
        place="generic",
        formula="y += sum_k c_k cos(pi k (t - start) / length), k = 1..8, per record and axis",
        source="cosine series",
        reveals="any record; repeats separate it from what the drive causes",
        mistaken_for="everything slow",
        per_record=True,
        disturbance=True,
    )

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """c_k [response unit] per axis."""
        return per_axis(ranges, tuple(f"c{k + 1}" for k in range(_WAVES)), 0.005)

    def added(self, scene: Scene, psi: Vector) -> Matrix:
        """Linear in the coefficients."""
        length = max(float(scene.times[-1] - scene.times[0]), scene.ranges.period)
        phase = np.pi * (scene.times - scene.times[0]) / length
        waves = np.cos(np.outer(phase, np.arange(1, _WAVES + 1)))
        return np.asarray(waves @ psi.reshape(-1, _WAVES).T)


@final
class UnmodelledNonlinear(ParallelEffect):
    """A further response to powers of the drive, and to its falls."""

    card: ClassVar[Card] = Card(
        name="unmodelled_nonlinear",
        place="generic",
        formula="y += K umax sum_pk c_pk (u/umax)^p / (1 + T_k s), p = 2, 3, and falls of u alone, "
        "T_k 0.3 to 3 response times",
        source="Hammerstein series",
        reveals="amplitude series, on/off, sign reversal",
        mistaken_for="a named non-linear effect",
    )

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """c [-], shared by the axes."""
        names = [f"{kind}_{k + 1}" for kind in ("even", "odd", "fall") for k in range(len(_PARTS))]
        return tuple(Coefficient(name, "-", 0.03) for name in names)

    def added(self, scene: Scene, psi: Vector) -> Matrix:
        """One exponential per change, kind and lag."""
        out = np.zeros((scene.times.size, scene.ranges.axes))
        kinds = psi.reshape(len(_POWERS) + 1, len(_PARTS))
        for axis in range(scene.ranges.axes):
            drive, rest, gain, delay = scene.direct(axis)
            size = scene.ranges.drive[scene.ranges.direct[axis]]
            levels = (rest + np.concatenate(([0.0], drive.values))) / size
            inputs = [(float(levels[0]) ** p, np.diff(levels**p)) for p in _POWERS]
            inputs.append((0.0, np.where(falling(drive, rest), np.diff(levels), 0.0)))
            for (level, jumps), mine in zip(inputs, kinds, strict=True):
                for c, part in zip(mine, _PARTS, strict=True):
                    if c != 0.0:
                        rate = 1 / (part * scene.ranges.speed)
                        moved = relaxation(scene.times, drive, delay, jumps, rate)
                        out[:, axis] += c * gain * size * (level + moved)
        return out
