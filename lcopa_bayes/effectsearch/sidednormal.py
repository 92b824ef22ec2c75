"""A normal with a scale of its own to each side of each principal axis, which follows a posterior that is
flat along a ridge and falls steeply off it far better than a normal (Geweke 1989, Econometrica 57, sect. 5).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self, TypeAlias, final

import numpy as np
from scipy.special import log_ndtr
from scipy.stats import truncnorm

from lcopa_bayes.core.arrays import Flags, Index, Matrix, Vector
from lcopa_bayes.effectsearch.regression import Optimum

_NEAR, _WANTED = 2.0, 0.5
"""Rise of the cost at which a scale is read off, at most, and at one standard deviation of a normal [nat]."""
_TRIES = 16
"""Times as many draws as are wanted, of which those inside the support are taken [-]."""
_SHORTER, _SHORTEST, _LONGER = 0.05, 1e-4, 1e6
"""Factors by which a step along an axis is shortened at most, shares of the normal scale that end it, and
factor over a step at which a cost has not risen."""

Costs: TypeAlias = Callable[[Matrix], Vector]
"""Cost at coordinates (batch, k), infinite beyond the support, (batch,) [nat]."""


@final
@dataclass(frozen=True, eq=False)
class SidedNormal:
    """Shifts of coordinates from an optimum: of those that an end of their support holds by the slope there,
    of the others given these with a scale to each side of each principal axis."""

    stuck: Flags
    """Whether an end of the support holds a coordinate, (k,)."""
    free: Flags
    """Whether a coordinate may go either way, (k,)."""
    slope: Vector
    """Of the cost where it does, (stuck,) [nat]."""
    sd: Vector
    """Standard deviations there, (stuck,)."""
    onto: Matrix
    """Shift of the others by these, (free, stuck)."""
    axes: Matrix
    """Directions of the others, in rows, (free, k)."""
    scales: Matrix
    """Standard deviations below and above along each, (free, 2)."""

    @classmethod
    def about(cls, optimum: Optimum, spread: Vector, costs: Costs, known: int | None = None) -> Self:
        """Of an optimum of coordinates of a prior `spread`, (k,), and the `costs` about it; with the
        coordinate `known` where it is, of the optimum given that."""
        given = np.arange(optimum.x.size) == known
        stuck, whole = optimum.stuck & ~given, optimum.covariance
        free = ~(stuck | given)
        if known is not None:
            whole = whole - np.outer(whole[known], whole[known]) / whole[known, known]
        onto = whole[np.ix_(free, stuck)] @ np.linalg.pinv(whole[np.ix_(stuck, stuck)])
        others = whole[np.ix_(free, free)] - onto @ whole[np.ix_(stuck, free)]
        power, own = np.linalg.eigh(others / np.outer(spread[free], spread[free]))
        axes = np.zeros((own.shape[0], stuck.size))
        axes[:, free] = (own * spread[free, None]).T
        sides = np.stack([-axes, axes], axis=1).reshape(-1, stuck.size)
        scales = _scales(
            lambda step, which: costs(optimum.x + step[:, None] * sides[which]) - optimum.cost,
            np.repeat(np.sqrt(np.maximum(power, 0.0)), 2),
        )
        slope, sd = (optimum.jacobian.T @ optimum.white)[stuck], np.sqrt(np.diag(whole)[stuck])
        return cls(stuck, free, slope, sd, onto, axes, scales.reshape(-1, 2))

    @property
    def log_volume(self) -> float:
        """Log integral of its density, 1 at the optimum, over the coordinates that are not known [-]."""
        steep = np.abs(self.slope) * self.sd
        held = np.log(self.sd) + 0.5 * steep**2 + log_ndtr(-steep)
        wide = np.log(self.scales.mean(axis=1)).sum() + np.linalg.slogdet(self.axes[:, self.free])[1]
        constant = 0.5 * np.log(2 * np.pi) * (steep.size + len(self.axes))
        return float(held.sum() + wide + constant)

    def draw(self, rng: np.random.Generator, count: int) -> Matrix:
        """So many shifts, (count, k)."""
        shift, steep = np.zeros((count, self.stuck.size)), np.abs(self.slope) * self.sd
        inward = truncnorm(steep, np.inf, -steep * self.sd, self.sd).rvs(
            (count, steep.size), random_state=rng
        )
        shift[:, self.stuck] = -np.sign(self.slope) * inward
        shift[:, self.free] = shift[:, self.stuck] @ self.onto.T
        z = rng.standard_normal((count, len(self.axes)))
        return np.asarray(shift + (np.where(z < 0, self.scales[:, 0], self.scales[:, 1]) * z) @ self.axes)

    def inside(self, supported: Callable[[Matrix], Flags], rng: np.random.Generator, count: int) -> Matrix:
        """So many of those that are `supported`, (count, k), and others where `_TRIES` as many give too
        few."""
        kept = np.empty((0, self.stuck.size))
        for _ in range(_TRIES):
            drawn = self.draw(rng, count)
            kept = np.concatenate([kept, drawn[supported(drawn)]])
            if len(kept) >= count:
                break
        return np.concatenate([kept, drawn])[:count]


def _scales(rises: Callable[[Vector, Index], Vector], sd: Vector) -> Vector:
    """Standard deviations to the sides of axes, (sides,), each of the normal whose log density falls as the
    cost `rises` with the step, and not more than `sd`; `rises` takes steps and the sides they go to, and is
    infinite beyond the support: of a side that lies there as a whole the scale is `sd`."""
    step, out = sd.copy(), np.full(sd.size, np.nan)
    left = np.flatnonzero(sd > 0)
    out[sd <= 0] = 0.0
    while left.size:
        risen = rises(step[left], left)
        here, beyond = step[left], np.isinf(risen)
        read = (risen <= _NEAR) | (here <= _SHORTEST * sd[left])
        ratio = np.sqrt(_WANTED / np.maximum(risen, 1e-300))
        scale = np.minimum(here * np.where(beyond, np.inf, np.minimum(ratio, _LONGER)), sd[left])
        out[left[read]] = scale[read]
        step[left] = np.where(beyond, here / 2, here * np.maximum(_SHORTER, np.minimum(ratio, 1.0)))
        left = left[~read]
    return out
