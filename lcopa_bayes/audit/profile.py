"""Profile likelihood: how far one parameter may move while all others make up for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

import numpy as np
from scipy.stats import chi2

from lcopa_bayes.arrays import Vector
from lcopa_bayes.estimate import LEVEL, plain

LEVELS = (0.68, LEVEL, 0.95)
"""Two-sided levels at which intervals are read [-]."""


def fall_at(level: float) -> float:
    """Fall of twice the log likelihood at the ends of a two-sided interval of one parameter [nat]."""
    return float(chi2.ppf(level, 1))


@final
@dataclass(frozen=True, eq=False)
class Profile:
    """Largest likelihood at each value of one parameter.

    Confidence intervals hold where ``2 (max L - L)`` is below the quantile of chi^2 with one degree of
    freedom (Venzon and Moolgavkar 1988, Applied Statistics 37); a side is open when the fall does not
    reach it before the end of the search (Raue et al. 2009, Bioinformatics 25).
    """

    parameter: str
    unit: str
    coordinates: Vector
    """Points of the profile on the sampled scale, increasing, (n,)."""
    values: Vector
    """The same in `unit`, (n,)."""
    log_likelihood: Vector
    """Profile there, (n,) [nat]."""
    best: float
    """Largest log likelihood known [nat]."""
    at_bound: tuple[str, ...]
    """Other parameters that stand at an end of their search within the widest interval."""
    ends: tuple[float, float]
    """Ends of the search, in `unit`."""
    moving: tuple[str, ...]
    """Other parameters that move within that interval to make up for this one, farthest first."""
    top: Vector
    """Table values of the highest point, (rows,)."""

    @property
    def fall(self) -> Vector:
        """``2 (max L - L)``, (n,) [nat]."""
        return np.maximum(2 * (self.best - self.log_likelihood), 0.0)

    @cached_property
    def intervals(self) -> Mapping[float, tuple[float | None, float | None]]:
        """Lower and upper end by level, in `unit`; None is open."""
        return {level: (self._end(level, -1), self._end(level, 1)) for level in LEVELS}

    def _end(self, level: float, side: int) -> float | None:
        """Outermost crossing on a side, linear in the root of the fall; None when there is none."""
        u, root, wanted = self.coordinates[::side], np.sqrt(self.fall)[::side], np.sqrt(fall_at(level))
        inside = np.flatnonzero(root <= wanted)
        last = int(inside[-1])
        if last == u.size - 1:
            return None
        share = (wanted - root[last]) / (root[last + 1] - root[last])
        at = u[last] + share * (u[last + 1] - u[last])
        return float(np.interp(at, self.coordinates, self.values))

    @property
    def open_sides(self) -> tuple[str, ...]:
        """Which sides are open at `LEVEL`."""
        lower, upper = self.intervals[LEVEL]
        return tuple(side for side, end in (("below", lower), ("above", upper)) if end is None)

    @property
    def parts(self) -> int:
        """Number of separate stretches of the interval at `LEVEL`."""
        inside = self.fall <= fall_at(LEVEL)
        return int(inside[0]) + int(np.sum(inside[1:] & ~inside[:-1]))

    def as_json(self) -> dict[str, Any]:
        """Plain values; an open side is None."""
        lower, upper = self.intervals[LEVEL]
        told: dict[str, Any] = plain(
            {
                "lower": lower,
                "upper": upper,
                "level": LEVEL,
                "interval": "profile likelihood",
                "levels": [
                    {"level": level, "lower": ends[0], "upper": ends[1]}
                    for level, ends in self.intervals.items()
                ],
                "searched": self.ends,
                "nuisance_at_bound": self.at_bound,
                "nuisance_moving": self.moving,
                "parts": self.parts,
                "values": self.values,
                "fall": self.fall,
            }
        )
        return told
