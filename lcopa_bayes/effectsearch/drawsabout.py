"""Draws about the optimum of a model that follow the records.

The posterior of a plant with a term that the records do not need is no normal one: along a ridge the
likelihood is flat, off it falls steeply, and most normal draws are plants that the records reject, by
hundreds of nat, with steady values of twice the true one. A normal with a scale of its own to each side of
each principal axis (Geweke 1989, Econometrica 57, sect. 5) follows such a posterior far better; what it still
draws too far off is drawn nearer to the optimum, and left out at last.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.stats import chi2, truncnorm

from lcopa_bayes.core.arrays import Flags, Index, Matrix, Vector
from lcopa_bayes.effectsearch.regression import Optimum, Regression
from lcopa_bayes.effectsearch.scores import State

CHANCE = 1e-3
"""Probability of a draw of a normal posterior so far below its optimum that it is left out [-]."""
_NEARER = (1.0, 0.5, 0.25)
"""Shares of its distance from the optimum at which a draw is tried [-]."""
_NEAR, _WANTED = 2.0, 0.5
"""Rise of the cost at which a scale is read off, at most, and at one standard deviation of a normal [nat]."""
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

    shift, given = _held(state.optimum, rng, count)
    free = np.flatnonzero(~state.optimum.stuck)
    spread = state.model.spread[free]
    power, axes = np.linalg.eigh(given / np.outer(spread, spread))
    sd = np.repeat(np.sqrt(np.maximum(power, 0.0)), 2)
    onto = np.zeros((free.size, x.size))
    onto[:, free] = (axes * spread[:, None]).T
    sides = np.stack([-onto, onto], axis=1).reshape(-1, x.size)
    scales = _scales(lambda step, which: rises(x + step[:, None] * sides[which]), sd).reshape(-1, 2)
    z = rng.standard_normal((count, free.size))
    shift += (np.where(z < 0, scales[:, 0], scales[:, 1]) * z) @ onto
    limit = float(chi2.isf(CHANCE, x.size)) / 2
    kept, left = np.full((count, x.size), np.nan), np.arange(count)
    for share in _NEARER:
        near = x + share * shift[left]
        follow = rises(near) <= limit
        kept[left[follow]] = near[follow]
        left = left[~follow]
    return np.concatenate([x[None], np.delete(kept, left, axis=0)])


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
    return np.asarray(((many >= low) & (many <= high)).all(axis=1) & state.model.supported(many))


def _beyond(whole: Matrix, part: Matrix) -> Matrix:
    """A factor of what one covariance has over another, (k, k); where it has less, of nothing."""
    sd = np.sqrt(np.diag(whole))
    power, axes = np.linalg.eigh((whole - part) / np.outer(sd, sd))
    return np.asarray(sd[:, None] * axes * np.sqrt(np.maximum(power, 0.0)))


def _held(optimum: Optimum, rng: np.random.Generator, count: int) -> tuple[Matrix, Matrix]:
    """Shifts of the coordinates that an end of their support holds, and of the others by these, (count,
    coordinates); and the covariance of the others given them."""
    whole, stuck = optimum.covariance, optimum.stuck
    shift = np.zeros((count, optimum.x.size))
    slope, sd = (optimum.jacobian.T @ optimum.white)[stuck], np.sqrt(np.diag(whole))[stuck]
    steep = np.abs(slope) * sd
    inward = truncnorm(steep, np.inf, -steep * sd, sd).rvs((count, steep.size), random_state=rng)
    shift[:, stuck] = -np.sign(slope) * inward
    onto = whole[np.ix_(~stuck, stuck)] @ np.linalg.pinv(whole[np.ix_(stuck, stuck)])
    shift[:, ~stuck] = shift[:, stuck] @ onto.T
    return shift, np.asarray(whole[np.ix_(~stuck, ~stuck)] - onto @ whole[np.ix_(stuck, ~stuck)])


def _scales(rises: Callable[[Vector, Index], Vector], sd: Vector) -> Vector:
    """Standard deviations to the sides of axes, (sides,), each of the normal whose log density falls as the
    cost `rises` with the step, and not more than `sd`; `rises` takes steps and the sides they go to."""
    step, most, out = sd.copy(), sd.copy(), np.full(sd.size, np.nan)
    left = np.flatnonzero(sd > 0)
    out[sd <= 0] = 0.0
    while left.size:
        risen = rises(step[left], left)
        here, beyond = step[left], np.isinf(risen)  # beyond the support, where no normal ends
        read = (risen <= _NEAR) | (here <= _SHORTEST * sd[left])
        ratio = np.sqrt(_WANTED / np.maximum(risen, 1e-300))
        out[left[read]] = np.minimum(most[left], here * np.minimum(ratio, _LONGER))[read]
        step[left] = np.where(beyond, here / 2, here * np.maximum(_SHORTER, np.minimum(ratio, 1.0)))
        most[left[beyond]] = step[left[beyond]]
        left = left[~read]
    return out
