"""Step response of a fractional compliance by numerical inverse Laplace transform.

The Bromwich integral is taken on Talbot's cotangent contour with the optimal parameters of Weideman,
SIAM J. Numer. Anal. 44 (2006) 2342, scaled to each time. Poles that the contour could cut off (lightly
damped ones at late times) are found beforehand, counted by the argument principle and removed by
their residues, so that one short contour serves every time.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import inf, isfinite, pi
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lcopa_bayes.core.arrays import Array, Vector, frozen
from lcopa_bayes.core.errors import InputError

_Complex = NDArray[np.complex128]

_NODES = (24, 32)
"""Nodes of the two contours compared; each alone is good to about ``exp(-1.36 nodes)`` before rounding."""
_NEAR = 0.3
"""A pole with ``|pole| time`` below this lies deep inside either contour and is left to it."""
_BLOCK = 1 << 15
"""Times treated at once."""


class InversionError(ArithmeticError):
    """Two contours disagree; carries the worst `time`, the `difference` there and the `allowed` one."""

    def __init__(self, time: float, difference: float, allowed: float) -> None:
        self.time, self.difference, self.allowed = time, difference, allowed
        super().__init__(
            f"two contours differ by {difference:.3g} at time {time:.6g}, {allowed:.3g} allowed; "
            "check the orders and viscosities, or allow a larger difference"
        )


class PoleSearchError(ArithmeticError):
    """The poles `found` are not as many as the argument principle `counted`."""

    def __init__(self, counted: int, found: tuple[complex, ...]) -> None:
        self.counted, self.found = counted, found
        super().__init__(f"{counted} pole(s) counted above the real axis but {len(found)} found: {found}")


@final
@dataclass(frozen=True)
class Compliance:
    """``1 / (sum_i eta_i s^order_i + stiffness)``, Ta et al. 2026, Eq. 31 without gain and delay.

    Raises InputError unless there are as many viscosities as orders, at least one, all numbers are
    positive and finite, and no order occurs twice. Orders above 2 are allowed.
    """

    etas: tuple[float, ...]
    """Viscosities [ms^order], one per order; positive."""
    orders: tuple[float, ...]
    """Fractional orders [-]; positive and distinct."""
    stiffness: float
    """k [-]; positive."""

    def __post_init__(self) -> None:
        problems = []
        if not self.orders or len(self.etas) != len(self.orders):
            problems.append(f"one viscosity per order is needed; got {self.etas} and orders {self.orders}")
        if not all(0 < value < inf for value in (*self.etas, *self.orders, self.stiffness)):
            problems.append(f"viscosities, orders and stiffness must be positive and finite; got {self}")
        if len(set(self.orders)) != len(self.orders):
            problems.append(f"orders must be distinct: add the viscosities of equal ones; got {self.orders}")
        if problems:
            raise InputError(problems)

    @cached_property
    def poles(self) -> _Complex:
        """Poles [1/ms] above the real axis, up to an argument of about 0.9 pi, (n_poles,).

        With orders in (0, 2] there is at most one. Poles nearer to the negative axis are not listed:
        wherever a contour could cut them off they have died out. Raises PoleSearchError.
        """
        return _poles(self)

    def step_response(self, time: ArrayLike, *, tolerance: float = 1e-9) -> Array:
        """Response to a unit step at time 0, in the shape of `time` [ms]; zero up to time 0.

        Raises InversionError where two contours differ by more than `tolerance` times the larger of
        the response and ``1 / stiffness``. Accuracy about 1e-12 of that.
        """
        return self._inverse(time, 0, tolerance)

    def ramp_response(self, time: ArrayLike, *, tolerance: float = 1e-9) -> Array:
        """Integral of the step response from 0 [ms], in the shape of `time` [ms]; zero up to time 0.

        Raises InversionError as `step_response` does, relative to ``time / stiffness``.
        """
        return self._inverse(time, 1, tolerance)

    def _inverse(self, time: ArrayLike, integrals: int, tolerance: float) -> Array:
        """Inverse transform of ``compliance / s^(1 + integrals)``."""
        time = np.asarray(time, dtype=float)
        flat = frozen(time.ravel(), name="time")
        out = np.zeros(flat.shape)
        later = np.flatnonzero(flat > 0)
        for first in range(0, later.size, _BLOCK):
            block = later[first : first + _BLOCK]
            t = flat[block]
            coarse, fine = (_contour_integral(self, t, integrals, nodes) for nodes in _NODES)
            difference = np.abs(fine - coarse)
            allowed = tolerance * np.maximum(np.abs(fine), t**integrals / self.stiffness)
            if not (difference <= allowed).all():
                worst = int(np.argmax(np.where(np.isnan(difference), inf, difference / allowed)))
                raise InversionError(float(t[worst]), float(difference[worst]), float(allowed[worst]))
            out[block] = fine
        return out.reshape(time.shape)


def _contour_integral(compliance: Compliance, time: Vector, integrals: int, nodes: int) -> Vector:
    """Midpoint rule on the cotangent contour, poles beyond `_NEAR` by their residues."""
    theta = pi * (2 * np.arange(nodes // 2) + 1) / nodes  # upper half; the lower one is its conjugate
    cot, turn = 1 / np.tan(0.6407 * theta), 0.6407 * theta / np.sin(0.6407 * theta) ** 2
    z = nodes * (-0.6122 + 0.5017 * theta * cot + 0.2645j * theta)
    weight = 2 / nodes * np.exp(z) * nodes * (0.5017 * (cot - turn) + 0.2645j)

    order, eta = np.array(compliance.orders), np.array(compliance.etas)
    # with s = z / time every power separates into one of the node and one of the time
    system = (eta * time[:, None] ** -order) @ z ** order[:, None] + compliance.stiffness
    transform = time[:, None] ** integrals / (z ** (1 + integrals) * system)  # divided by time
    residues = np.zeros(time.shape)
    for pole in compliance.poles:
        residue = 1 / (pole ** (1 + integrals) * np.sum(eta * order * pole ** (order - 1)))
        far = abs(pole) * time > _NEAR
        q = pole * time[far, None]
        transform[far] -= residue / (z - q) + residue.conjugate() / (z - q.conj())
        residues[far] = residues[far] + 2 * (residue * np.exp(q[:, 0])).real
    return np.asarray((transform @ weight).imag + residues)


def _poles(compliance: Compliance) -> _Complex:
    """Zeros of ``sum_i eta_i s^order_i + stiffness`` in a sector above the real axis.

    Works with ``w = log s``. Terms whose phases differ by less than a right angle within the sector
    cannot cancel, which bounds ``log |s|`` from both sides.
    """
    order = np.array([0.0, *compliance.orders])
    log_weight = np.log([compliance.stiffness, *compliance.etas])
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
    found: list[complex] = []
    for candidate in w[settled].tolist():
        if all(abs(candidate - other) > 1e-7 for other in found):
            found.append(candidate)
    if len(found) != counted:
        raise PoleSearchError(counted, tuple(complex(np.exp(zero)) for zero in found))
    if not all(isfinite(abs(np.exp(zero))) for zero in found):
        raise InputError(f"time scales beyond the range of floating point; got {compliance}")
    return np.asarray(np.exp(np.array(found, dtype=complex)))
