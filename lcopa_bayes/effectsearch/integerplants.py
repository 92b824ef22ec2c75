"""The plant that a loop ends with, its orders held at integers, and its part in the numbers.

Elements whose orders the records let be integers are held there (`inference.integerorders`), and that plant
has a part in gains, delays and figures of the step responses by its evidence. A linear effect that such a
plant follows as well takes no name.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log
from typing import final

from lcopa_bayes.core.crew import ALONE, Crew
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.heldoutscores import unseen_scores
from lcopa_bayes.effectsearch.lags import linear
from lcopa_bayes.effectsearch.lesseffects import descended_with_effects, following, less_effects
from lcopa_bayes.effectsearch.openeffects import Weighed
from lcopa_bayes.effectsearch.otherplants import OtherPlant
from lcopa_bayes.effectsearch.refits import without
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.scores import State, fit_scores, over_noise
from lcopa_bayes.effectsearch.verdict import MARGIN, REACHED, Dynamics
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.declared import campaign_places
from lcopa_bayes.inference.integerorders import (
    LEAST,
    Orders,
    most_likely,
    nearest,
    problem_with,
    said_of,
    starts,
    weight_of,
)
from lcopa_bayes.inference.parameter import Parameter

_DOUBT = 50.0
"""Log odds that effects may add to those of records less what they add beside free orders [nat]: their sizes
change too."""


@final
@dataclass(frozen=True, eq=False)
class IntegerPlant:
    """The final plant of a loop with the orders of some elements at integers."""

    plant: OtherPlant
    orders: Orders
    log_odds: float
    """By the Bayesian information criterion, against the plant with free orders [nat]."""
    problem: Problem
    """The study with these orders."""

    @property
    def weight(self) -> float:
        """Its part beside the chosen plant [-]."""
        return weight_of(self.log_odds, self.plant.gained)

    def figures(self, figures: Sequence[Weighed], *, span: float, time_unit: str) -> tuple[Weighed, ...]:
        """Figures of the response to a unit step over `span` [time unit], over this plant too."""
        own = self.plant.figures(span=span, time_unit=time_unit)
        return tuple(one.beside([own[one.name]], self.weight) if one.name in own else one for one in figures)

    def number(self, number: Weighed, row: Parameter) -> Weighed:
        """A gain or delay over this plant too; times of unlike orders are not the same numbers."""
        values = self.plant.number(row.name) if row.kind in ("gain", "delay") else None
        return number if values is None else number.beside([values], self.weight)

    @property
    def unseen(self) -> float:
        """Largest root mean square error of any axis on unseen records over the noise [-]."""
        state = self.plant.state
        return over_noise(fit_scores(state), unseen_scores(state, self.problem), clear=True)

    @property
    def said(self) -> str:
        """What it is."""
        return f"integer orders ({said_of(self.orders)}; {self.log_odds:+.1f} nat by BIC)"


def integer_plant(state: State, problem: Problem, crew: Crew = ALONE) -> IntegerPlant | None:
    """The plant of a final state with integer orders of all elements of one or two terms that the records let
    have them; None without any. With effects it is fitted to the records less these first."""
    try:
        bare = less_effects(state)
    except ArithmeticError:
        return None

    def held(orders: Orders) -> IntegerPlant | None:
        found = _held(bare, problem, orders, crew)
        if found is None or bare is state:
            return found
        return _with_effects(state, found) if found.log_odds > log(LEAST) - _DOUBT else None

    return most_likely(dict(nearest(bare.model.plant.table, bare.model.values(bare.optimum.x))), held)


def integer_dynamics(state: State, problem: Problem, crew: Crew = ALONE) -> Dynamics | None:
    """A plant with integer orders and without the effects of a final state, where it follows the fitted
    records as well, to the noise; None where it does not, or where an effect is nonlinear or changes with
    time."""
    effects = state.model.effects
    if not effects or not all(map(linear, effects)):
        return None
    model, x = without(state.model, state.optimum.x, [effect.name for effect in effects])
    try:
        bare = replace(state, model=model, optimum=Regression(model, state.whitening).descend(x))
    except ArithmeticError:
        return None
    found = integer_plant(bare, problem, crew)
    if found is None:
        return None
    own = found.plant.state.optimum
    gained = OtherPlant.beside(state, found.plant.state.model, own).gained
    left = float(own.white @ own.white) / own.white.size
    if gained + _saved(state, own.x.size) < -MARGIN or left > REACHED**2:
        return None
    said = f"elements of integer orders ({said_of(found.orders)}) follow the records as well"
    return Dynamics(said, found.unseen)


def _saved(state: State, size: int) -> float:
    """What a plant of so many coordinates gains by the Bayesian information criterion for being smaller than
    that of a state [nat]."""
    return 0.5 * (state.optimum.x.size - size) * log(state.whitening.effective)


def _held(state: State, problem: Problem, orders: Orders, crew: Crew) -> IntegerPlant | None:
    """The plant of a state without effects with these elements at integer orders; None where it cannot follow
    the records."""
    table = state.model.plant.table
    try:
        own = problem_with(problem, table, orders)
        model = following(ExtendedModel(own.posterior), state.whitening.samples)
        values = state.model.values(state.optimum.x)
        begun = [model.coordinates(one) for one in starts(table, values, model.plant.table, orders)]
        optimum = Regression(model, state.whitening).best(begun, crew)
        model = model.at_scales(optimum.x, campaign_places(own.study))
    except (ArithmeticError, InputError):
        return None
    plant = OtherPlant.beside(state, model, optimum)
    return IntegerPlant(plant, orders, plant.gained + _saved(state, optimum.x.size), own)


def _with_effects(state: State, found: IntegerPlant) -> IntegerPlant | None:
    """A plant that follows the records less the effects of a state, with these; None without a bounded
    response."""
    bare = found.plant.state
    try:
        model, optimum = descended_with_effects(state, bare.model, bare.optimum.x)
    except ArithmeticError:
        return None
    plant = OtherPlant.beside(state, model, optimum)
    return replace(found, plant=plant, log_odds=plant.gained + _saved(state, optimum.x.size))
