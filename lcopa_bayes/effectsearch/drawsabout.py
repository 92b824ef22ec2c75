"""Draws about the optimum of a model: normal ones, and ones that follow the records where these are not.

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

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.covariance import root_of
from lcopa_bayes.effectsearch.regression import Optimum, Regression
from lcopa_bayes.effectsearch.scores import State

_CHANCE = 1e-3
"""Probability of a draw of a normal posterior so far below its optimum that it is left out [-]."""
_NEARER = (1.0, 0.5, 0.25)
"""Shares of its distance from the optimum at which a draw is tried [-]."""
_NEAR, _WANTED = 2.0, 0.5
"""Rise of the cost at which a scale is read off, at most, and at one standard deviation of a normal [nat]."""
_SHORTER, _SHORTEST = 0.05, 1e-4
"""Factor by which a step along an axis is shortened at most, and share of the normal scale that ends it."""


def normal_draws(state: State, rng: np.random.Generator, count: int) -> Matrix:
    """Normal draws about an optimum, (count + 1, coordinates), the optimum first; some may be outside of the
    support.

    Coordinates that an end of their support holds are drawn on its inner side, each by itself, with the slope
    of the likelihood there: of normal draws of several of them at once none may be inside.
    """
    shift, given = _held(state, rng, count)
    free = ~state.optimum.stuck
    shift[:, free] += rng.standard_normal((count, len(given))) @ root_of(given).T
    return np.concatenate([state.optimum.x[None], state.optimum.x + shift])


def likely_draws(state: State, rng: np.random.Generator, count: int) -> Matrix:
    """Of `count` draws, those inside the support that follow the records, the optimum first, (draws,
    coordinates); their likelihood is computed, and that of some steps along each principal axis."""
    x, stuck, (low, high) = state.optimum.x, state.optimum.stuck, state.model.bounds
    regression = Regression(state.model, state.whitening)

    def rise(there: Vector) -> float:
        inside = ((there >= low) & (there <= high)).all()
        return regression.cost(there) - state.optimum.cost if inside else np.inf

    shift, given = _held(state, rng, count)
    free = np.flatnonzero(~stuck)
    spread = state.model.spread[free]
    power, axes = np.linalg.eigh(given / np.outer(spread, spread))
    sd, axes = np.sqrt(np.maximum(power, 0.0)), axes * spread[:, None]

    def along(axis: Vector) -> Callable[[float], float]:
        def at(step: float) -> float:
            there = x.copy()
            there[free] += step * axis
            return rise(there)

        return at

    scales = np.array(
        [[_scale(along(side * axis), one) for side in (-1, 1)] for axis, one in zip(axes.T, sd, strict=True)]
    ).reshape(-1, 2)
    z = rng.standard_normal((count, free.size))
    shift[:, free] += (np.where(z < 0, scales[:, 0], scales[:, 1]) * z) @ axes.T
    limit = float(chi2.isf(_CHANCE, x.size)) / 2
    kept = [x]
    for one in shift:
        near = next((x + share * one for share in _NEARER if rise(x + share * one) <= limit), None)
        kept += [] if near is None else [near]
    return np.array(kept)


def _held(state: State, rng: np.random.Generator, count: int) -> tuple[Matrix, Matrix]:
    """Shifts of the coordinates that an end of their support holds, and of the others by these, (count,
    coordinates); and the covariance of the others given them."""
    optimum: Optimum = state.optimum
    whole, stuck = state.covariance, optimum.stuck
    shift = np.zeros((count, optimum.x.size))
    slope, sd = (optimum.jacobian.T @ optimum.white)[stuck], np.sqrt(np.diag(whole))[stuck]
    steep = np.abs(slope) * sd
    inward = truncnorm(steep, np.inf, -steep * sd, sd).rvs((count, steep.size), random_state=rng)
    shift[:, stuck] = -np.sign(slope) * inward
    onto = whole[np.ix_(~stuck, stuck)] @ np.linalg.pinv(whole[np.ix_(stuck, stuck)])
    shift[:, ~stuck] = shift[:, stuck] @ onto.T
    return shift, np.asarray(whole[np.ix_(~stuck, ~stuck)] - onto @ whole[np.ix_(stuck, ~stuck)])


def _scale(rise: Callable[[float], float], sd: float) -> float:
    """Standard deviation to one side of an axis: of the normal whose log density falls as the `rise` of the
    cost with the step, not more than `sd`."""
    step = most = sd
    while step > _SHORTEST * sd:
        risen = rise(step)
        if risen <= _NEAR:
            return min(most, step * np.sqrt(_WANTED / risen)) if risen > 0 else most
        if np.isinf(risen):  # beyond the support, where no normal ends
            most = step = step / 2
        else:
            step *= max(_SHORTER, np.sqrt(_WANTED / risen))
    return step
