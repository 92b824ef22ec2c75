"""Internal constants of effects as parameters of a descent: a shutter time, a corner, a phase of frames."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.regression import GAIN, Regression
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.trace import LEVEL
from lcopa_bayes.effectsearch.whitening import Whitening
from lcopa_bayes.inference.kinds import CONSTANTS
from lcopa_bayes.model.effects.effect import Effect, Ranges

_EVALUATIONS = 15
"""Most responses of a descent with constants [-]."""
_BACK = 6
"""Responses after which a constant that moved back to its grid is judged [-]."""
_HOPELESS = 1000.0
"""Cost beyond which these would not mend it [nat]."""
_SLIGHT = 0.05
"""A step that gains less is the last [nat]."""


def freed(
    model: ExtendedModel, x: Vector, whitening: Whitening, names: Sequence[str]
) -> tuple[ExtendedModel, Vector]:
    """The model with the constants of its effects `names` where the residual is smallest, and coordinates.

    They are parameters like any other of the descent, which uses the plant's own tangents; those that a fit
    holds by default stay.
    """
    wide = replace(loosened(model, names), exact=False)
    if len(wide.columns) == len(model.columns):
        return model, x
    best = Regression(replace(model, exact=False), whitening).cost(x)
    try:
        start, fit = wide.coordinates(model.values(x)), Regression(wide, whitening)
        starts = (start, *_whole(wide, start, names))
        reached = min((fit.reached(one, most=_EVALUATIONS, gain=_SLIGHT)[0] for one in starts), key=fit.cost)
    except ArithmeticError:
        return model, x
    moved, other = wide.held(reached)
    if Regression(moved, whitening).cost(other) < best:
        model, x = replace(moved, exact=model.exact), other
    return _likely(model, x, whitening, names)


def _whole(model: ExtendedModel, x: Vector, names: Collection[str]) -> tuple[Vector, ...]:
    """Coordinates with all of each of these effects that comes in shares; none without any. A part of a limit
    that is too low is likelier than its neighbours, and no descent leaves it."""
    shares = {one.name for one in model.effected.coefficients if one.coefficient.share}
    own = [name in shares and name.partition(".")[0] in names for name in model.names]
    return (np.where(own, 1.0, x),) if any(own) else ()


def loosened(model: ExtendedModel, names: Collection[str]) -> ExtendedModel:
    """The model with the internal constants of some of its effects as coordinates."""
    # a phase of commands moves them from sample to sample: no slope says where it should be
    held = {effect.name for effect in model.effects if effect.card.place == "drive"}
    loose = set()
    for row in model.posterior.table.rows:
        own = row.name.partition(".")[0]
        if row.kind in CONSTANTS and own in names and not (row.kind == "fraction" and own in held):
            loose.add(row.name)
    return replace(model, loose=frozenset(loose))


def released(state: State) -> State:
    """The state at the likeliest internal constants of its effects, with what these leave open in the
    covariance of all other coordinates; as it is where a descent does not find any as likely."""
    model, whitening = state.model, state.whitening
    wide = loosened(model, [effect.name for effect in model.effects if not effect.timed])
    if len(wide.columns) == len(model.columns):
        return state
    try:
        best = Regression(wide, whitening).descend(wide.coordinates(model.values(state.optimum.x)))
        moved, x = wide.held(best.x)
        optimum = Regression(moved, whitening).at(x)
    except ArithmeticError:
        return state
    if not optimum.cost <= state.optimum.cost + GAIN:
        return state
    own = np.isin(wide.names, moved.names)
    return replace(state, model=moved, optimum=optimum, spread=best.covariance[np.ix_(own, own)])


def _likely(
    model: ExtendedModel, x: Vector, whitening: Whitening, names: Sequence[str]
) -> tuple[ExtendedModel, Vector]:
    """The model with constants back on the grid, of likely values, where the fit does not separate them.

    A phase and a delay move together until a command falls to another refresh, which other records may show.
    A noise that still holds what the effect takes away separates too little.
    """
    if whitening.dependence:
        return model, x
    cost = Regression(model, whitening).cost(x)
    for k, effect in enumerate(model.effects):
        if effect.name not in names:
            continue
        moved = _on_grid(effect, model.effected.ranges)
        tried = [moved] if moved else []
        if len(moved) > 1:
            tried += [{name: value} for name, value in moved.items()]
        for own in tried:
            back = _replaced(model, k, own)
            fit = Regression(back, whitening)
            if not fit.cost(x) < cost + _HOPELESS:
                continue
            there, _ = fit.reached(x, most=_BACK, gain=_SLIGHT)
            if fit.cost(there) < cost + LEVEL:
                model, x = back, there
    return model, x


def _on_grid(effect: Effect, ranges: Ranges) -> dict[str, float]:
    """The constants of an effect that lie off its grid, at the nearest value there."""
    listed = effect.grid(ranges)
    out = {}
    for name, here in effect.constants.items():
        values = np.array([float(getattr(one, name)) for one in listed])
        near = float(values[np.argmin(np.abs(values - here))])
        if isinstance(here, float) and near != here:
            out[name] = near
    return out


def _replaced(model: ExtendedModel, effect: int, constants: Mapping[str, float]) -> ExtendedModel:
    """The model with constants of one effect at other values."""
    effects: list[Any] = list(model.effects)
    effects[effect] = replace(effects[effect], **constants)
    return model.having(*effects)
