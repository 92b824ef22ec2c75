"""Profile likelihood: how far one parameter may move while all others compensate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

import numpy as np
from scipy.stats import chi2, t

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.estimate import LEVEL, plain
from lcopa_bayes.inference.posterior import Posterior

LEVELS = (0.68, LEVEL, 0.95)
"""Two-sided levels at which intervals are read [-]."""


@final
@dataclass(frozen=True)
class Freedom:
    """Numbers of samples and of fitted parameters."""

    samples: int
    fitted: int
    """Parameters of the plant."""
    scale_known: bool
    """Whether the noise scale is fixed."""

    @classmethod
    def of(cls, posterior: Posterior) -> Freedom:
        """Of a posterior's likelihood; samples of all axes count as one."""
        free = [row for row in posterior.table.rows if row.free]
        plant = sum(not row.noise for row in free)
        return cls(posterior.size, plant, not any(row.declared.noise == "scale" for row in free))

    def fall_at(self, level: float) -> float:
        """Fall of twice the log likelihood at the ends of a two-sided interval of one parameter [nat].

        With n samples, nu = n - fitted and Student's t, ``n log(1 + t_nu^2 / nu)``: exact for responses
        linear in the parameters and white noise of one unknown scale, where the likelihood ratio is a
        function of Student's t. The quantile of chi^2 is its limit for many samples; with 20 samples and 5
        parameters an interval of 90 % that is read at the quantile holds the truth in 83 %.
        """
        degrees = self.samples - self.fitted
        if self.scale_known or degrees < 1:
            return float(chi2.ppf(level, 1))
        return self.samples * float(np.log1p(t.ppf((1 + level) / 2, degrees) ** 2 / degrees))


@final
@dataclass(frozen=True, eq=False)
class Profile:
    """Largest likelihood at each value of one parameter.

    Confidence intervals hold where ``2 (max L - L)`` is below `Freedom.fall_at` (Venzon and Moolgavkar 1988,
    Applied Statistics 37); a side is open when the fall does not reach it before the end of the search (Raue
    et al. 2009, Bioinformatics 25).
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
    """Other parameters that are at an end of their search within the widest interval."""
    ends: tuple[float, float]
    """Ends of the search, in `unit`."""
    moving: tuple[str, ...]
    """Other parameters that move within that interval to compensate the change, farthest first."""
    top: Vector
    """Table values of the highest point, (rows,)."""
    freedom: Freedom

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
        u, root = self.coordinates[::side], np.sqrt(self.fall)[::side]
        wanted = np.sqrt(self.freedom.fall_at(level))
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

    def said_end(self, side: int) -> str:
        """An end of the search as the study states it, without the margin of 1e-6 that is kept from it."""
        linear = bool(np.all(self.coordinates == self.values))
        at = self.ends[side]
        return f"{0.0 if linear and abs(at) < 1e-5 * np.ptp(self.ends) else at:.4g}"

    @property
    def parts(self) -> int:
        """Number of separate stretches of the interval at `LEVEL`."""
        inside = self.fall <= self.freedom.fall_at(LEVEL)
        return int(inside[0]) + int(np.sum(inside[1:] & ~inside[:-1]))

    def as_json(self) -> dict[str, Any]:
        """Plain values; an open side is None."""
        lower, upper = self.intervals[LEVEL]
        return plain(
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
