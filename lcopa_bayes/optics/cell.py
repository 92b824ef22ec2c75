"""Planar nematic cell with strong anchoring: its material and the field inside it.

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
from typing import Annotated

from lcopa_bayes.core.rules import POSITIVE, Ruled
from lcopa_bayes.model.literature import PAPER, StatedOptics
from lcopa_bayes.optics.checks import PRETILT


class Field(Enum):
    """Field inside the cell."""

    UNIFORM = "uniform"
    """``dV/dz = V / d`` everywhere: the plain reading of Ta et al. 2026, Eq. 20."""
    SELF_CONSISTENT = "self-consistent"
    """Constant displacement ``D``, ``dV/dz = D / (eps + deps sin^2 th)``, which integrates to V."""


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
