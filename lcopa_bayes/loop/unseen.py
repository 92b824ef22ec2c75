"""What named effects leave on records that were not fitted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lcopa_bayes.arrays import Vector
from lcopa_bayes.loop.scores import Score, State, pooled_rmse
from lcopa_bayes.study import Study

_ROOM = 0.05
"""Share of the range of a drive beyond which a model extrapolates [-]."""
_DOUBTS = 9.0
"""Variances of a prediction that an error must exceed [-]."""
_SEEN = 5.0
"""Standard deviations of a chance sum of squares that error beyond noise must exceed to be judged [-]."""


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
    was, count = _beyond(study, before, state, noise)
    now, _ = _beyond(study, after, state, noise)
    return now / was if was > _SEEN * np.sqrt(2 * count) else np.nan


def missed(study: Study, fit: Sequence[Score], scores: Sequence[Score], state: State) -> float:
    """Root mean square error on held-out records over that of the fit, where it is more than that and three
    standard deviations of what the fit leaves uncertain; NaN where it is not [-].

    The fit's own residual, where nothing is found in it, knows the noise better than the quiet samples do.
    """
    noise = {one.axis: max(pooled_rmse(fit, one.axis), one.noise_sd) for one in scores}
    power, count = _beyond(study, scores, state, [(noise[one.axis], 0 * one.variance) for one in scores])
    allowed = [(noise[one.axis], _DOUBTS * one.variance) for one in scores]
    unsure, _ = _beyond(study, scores, state, allowed)
    return float(np.sqrt(1 + power / count)) if unsure > _SEEN * np.sqrt(2 * count) else np.nan


def _beyond(
    study: Study, scores: Sequence[Score], state: State, noise: Sequence[tuple[float, Vector]]
) -> tuple[float, float]:
    """Squared error less that of the noise and a variance of the prediction, over the noise's, summed over
    independent samples inside the fitted drive range; and their number [-]."""
    axes = {axis.name: k for k, axis in enumerate(study.response_axes)}
    power, count = 0.0, 0.0
    for one, (sd, variance) in zip(scores, noise, strict=True):
        inside = one.time < _left(study, one.record)
        independent = 1 / state.whitening.dependence[axes[one.axis]] if state.whitening.dependence else 1.0
        error = (one.observed - one.predicted)[inside]
        power += independent * float(((error**2 - variance[inside]) / sd**2 - 1).sum())
        count += independent * float(inside.sum())
    return power, count


def _left(study: Study, name: str) -> float:
    """When a held-out record's drive leaves the range of the fitted ones [time unit]; infinite if never."""
    record = next(one for one in study.held_out if one.name == name)
    low, high = (pick([pick(one.drive, axis=0) for one in study.fit], axis=0) for pick in (np.min, np.max))
    room = _ROOM * (high - low)
    beyond = ((record.drive < low - room) | (record.drive > high + room)).any(axis=1)
    return float(record.time[np.argmax(beyond)]) if beyond.any() else np.inf
