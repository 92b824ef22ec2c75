"""Draws about the optimum of a model that follow the records.

The posterior of a plant with a term that the records do not need is no normal one: along a ridge the
likelihood is flat, off it falls steeply, and most normal draws are plants that the records reject, by
hundreds of nat, with steady values of twice the true one. A normal with sides of its own (`SidedNormal`)
follows such a posterior far better, and where a valley bends, one about each of its points (`Valley`); what
is still drawn too far off is drawn nearer to the optimum, and left out at last.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from lcopa_bayes.core.arrays import Matrix
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.sidednormal import SidedNormal

CHANCE = 1e-3
"""Probability of a draw of a normal posterior so far below its optimum that it is left out [-]."""
_NEARER = (1.0, 0.5, 0.25)
"""Shares of its distance from the optimum at which a draw is tried [-]."""


def likely_draws(state: State, rng: np.random.Generator, count: int) -> Matrix:
    """Of `count` draws, those inside the support that follow the records, the optimum first, (draws,
    coordinates); their likelihood is computed, and that of some steps along each principal axis.

    Coordinates that an end of their support holds are drawn on its inner side, each by itself, with the slope
    of the likelihood there: of normal draws of several of them at once none may be inside.
    """
    x, regression = state.optimum.x, Regression(state.model, state.whitening)
    if state.valley is None:
        normal = SidedNormal.about(state.optimum, state.model.spread, regression.costs_inside)
        shift = normal.inside(lambda shift: state.model.inside(x + shift), rng, count)
        middle, least = np.tile(x, (count, 1)), np.full(count, state.optimum.cost)
    else:
        middle, least, shift = state.valley.draws(rng, count)
    limit = float(chi2.isf(CHANCE, x.size)) / 2
    kept, left = np.full((count, x.size), np.nan), np.arange(count)
    for share in _NEARER:
        near = middle[left] + share * shift[left]
        follow = regression.costs_inside(near) - least[left] <= limit
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
    return np.where(state.model.inside(moved)[:, None], moved, drawn)


def beside_constants(state: State, drawn: Matrix, rng: np.random.Generator) -> Matrix:
    """Draws of coordinates at internal constants of the effects that are held, moved as far as what these
    leave open moves them; predictions have to be those of the draws themselves, at these constants."""
    if state.spread is None:
        return drawn
    beyond = _beyond(state.spread, state.optimum.covariance)
    moved = drawn + rng.standard_normal(drawn.shape) @ beyond.T
    return np.where(state.model.inside(moved)[:, None], moved, drawn)


def _beyond(whole: Matrix, part: Matrix) -> Matrix:
    """A factor of what one covariance has over another, (k, k); where it has less, of nothing."""
    sd = np.sqrt(np.diag(whole))
    power, axes = np.linalg.eigh((whole - part) / np.outer(sd, sd))
    return np.asarray(sd[:, None] * axes * np.sqrt(np.maximum(power, 0.0)))
