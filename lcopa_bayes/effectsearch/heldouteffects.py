"""What named effects leave on records that were not fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from scipy.stats import chi2, norm

from lcopa_bayes.core.arrays import Index, Vector
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.basefit import axis_pieces
from lcopa_bayes.effectsearch.noise import Law, laws, plausible
from lcopa_bayes.effectsearch.scores import Score, State, pooled_rmse
from lcopa_bayes.inference.defaultpriors import Scales

_ROOM = 0.05
"""Share of the range of a drive beyond which a model extrapolates [-]."""
_DOUBTS = 9.0
"""Variances of a prediction that an error must exceed [-]."""
_SEEN = float(norm.sf(5.0))
"""p-value of noise alone below which error beyond noise is judged, five normal standard deviations [-]."""
_PROCESSES = 400
"""Noise processes over which that p-value is averaged [-]."""
_SEED = 9


def unseen_share(study: Study, before: Sequence[Score], after: Sequence[Score], state: State) -> float:
    """Squared error beyond noise on held-out records, with the effects over without [-].

    Over samples before the drive leaves the range it has in the fitted records; what the effects leave
    uncertain is no error of either. NaN where it says nothing: no such error, or effects that all differ from
    record to record.
    """
    effects = state.model.effects
    if effects and all(effect.card.per_record for effect in effects):
        return np.nan
    # one noise for both: a fit without the effects may have taken them for noise
    noise = [(one.noise_sd, one.variance) for one in after]
    was = _errors(study, before, state, noise)
    now = _errors(study, after, state, noise)
    return now.beyond / was.beyond if was.p_value(_measured(state)) < _SEEN else np.nan


def missed(study: Study, fit: Sequence[Score], scores: Sequence[Score], state: State) -> float:
    """Root mean square error on held-out records over that of the fit, where it is more than that and three
    standard deviations of what the fit leaves uncertain; NaN where it is not [-].

    The fit's own residual, where nothing is found in it, knows the noise better than the quiet samples do:
    neither of the two may explain the error.
    """
    noise = {one.axis: max(pooled_rmse(fit, one.axis), one.noise_sd) for one in scores}
    errors = _errors(study, scores, state, [(noise[one.axis], 0 * one.variance) for one in scores])
    unsure = _errors(study, scores, state, [(noise[one.axis], _DOUBTS * one.variance) for one in scores])
    for known in (_independent, _measured, _left_by_fit):
        if not unsure.p_value(known(state)) < _SEEN:
            return np.nan
    return float(np.sqrt(1 + errors.beyond / errors.count))


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

        A sum of squares of correlated normal samples is nearly a multiple of chi-squared with the same mean
        and variance (Box 1954, Ann. Math. Stat. 25); with squared autocorrelations rho_k^2 its variance is
        that of ``n / (1 + 2 sum_k (1 - k / n) rho_k^2)`` independent samples.
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
        multiple, freedom = variance / (2 * mean), 2 * mean**2 / variance
        return float(np.mean(chi2.sf(self.power.sum() / multiple, freedom)))


def _independent(state: State) -> list[list[Law]]:
    """Noise of independent samples: what it explains, correlated noise of that sd explains too."""
    return [[Law(process.sd)] for process in state.whitening.noise]


def _measured(state: State) -> list[list[Law]]:
    """Noise that the samples it was measured from leave plausible, per axis."""
    white, rng = state.whitening, np.random.default_rng(_SEED)
    if not white.posterior:
        return [[process] for process in white.noise]
    return [laws(one.draw(_PROCESSES, rng)) for one in white.posterior]


def _left_by_fit(state: State) -> list[list[Law]]:
    """Noise that the residual of the fit leaves plausible, per axis."""
    posterior, rng = state.model.plant, np.random.default_rng(_SEED)
    axes = range(len(state.whitening.noise))
    scales = Scales.of([one.record for one in posterior.samples])
    pieces = [axis_pieces(posterior, state.optimum.residual, axis) for axis in axes]
    return [laws(plausible(one, scales).draw(_PROCESSES, rng)) for one in pieces]


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
    """When a held-out record's drive leaves the range of the fitted ones [time unit]; infinite if never."""
    record = next(one for one in study.held_out if one.name == name)
    low, high = (pick([pick(one.drive, axis=0) for one in study.fit], axis=0) for pick in (np.min, np.max))
    room = _ROOM * (high - low)
    beyond = ((record.drive < low - room) | (record.drive > high + room)).any(axis=1)
    return float(record.time[np.argmax(beyond)]) if beyond.any() else np.inf
