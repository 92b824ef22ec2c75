"""Equilibrium director of a cell by energy minimisation (Ta et al. 2026, Eqs. 18-20); tilt as in `cell`.

The energy on an equal grid is ``sum K(th) (dth)^2 / h`` plus the electric term, for
``2 G = k1 cos^2 th + k3 sin^2 th``, in units of ``k1 / (2 thickness)``. The drive is
``V sqrt(deps / k1)`` [-], pi at threshold.

Planar nematic cell with strong anchoring: its material and the field inside it.

Convention: the tilt th is measured out of the plates, 0 for a director lying in them and pi/2 along the
cell normal, as ``G`` and the electric term of Ta et al. 2026, Eq. 20 read it (Eq. 17 counts from the
normal). The director stays in one plane and varies across the cell only, so the terms in ``ph_x`` of
Eq. 20 vanish, and with them the twist constant. Position is a fraction of the cell: the thickness, which the
paper does not give, drops out of the tilt.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from math import pi, sqrt
from typing import Annotated, NamedTuple, final

import numpy as np
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded

from lcopa_bayes.core.arrays import Matrix, Vector, frozen
from lcopa_bayes.core.rules import POSITIVE, Rule, Ruled, is_number
from lcopa_bayes.model.literature import PAPER, StatedOptics

PRETILT = Rule(
    "a tilt in radians, from 0 to below pi/2", lambda value: is_number(value) and 0 <= value < pi / 2
)


@final
class Field(Enum):
    """Field inside the cell."""

    UNIFORM = "uniform"
    """``dV/dz = V / d`` everywhere: the plain reading of Ta et al. 2026, Eq. 20."""
    SELF_CONSISTENT = "self-consistent"
    """Constant displacement ``D``, ``dV/dz = D / (eps + deps sin^2 th)``, which integrates to V."""


@final
@dataclass(frozen=True)
class Cell(Ruled):
    """Nematic of positive dielectric anisotropy between parallel plates; InputError for anything else."""

    k1: Annotated[float, POSITIVE]
    """Splay constant [N]."""
    k3: Annotated[float, POSITIVE]
    """Bend constant [N]."""
    permittivity: Annotated[float, POSITIVE]
    """eps, perpendicular to the director [F/m]."""
    permittivity_anisotropy: Annotated[float, POSITIVE]
    """deps [F/m]; positive, or the field would not tilt the director."""
    pretilt: Annotated[float, PRETILT] = 0.0
    """Tilt at both plates [rad]; the same sense on both."""

    @property
    def threshold(self) -> float:
        """Freedericksz voltage ``pi sqrt(k1 / deps)`` [V], for no pretilt and either field."""
        return pi * sqrt(self.k1 / self.permittivity_anisotropy)


def paper_cell(optics: StatedOptics = PAPER.optics, *, pretilt: float = 0.0) -> Cell:
    """Liquid crystal of Section 3.2 (Ta et al. 2026, below Eqs. 18 and 19).

    `optics` holds the printed numbers; `pretilt` [rad], which the paper does not give, is free.
    """
    return Cell(optics.k1, optics.k3, optics.permittivity, optics.permittivity_anisotropy, pretilt)


CELLS = 800
"""Default number of grid cells [-]; keeps the mean tilt of the paper's cell within 1.1e-5 rad up to 5 V."""
_ITERATIONS = 60
"""Newton steps at most."""


@final
class NotConverged(RuntimeError):  # noqa: N818 - a state of the iteration, named as such
    """Newton's iteration stopped short; holds the voltage, the residual reached and the iterations."""

    def __init__(self, voltage: float, residual: float, iterations: int) -> None:
        self.voltage, self.residual, self.iterations = voltage, residual, iterations
        super().__init__(
            f"director at {voltage:.6g} V: residual {residual:.3g} after {iterations} iterations; allow more "
            "iterations, or keep off the threshold voltage, where the tilt is undetermined to first order."
        )


