"""Internal constants of a candidate chosen by descents of the whole model, where linear evidence misleads.

Far from the base fit the plant bends to imitate what is missing (an order above 1 imitates overdrive), and
the best frame, level or frequency beside that bent plant is not the best beside the plant as it is.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.effectsearch.constants import constants_of
from lcopa_bayes.effectsearch.gaussnewton import Optimum, Regression
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.signature import Signature
from lcopa_bayes.effectsearch.trace import Trace, Traced
from lcopa_bayes.model.effects.effect import Effect, ForceEffect

ROUGH = 5.0
"""Residual over noise beyond which the linear evidence is too rough to choose by [-]."""
_INSTANCES = 16
"""Instances descended from, those of largest evidence [-]."""
_FORCED = 3
"""The same beside a force that is already there [-]."""
_STEPS = 12
_MOVES = 10
_SIZES = (1.0, -1.0)
"""Coefficients from which a single one is also started, with fitted and with integer orders [prior sd]."""


def rough(seen: Trace) -> bool:
    """Whether a residual is far above the noise."""
    return float(np.mean(seen.residual**2)) > ROUGH**2


def movable(traced: Traced) -> bool:
    """Whether there are instances to choose from that take no iteration to simulate: a refit has several
    starts of its own."""
    return len(traced.signatures) > 1 and not isinstance(traced.signatures[0].effect, ForceEffect)


def descended(state: State, seen: Trace, traced: Traced, tuned: Signature) -> tuple[Effect, Vector]:
    """The instance with the lowest cost after a short descent, and the coordinates it reached.

    Its positive constants are then moved between their grid neighbours. ArithmeticError when no instance has
    a bounded response.
    """
    listed = sorted(traced.signatures, key=lambda one: -seen.alone(one))
    listed = listed[: _FORCED if _forced(state) else _INSTANCES]
    best: tuple[Effect, Optimum] | None = None
    for signature in [tuned, *listed]:
        found = _descent(state, signature.effect, _starts(state, signature, seen))
        if found is not None and (best is None or found.cost < best[1].cost):
            best = signature.effect, found
    if best is None:
        raise FloatingPointError(f"{traced.name}: no instance has a bounded response")
    for name in constants_of(best[0]):
        best = _moved(state, best, name, sorted({getattr(one.effect, name) for one in traced.signatures}))
    return best[0], best[1].x


def _forced(state: State) -> bool:
    """Whether the plant already has a force that takes iterations to simulate."""
    return any(isinstance(effect, ForceEffect) for effect in state.model.effects)


def _starts(state: State, signature: Signature, seen: Trace) -> list[Vector]:
    """Coordinates to descend from: the linear estimate, and a prior sd to either side of none, there also
    with every order at the nearest integer."""
    linear = signature.amplitude(seen.residual)
    sizes = [linear, 0.3 * linear]
    starts = [np.concatenate([state.optimum.x, size]) for size in sizes]
    if linear.size == 1 and not _forced(state):
        rows = state.model.base.posterior.table.rows
        straight = state.optimum.x.copy()
        for position, k in enumerate(state.model.base.least.columns):
            if rows[k].kind == "order":
                straight[position] = max(np.round(straight[position]), 1.0)
        starts += [np.append(x, size) for x in (state.optimum.x, straight) for size in _SIZES]
    return starts


def _descent(state: State, effect: Effect, starts: list[Vector]) -> Optimum | None:
    model = state.model.having(*state.model.effects, effect)
    curve = Regression(replace(model, exact=not _forced(state)), state.whitening)
    low, high = model.bounds
    found: list[Optimum] = []
    for start in starts:
        try:
            found.append(curve.descend(np.clip(start, low, high), most=_STEPS, gain=1.0))  # a start only
        except ArithmeticError:
            continue
    return min(found, key=lambda one: one.cost, default=None)


def _moved(
    state: State, best: tuple[Effect, Optimum], name: str, listed: list[float]
) -> tuple[Effect, Optimum]:
    """With one positive constant moved between its grid neighbours."""
    here = getattr(best[0], name)
    if len(listed) < 2 or listed[0] <= 0:
        return best
    below = [value for value in listed if value < here * (1 - 1e-9)]
    above = [value for value in listed if value > here * (1 + 1e-9)]
    tried = {float(np.log(here)): best}

    def cost(log_value: float) -> float:
        moved: Any = replace(best[0], **{name: float(np.exp(log_value))})
        nearest = tried[min(tried, key=lambda one: abs(one - log_value))]
        found = _descent(state, moved, [nearest[1].x])
        if found is None:
            return 1e300
        tried[float(log_value)] = moved, found
        return found.cost

    ends = np.log([below[-1] if below else here, above[0] if above else here])
    minimize_scalar(cost, bounds=tuple(ends), method="bounded", options={"maxiter": _MOVES, "xatol": 1e-3})
    return min(tried.values(), key=lambda one: one[1].cost)
