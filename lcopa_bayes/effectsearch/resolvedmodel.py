"""Models on blocks so narrow that their width does not move the optimum.

The base fit has blocks that its plant asks for. An effect may ask for narrower ones: the size of an asymmetry
was 1.2 standard deviations off on the blocks that the plant alone was content with.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.whitening import Whitening
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.results.discretisation import FACTORS, largest_shift, narrowed


def narrowed_for(state: State, problem: Problem) -> Problem:
    """The problem on blocks as narrow as a state asks for at its optimum; itself where they are."""
    white, x, covariance = state.whitening, state.optimum.x, state.optimum.covariance
    return narrowed(
        problem, lambda each: shift_by_width(lambda one: on(state.model, one), each, x, covariance, white)
    )


def moved(state: State, problem: Problem) -> State:
    """A state at its optimum on the blocks of a problem."""
    model = on(state.model, problem)
    return replace(state, model=model, optimum=Regression(model, state.whitening).descend(state.optimum.x))


def on(model: ExtendedModel, problem: Problem) -> ExtendedModel:
    """A model with effects on the blocks of a problem, at the same scales."""
    blocks = problem.posterior.model
    scaled = model.scaled and model.scaled.on(blocks)
    return replace(model, plant=replace(model.plant, model=blocks), scaled=scaled)


def shift_by_width(
    model_on: Callable[[Problem], ExtendedModel],
    problem: Problem,
    x: Vector,
    covariance: Matrix,
    white: Whitening,
) -> float:
    """Largest shift of a coordinate at an optimum `x` on narrower blocks than a problem's, to first order in
    the change of the response [posterior sd]."""
    here, tangents = model_on(problem).tangents(x)
    finer = [model_on(problem.refined(factor)) for factor in FACTORS]
    changes = [white(each.predict(x) - here) for each in finer]
    return largest_shift(covariance, white(tangents.T).T, changes)
