"""Director by quadrature: the first integral of the equilibrium equation, a method without a grid.

``K(th) (dth/dz)^2`` plus the electric term is constant across the cell, so position, voltage and mean tilt
are integrals over the tilt between plate and middle (Deuling 1972 for the self-consistent field). With
``th_m`` the middle tilt, ``sin th = sin th_m cos mu`` and ``tan mu = cos th_m sinh t`` the integrands are
smooth and decay exponentially, however close th_m is to pi/2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import asinh, cos, exp, inf, log, pi, sqrt
from typing import final

import numpy as np
from scipy.integrate import quad
from scipy.optimize import brentq

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.optics.director import Cell, Field


@final
@dataclass(frozen=True)
class Quadrature:
    """Equilibrium given by its middle tilt; accurate to about 1e-10 in tilt and position."""

    cell: Cell
    field: Field
    cosine: float
    """Cosine of the middle tilt [-], in (0, cos pretilt); 0 and the flat state are limits."""

    @property
    def voltage(self) -> float:
        """[V]."""
        c = self.cell
        root = sqrt(c.k1 / c.permittivity_anisotropy)
        if self.field is Field.UNIFORM:
            return 2 * root * self._integral(lambda t: self._weight(t)[0])
        return 2 * root * self._integral(lambda t: self._weight(t)[2]) * sqrt(self._well(1 - self.cosine**2))

    @property
    def mean(self) -> float:
        """Spatial mean of the tilt [rad]."""
        whole = self._integral(lambda t: self._weight(t)[1])
        return self._integral(lambda t: self._weight(t)[1] * self._tilt(t)) / whole

    @property
    def largest(self) -> float:
        """Tilt in the middle of the cell [rad]."""
        return pi / 2 - float(np.arcsin(self.cosine))

    def positions(self, tilts: Vector) -> Vector:
        """Positions in the lower half of the cell, [0, 1/2] [-], at tilts [rad] from pretilt to `largest`."""
        whole = self._integral(lambda t: self._weight(t)[1])
        out = [
            0.5 - 0.5 * self._integral(lambda t: self._weight(t)[1], self._reach(x)) / whole for x in tilts
        ]
        return np.array(out)

    def _well(self, sine2: float) -> float:
        return 1 + self.cell.permittivity_anisotropy / self.cell.permittivity * sine2

    def _reach(self, tilt: float) -> float:
        """Parameter t at which the tilt is reached; infinite at a tilt of 0."""
        if tilt == 0:
            return inf
        gap = max(0.0, float(np.cos(tilt)) ** 2 - self.cosine**2)
        return asinh(sqrt(gap) / float(np.sin(tilt)) / self.cosine)

    def _point(self, t: float) -> tuple[float, float]:
        """``(sin th)^2`` and ``cos mu`` at parameter t; the exponent keeps sinh finite."""
        shrink = exp(-t)
        grow = (1 - shrink**2) / 2 * self.cosine
        cos_mu = shrink / sqrt(shrink**2 + grow**2)
        return (1 - self.cosine**2) * cos_mu**2, cos_mu

    def _tilt(self, t: float) -> float:
        sine2, _ = self._point(t)
        return float(np.arcsin(sqrt(sine2)))

    def _weight(self, t: float) -> tuple[float, float, float]:
        """Densities over t of voltage (uniform field), position, and voltage (self-consistent field)."""
        sine2, cos_mu = self._point(t)
        k = sqrt(1 + (self.cell.k3 / self.cell.k1 - 1) * sine2) * cos_mu
        if self.field is Field.UNIFORM:
            return k, k, k
        root = sqrt(self._well(sine2))
        return k, k * root, k / root

    def _integral(self, density: Callable[[float], float], upper: float | None = None) -> float:
        top = self._reach(self.cell.pretilt) if upper is None else upper
        # The integrand turns from constant to exp(-t) at the wall; a break there keeps quad exact.
        wall = min(top, log(2 / self.cosine))
        pieces = [(0.0, wall)] + ([(wall, top)] if top > wall else [])
        return sum(float(quad(density, a, b, epsabs=1e-13, epsrel=1e-12, limit=200)[0]) for a, b in pieces)


def quadrature(cell: Cell, voltage: float, *, field: Field = Field.UNIFORM) -> Quadrature:
    """Tilted equilibrium of `cell` at `voltage` [V] in a `field` by root finding on the middle tilt.

    Raises InputError at and below threshold without pretilt, at 0 V with pretilt, and where the middle tilt
    comes within 1e-12 rad of pi/2, where no digits remain.
    """
    flat = cell.threshold if cell.pretilt == 0 else 0.0
    top = cos(cell.pretilt)

    def excess(x: float) -> float:  # x = log(cosine gap): resolves both ends of (0, top)
        return Quadrature(cell, field, top / (1 + exp(x))).voltage - voltage

    low, high = -27.0, 27.0
    if voltage <= flat * (1 + 1e-9) or excess(low) > 0:
        raise InputError(f"at {voltage:.9g} V the director is flat; give a voltage above {flat:.9g} V.")
    if excess(high) < 0:
        raise InputError(f"at {voltage:.6g} V the middle tilt is pi/2 to rounding.")
    root = float(brentq(excess, low, high, xtol=1e-13, rtol=1e-14))
    return Quadrature(cell, field, top / (1 + exp(root)))
