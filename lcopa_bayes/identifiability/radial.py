"""Radial test: a fit far from the maximum, whose likelihood shows whether a direction is free."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
from scipy.optimize import least_squares

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.estimate import plain
from lcopa_bayes.inference.leastsquares import apart
from lcopa_bayes.inference.likelihood import Landscape, Peak

_MOVED = 0.2
"""Share of the radius from which a parameter counts as moved [-]."""
_WEIGHT = 10.0
"""Standardised residual of a point that stays at the maximum: far above what the data object [-]."""


@final
@dataclass(frozen=True)
class Radial:
    """Result of the radial test (Kreutz 2018, Bioinformatics 34)."""

    radius: float
    """Distance requested, in prior standard deviations [-]."""
    reached: float
    """Distance reached [-]."""
    fall: float
    """``2 (max L - L)`` there [nat]."""
    moved: tuple[str, ...]
    """Parameters that moved, farthest first."""

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return plain(vars(self))


def radial(landscape: Landscape, peak: Peak, prior_sd: Vector, direction: Vector, radius: float) -> Radial:
    """The easier of two fits that start along plus and minus `direction` and are pulled to `radius`.

    Plant parameters only, at the noise parameters of `peak`; distances in prior standard deviations
    (`prior_sd`, (rows,)) of the sampled scale.
    """
    least = landscape.least
    centre, scale = least.coordinates(peak.values), prior_sd[least.columns]
    ends = np.array([landscape.search(k) for k in least.columns]).T
    names = [landscape.posterior.table.names[k] for k in least.columns]
    moving = list(range(centre.size))
    base = landscape.rows(centre, peak.values, moving)[0]

    def pulled(x: Vector) -> tuple[Vector, Matrix]:
        residual, jacobian = landscape.rows(x, peak.values, moving)
        away = (x - centre) / scale
        distance = float(np.linalg.norm(away))
        slope = away / scale / max(distance, 1e-12)
        pull = _WEIGHT * (distance - radius) / radius
        return np.append(residual, pull), np.vstack([jacobian, _WEIGHT * slope / radius])

    candidates = []
    for sign in (-1.0, 1.0):
        start = np.clip(centre + 0.1 * sign * radius * scale * direction, *ends)
        solved = least_squares(*apart(pulled, start), bounds=(ends[0], ends[1]), x_scale="jac", max_nfev=100)
        residual = landscape.rows(solved.x, peak.values, moving)[0]
        away = np.abs(solved.x - centre) / scale
        order = [p for p in np.argsort(-away) if away[p] > _MOVED * radius]
        fall = float(residual @ residual - base @ base)
        reached = float(np.linalg.norm(away))
        candidates.append(Radial(radius, reached, max(fall, 0.0), tuple(names[p] for p in order)))
    return min(
        candidates, key=lambda candidate: candidate.fall + (_WEIGHT * (candidate.reached / radius - 1)) ** 2
    )
