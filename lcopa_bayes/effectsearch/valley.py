"""A valley of a posterior that bends, or whose floor is not that of a normal: draws along it.

Where an effect and the plant can take each other's part, the plant that goes with one size of the effect is
another than that with the next, and the curvature at the optimum says neither how far the valley reaches nor
where it leads: of a waiting centroid (`cross_fade`) under plain steps the true size was seven standard
deviations away at a rise of the cost by 2.8 nat. Given the size, the rest is nearly normal: nested Laplace
approximations (Tierney and Kadane 1986, J. Am. Stat. Assoc. 81; Rue, Martino and Chopin 2009, J. R. Stat.
Soc. B 71, sect. 3), one at each of several sizes, weighted by their integrals.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple, final

import numpy as np
from scipy.interpolate import PchipInterpolator

from lcopa_bayes.core.arrays import Flags, Matrix, Vector
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.regression import Optimum, Regression
from lcopa_bayes.effectsearch.sidednormal import SidedNormal
from lcopa_bayes.effectsearch.whitening import Whitening

_ASIDE = 2.0
"""Distance from the optimum at which a valley is compared with a normal [sd]."""
_UNLIKE = 1.5
"""Factor by which the cost there rises more, or less, along a valley that is none of a normal [-]."""
_FIRST, _RISE, _STEPS = 0.5, 0.6, (0.5, 2.0)
"""First step along a valley [sd], rise of the cost that the next are to have [nat], and factors on a step at
most [-]."""
_HIGH = 6.0
"""Rise of the cost above the lowest at which a valley ends [nat]."""
_NEAR = 4.0
"""How far below the largest the density is, at most, where a point of the floor counts [nat]."""
_MOST = 16
"""Steps to either side [-]."""
_EVALUATIONS, _GAIN = 10, 0.02
"""Of a descent at a value, at most [-], and gain of its last step [nat]."""
_FINE = 2001
"""Values among which draws are distributed [-]."""


@final
@dataclass(frozen=True, eq=False)
class Valley:
    """Optima given each of several values of one coordinate, and what is left open there."""

    model: ExtendedModel
    known: int
    """Position of the coordinate."""
    floor: tuple[Optimum, ...]
    """Optima given its value, by rising value."""
    about: tuple[SidedNormal, ...]
    """What each leaves open of the others."""

    @property
    def values(self) -> Vector:
        """Values of the coordinate, (n,)."""
        return np.array([one.x[self.known] for one in self.floor])

    @property
    def log_density(self) -> Vector:
        """Of these values, up to a constant, (n,) [nat]."""
        return np.array([one.log_volume - at.cost for one, at in zip(self.about, self.floor, strict=True)])

    def draws(self, rng: np.random.Generator, count: int) -> FloorDraws:
        """So many points of the floor, their cost, and shifts from them."""
        values = self.values
        fine = np.linspace(values[0], values[-1], _FINE)
        level = PchipInterpolator(values, self.log_density)(fine)
        density = np.exp(level - level.max())
        below = np.append(0.0, np.cumsum(density[1:] + density[:-1]))
        value = np.interp(rng.random(count), below / below[-1], fine)
        middle = np.asarray(PchipInterpolator(values, np.array([one.x for one in self.floor]))(value))
        least = np.asarray(PchipInterpolator(values, np.array([one.cost for one in self.floor]))(value))
        nearest = np.abs(value[:, None] - values).argmin(axis=1)
        shift = np.zeros_like(middle)
        for place, normal in enumerate(self.about):
            own = np.flatnonzero(nearest == place)
            if own.size:
                supported = partial(self._supported, place)
                shift[own] = normal.inside(supported, rng, own.size)
        return FloorDraws(middle, least, shift)

    def aside(self, optimum: Optimum) -> list[Vector]:
        """Coordinates of those points of the floor beside an optimum that its draws are about, (k,) each."""
        level = self.log_density
        pairs = zip(self.floor, level > level.max() - _NEAR, strict=True)
        return [one.x for one, counts in pairs if counts and one is not optimum]

    def _supported(self, place: int, shift: Matrix) -> Flags:
        return self.model.inside(self.floor[place].x + shift)


@final
class FloorDraws(NamedTuple):
    """Draws about the floor of a valley."""

    middle: Matrix
    """Points of the floor, (draws, k)."""
    least: Vector
    """Cost there, (draws,) [nat]."""
    shift: Matrix
    """From them, (draws, k)."""


@lru_cache(maxsize=2)
def valley_of(model: ExtendedModel, optimum: Optimum, whitening: Whitening) -> Valley | None:
    """That of the coefficient along which the cost about an optimum is least that of a normal; None where it
    is that of one along all."""
    regression = Regression(model, whitening)
    unlike = {k: _unlike(regression, optimum, k) for k in _shared(model)}
    known = max(unlike, key=unlike.__getitem__, default=None)
    if known is None or unlike[known] < np.log(_UNLIKE):
        return None
    below, above = (list(_along(regression, optimum, known, side)) for side in (-1.0, 1.0))
    floor = (*reversed(below), optimum, *above)
    if len(floor) == 1:
        return None
    about = (SidedNormal.about(one, model.spread, regression.costs_inside, known) for one in floor)
    return Valley(model, known, floor, tuple(about))


def _shared(model: ExtendedModel) -> list[int]:
    """Coordinates that are coefficients of all records."""
    placed = enumerate(model.effected.coefficients) if model.effects else ()
    return [model.plant_size + k for k, one in placed if one.record is None]


def _unlike(regression: Regression, optimum: Optimum, k: int) -> float:
    """How far the rise of the cost along a valley is from that of a normal, the larger of both sides [nat
    per nat, logarithm]."""
    x, out = optimum.x, [0.0]
    towards = optimum.covariance[:, k] / optimum.sd[k]
    for side in (-_ASIDE, _ASIDE):
        value = x[k] + side * optimum.sd[k]
        if not regression.model.bounds[0][k] <= value <= regression.model.bounds[1][k]:
            continue
        try:
            there = _given(regression, k, value, x + side * towards)
        except ArithmeticError:  # no bounded response
            continue
        rise = max(regression.cost(there) - optimum.cost, 1e-3)
        out.append(abs(float(np.log(rise / (0.5 * side**2)))))
    return max(out)


def _given(regression: Regression, k: int, value: float, start: Vector) -> Vector:
    """Coordinates of the optimum given the value of one."""
    start = np.clip(start, *regression.model.bounds)  # a start only
    return regression.along(k, value, start, most=_EVALUATIONS, gain=_GAIN)


def _along(regression: Regression, optimum: Optimum, k: int, side: float) -> Iterator[Optimum]:
    """Optima given values of a coordinate to one side of its own, in steps of like rise, until the cost is
    high above the lowest or the support ends."""
    ends = regression.model.bounds[0][k], regression.model.bounds[1][k]
    step, last, lowest = side * _FIRST * optimum.sd[k], optimum, optimum.cost
    slope = optimum.covariance[:, k] / optimum.covariance[k, k]
    for _ in range(_MOST):
        value = float(np.clip(last.x[k] + step, *ends))  # the last value is the end of the support
        if value == last.x[k]:
            return
        try:
            there = regression.at(_given(regression, k, value, last.x + (value - last.x[k]) * slope))
        except ArithmeticError:  # no bounded response
            return
        yield there
        slope = (there.x - last.x) / (there.x[k] - last.x[k])
        rise = max(there.cost - last.cost, 0.0)
        step *= float(np.clip(_RISE / max(rise, 1e-9), *_STEPS))
        last, lowest = there, min(lowest, there.cost)
        if there.cost > lowest + _HIGH:
            return
