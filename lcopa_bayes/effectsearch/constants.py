"""Internal constants of effects, moved off the grid they were tried on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.gaussnewton import Optimum, Regression
from lcopa_bayes.effectsearch.signature import Projection, Signature, signature_of
from lcopa_bayes.effectsearch.trace import LEVEL, Trace, Traced
from lcopa_bayes.effectsearch.whitening import Whitening
from lcopa_bayes.model.effects.effect import Effect

_ROUNDS = 6
_STEPS = 4
"""Steps after which a constant that moved back to its grid is judged [-]."""
_HOPELESS = 1000.0
"""Cost beyond which these steps would not mend it [nat]."""
_STEP = 1e-3
"""Step of a constant's logarithm for its slope [-]."""
_FAR = 0.2
"""Largest move of a constant's logarithm in one round, and the spread that holds it back [-]."""
_GAIN = 0.05
"""A round that gains less is the last [nat]."""


def polished(
    model: ExtendedModel, x: Vector, whitening: Whitening, names: Sequence[str]
) -> tuple[ExtendedModel, Vector]:
    """The model with the constants of its effects `names` where the residual is smallest, and coordinates.

    Gauss-Newton over coordinates and logarithms of the positive constants together, with step halving and the
    plant's own tangents. Constants without a slope, as a number of grey levels, stay; so does one whose move
    off the grid the records do not ask for.
    """
    fit = Regression(replace(model, exact=False), whitening)
    for _ in range(_ROUNDS):
        here = fit.at(x)
        columns, moves = [], []
        for k, effect in enumerate(model.effects):
            for name in constants_of(effect) if effect.name in names else ():
                column = _slope(model, x, whitening, k, name)
                if column is not None and column @ column > 1.0:
                    columns.append(column)
                    moves.append((k, name))
        if not moves:
            break
        jacobian = np.column_stack([here.jacobian, *columns])
        held = np.concatenate([1 / model.spread**2, np.full(len(moves), 1 / _FAR**2)])
        step = np.linalg.solve(jacobian.T @ jacobian + np.diag(held), jacobian.T @ here.white)
        step *= min(1.0, _FAR / max(float(np.abs(step[x.size :]).max()), 1e-12))
        for share in (1.0, 0.5, 0.25, 0.1):
            other = _moved(model, moves, share * step[x.size :])
            # a step ends where the support does
            new = np.clip(x + share * step[: x.size], *model.bounds_about(x))
            cost = Regression(replace(other, exact=False), whitening).cost(new)
            if cost < here.cost:
                break
        else:
            break
        model, x = other, new
        fit = Regression(replace(model, exact=False), whitening)
        if here.cost - cost < _GAIN:
            break
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
            found = fit.descend(x, most=_STEPS, gain=_GAIN)
            if found.cost < cost + LEVEL:
                model, x = back, found.x
    return model, x


def _replaced(model: ExtendedModel, effect: int, name: str, value: float) -> ExtendedModel:
    """The model with one constant of one effect at another value."""
    effects: list[Any] = list(model.effects)
    effects[effect] = replace(effects[effect], **{name: value})
    return model.having(*effects)


def _moved(model: ExtendedModel, moves: Sequence[tuple[int, str]], logs: Vector) -> ExtendedModel:
    """The model with the logarithms of these constants moved."""
    for (k, name), change in zip(moves, logs, strict=True):
        value = getattr(model.effects[k], name) * float(np.exp(change))
        model = _replaced(model, k, name, value)
    return model


def _slope(model: ExtendedModel, x: Vector, whitening: Whitening, effect: int, name: str) -> Vector | None:
    """Whitened slope of the response in a constant's logarithm, (n,) [-]; None where there is none."""
    if not getattr(model.effects[effect], name) > 0:
        return None
    try:
        up, down = (
            _moved(model, [(effect, name)], np.array([side * _STEP])).predict(x) for side in (1.0, -1.0)
        )
    except ArithmeticError:
        return None
    slope = (up - down) / (2 * _STEP)
    return whitening(slope) if np.isfinite(slope).all() else None


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
