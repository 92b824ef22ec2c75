"""What named effects leave on records that were not fitted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lcopa_bayes.loop.scores import Score, State
from lcopa_bayes.study import Study

_ROOM = 0.05
"""Share of the range of a drive beyond which a model extrapolates [-]."""
_SEEN = 5.0
"""Standard deviations of a chance sum of squares that error beyond noise must exceed to be judged [-]."""


def unseen_share(study: Study, before: Sequence[Score], after: Sequence[Score], state: State) -> float:
    """Squared error beyond noise on held-out records, with the effects over without [-].

    Over samples before the drive leaves the range it has in the fitted records. NaN where it says nothing: no
    such error, or effects that differ from record to record.
    """
    if any(effect.card.per_record for effect in state.model.effects):
        return np.nan
    was, now, count = 0.0, 0.0, 0
    for one, other in zip(before, after, strict=True):
        inside = one.time < _left(study, one.record)
        count += int(inside.sum())
        noise = other.noise_sd  # of both: a fit without the effects may have taken them for noise
        was += float((((one.observed - one.predicted)[inside] / noise) ** 2 - 1).sum())
        now += float((((other.observed - other.predicted)[inside] / noise) ** 2 - 1).sum())
    return now / was if was > _SEEN * np.sqrt(2 * count) else np.nan


def _left(study: Study, name: str) -> float:
    """When a held-out record's drive leaves the range of the fitted ones [time unit]; infinite if never."""
    record = next(one for one in study.held_out if one.name == name)
    low, high = (pick([pick(one.drive, axis=0) for one in study.fit], axis=0) for pick in (np.min, np.max))
    room = _ROOM * (high - low)
    beyond = ((record.drive < low - room) | (record.drive > high + room)).any(axis=1)
    return float(record.time[np.argmax(beyond)]) if beyond.any() else np.inf
