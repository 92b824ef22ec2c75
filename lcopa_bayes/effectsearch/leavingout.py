"""What a fit says of samples it is not shown: each record, or each fifth of a single one, left out in turn.

Of the linearised model this needs no refit. With whitened residual r and tangents J at the optimum,
information ``H = J' J + prior`` and group k, the optimum without the group is one Gauss-Newton step away,
``x - (H - J_k' J_k)^-1 J_k' r_k``. Tangents hold no further than a few standard deviations: where the step is
longer, as of a delay that one stretch of an onset alone determines, predictions come from a descent without
the group. The linear step of such a delay was 160, and its prediction six times as far off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, final

import numpy as np

from lcopa_bayes.core.arrays import Index, Matrix, Vector
from lcopa_bayes.core.covariance import covariance_of, root_of
from lcopa_bayes.effectsearch.regression import GAIN, Optimum, Regression
from lcopa_bayes.effectsearch.scores import Score, State, level_of, own_levels_of, scores_of
from lcopa_bayes.effectsearch.whitening import Part, Whitening
from lcopa_bayes.inference.descents import Place, descended

PARTS = 5
"""Parts of a single record that are left out in turn [-]."""
_STRETCHES = 10
"""Stretches of successive samples in each part [-]."""
_DRAWS = 100
"""Draws about an optimum behind the prediction of a record [-]."""
_SEED = 15
_FAR, _STEPS = 3.0, 20
"""Step of a coordinate from which a group is left out by a descent [sd], and its most steps [-]."""


def groups(whitening: Whitening) -> list[Index]:
    """Positions in the stack: of each record; of a single one every fifth of 50 stretches of successive
    samples, all axes alike.

    One fifth in one piece would take away the only step of a record, and nothing predicts a step not seen.
    """
    records: dict[int, list[Index]] = {}
    for part in whitening.parts:
        records.setdefault(part.record, []).append(np.arange(part.rows.start, part.rows.stop))
    if len(records) > 1:
        return [np.concatenate(axes) for axes in records.values()]
    (axes,) = records.values()
    cut = [np.array_split(rows, PARTS * _STRETCHES) for rows in axes]
    return [np.concatenate([stretch for each in cut for stretch in each[k::PARTS]]) for k in range(PARTS)]


def in_turn(records: int) -> str:
    """In words, what is left out of that many records."""
    if records > 1:
        return "leaving records out in turn"
    return f"leaving each of {PARTS} parts of the only record out in turn"


def log_scores(optimum: Optimum, chosen: Sequence[Index]) -> Vector:
    """Log predictive density of each group given the others, by the linearised model and without the constant
    of the noise [nat]."""
    whole = np.linalg.slogdet(optimum.information)[1]
    out = []
    for rows in chosen:
        residual = optimum.settled[rows]
        rest, pull = _less(optimum, rows, residual)
        power = residual @ residual + pull @ covariance_of(rest) @ pull
        out.append(-0.5 * power + 0.5 * (np.linalg.slogdet(rest)[1] - whole))
    return np.array(out)


def _less(optimum: Optimum, rows: Index, residual: Vector) -> tuple[Matrix, Vector]:
    """Information of all samples but some, (k, k), and what these, by their whitened `residual`, add to the
    slope of the log density, (k,)."""
    tangents = optimum.jacobian[rows]
    return optimum.information - tangents.T @ tangents, tangents.T @ residual


def left_out_scores(state: State) -> list[Score]:
    """On the fit records, each left out in turn."""
    several = len(state.whitening.samples) > 1
    mean, rng = state.fitted, np.random.default_rng(_SEED)
    variance, draws = np.zeros_like(mean), np.zeros((_DRAWS if several else 0, mean.size))
    for rows in groups(state.whitening):
        mean[rows], tangents, covariance = _predicted(state, rows)
        variance[rows] = np.einsum("nk,kl,nl->n", tangents, covariance, tangents, optimize=True)
        if several:
            apart = rng.standard_normal((_DRAWS, len(covariance))) @ root_of(covariance).T
            draws[:, rows] = apart @ tangents.T
    own = several and own_levels_of(state)
    scores = scores_of(state, mean, variance, "the other records", own_levels=own)
    if not several:  # parts of a record are beside what was fitted, and say nothing of another one
        return scores
    parts = zip(scores, state.whitening.parts, strict=True)
    return [replace(one, draws=_of_part(state, part, draws[:, part.rows], own, rng)) for one, part in parts]


@final
class _Predicted(NamedTuple):
    """Samples of a group, by an optimum that the others have."""

    mean: Vector
    """(n,) [response unit]."""
    tangents: Matrix
    """(n, k) [response unit / coordinate]."""
    covariance: Matrix
    """Of the coordinates, (k, k)."""


def _predicted(state: State, rows: Index) -> _Predicted:
    """One Gauss-Newton step away from the fit of all, or where that is far, at the end of a descent; not of
    several records with effects, each of which would take as long as a refit does."""
    optimum = state.optimum
    rest, pull = _less(optimum, rows, optimum.settled[rows])
    covariance = covariance_of(rest)
    step = -covariance @ pull
    mean, slopes = state.fitted[rows] + optimum.tangents[rows] @ step, optimum.tangents[rows]
    affordable = len(state.whitening.samples) == 1 or not state.model.effects
    if affordable and (np.abs(step) > _FAR * optimum.sd).any():
        regression = Regression(state.model, state.whitening)
        end = descended(_Others(regression, rows), optimum.x[None], steps=_STEPS, least=GAIN)
        predicted, tangents = state.model.tangents(end.points[0])
        mean, slopes = predicted[rows], tangents[rows]
        covariance = covariance_of(end.information[0])
    return _Predicted(mean, slopes, covariance)


@final
@dataclass(frozen=True, eq=False)
class _Others:
    """The log density that all samples but some give, for `inference.descents`."""

    regression: Regression
    left_out: Index

    def at(self, points: Matrix, /) -> Place:
        """What a descent knows at points; log density -inf where there is no bounded response."""
        places = [self._at(x) for x in points]
        return Place(points, *(np.array(each) for each in zip(*places, strict=True)))

    def _at(self, x: Vector) -> tuple[float, Vector, Matrix]:
        try:
            here = self.regression.at(x)
        except ArithmeticError:
            return -np.inf, np.zeros(x.size), np.eye(x.size)
        residual = here.white[self.left_out]
        rest, pull = _less(here, self.left_out, residual)
        level = 0.5 * float(residual @ residual) - here.cost
        return level, self.regression.gradient(here) - pull, rest

    def room(self, points: Matrix, /) -> tuple[Matrix, Matrix]:
        """Steps to the ends of the support."""
        ends = [self.regression.model.bounds_about(x) for x in points]
        low, high = (np.array(each) for each in zip(*ends, strict=True))
        return low - points, high - points

    def moved(self, points: Matrix, steps: Matrix, /) -> Matrix:
        """Points so many steps on."""
        return points + steps


def _of_part(state: State, part: Part, draws: Matrix, own: bool, rng: np.random.Generator) -> Matrix:
    """Draws of a prediction, with `own` level about the level that would be taken from each."""
    if own:
        noise = state.whitening.weighed[part.axis]
        known = [level_of(part.samples, part.axis, draw, noise) for draw in draws]
        levels = np.array([level + np.sqrt(doubt) * rng.standard_normal() for level, doubt, _ in known])
        draws = draws - levels[:, None]
    return np.asarray(draws - draws.mean(axis=0))
