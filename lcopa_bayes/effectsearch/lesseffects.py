"""Records less what the effects of a model add at its optimum.

Other plants are held against these first: a plant alone is simulated at once, effects that depend on the
response block by block, and what they add hardly depends on which plant follows the records.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.refits import without
from lcopa_bayes.effectsearch.regression import Optimum, Regression
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.inference.observations import Samples


def added(state: State, names: Sequence[str]) -> Vector:
    """What some effects add at the optimum, stacked, (n,) [response unit]."""
    bare, own = without(state.model, state.optimum.x, names)
    return state.fitted - bare.predict(own) if names else np.zeros(state.whitening.size)


def samples_less(state: State, names: Sequence[str]) -> tuple[Samples, ...]:
    """Samples less what some effects add at the optimum."""
    taken, out = added(state, names), [list(samples.axes) for samples in state.whitening.samples]
    for part in state.whitening.parts:
        observed = part.observed
        out[part.record][part.axis] = replace(observed, values=observed.values - taken[part.rows])
    pairs = zip(state.whitening.samples, out, strict=True)
    return tuple(replace(samples, axes=tuple(axes)) for samples, axes in pairs)


def less_effects(state: State) -> State:
    """The plant of a state at its optimum on the records less all effects; the state itself without any."""
    names = [effect.name for effect in state.model.effects]
    if not names:
        return state
    samples = samples_less(state, names)
    model, x = without(state.model, state.optimum.x, names)
    model, whitening = following(model, samples), replace(state.whitening, samples=samples)
    return State(model, Regression(model, whitening).descend(x), whitening)


def following(model: ExtendedModel, samples: Sequence[Samples]) -> ExtendedModel:
    """A model of the same records with these samples."""
    return replace(model, plant=replace(model.plant, samples=tuple(samples)))


def descended_with_effects(state: State, plant: ExtendedModel, x: Vector) -> tuple[ExtendedModel, Optimum]:
    """Another plant with the effects of a state, at the scales of these and on its records, and its optimum,
    from the coordinates `x` of the plant alone and the state's coefficients.

    ArithmeticError where there is no bounded response.
    """
    effects = state.optimum.x[state.model.plant_size :]
    scaled = plant.with_ranges(state.model.effected.ranges).having(*state.model.effects)
    model = replace(following(scaled, state.whitening.samples), wider=state.model.wider)
    return model, Regression(model, state.whitening).descend(np.concatenate([x, effects]))