@final
@dataclass(frozen=True)
class Profile:
    """Equilibrium tilt across the cell at one voltage."""

    voltage: float
    """[V]."""
    position: Vector
    """Fraction of the cell thickness, (n + 1,) [-]."""
    tilt: Vector
    """(n + 1,) [rad], out of the plates."""
    residual: float
    """Largest Euler-Lagrange residual over ``2 k1``, in units of 1 over thickness squared [rad]."""
    iterations: int
    """Newton iterations [-]."""

    @property
    def mean(self) -> float:
        """Spatial mean of the tilt [rad], trapezium rule."""
        return float(np.trapezoid(self.tilt, self.position))

    @property
    def largest(self) -> float:
        """Tilt in the middle of the cell [rad]."""
        return float(self.tilt.max())


@final
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
    lower, upper, squares = rise[:-1], rise[1:], rise[:-1] ** 2 + rise[1:] ** 2
    gradient = (2 * k[:-1] * lower - 2 * k[1:] * upper + slope[1:-1] * squares / 2) / h
    band = np.zeros((2, inner.size))
    band[1] = (2 * (k[:-1] + k[1:]) + 2 * slope[1:-1] * (lower - upper) + bend * squares / 2) / h
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


def grid_threshold(cell: Cell, cells: int = CELLS) -> float:
    """Voltage [V] where the flat state of `cell` turns unstable, ``threshold * sinc(0.5 / cells)``."""
    return cell.threshold * float(np.sinc(0.5 / cells))


def equilibrium(
    cell: Cell,
    voltage: float,
    *,
    field: Field = Field.UNIFORM,
    cells: int = CELLS,
    guess: Vector | None = None,
) -> Profile:
    """Stable tilt profile of `cell` at `voltage` [V], a minimum of the energy of Ta et al. 2026, Eq. 20.

    Minimises the free energy, discretised on `cells` equal cells, by Newton's method: each step solves with
    the Cholesky factor of the Hessian, shifted while it is not positive definite, and must lower the energy.
    The end state is therefore a minimum, never the flat state above threshold. Without pretilt both signs of
    tilt are minima; the positive one is returned, and exactly zero below `grid_threshold`. `guess`
    (cells + 1,) [rad], positive between the plates, starts the iteration, as the profile of a neighbouring
    voltage does.

    Parameters beyond these: `field`, how the voltage spreads over the cell.
    Accuracy: second order in ``1 / cells``, 1.1e-5 rad in the mean at 5 V with the default.
    Raises NotConverged, carrying the residual, after sixty iterations.
    """
    position = np.linspace(0.0, 1.0, cells + 1)
    if voltage == 0 or (cell.pretilt == 0 and voltage <= grid_threshold(cell, cells)):
        flat = np.full(cells + 1, cell.pretilt)
        return Profile(voltage, frozen(position, name="position"), frozen(flat, name="tilt"), 0.0, 0)
    drive = pi * voltage / cell.threshold
    if guess is None:  # half-space profile of the one-constant cell: sin th = tanh(drive * position)
        wall = np.arcsin(np.tanh(drive * np.minimum(position, 1 - position)))
        guess = cell.pretilt + (1 - 2 * cell.pretilt / pi) * wall
    tilt = guess.copy()
    tilt[[0, -1]] = cell.pretilt
    state = expand(cell, field, drive, tilt)
    for count in range(1, _ITERATIONS + 1):
        step, stable = newton_step(state)
        size = float(np.abs(step).max())
        trial, scale = tilt.copy(), 1.0
        while True:
            trial[1:-1] = tilt[1:-1] + scale * step
            new = expand(cell, field, drive, trial)
            # Below 1e-6 rad the change of energy is lost in rounding and a Newton step needs no guard.
            if new.energy < state.energy or (stable and size < 1e-6) or scale < 1e-10:
                break
            scale /= 2
        tilt, state = trial, new
        if stable and size < 1e-9 and tilt[1:-1].min() > 0:
            return Profile(
                voltage,
                frozen(position, name="position"),
                frozen(tilt, name="tilt"),
                _residual(state, cells),
                count,
            )
    raise NotConverged(voltage, _residual(state, cells), _ITERATIONS)


def _residual(state: Expansion, cells: int) -> float:
    return float(np.abs(state.gradient).max()) * cells / 2
