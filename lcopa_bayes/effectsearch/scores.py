"""Errors of a model on records it was fitted to and on records it never saw, per axis and record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from scipy.stats import norm

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.effectsearch.bandwidening import Widening
from lcopa_bayes.effectsearch.crossvalidation import groups, shifts
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.prediction import level_of, predicted
from lcopa_bayes.effectsearch.regression import Optimum
from lcopa_bayes.effectsearch.whitening import Whitening
from lcopa_bayes.inference.assembly import Problem

LEVEL = 0.9
"""Probability inside the bands [-]."""
_WIDTH = float(norm.ppf(0.5 + LEVEL / 2))


@final
@dataclass(frozen=True, eq=False)
class Score:
    """One response axis of one record against its prediction."""

    record: str
    axis: str
    unit: str
    held_out: bool
    time: Vector
    """(n,) [time unit]."""
    observed: Vector
    """(n,) [response unit]."""
    predicted: Vector
    """(n,) [response unit]."""
    variance: Vector
    """Of what the fit leaves uncertain, without noise, (n,) [response unit^2]; NaN where no band is given."""
    noise_sd: float
    """Standard deviation of the noise [response unit]."""
    level_from: str

    @property
    def half_width(self) -> Vector:
        """Half the width of the 90 % band with noise, (n,) [response unit]; NaN where no band is given."""
        return np.asarray(_WIDTH * np.sqrt(self.variance + self.noise_sd**2))

    @property
    def rmse(self) -> float:
        """Root mean square of observed minus predicted [response unit]."""
        return float(np.sqrt(np.mean((self.observed - self.predicted) ** 2)))

    @property
    def coverage(self) -> float:
        """Share of the samples with a band that lie inside it [-]; NaN without any."""
        banded = np.isfinite(self.half_width)
        if not banded.any():
            return float("nan")
        miss = np.abs(self.observed - self.predicted)[banded]
        return float(np.mean(miss <= self.half_width[banded]))

    @property
    def banded(self) -> float:
        """Share of the samples for which a band is given [-]."""
        return float(np.isfinite(self.half_width).mean())

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "record": self.record,
            "axis": self.axis,
            "unit": self.unit,
            "held_out": self.held_out,
            "samples": self.time.size,
            "rmse": self.rmse,
            "noise_sd": self.noise_sd,
            "rmse_over_noise": self.rmse / self.noise_sd,
            "coverage_90": self.coverage,
            "share_with_band": self.banded,
            "level_from": self.level_from,
        }


@final
@dataclass(frozen=True, eq=False)
class State:
    """A model at its optimum under its noise, and how wide its bands must be."""

    model: ExtendedModel
    optimum: Optimum
    whitening: Whitening
    covariance: Matrix
    """Of the coordinates, (k, k)."""
    widening: Widening | None = None


def fit_scores(state: State) -> list[Score]:
    """On the records that were fitted."""
    tangents = state.optimum.tangents
    variance = np.einsum("nk,kl,nl->n", tangents, state.covariance, tangents, optimize=True)
    return _scores(
        state, state.whitening.observed - state.optimum.residual, variance, "the fit", own_levels=False
    )


def left_out_scores(state: State) -> list[Score]:
    """On the fit records, each left out in turn (one Gauss-Newton step away from the fit of all)."""
    chosen = groups(state.whitening)
    mean = state.whitening.observed - state.optimum.residual
    variance = np.zeros_like(mean)
    for group, (shift, covariance) in zip(chosen, shifts(state.optimum, chosen), strict=True):
        tangents = state.optimum.tangents[group.rows]
        mean[group.rows] += tangents @ shift
        variance[group.rows] = np.einsum("nk,kl,nl->n", tangents, covariance, tangents, optimize=True)
    own = len(state.whitening.samples) > 1 and _own_levels(state)
    return _scores(state, mean, variance, "the other records", own_levels=own)


def held_out_scores(state: State, problem: Problem) -> list[Score]:
    """On the study's held-out records."""
    unseen = predicted(problem, state.model, state.optimum.x, state.covariance, problem.study.held_out)
    elsewhere = State(
        state.model,
        state.optimum,
        Whitening(unseen.samples, state.whitening.noise),
        state.covariance,
        state.widening,
    )
    own = _own_levels(state)
    return _scores(elsewhere, unseen.mean, unseen.variance, "the fit records", own_levels=own)


def _own_levels(state: State) -> bool:
    """Whether every record has an offset of its own."""
    table = state.model.plant.table
    return any(row.kind == "offset" and row.place.second >= 0 for row in table.rows)


def _scores(
    state: State, mean: Vector, variance: Vector, level_from: str, *, own_levels: bool
) -> list[Score]:
    """One score per record and axis; with `own_levels` each record's level is taken from its samples."""
    whitening, out = state.whitening, []
    for part in whitening.parts:
        record = whitening.samples[part.record]
        observed = record.axes[part.axis]
        if not observed.values.size:
            continue
        noise = whitening.noise[part.axis]
        centre, spread, source = mean[part.rows], variance[part.rows], level_from
        if own_levels:
            level, doubt, source = level_of(record, part.axis, observed.values - centre, noise)
            # what the fit did not know about the level is known now
            centre, spread = centre + level, _without_level(spread, doubt)
        if state.widening is not None:
            spread = spread + state.widening.variance(record, part.axis)
        axis = record.record.response_axes[part.axis]
        out.append(
            Score(
                record.record.name,
                axis.name,
                axis.unit,
                level_from != "the fit",
                record.times[observed.index],
                observed.values,
                centre,
                spread,
                noise.sd,
                source,
            )
        )
    return out


def _without_level(variance: Vector, doubt: float) -> Vector:
    """Variance once a level has been taken from data: that of the first sample, at rest, is only its
    level's."""
    rest = variance[0]
    return np.asarray(np.where(variance > rest, variance - rest, 0.0) + doubt)


def pooled_rmse(scores: Sequence[Score], axis: str) -> float:
    """Over all records of an axis [response unit]; NaN without any."""
    chosen = [score for score in scores if score.axis == axis]
    if not chosen:
        return float("nan")
    total = sum(score.rmse**2 * score.time.size for score in chosen)
    return float(np.sqrt(total / sum(score.time.size for score in chosen)))


def pooled_coverage(scores: Sequence[Score]) -> float:
    """Over all axes and records [-]; NaN without a band."""
    weights = np.array([score.banded * score.time.size for score in scores])
    if not weights.sum():
        return float("nan")
    return float(
        np.nansum([w * s.coverage for w, s in zip(weights, scores, strict=True) if w]) / weights.sum()
    )
