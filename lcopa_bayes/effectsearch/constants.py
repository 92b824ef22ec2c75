"""Internal constants of effects, moved off the grid they were tried on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.regression import Optimum, Regression
from lcopa_bayes.effectsearch.signature import Projection, Signature, signature_of
from lcopa_bayes.effectsearch.trace import LEVEL, Trace, Traced
from lcopa_bayes.effectsearch.whitening import Whitening
from lcopa_bayes.inference.kinds import CONSTANTS
from lcopa_bayes.model.effects.effect import Effect

_EVALUATIONS = 15
"""Most responses of a descent with constants [-]."""
_STEPS = 6
"""Responses after which a constant that moved back to its grid is judged [-]."""
_HOPELESS = 1000.0
"""Cost beyond which these would not mend it [nat]."""
_GAIN = 0.05
"""A step that gains less is the last [nat]."""


def freed(
    model: ExtendedModel, x: Vector, whitening: Whitening, names: Sequence[str]
) -> tuple[ExtendedModel, Vector]:
    """The model with the constants of its effects `names` where the residual is smallest, and coordinates.

    They are parameters like any other of the descent, which uses the plant's own tangents; those that a fit
    holds by default stay.
    """
    rows = model.posterior.table.rows
    loose = frozenset(
        row.name for row in rows if row.kind == "constant" and row.name.partition(".")[0] in names
    )
    wide = replace(model, exact=False, loose=loose)
    if not any(rows[k].kind in CONSTANTS for k in wide.columns):
        return model, x
    best = Regression(replace(model, exact=False), whitening).cost(x)
    try:
        reached, _ = Regression(wide, whitening).reached(
            wide.coordinates(model.values(x)), most=_EVALUATIONS, gain=_GAIN
        )
    except ArithmeticError:
        return model, x
    moved, other = wide.held(reached)
    if Regression(moved, whitening).cost(other) < best:
        model, x = replace(moved, exact=model.exact), other
    return _likely(model, x, whitening, names)


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
        listed = effect.grid(model.effected.ranges)
        for name in constants_of(effect) if effect.name in names else ():
            here = getattr(effect, name)
            values = np.array([getattr(one, name) for one in listed])
            near = float(values[np.argmin(np.abs(values - here))])
            back = _replaced(model, k, name, near)
            fit = Regression(back, whitening)
            if near == here or not fit.cost(x) < cost + _HOPELESS:
                continue
            there, _ = fit.reached(x, most=_STEPS, gain=_GAIN)
            if fit.cost(there) < cost + LEVEL:
                model, x = back, there
    return model, x


def _replaced(model: ExtendedModel, effect: int, name: str, value: float) -> ExtendedModel:
    """The model with one constant of one effect at another value."""
    effects: list[Any] = list(model.effects)
    effects[effect] = replace(effects[effect], **{name: value})
    return model.having(*effects)


def tuned(
    model: ExtendedModel, optimum: Optimum, whitening: Whitening, traced: Traced, seen: Trace
) -> Signature:
    """The best instance of an effect with its internal constants moved between their grid neighbours.

    Each positive constant is maximised in turn over its logarithm, by the evidence in the residual that was
    `seen`.
    """
    best = traced.signatures[traced.best]
    project = Projection(optimum.moving * model.spread)
    for name in constants_of(best.effect):
        listed = sorted({getattr(one.effect, name) for one in traced.signatures})
        here = getattr(best.effect, name)
        place = listed.index(here) if here in listed else None
        if place is None or len(listed) < 2 or listed[0] <= 0:
            continue
        low, high = listed[max(place - 1, 0)], listed[min(place + 1, len(listed) - 1)]
        tried: dict[float, Signature] = {}
        found = minimize_scalar(
            _falling(tried, best.effect, name, seen, model, optimum.x, whitening, project),
            bounds=(np.log(low), np.log(high)),
            method="bounded",
            options={"maxiter": 10, "xatol": 1e-3},
        )
        better = tried.get(float(found.x))
        if better is not None and seen.alone(better) > seen.alone(best) + LEVEL:
            best = better
    return best


def _falling(
    tried: dict[float, Signature],
    effect: Effect,
    name: str,
    seen: Trace,
    model: ExtendedModel,
    x: Vector,
    whitening: Whitening,
    project: Projection,
) -> Callable[[float], float]:
    def cost(log_value: float) -> float:
        moved: Any = replace(effect, **{name: float(np.exp(log_value))})
        try:
            tried[float(log_value)] = signature_of(model, x, whitening, project, moved)
        except ArithmeticError:
            return 1e9
        return -seen.alone(tried[float(log_value)])

    return cost


def constants_of(effect: Effect) -> list[str]:
    """Names of the internal constants that are real numbers."""
    listed = [field.name for field in fields(effect)]
    return [name for name in listed if isinstance(getattr(effect, name), float)]
