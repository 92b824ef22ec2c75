"""Free energy of a cell on an equal grid, its derivatives, and Newton's step towards its minimum.

``sum K(th) (dth)^2 / h`` plus the electric term, for ``2 G = k1 cos^2 th + k3 sin^2 th`` (Ta et al. 2026,
Eq. 20), in units of ``k1 / (2 thickness)``. The drive is ``V sqrt(deps / k1)`` [-], pi at threshold.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.optics.cell import Cell, Field


class Expansion(NamedTuple):
    """Energy over ``k1 / thickness`` and its derivatives with respect to the interior tilts."""

    energy: float
    gradient: Vector
    band: Matrix
    """Upper band form of the tridiagonal part of the Hessian, (2, n - 1)."""
    push: Vector
    """The Hessian is the tridiagonal part minus ``push push^T``."""


def expand(cell: Cell, field: Field, drive: float, tilt: Vector) -> Expansion:
    """Energy ``sum K dth^2 / h + electric`` with K averaged over each grid cell, ``K = 1 + a sin^2 th``.

    `cell`, `field` and `drive` [-] as in the module; `tilt` (n + 1,) [rad], plates included.
    """
    h, a = 1 / (tilt.size - 1), cell.k3 / cell.k1 - 1
    sine2, inner = np.sin(tilt) ** 2, tilt[1:-1]
    modulus = 1 + a * sine2
    k, rise = (modulus[1:] + modulus[:-1]) / 2, np.diff(tilt)
    slope, bend = a * np.sin(2 * tilt), 2 * a * np.cos(2 * inner)
    left, right, squares = rise[:-1], rise[1:], rise[:-1] ** 2 + rise[1:] ** 2
    gradient = (2 * k[:-1] * left - 2 * k[1:] * right + slope[1:-1] * squares / 2) / h
    band = np.zeros((2, inner.size))
    band[1] = (2 * (k[:-1] + k[1:]) + 2 * slope[1:-1] * (left - right) + bend * squares / 2) / h
    band[0, 1:] = (-2 * k[1:-1] + (slope[1:-2] - slope[2:-1]) * rise[1:-1]) / h
    elastic = float(k @ rise**2) / h
    end = (sine2[0] + sine2[-1]) / 2
    if field is Field.UNIFORM:
        gradient -= drive**2 * h * np.sin(2 * inner)
        band[1] -= 2 * drive**2 * h * np.cos(2 * inner)
        electric = -(drive**2) * h * float(sine2[1:-1].sum() + end)
        return Expansion(elastic + electric, gradient, band, np.zeros_like(inner))
    # With the displacement eliminated the electric energy is -V^2 / mean(1 / permittivity).
    g = cell.permittivity_anisotropy / cell.permittivity
    well = 1 + g * sine2
    mean = h * float((1 / well[1:-1]).sum() + (1 / well[0] + 1 / well[-1]) / 2)
    scale, e, de = drive**2 / g / mean, well[1:-1], g * np.sin(2 * inner)
    first = -h * de / e**2
    gradient += scale / mean * first
    band[1] += scale / mean * h * (2 * de**2 / e**3 - 2 * g * np.cos(2 * inner) / e**2)
    return Expansion(elastic - scale, gradient, band, sqrt(2 * scale) / mean * first)


def newton_step(state: Expansion) -> tuple[Vector, bool]:
    """Descent step, and whether the Hessian of `state` was positive definite.

    ``T - p p^T`` is positive definite exactly when T is and ``p^T T^-1 p < 1``; its inverse is then
    given by Sherman and Morrison.
    """
    shift, band = 0.0, state.band.copy()
    while True:
        band[1] = state.band[1] + shift
        try:
            factor = (cholesky_banded(band), False)
            solved, along = cho_solve_banded(factor, -state.gradient), cho_solve_banded(factor, state.push)
            gap = 1 - float(state.push @ along)
            if gap > 0:
                return solved + along * float(state.push @ solved) / gap, shift == 0
        except LinAlgError:
            pass
        shift = 2 * shift if shift else 1e-3 * float(np.abs(state.band[1]).max())
