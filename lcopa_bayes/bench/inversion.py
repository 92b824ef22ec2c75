"""Step response of a transfer path by numerical inverse Laplace transform.

The Bromwich integral is taken on Talbot's cotangent contour with the optimal parameters of Weideman,
SIAM J. Numer. Anal. 44 (2006) 2342, scaled to each time. Poles that the contour could cut off (lightly
damped ones at late times) are located beforehand, counted by the argument principle and removed by
their residues, so that one short contour is enough for every time.
"""

from __future__ import annotations

from functools import lru_cache
from math import inf, isfinite, pi
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lcopa_bayes.core.arrays import Array, Vector, frozen
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.model.path import TransferPath

_Complex = NDArray[np.complex128]

_NODES = (24, 32)
"""Nodes of the two contours compared; each alone is good to about ``exp(-1.36 nodes)`` before rounding."""
_NEAR = 0.3
"""A pole with ``|pole| time`` below this lies deep inside either contour and is not removed."""
_TOLERANCE = 1e-9
"""Largest relative difference of the two contours [-]."""
_BLOCK = 1 << 15
"""Times treated at once."""


@final
class InversionError(ArithmeticError):
    """Two contours disagree; holds the worst `time`, the `difference` there and the `allowed` difference."""

    def __init__(self, time: float, difference: float, allowed: float) -> None:
        self.time, self.difference, self.allowed = time, difference, allowed
        super().__init__(
            f"two contours differ by {difference:.3g} at time {time:.6g}, {allowed:.3g} allowed; "
            "check the orders and viscosities, or allow a larger difference"
        )


@final
class PoleSearchError(ArithmeticError):
    """The poles `located` are not as many as the argument principle `counted`."""

    def __init__(self, counted: int, located: tuple[complex, ...]) -> None:
        self.counted, self.located = counted, located
        super().__init__(
            f"{counted} pole(s) counted above the real axis but {len(located)} located: {located}"
        )


def unsuited(path: TransferPath) -> list[str]:
    """Sentences on what keeps the response of a path from being inverted: it must be a physical element."""
    problems = []
    if not path.physical:
        problems.append(f"viscosities and stiffness must be positive; got {path}")
    if len(set(path.orders)) != len(path.orders):
        problems.append(f"orders must be distinct: add the viscosities of equal orders; got {path.orders}")
    return problems


@lru_cache(maxsize=256)
def poles(path: TransferPath) -> _Complex:
    """Poles [1/ms] of a path above the real axis, up to an argument of about 0.9 pi, (n_poles,).

    With orders in (0, 2] there is at most one. Poles nearer to the negative axis are not listed: wherever a
    contour could cut them off they have died out. Raises InputError for a path that is `unsuited`, and
    PoleSearchError.
    """
    if problems := unsuited(path):
        raise InputError(problems)
    return _poles(path)


def step_response(path: TransferPath, time: ArrayLike) -> Array:
    """Response [response unit per drive unit] of a path at `time` [ms] after a unit step, in its shape."""
    return path.gain * unit_step(path, np.asarray(time, dtype=float) - path.delay)


def unit_step(path: TransferPath, time: ArrayLike) -> Array:
    """Response of a path of gain 1 and no delay to a unit step at time 0, in the shape of `time` [ms].

    Zero up to time 0. Raises InversionError where two contours differ by more than 1e-9 times the
    larger of the response and ``1 / stiffness``, and as `poles`. Accuracy about 1e-12 of that.
    """
    return _inverse(path, time, 0)


def unit_ramp(path: TransferPath, time: ArrayLike) -> Array:
    """Integral of `unit_step` from 0 [ms], in the shape of `time` [ms]; zero up to time 0.

    Raises InversionError as `unit_step` does, relative to ``time / stiffness``.
    """
    return _inverse(path, time, 1)


def _inverse(path: TransferPath, time: ArrayLike, integrals: int) -> Array:
    """Inverse transform of ``1 / (s^(1 + integrals) (sum_i eta_i s^order_i + stiffness))``."""
    time = np.asarray(time, dtype=float)
    flat = frozen(time.ravel(), name="time")
    out = np.zeros(flat.shape)
    later = np.flatnonzero(flat > 0)
    for first in range(0, later.size, _BLOCK):
        block = later[first : first + _BLOCK]
        t = flat[block]
        coarse, fine = (_contour_integral(path, t, integrals, nodes) for nodes in _NODES)
        difference = np.abs(fine - coarse)
        allowed = _TOLERANCE * np.maximum(np.abs(fine), t**integrals / path.stiffness)
        if not (difference <= allowed).all():
            worst = int(np.argmax(np.where(np.isnan(difference), inf, difference / allowed)))
            raise InversionError(float(t[worst]), float(difference[worst]), float(allowed[worst]))
        out[block] = fine
    return out.reshape(time.shape)


