"""Internal constants of a candidate chosen by descents of the whole model, where linear evidence misleads.

Far from the base fit the plant bends to imitate what is missing (an order above 1 imitates overdrive), and
the best frame, level or frequency beside that bent plant is not the best beside the plant as it is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.effectsearch.regression import Regression
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
    """The instance with the lowest cost after a short descent, and the coordinates it reached; its constants
    are freed in the refit.

    ArithmeticError when no instance has a bounded response.
    """
    forced = any(isinstance(effect, ForceEffect) for effect in state.model.effects)
    listed = sorted(traced.signatures, key=lambda one: -seen.alone(one))
    best: tuple[float, Effect, Vector] | None = None
    for signature in [tuned, *listed[: _FORCED if forced else _INSTANCES]]:
        model = replace(state.model.having(*state.model.effects, signature.effect), exact=not forced)
        fit = Regression(model, state.whitening)
        for start in _starts(state, signature, seen, forced=forced):
            try:
                x, _ = fit.reached(np.clip(start, *model.bounds), most=_STEPS, gain=1.0)  # a start only
            except ArithmeticError:
                continue
            cost = fit.cost(x)
            if best is None or cost < best[0]:
                best = cost, signature.effect, x
    if best is None:
        raise FloatingPointError(f"{traced.name}: no instance has a bounded response")
    return best[1], best[2]


def _starts(state: State, signature: Signature, seen: Trace, *, forced: bool) -> list[Vector]:
    """Coordinates to descend from: the linear estimate, and a prior sd to either side of none, there also
    with every order at the nearest integer."""
    model = state.model.having(*state.model.effects, signature.effect)
    linear = signature.amplitude(seen.residual)
    unit = model.scale[-linear.size :]
    starts = [np.concatenate([state.optimum.x, size * unit]) for size in (linear, 0.3 * linear)]
    if linear.size == 1 and not forced:
        rows = model.posterior.table.rows
        straight = state.optimum.x.copy()
        for position, k in enumerate(state.model.columns):
            if rows[k].kind == "order":
                straight[position] = max(np.round(straight[position]), 1.0)
        starts += [np.append(x, size * unit) for x in (state.optimum.x, straight) for size in _SIZES]
    return starts
