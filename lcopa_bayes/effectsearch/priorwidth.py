"""Widths of the priors of effects: a default prior four times as wide is a tenth as common.

Effects may be some hundred times as large as expected. Together the widths are a prior with the tails of a
Student law of 1.7 degrees of freedom. Shares of an effect keep one width: more than the whole is no name.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.regression import Optimum, Regression
from lcopa_bayes.effectsearch.whitening import Whitening
from lcopa_bayes.inference.effects import Placed
from lcopa_bayes.model.effects.effect import Effect

WIDER = 4.0
"""Factor from one width of the prior of coefficients to the next [-]."""
COMMON = 10.0
"""How many times more common effects within a prior are than within the next wider one [-]."""
FACTORS = WIDER ** np.arange(4)
"""Widths of that prior tried: an effect may be some hundred times as large as expected [-]."""
RARE = -np.log(COMMON) * np.arange(FACTORS.size)
_FAR = 3.0
"""Coefficients beyond so many prior standard deviations widen their prior [-]."""
_STEPS = 4
"""How often it is widened at most [-]."""


def widened(model: ExtendedModel, added: Sequence[tuple[Effect, Vector]]) -> ExtendedModel:
    """The model with priors that hold linear estimates of `added` effects, which narrow ones would keep a
    descent from."""
    shares = {model.effects[one.effect].name for one in _shares(model)}
    steps = {effect.name: _steps(psi) for effect, psi in added if effect.name not in shares}
    more = {name: WIDER**count for name, count in steps.items() if count}
    return replace(model, wider={**model.wider, **more}) if more else model


def rarity(model: ExtendedModel, names: Collection[str]) -> float:
    """What the evidence pays for priors of effects `names` that are wider than the default ones [nat]."""
    factors = [model.wider.get(name, 1.0) for name in names]
    return float(np.log(COMMON) * np.log(factors).sum() / np.log(WIDER))


def _shares(model: ExtendedModel) -> list[Placed]:
    """Coefficients that say how much of an effect is there."""
    return [one for one in model.effected.coefficients if one.coefficient.share]


def _steps(psi: Vector) -> int:
    """How often a prior is widened to hold coefficients over its sd [-]."""
    apart = float(np.abs(psi).max(initial=0.0)) / _FAR
    return min(int(np.ceil(np.log(apart) / np.log(WIDER))), _STEPS) if apart > 1 else 0


def with_room(
    model: ExtendedModel, optimum: Optimum, whitening: Whitening, names: Sequence[str]
) -> tuple[ExtendedModel, Optimum]:
    """Model and optimum with priors of the effects `names` so wide that these do not pull their coefficients
    back.

    A prior a normal law's tail away from the data biases the coefficient, and what it takes away would look
    like a further effect. Scales four times as large are a tenth as common: together a prior with the tails
    of a Student law of 1.7 degrees of freedom.
    """
    for _ in range(_STEPS):
        apart = np.abs(optimum.x[model.plant_size :]) / model.scale
        placed = zip(model.effected.coefficients, apart, strict=True)
        beyond = (one for one, size in placed if size > _FAR and not one.coefficient.share)
        far = {model.effects[one.effect].name for one in beyond} & set(names)
        if not far:
            break
        more = {name: WIDER * model.wider.get(name, 1.0) for name in far}
        model = replace(model, wider={**model.wider, **more})
        optimum = Regression(model, whitening).descend(optimum.x, most=12, gain=0.02)
    return model, optimum
