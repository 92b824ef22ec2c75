"""Draws about the optimum of a model that follow the records.

The posterior of a plant with a term that the records do not need is no normal one: along a ridge the
likelihood is flat, off it falls steeply, and most normal draws are plants that the records reject, by
hundreds of nat, with steady values of twice the true one. A normal with a scale of its own to each side of
each principal axis (Geweke 1989, Econometrica 57, sect. 5) follows such a posterior far better; what it still
draws too far off is drawn nearer to the optimum, and left out at last.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self, final

import numpy as np
from scipy.stats import chi2, truncnorm

from lcopa_bayes.core.arrays import Flags, Index, Matrix, Vector
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.scores import State

CHANCE = 1e-3
"""Probability of a draw of a normal posterior so far below its optimum that it is left out [-]."""
_NEARER = (1.0, 0.5, 0.25)
"""Shares of its distance from the optimum at which a draw is tried [-]."""
_NEAR, _WANTED = 2.0, 0.5
"""Rise of the cost at which a scale is read off, at most, and at one standard deviation of a normal [nat]."""
_TRIES = 16
"""Times as many draws as are wanted, of which those inside the support are taken [-]."""
_SHORTER, _SHORTEST, _LONGER = 0.05, 1e-4, 1e6
"""Factors by which a step along an axis is shortened at most, shares of the normal scale that end it, and
factor over a step at which a cost has not risen."""


def likely_draws(state: State, rng: np.random.Generator, count: int) -> Matrix:
    """Of `count` draws, those inside the support that follow the records, the optimum first, (draws,
    coordinates); their likelihood is computed, and that of some steps along each principal axis.

    Coordinates that an end of their support holds are drawn on its inner side, each by itself, with the slope
    of the likelihood there: of normal draws of several of them at once none may be inside.
    """
    x, regression = state.optimum.x, Regression(state.model, state.whitening)

    def rises(many: Matrix) -> Vector:
        inside = _supported(state, many)
        out = np.full(len(many), np.inf)
        out[inside] = regression.costs(many[inside]) - state.optimum.cost
        return out

    normal = _SidedNormal.about(state, rises)
    shift = normal.inside(lambda shift: _supported(state, x + shift), rng, count)
    limit = float(chi2.isf(CHANCE, x.size)) / 2
    kept, left = np.full((count, x.size), np.nan), np.arange(count)
    for share in _NEARER:
        near = x + share * shift[left]
        follow = rises(near) <= limit
        kept[left[follow]] = near[follow]
        left = left[~follow]
    return np.concatenate([x[None], np.delete(kept, left, axis=0)])


def draws_about(state: State, rng: np.random.Generator, count: int) -> Matrix:
    """Those of `likely_draws` with all that noise and held constants leave open, (draws, coordinates)."""
    return beside_constants(state, under_plausible_noise(state, likely_draws(state, rng, count), rng), rng)


def under_plausible_noise(state: State, drawn: Matrix, rng: np.random.Generator) -> Matrix:
    """Draws of coordinates as far from the optimum as under noise that the residual leaves plausible, where
    nothing else tells it: of correlated noise 90 % intervals under the residual's own hold 0.75 to 0.8."""
    if state.stretches is None:
        return drawn
    x, which = state.optimum.x, rng.integers(len(state.stretches), size=len(drawn))
    moved = x + np.einsum("dkl,dl->dk", state.stretches[which], drawn - x)
    return np.where(_supported(state, moved)[:, None], moved, drawn)


def beside_constants(state: State, drawn: Matrix, rng: np.random.Generator) -> Matrix:
    """Draws of coordinates at internal constants of the effects that are held, moved as far as what these
    leave open moves them; predictions have to be those of the draws themselves, at these constants."""
    if state.spread is None:
        return drawn
    beyond = _beyond(state.spread, state.optimum.covariance)
    moved = drawn + rng.standard_normal(drawn.shape) @ beyond.T
    return np.where(_supported(state, moved)[:, None], moved, drawn)


def _supported(state: State, many: Matrix) -> Flags:
    low, high = state.model.bounds
    inside: Flags = np.asarray(((many >= low) & (many <= high)).all(axis=1))
    inside[inside] = state.model.supported(many[inside])
    return inside


def _beyond(whole: Matrix, part: Matrix) -> Matrix:
    """A factor of what one covariance has over another, (k, k); where it has less, of nothing."""
    sd = np.sqrt(np.diag(whole))
    power, axes = np.linalg.eigh((whole - part) / np.outer(sd, sd))
    return np.asarray(sd[:, None] * axes * np.sqrt(np.maximum(power, 0.0)))


@final
@dataclass(frozen=True, eq=False)
class _SidedNormal:
    """Shifts of coordinates from an optimum: of those that an end of their support holds by the slope there,
    of the others given these with a scale to each side of each principal axis."""

    stuck: Flags
    """Whether an end of the support holds a coordinate, (k,)."""
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
    def about(cls, state: State, rises: Callable[[Matrix], Vector]) -> Self:
        """Of a state, whose cost `rises` from its optimum to coordinates (n, k) [nat]."""
        optimum, stuck, whole = state.optimum, state.optimum.stuck, state.optimum.covariance
        onto = whole[np.ix_(~stuck, stuck)] @ np.linalg.pinv(whole[np.ix_(stuck, stuck)])
        given = whole[np.ix_(~stuck, ~stuck)] - onto @ whole[np.ix_(stuck, ~stuck)]
        spread = state.model.spread[~stuck]
        power, own = np.linalg.eigh(given / np.outer(spread, spread))
        axes = np.zeros((spread.size, stuck.size))
        axes[:, ~stuck] = (own * spread[:, None]).T
        sides = np.stack([-axes, axes], axis=1).reshape(-1, stuck.size)
        scales = _scales(
            lambda step, which: rises(optimum.x + step[:, None] * sides[which]),
            np.repeat(np.sqrt(np.maximum(power, 0.0)), 2),
        )
        slope, sd = (optimum.jacobian.T @ optimum.white)[stuck], np.sqrt(np.diag(whole))[stuck]
        return cls(stuck, slope, sd, onto, axes, scales.reshape(-1, 2))

    def draw(self, rng: np.random.Generator, count: int) -> Matrix:
        """So many shifts, (count, k)."""
        shift, steep = np.zeros((count, self.stuck.size)), np.abs(self.slope) * self.sd
        inward = truncnorm(steep, np.inf, -steep * self.sd, self.sd).rvs(
            (count, steep.size), random_state=rng
        )
        shift[:, self.stuck] = -np.sign(self.slope) * inward
        shift[:, ~self.stuck] = shift[:, self.stuck] @ self.onto.T
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
