"""Errors of a model on records it was fitted to and on records it never saw, per axis and record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.core.covariance import root_of
from lcopa_bayes.core.estimate import HALF_WIDTH, LEVEL, attributes
from lcopa_bayes.effectsearch.bandwidening import Widening
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.noiselaw import Law
from lcopa_bayes.effectsearch.regression import Optimum
from lcopa_bayes.effectsearch.residualnoise import BandScales, ResidualNoise
from lcopa_bayes.effectsearch.valley import Valley, valley_of
from lcopa_bayes.effectsearch.whitening import Whitening
from lcopa_bayes.inference.noise import Noise
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.sampling.draws import Draws

_DRAWS = 400
"""Draws of the noise that a residual leaves plausible, and of a posterior behind bands [-]."""
_SAMPLES = 64
"""Samples of each of the latter [-]."""
_SEED = 9
"""Mark of their randomness."""


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
    draws: Matrix | None = None
    """Draws of the prediction less their mean, (draws, n) [response unit]; None where none were taken."""
    varied: Matrix | None = None
    """What effects that differ from record to record add in these draws, (draws, n) [response unit]; None
    without any."""
    scales: BandScales | None = None
    """Those of its bands; None where noise of `noise_sd` is known."""

    @property
    def half_width(self) -> Vector:
        """Half the width of the 90 % band with noise, (n,) [response unit]; NaN where no band is given."""
        return (self.scales or BandScales(self.noise_sd)).half_width(self.variance)

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
            **attributes(self, "record", "axis", "unit", "held_out"),
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
    widening: Widening | None = None
    sampled: tuple[Draws, Noise] | None = None
    """Draws of the explained study and its noise; None where only the optimum is known."""
    spread: Matrix | None = None
    """Covariance of the coordinates in these draws, or with internal constants of effects free, (k, k); None
    where that of the optimum is all."""

    @property
    def valley(self) -> Valley | None:
        """The valley of the posterior that a coefficient of an effect leads along and no normal about the
        optimum follows; None where there is none."""
        return valley_of(self.model, self.optimum, self.whitening)

    @cached_property
    def residual_noise(self) -> tuple[ResidualNoise, ...]:
        """What its residual leaves plausible of the noise of each axis."""
        return tuple(
            ResidualNoise.of(
                self.model, self.optimum, self.whitening, axis, _DRAWS, np.random.default_rng([_SEED, axis])
            )
            for axis in range(len(self.whitening.noise))
        )

    @cached_property
    def band_scales(self) -> tuple[BandScales | None, ...]:
        """Those of the bands of each axis; None where the noise is known, if only as that of what remains."""
        none = (None,) * len(self.whitening.noise)
        if self.sampled is not None and self.widening is None:
            return tuple(_sampled_scales(*self.sampled, axis) for axis in range(len(none)))
        return tuple(one.scales for one in self.residual_noise) if self.whitening.dependence else none

    @cached_property
    def stretches(self) -> Array | None:
        """What turns deviations of the coordinates from the optimum into those under noise that the residual
        leaves plausible, (draws, k, k) [-]; None where the noise is known.

        Their covariance is the sandwich of White (1982, Econometrica 50).
        """
        if not self.whitening.dependence:
            return None
        at, sd = self.optimum, self.optimum.sd
        unit = np.where(sd > 0.0, sd, 1.0)  # no result depends on the units
        root = root_of(at.covariance / np.outer(unit, unit))
        priors = at.information - at.jacobian.T @ at.jacobian
        slopes = priors + sum(one.slopes for one in self.residual_noise)
        power, axes = np.linalg.eigh(root.T @ (slopes * np.outer(unit, unit)) @ root)
        whitened = (axes * np.sqrt(np.maximum(power, 0.0))[:, None]) @ axes.swapaxes(1, 2)
        return np.asarray(unit[:, None] * (root @ whitened @ np.linalg.pinv(root)) / unit)

    @property
    def covariance(self) -> Matrix:
        """Of the coordinates, (k, k)."""
        return self.optimum.covariance if self.spread is None else self.spread

    @property
    def log_evidence(self) -> float:
        """Laplace approximation, noise held at its estimate [nat]."""
        return self.optimum.log_evidence + self.model.plant.table.log_support

    @property
    def fitted(self) -> Vector:
        """Responses at the samples, stacked [response unit]."""
        return self.whitening.observed - self.optimum.residual


def fit_scores(state: State) -> list[Score]:
    """On the records that were fitted."""
    tangents = state.optimum.tangents
    variance = np.einsum("nk,kl,nl->n", tangents, state.covariance, tangents, optimize=True)
    return scores_of(state, state.fitted, variance, "the fit", own_levels=False)


def own_levels_of(state: State) -> bool:
    """Whether every record has an offset of its own."""
    table = state.model.plant.table
    return any(row.kind == "offset" and row.place.second >= 0 for row in table.rows)


def scores_of(
    state: State, mean: Vector, variance: Vector, level_from: str, *, own_levels: bool
) -> list[Score]:
    """One score per record and axis; with `own_levels` each record's level is taken from its samples."""
    out = []
    for part in state.whitening.parts:
        centre, spread, source = mean[part.rows], variance[part.rows], level_from
        if own_levels:
            misfit, noise = part.observed.values - centre, state.whitening.weighed[part.axis]
            level, doubt, source = level_of(part.samples, part.axis, misfit, noise)
            # what the fit did not know about the level is known now
            centre, spread = centre + level, _without_level(spread, doubt)
        held_out = level_from != "the fit"
        out.append(score_of(state, part.samples, part.axis, (centre, spread), source, held_out=held_out))
    return out