def _contour_integral(path: TransferPath, time: Vector, integrals: int, nodes: int) -> Vector:
    """Midpoint rule on the cotangent contour, poles beyond `_NEAR` by their residues."""
    theta = pi * (2 * np.arange(nodes // 2) + 1) / nodes  # upper half; the lower one is its conjugate
    cot, turn = 1 / np.tan(0.6407 * theta), 0.6407 * theta / np.sin(0.6407 * theta) ** 2
    z = nodes * (-0.6122 + 0.5017 * theta * cot + 0.2645j * theta)
    weight = 2 / nodes * np.exp(z) * nodes * (0.5017 * (cot - turn) + 0.2645j)

    order, eta = np.array(path.orders), np.array(path.etas)
    # with s = z / time every power separates into one of the node and one of the time
    system = (eta * time[:, None] ** -order) @ z ** order[:, None] + path.stiffness
    transform = time[:, None] ** integrals / (z ** (1 + integrals) * system)  # divided by time
    residues = np.zeros(time.shape)
    for pole in poles(path):
        residue = 1 / (pole ** (1 + integrals) * np.sum(eta * order * pole ** (order - 1)))
        far = abs(pole) * time > _NEAR
        q = pole * time[far, None]
        transform[far] -= residue / (z - q) + residue.conjugate() / (z - q.conj())
        residues[far] = residues[far] + 2 * (residue * np.exp(q[:, 0])).real
    return np.asarray((transform @ weight).imag + residues)


def _poles(path: TransferPath) -> _Complex:
    """Zeros of ``sum_i eta_i s^order_i + stiffness`` in a sector above the real axis.

    Works with ``w = log s``. Terms whose phases differ by less than a right angle within the sector
    cannot cancel, which bounds ``log |s|`` from both sides.
    """
    order = np.array([0.0, *path.orders])
    log_weight = np.log([path.stiffness, *path.etas])
    top, widest = int(np.argmax(order)), 0.95 * pi
    opposing = pi / (2 * widest)

    def terms(w: _Complex) -> _Complex:
        exponent = log_weight + order * w[..., None]
        return np.asarray(np.exp(exponent - exponent.real.max(axis=-1, keepdims=True)))

    against_rest, against_top = order > opposing, order[top] - order > opposing
    if not against_rest.any():
        return np.empty(0, dtype=complex)
    margin = np.log(order.size)
    low = np.min((log_weight[0] - log_weight - margin)[against_rest] / order[against_rest])
    high = np.max((log_weight - log_weight[top] + margin)[against_top] / (order[top] - order)[against_top])
    log_r = np.linspace(low, high, 2 + int(20 * (high - low))) if high > low else np.array([low])

    def relative_size(w: _Complex) -> Array:
        each = terms(w)
        return np.asarray(np.abs(each.sum(axis=-1)) / np.abs(each).sum(axis=-1))

    # the sector ends on the ray that keeps farthest from any zero
    rays = np.linspace(0.85 * pi, widest, 9)
    ray = float(rays[np.argmax(relative_size(log_r + 1j * rays[:, None]).min(axis=1))])
    fine = np.linspace(log_r[0], log_r[-1], 16 * log_r.size)
    along = np.unwrap(np.angle(terms(fine + 1j * ray).sum(axis=-1)))
    counted = round(float(order[top] * ray - along[-1]) / (2 * pi))

    grid = log_r + 1j * np.linspace(0, ray, 2 + int(16 * max(1.0, order[top])))[:, None]
    w = grid[relative_size(grid) < 0.5]
    for _ in range(40):  # Newton
        each = terms(w)
        step = each.sum(axis=-1) / np.where((slope := (order * each).sum(axis=-1)) == 0, 1, slope)
        w = w - step / np.maximum(1, 4 * np.abs(step))
    settled = (np.abs(step) < 1e-10) & (w.imag > 0) & (w.imag < ray) if w.size else np.zeros(0, dtype=bool)
    located: list[complex] = []
    for candidate in w[settled].tolist():
        if all(abs(candidate - other) > 1e-7 for other in located):
            located.append(candidate)
    if len(located) != counted:
        raise PoleSearchError(counted, tuple(complex(np.exp(zero)) for zero in located))
    if not all(isfinite(abs(np.exp(zero))) for zero in located):
        raise InputError(f"time scales beyond the range of floating point; got {path}")
    return np.asarray(np.exp(np.array(located, dtype=complex)))
