"""Equilibrium director of a cell by energy minimisation (Ta et al. 2026, Eqs. 18-20); tilt as in `cell`."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite, pi
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Vector, frozen
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.optics.cell import Cell, Field
from lcopa_bayes.optics.checks import finite
from lcopa_bayes.optics.freeenergy import Expansion, expand, newton_step

CELLS = 800
"""Default number of grid cells [-]; keeps the mean tilt of the paper's cell within 1.1e-5 rad up to 5 V."""
_PER_LAYER = 4
"""Least grid cells per wall layer ``sqrt(k1 / deps) / V`` [-]; coarser grids do not see the wall."""


class NotConverged(RuntimeError):  # noqa: N818 - a state of the iteration, named as such
    """Newton's iteration stopped short; carries the voltage, the residual reached and the iterations."""

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
    iterations: int = 60,
) -> Profile:
    """Stable tilt profile of `cell` at `voltage` [V], a minimum of the energy of Ta et al. 2026, Eq. 20.

    Minimises the free energy, discretised on `cells` equal cells, by Newton's method: each step solves with
    the Cholesky factor of the Hessian, shifted while it is not positive definite, and must lower the energy.
    The end state is therefore a minimum, never the flat state above threshold. Without pretilt both signs of
    tilt are minima; the positive one is returned, and exactly zero below `grid_threshold`. `guess`
    (cells + 1,) [rad] starts the iteration, e.g. the profile of a neighbouring voltage.

    Parameters beyond these: `field`, how the voltage spreads over the cell.
    Accuracy: second order in ``1 / cells``, 1.1e-5 rad in the mean at 5 V with the default.
    Raises InputError for a negative or non-finite voltage, fewer than 8 cells, or a grid too coarse for the
    voltage; NotConverged, carrying the residual, after `iterations`.
    """
    _check(cell, voltage, cells)
    position = np.linspace(0.0, 1.0, cells + 1)
    if voltage == 0 or (cell.pretilt == 0 and voltage <= grid_threshold(cell, cells)):
        flat = np.full(cells + 1, cell.pretilt)
        return Profile(voltage, frozen(position, name="position"), frozen(flat, name="tilt"), 0.0, 0)
    drive = pi * voltage / cell.threshold
    if guess is None:  # half-space profile of the one-constant cell: sin th = tanh(drive * position)
        wall = np.arcsin(np.tanh(drive * np.minimum(position, 1 - position)))
        guess = cell.pretilt + (1 - 2 * cell.pretilt / pi) * wall
    tilt = finite(guess, name="guess", unit="rad").copy()
    if tilt.shape != position.shape or tilt[1:-1].min() <= 0:
        raise InputError(
            f"`guess` must be {cells + 1} tilts [rad], positive between the plates: pass a tilted profile."
        )
    tilt[[0, -1]] = cell.pretilt
    state = expand(cell, field, drive, tilt)
    for count in range(1, iterations + 1):
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
    raise NotConverged(voltage, _residual(state, cells), iterations)


def _residual(state: Expansion, cells: int) -> float:
    return float(np.abs(state.gradient).max()) * cells / 2


def _check(cell: Cell, voltage: float, cells: int) -> None:
    problems = []
    if not (isfinite(voltage) and voltage >= 0):
        problems.append(f"`voltage` must be finite and not negative [V]; got {voltage!r}: give its size.")
    if cells < 8:
        problems.append(f"`cells` must be at least 8; got {cells}: the wall layers need a grid.")
    elif isfinite(voltage) and voltage * _PER_LAYER * pi > cells * cell.threshold:
        need = int(np.ceil(voltage * _PER_LAYER * pi / cell.threshold))
        problems.append(f"{cells} cells are too few at {voltage:.6g} V; use at least {need}.")
    if problems:
        raise InputError(problems)
