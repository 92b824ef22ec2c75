"""Sums of lags beside the plant that a loop ends with, and their part in its numbers.

A search chooses the number of terms of a family; steady values and delays depend on that family where the
records do not show them (`results.sumsoflags`). What nonlinear effects add at the optimum is taken off the
records first. What is linear and does not change with time may be part of the plant as well as an effect:
sums of lags stand for both, and a linear effect is named only where they have no support and where it is
ahead of them by more than the best of all effects is by chance, whatever their number of parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import f as f_distribution

from lcopa_bayes.core.crew import ALONE, Crew
from lcopa_bayes.core.wording import listed
from lcopa_bayes.effectsearch.lesseffects import added, samples_less
from lcopa_bayes.effectsearch.openeffects import Weighed
from lcopa_bayes.effectsearch.refits import places
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.verdict import REACHED, Dynamics
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.noise import WhiteAR1
from lcopa_bayes.inference.parameter import Parameter
from lcopa_bayes.model.effects.effect import Effect
from lcopa_bayes.model.layout import Layout, PathSlot
from lcopa_bayes.results.stepcurves import curves_of, step_times
from lcopa_bayes.results.sumsoflags import (
    Alternative,
    FittedPlant,
    lag_figures,
    lags_beside,
    weight_in,
    weights_of,
)

_CHANCE = 0.99
"""Probability up to which chance explains a residual above the noise [-]."""


def lags_of(state: State, problem: Problem, crew: Crew = ALONE) -> tuple[Alternative, ...]:
    """Sums of lags beside the plant of a final model and its linear effects, of each response axis that has
    any."""
    return lags_beside(fitted_plant(state, problem), crew=crew)


def fitted_plant(state: State, problem: Problem) -> FittedPlant:
    """The plant of a model with its linear effects, as sums of lags are held against it."""
    model = state.model
    constant = [effect.name for effect in model.effects if linear(effect)]
    others = [effect.name for effect in model.effects if not linear(effect)]
    plant = replace(model.plant, samples=samples_less(state, [*constant, *others]), noise=WhiteAR1())
    values = model.values(state.optimum.x)[: len(plant.table.rows)]
    more, acting = sum(len(places(model, name)) for name in constant), _acting(state, constant)
    return FittedPlant(
        replace(problem, posterior=plant),
        values,
        state.whitening.held,
        curves_of(plant.table, values[None], problem.scales.span),
        problem.study.seed,
        tuple(more * (axis in acting) for axis in range(len(state.whitening.noise))),
        samples_less(state, others),
    )


def linear_dynamics(
    state: State, found: Sequence[Alternative], quiet: Sequence[int], chance: float
) -> Dynamics | None:
    """Sums of lags, where they are all that the fitted records ask for; None where they are not.

    They are where no effect of a final model is nonlinear, they have support on every response axis on which
    a linear one acts, or without any on one at least, and leave, or the plant where that is better, no more
    than the noise, which is known from so many `quiet` samples of each axis. Beside an effect they have
    support too where its likelihood is above theirs by no more than `chance` gives the best of all effects
    [nat].
    """
    effects = state.model.effects
    supported = [one for one in found if one.support != "plant" or (effects and _behind(one) <= chance)]
    if not supported or not all(linear(effect) for effect in effects):
        return None
    acting = _acting(state, [effect.name for effect in effects])
    if not at_noise(found, quiet) or not acting <= {one.search.axis for one in supported}:
        return None
    names = state.model.plant.table.layout.responses
    followed = dict.fromkeys(
        listed([path.name for path in one.paths]) if one.beside else names[one.search.axis].name
        for one in supported
    )
    return Dynamics(f"{supported[0].said} follow {listed(list(followed))} as well")


def at_noise(found: Sequence[Alternative], quiet: Sequence[int]) -> bool:
    """Whether sums of lags, or the plant where that is better, leave no more than the noise, which is known
    from so many `quiet` samples of each axis; without any sums of lags nothing is known of that."""
    if not found:
        return False
    axes = {one.search.axis for one in found}
    return axes == {one.search.axis for one in found if _at_noise(one, quiet[one.search.axis])}


def _at_noise(one: Alternative, quiet: int) -> bool:
    best = one.search.best
    chance = f_distribution.ppf(_CHANCE, best.size, quiet) if quiet else np.inf
    return bool(min(one.square, best.misfit) / best.size <= max(REACHED**2, chance))


def _behind(one: Alternative) -> float:
    """What sums of lags lack in log likelihood of the plant and its effects [nat]."""
    return 0.5 * (one.search.best.misfit - one.square)


def linear(effect: Effect) -> bool:
    """Whether an effect is linear and does not change with time, or such dynamics without a name."""
    return effect.card.linear or effect.card.dynamics


def _acting(state: State, names: Sequence[str]) -> set[int]:
    """Response axes on which effects act."""
    shown = added(state, names)
    return {part.axis for part in state.whitening.parts if shown[part.rows].any()}


def figures_with_lags(
    figures: Sequence[Weighed], found: Sequence[Alternative], layout: Layout, *, span: float, time_unit: str
) -> tuple[Weighed, ...]:
    """Figures of the response to a unit step over `span` [time unit], over the sums of lags too."""
    supported = [one for one in found if one.support != "plant"]
    if not supported:
        return tuple(figures)
    weights, time = weights_of(layout, found), step_times(span)
    lags = {one.name: one.values for one in lag_figures(supported, time, time_unit)}
    shares = {one.name: weight_in(one.name, weights) for one in figures if one.name in lags}
    return tuple(
        one.beside([lags[one.name]], shares[one.name]) if shares.get(one.name) else one for one in figures
    )


def number_with_lags(
    number: Weighed, row: Parameter, found: Sequence[Alternative], layout: Layout
) -> Weighed:
    """A gain or delay of the plant over the sums of lags too, of paths with one delay over that of each;
    other parameters are those of the plant alone."""
    own = [one for one in layout.paths if _uses(row, one, layout)]
    shares = weights_of(layout, found)
    values = [
        (one.draws.gains if row.kind == "gain" else one.draws.delays)[:, p]
        for one in found
        if one.support != "plant"
        for p, path in enumerate(one.paths)
        if path in own
    ]
    return number.beside(values, float(np.mean([shares[one.name] for one in own]))) if values else number


def ess_with_lags(ess: float, found: Sequence[Alternative]) -> float:
    """Effective draws of a number over sums of lags too: the fewest of any part."""
    return min([ess, *(one.draws.ess for one in found if one.support != "plant")])


def _uses(row: Parameter, path: PathSlot, layout: Layout) -> bool:
    """Whether a parameter is the gain or the delay of a path."""
    if row.kind == "delay":
        return layout.delay_of[path.response][path.drive] == row.place.first
    return row.kind == "gain" and (path.response, path.drive) == row.place
