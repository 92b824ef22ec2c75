"""What a model leaves on records that were not fitted: beyond chance, and beyond the noise beside effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self, final

import numpy as np
from scipy.stats import chi2, genpareto, norm

from lcopa_bayes.core.arrays import Array, Index, Vector
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.noiselaw import Law, laws
from lcopa_bayes.effectsearch.residualnoise import ResidualNoise
from lcopa_bayes.effectsearch.scores import Score, State, pooled_rmse
from lcopa_bayes.effectsearch.verdict import Miss

_ROOM = 0.05
"""Share of the range of a drive beyond which a model extrapolates [-]."""
_SEEN = float(norm.sf(5.0))
"""p-value of noise alone below which error beyond noise is judged, five normal standard deviations [-]."""
_PROCESSES = 400
"""Noise processes over which that p-value is averaged [-]."""
_LARGEST = 0.05
"""Share of simulated errors that the law of their tail is fitted to [-]."""
_SEED = 9


def unseen_share(study: Study, before: Sequence[Score], after: Sequence[Score], state: State) -> float:
    """`share_beyond_noise` on held-out records; NaN for effects that all differ from record to record."""
    effects = state.model.effects
    if effects and all(effect.card.per_record for effect in effects):
        return np.nan
    return share_beyond_noise(study, before, after, state)


def share_beyond_noise(study: Study, before: Sequence[Score], after: Sequence[Score], state: State) -> float:
    """Squared error beyond noise on unseen records, with effects over with fewer or none [-]; NaN where
    there is no such error.

    Over samples before the drive leaves the range it has in the fitted records; what the effects leave
    uncertain is no error of either.
    """
    # one noise for both: a fit without the effects may have taken them for noise
    noise = [(one.noise_sd, one.variance) for one in after]
    was = _errors(study, before, state, noise)
    now = _errors(study, after, state, noise)
    return now.beyond / was.beyond if was.p_value(_measured(state)) < _SEEN else np.nan


def missed(study: Study, fit: Sequence[Score], scores: Sequence[Score], state: State) -> Miss | None:
    """How far unseen records are missed, on the axis where chance reaches that least often; None without a
    drawn prediction.

    Inside the drive range of the other records; where no sample is inside, or chance explains the errors
    there, beyond it, where errors have twice the p-value.

    Chance is noise as the residual of the fit has it, which knows it as well as quiet samples where nothing
    is found in it, and what the fit leaves uncertain under it. Error and coverage have a p-value each by
    simulation (an error beyond all simulated ones by the tail of these); their geometric mean, at most e
    times too small whatever their dependence (Vovk and Wang 2020, Biometrika 107), is multiplied by the
    number of axes.
    """
    if not study.held_out and state.whitening.dependence:
        return None  # the residual was taken for noise, and errors of records left out are little else
    names = [axis.name for axis in study.response_axes]
    own = {axis: [one for one in scores if one.axis == axis and one.draws is not None] for axis in names}
    known = {axis: _Known.of(fit, own[axis], state, k) for k, axis in enumerate(names) if own[axis]}

    def least(*, beyond: bool) -> Miss | None:
        each = [one.missed(study, own[axis], beyond=beyond) for axis, one in known.items()]
        judged = [one for one in each if one is not None]
        chosen = min(judged, key=lambda one: one.p, default=None)
        return chosen and replace(chosen, p=min(1.0, chosen.p * len(judged)))

    inside = least(beyond=False)
    if inside is not None and inside.significant:
        return inside
    beyond = least(beyond=True)
    if beyond is None:
        return inside
    beyond = replace(beyond, p=min(1.0, 2 * beyond.p))
    within = inside is None or not inside.far
    return beyond if beyond.significant or (beyond.far and within) else inside


@final
@dataclass(frozen=True, eq=False)
class _Known:
    """What is known of the noise of one axis."""

    axis: str
    sd: float
    """Of the residual, that of quiet samples at least [response unit]."""
    noise: ResidualNoise

    @classmethod
    def of(cls, fit: Sequence[Score], scores: Sequence[Score], state: State, axis: int) -> Self:
        name = scores[0].axis
        return cls(name, max(pooled_rmse(fit, name), scores[0].noise_sd), state.residual_noise[axis])

    def missed(self, study: Study, scores: Sequence[Score], *, beyond: bool) -> Miss | None:
        """Errors inside the drive range of the other records, or beyond it; None without a sample there."""
        rng = np.random.default_rng(_SEED)
        seen, chance, count = np.zeros(2), np.zeros((2, 1)), 0
        for one in scores:
            counted = (one.time >= _left(study, one.record)) == beyond
            if not counted.any():
                continue
            assert one.draws is not None
            error, half = (one.observed - one.predicted)[counted], one.half_width[counted]
            drawn = self.noise.draw(one.time[counted], rng)
            by_turns = np.arange(len(drawn)) % len(one.draws)
            drawn += self.noise.widening[:, None] * one.draws[by_turns][:, counted]
            seen, chance = seen + _error_and_misses(error, half), chance + _error_and_misses(drawn, half)
            count += error.size
        if not count:
            return None
        reached = chance >= seen[:, None]
        shares = (1 + reached.sum(axis=1)) / (1 + reached[0].size)
        if not reached[0].any():  # the number of draws must not decide how improbable it is
            shares[0] = min(shares[0], _tail(chance[0], seen[0]))
        ratio, coverage = np.sqrt(seen[0] / count) / self.sd, 1 - seen[1] / count
        return Miss(self.axis, float(ratio), float(coverage), float(np.sqrt(np.prod(shares))), beyond)


def _error_and_misses(errors: Array, half_width: Vector) -> Array:
    """Squared error [response unit^2], and samples outside the band [-], of errors (..., n), (2, ...)."""
    return np.stack([(errors**2).sum(axis=-1), (np.abs(errors) > half_width).sum(axis=-1)])


def _tail(simulated: Vector, reached: float) -> float:
    """Probability of what lies beyond all simulated values, by a generalised Pareto law of the largest [-].

    Its shape is that of their mean and variance (Hosking and Wallis 1987, Technometrics 29), and no less than
    that of an exponential tail, so that tails of heavy noise remain heavy.
    """
    ordered = np.sort(simulated)
    count = max(2, int(_LARGEST * ordered.size))
    excess, x = ordered[-count:] - ordered[-count - 1], reached - ordered[-count - 1]
    mean, variance = excess.mean(), excess.var()
    if not variance:
        return 1.0 / (1 + ordered.size)
    shape = max(0.0, 0.5 * (1 - mean**2 / variance))
    scale = mean * (1 - shape)
    return float(count / ordered.size * genpareto.sf(x, shape, scale=scale))


def _beyond(power: float, mean: Vector | float, variance: Vector | float) -> Vector:
    """Probability of sums of squares of correlated normal samples above `power`, by their moments [-].

    Each is nearly a multiple of chi-squared with the same mean and variance (Box 1954, Ann. Math. Stat. 25).
    """
    return np.asarray(chi2.sf(2 * power * mean / variance, 2 * mean**2 / variance))


@final
@dataclass(frozen=True)
class Errors:
    """Squared errors on records that were not fitted, inside the fitted drive range."""

    power: Vector
    """Squared errors less a variance of the prediction, over the noise variance, per record and axis [-]."""
    counts: Vector
    """Their samples [-]."""
    sds: Vector
    """Their noise sd [response unit]."""
    axes: Index
    """Their response axes."""

    @property
    def count(self) -> float:
        """Samples [-]."""
        return float(self.counts.sum())

    @property
    def beyond(self) -> float:
        """Squared error beyond that of the noise, over the noise variance [-]."""
        return float((self.power - self.counts).sum())

    def p_value(self, noise: Sequence[Sequence[Law]]) -> float:
        """Probability of as much power by noise alone, averaged over the processes of each axis [-].

        With squared autocorrelations rho_k^2 the variance of a sum of squares is that of
        ``n / (1 + 2 sum_k (1 - k / n) rho_k^2)`` independent samples.
        """
        mean, variance = np.zeros(len(noise[0])), np.zeros(len(noise[0]))
        for count, sd, axis in zip(self.counts, self.sds, self.axes, strict=True):
            if not count:
                continue
            size = np.array([(process.sd / sd) ** 2 for process in noise[axis]])
            dependent = np.array([process.correlated(int(count) - 1) for process in noise[axis]])
            mean += count * size
            variance += 2 * count * dependent * size**2
        if not mean.any():
            return 1.0
        return float(_beyond(float(self.power.sum()), mean, variance).mean())


def _measured(state: State) -> list[list[Law]]:
    """Noise that the samples it was measured from leave plausible, per axis."""
    white, rng = state.whitening, np.random.default_rng(_SEED)
    if not white.posterior:
        return [[process] for process in white.noise]
    return [laws(one.draw(_PROCESSES, rng)) for one in white.posterior]


def _errors(
    study: Study, scores: Sequence[Score], state: State, noise: Sequence[tuple[float, Vector]]
) -> Errors:
    """Errors less a variance of the prediction, beside that noise sd, inside the fitted drive range."""
    names = [axis.name for axis in study.response_axes]
    power, counts = np.zeros(len(scores)), np.zeros(len(scores))
    for k, (one, (sd, variance)) in enumerate(zip(scores, noise, strict=True)):
        inside = one.time < _left(study, one.record)
        error = (one.observed - one.predicted)[inside]
        power[k] = float(((error**2 - variance[inside]) / sd**2).sum())
        counts[k] = inside.sum()
    axes = np.array([names.index(one.axis) for one in scores], dtype=int)
    return Errors(power, counts, np.array([sd for sd, _ in noise]), axes)


def _left(study: Study, name: str) -> float:
    """When a record's drive leaves the range of the other, fitted ones [time unit]; infinite if never."""
    record = next(one for one in (*study.fit, *study.held_out) if one.name == name)
    others = [one.drive for one in study.fit if one.name != name]
    if not others:
        return np.inf
    low, high = (pick([pick(one, axis=0) for one in others], axis=0) for pick in (np.min, np.max))
    room = _ROOM * (high - low)
    beyond = ((record.drive < low - room) | (record.drive > high + room)).any(axis=1)
    return float(record.time[np.argmax(beyond)]) if beyond.any() else np.inf
