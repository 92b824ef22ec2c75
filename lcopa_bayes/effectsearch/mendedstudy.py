"""Studies that lose an assumption which their records contradict: that a plant rested under the drive of the
first row, or that delays end where their default prior does."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple, final

import numpy as np
from scipy.optimize import minimize

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.units import measured
from lcopa_bayes.data.settings import PriorSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.basefit import BaseFit
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.verdict import MARGIN
from lcopa_bayes.effectsearch.whitening import Whitening
from lcopa_bayes.inference.assembly import problem_of

_EVALUATIONS = 60
_STEPS = 8
"""Evaluations of the descent at each level tried [-]."""
_LONGER = 2.0
"""Factor on the default prior of a delay that ends at it: 0.4 becomes 0.8 of the records' span [-]."""
_AT_END = 1e-2
"""Closer to the end of its prior than this share, a delay is at it [-]."""


@final
class Mended(NamedTuple):
    """A study whose base model lost an assumption that its records contradict."""

    study: Study
    sentence: str
    """What was changed."""
    power: float = np.inf
    """Squared residual that it leaves, where that was computed [response unit^2]."""


def started(study: Study, fit: BaseFit) -> Mended | None:
    """The study with one common drive before the first row of every record, when that is worth 3 nat.

    Before its first row the plant rests under the first row's drive; a record that begins while the plant
    moves would show the difference as a misfit of every slow effect at once. Where no record says or shows
    what it rests under (an early row without a response, quiet samples) the level is tried: a single value
    per drive, since records that each begin elsewhere would predict no other. Its own uncertainty is not
    part of what follows. None where rest is known or the level brings nothing.
    """
    if fit.noise_known or any(np.isnan(one.response[0]).all() for one in study.fit):
        return None
    drive = np.concatenate([one.drive for one in study.fit])
    low, high = drive.min(axis=0), drive.max(axis=0)
    reach = high - low

    def left(level: Vector) -> float:
        return _power(_begun(study, level), fit)

    first = np.mean([one.drive[0] for one in study.fit], axis=0)
    ends = list(zip(low - reach, high + reach, strict=True))
    best = minimize(left, first, method="Powell", bounds=ends, options={"maxfev": _EVALUATIONS, "xtol": 1e-2})
    if not np.isfinite(best.fun):
        return None
    count = fit.optimum.effective
    gain = 0.5 * count * np.log(fit.optimum.power / best.fun) - 0.5 * first.size * np.log(count)
    if not gain > MARGIN:
        return None
    levels = " and ".join(
        f"{measured(value, axis.unit, '.4g')} of {axis.name}"
        for value, axis in zip(best.x, study.drive_axes, strict=True)
    )
    return Mended(
        _begun(study, best.x),
        "No record shows the plant at rest, and it did not rest under the first row's drive: a drive before "
        f"the first row, the same for all records, was fitted ({levels}, worth {gain:.0f} nat); an early row "
        "with a drive and no response would state it.",
        float(best.fun),
    )


def _begun(study: Study, level: Vector) -> Study:
    """All records with an early row of that drive and no response."""
    return replace(
        study,
        fit=tuple(one.begun(level) for one in study.fit),
        held_out=tuple(one.begun(level) for one in study.held_out),
    )


def _power(study: Study, fit: BaseFit) -> float:
    """Squared residual of the base model from where it stood [response unit^2]; infinite where it fails."""
    model = ExtendedModel(problem_of(study).posterior)
    white = Whitening(model.plant.samples, fit.regression.whitening.noise)
    regression = Regression(model, white)
    try:
        x, _ = regression.reached(fit.optimum.x, most=_STEPS, gain=0.1)
        residual = white.observed - model.predict(x)
    except ArithmeticError:
        return np.inf
    return float(residual @ residual)


def longer_delays(study: Study, fit: BaseFit) -> Mended | None:
    """The study with a longer default prior of its delays, where one is at the end of it; else None."""
    model = fit.model
    stuck = []
    for position, k in enumerate(model.columns):
        row = model.plant.table.rows[k]
        late = fit.optimum.x[position] > (1 - _AT_END) * model.bounds[1][position]
        if row.kind == "delay" and row.default and late and not row.log_scale:
            stuck.append((row.name, row.domain[1]))
    if not stuck:
        return None
    longer = {
        name: PriorSettings(name, dist="uniform", parameters={"loc": 0.0, "scale": _LONGER * end})
        for name, end in stuck
    }
    names = ", ".join(f"{name} (ends at {end:.4g} {study.time_unit})" for name, end in stuck)
    return Mended(
        replace(study, priors={**study.priors, **longer}),
        f"The default prior of {names} is too short for these records and was doubled.",
    )