def score_of(
    state: State,
    record: Samples,
    axis: int,
    predicted: tuple[Vector, Vector],
    level_from: str,
    *,
    held_out: bool,
) -> Score:
    """Of one axis of a record, from mean and variance of its prediction."""
    observed, named = record.axes[axis], record.record.response_axes[axis]
    mean, variance = predicted
    if state.widening is not None:
        variance = variance + state.widening.variance(record, axis)
    return Score(
        record.record.name,
        named.name,
        named.unit,
        held_out,
        record.times[observed.index],
        observed.values,
        mean,
        variance,
        state.whitening.noise[axis].sd,
        level_from,
        scales=state.band_scales[axis],
    )


def _sampled_scales(draws: Draws, noise: Noise, axis: int) -> BandScales:
    """Scales of bands that hold the noise of draws: many samples of each, far apart."""
    values = draws.thinned(_DRAWS)
    parameters = values[:, [draws.table.at(name, axis) for name in noise.names]]
    drawn = noise.draw(parameters, np.full(_SAMPLES, np.inf), np.random.default_rng([_SEED, axis]))
    return BandScales(float(np.quantile(np.abs(drawn), LEVEL)) / HALF_WIDTH)


def level_of(record: Samples, axis: int, misfit: Vector, noise: Law) -> tuple[float, float, str]:
    """Level of a record that is not known from the fit, its variance and where it comes from.

    By generalised least squares from the samples that a fit takes the offset of a held-out record from.
    """
    used, source = record.level_samples(axis)
    columns = np.stack([misfit[used], np.ones(np.count_nonzero(used))])
    white, ones = noise.whiten(columns, record.axes[axis].gaps[used])
    power = float(ones @ ones)
    return float(ones @ white) / power, 1.0 / power, source


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


def risen(before: Sequence[Score], after: Sequence[Score]) -> float:
    """Largest root mean square error of any axis over that before [-]; NaN without samples."""
    axes = sorted({one.axis for one in before})
    ratios = [pooled_rmse(after, axis) / (pooled_rmse(before, axis) or 1.0) for axis in axes]
    return max(ratios, default=float("nan"))


def apart(one: Sequence[Score], other: Sequence[Score]) -> float:
    """Largest distance of any axis between two predictions of the same samples, over the standard deviation
    that the first leaves open, root mean squares [-]; NaN without a band."""
    ratios = []
    for axis in sorted({score.axis for score in one}):
        pairs = [(a, b) for a, b in zip(one, other, strict=True) if a.axis == axis]
        square = np.concatenate([np.square(a.predicted - b.predicted) for a, b in pairs])
        variance = np.concatenate([a.variance for a, _ in pairs])
        known = np.isfinite(variance)
        if known.any():
            ratios.append(float(np.sqrt(square[known].sum() / variance[known].sum())))
    return max(ratios, default=float("nan"))


def over_noise(fit: Sequence[Score], unseen: Sequence[Score], *, clear: bool) -> float:
    """Largest root mean square error of any axis on unseen records over the noise [-]; NaN without samples.

    Where nothing significant is left in it, the residual of the fit knows the noise as well as quiet samples.
    """
    ratios = []
    for axis in sorted({one.axis for one in unseen}):
        noise = [one.noise_sd for one in unseen if one.axis == axis]
        ratios.append(pooled_rmse(unseen, axis) / max(noise[0], pooled_rmse(fit, axis) if clear else 0.0))
    return max(ratios, default=float("nan"))


def pooled_coverage(scores: Sequence[Score]) -> float:
    """Over all axes and records [-]; NaN without a band."""
    weights = np.array([score.banded * score.time.size for score in scores])
    if not weights.sum():
        return float("nan")
    return float(
        np.nansum([w * s.coverage for w, s in zip(weights, scores, strict=True) if w]) / weights.sum()
    )
