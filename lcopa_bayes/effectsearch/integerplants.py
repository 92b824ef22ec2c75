"""The plant that a loop ends with, its orders held at integers, and its part in the numbers.

Orders 2 and 1 are a corner of the prior: a second-order plant has all of its posterior on one side, orders
below 2 with a longer delay, and intervals of delay and rise miss it. Whether orders are integers is a
question of structure like the number of terms: elements whose orders the records let be integers are held
there, and that plant has a part in gains, delays and figures of the step responses by its evidence. A linear
effect that such a plant follows as well takes no name.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import log
from typing import final

import numpy as np
from scipy.special import expit

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.wording import listed
from lcopa_bayes.data.settings import PriorSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.lags import linear
from lcopa_bayes.effectsearch.openeffects import LEAST, Weighed
from lcopa_bayes.effectsearch.otherplants import OtherPlant
from lcopa_bayes.effectsearch.refits import without
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.scores import State, fit_scores, held_out_scores, left_out_scores, over_noise
from lcopa_bayes.effectsearch.verdict import MARGIN, REACHED, Dynamics
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.declared import campaign_places
from lcopa_bayes.inference.parameter import Parameter
from lcopa_bayes.inference.parameters import ParameterTable

_FIRST = (1.0,)
_SECOND = (2.0, 1.0)
"""Orders of a lag and of a second-order element, which rings or is a product of two lags [-]."""
_SHORTER = (1.0, 0.5)
"""Factors on the delays where a descent begins [-]: orders below those of the plant lengthen them."""


@final
@dataclass(frozen=True, eq=False)
class IntegerPlant:
    """The final plant of a loop with the orders of some elements at integers."""

    plant: OtherPlant
    orders: dict[str, tuple[float, ...]]
    """Those of each element that is held, by its name [-]."""
    log_odds: float
    """By the Bayesian information criterion, against the plant with free orders [nat]."""
    problem: Problem
    """The study with these orders."""

    @property
    def weight(self) -> float:
        """Its part beside the chosen plant [-]: half of it where the records do not speak against it, and
        more where it is likelier; that it has fewer parameters does not count beyond half."""
        return float(expit(min(self.log_odds, max(self.plant.gained, 0.0))))

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
        held_out = self.problem.study.held_out
        unseen = held_out_scores(state, self.problem) if held_out else left_out_scores(state)
        return over_noise(fit_scores(state), unseen, clear=True)

    @property
    def said(self) -> str:
        """What it is."""
        return f"integer orders ({_listed(self.orders)}; {self.log_odds:+.1f} nat by BIC)"


def integer_plant(state: State, problem: Problem) -> IntegerPlant | None:
    """The plant of a final state with integer orders of all elements of one or two terms that the records let
    have them; None without any."""
    table = state.model.plant.table
    values = state.model.values(state.optimum.x)
    orders = dict(_nearest(table, values))
    if not orders:
        return None
    every = _held(state, problem, orders)
    if every is not None and every.log_odds > 0.0:
        return every
    apart = [_held(state, problem, {name: own}) for name, own in orders.items()] if len(orders) > 1 else []
    borne = [one.orders for one in apart if one is not None and one.log_odds > 0.0]
    some = {name: own for one in borne for name, own in one.items()}
    found = [every, *apart, _held(state, problem, some) if len(some) > 1 else None]
    best = max((one for one in found if one is not None), key=lambda one: one.log_odds, default=None)
    return best if best is not None and best.log_odds > log(LEAST) else None


def integer_dynamics(state: State, problem: Problem) -> Dynamics | None:
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
    found = integer_plant(bare, problem)
    if found is None:
        return None
    own = found.plant.state.optimum
    gained = OtherPlant.beside(state, found.plant.state.model, own).gained
    left = float(own.white @ own.white) / own.white.size
    if gained + _saved(state, own.x.size) < -MARGIN or left > REACHED**2:
        return None
    said = f"elements of integer orders ({_listed(found.orders)}) follow the records as well"
    return Dynamics(said, found.unseen)


def _saved(state: State, size: int) -> float:
    """What a plant of so many coordinates gains by the Bayesian information criterion for being smaller than
    that of a state [nat]."""
    return 0.5 * (state.optimum.x.size - size) * log(state.whitening.effective)


def _listed(orders: Mapping[str, tuple[float, ...]]) -> str:
    return listed(
        [
            f"{' and '.join(f'{order:g}' for order in own)}{f' of {name}' if name else ''}"
            for name, own in orders.items()
        ]
    )


def _nearest(table: ParameterTable, values: Vector) -> Iterator[tuple[str, tuple[float, ...]]]:
    """Integer orders of each element of one or two free orders, by its name; an order whose prior is stated
    stays as that says."""
    for slot, (_, own) in zip(table.layout.elements, table.terms, strict=True):
        rows = [table.rows[k] for k in own]
        if slot.terms <= len(_SECOND) and all(row.free and row.default for row in rows):
            yield slot.name, _FIRST if slot.terms == 1 and values[own[0]] <= 1.0 else _SECOND


def _held(state: State, problem: Problem, orders: dict[str, tuple[float, ...]]) -> IntegerPlant | None:
    """The plant with these elements at integer orders; None where it cannot follow the records."""
    table = state.model.plant.table
    try:
        study = _with_orders(problem.study, table, orders)
        own = problem_of(study)
        own = own if problem.refinement == 1 else own.refined(problem.refinement)
        model = ExtendedModel(own.posterior)
        starts = list(_starts(state, model, orders))
        model = model.at_scales(starts[0], campaign_places(study)).having(*state.model.effects)
        model = replace(model, wider=state.model.wider)
        effects = state.optimum.x[state.model.plant_size :]
        begin = [np.concatenate([x, effects]) for x in starts]
        optimum = Regression(model, state.whitening).best(begin)
    except (ArithmeticError, InputError):
        return None
    plant = OtherPlant.beside(state, model, optimum)
    return IntegerPlant(plant, orders, plant.gained + _saved(state, optimum.x.size), own)


def _with_orders(study: Study, table: ParameterTable, orders: dict[str, tuple[float, ...]]) -> Study:
    """The study with elements of these orders."""
    layout = table.layout
    terms = {slot.name: len(orders.get(slot.name, ())) or slot.terms for slot in layout.elements}
    model = study.model.for_plant(len(layout.drives), len(layout.responses))
    model = replace(model, terms=terms if len(terms) > 1 else next(iter(terms.values())))
    held = dict[str, PriorSettings]()
    for name, own in orders.items():
        for k, order in enumerate(own):
            full = f"order_{k + 1}_{name}" if name else f"order_{k + 1}"
            held[full] = PriorSettings(full, fixed=order)
    return replace(study, model=model, priors={**study.priors, **held})


def _starts(state: State, model: ExtendedModel, orders: Collection[str]) -> Iterator[Vector]:
    """Coordinates of the plant with integer orders near those of the final state, without effects."""
    old, table = state.model.plant.table, model.plant.table
    values = state.model.values(state.optimum.x)
    known = dict(zip(old.names, values, strict=False))
    several = any(
        slot.name in orders and len(own.times) > 1
        for slot, own in zip(table.layout.elements, old.terms, strict=True)
    )
    for share, alike in product(_SHORTER, (False, True) if several else (False,)):
        out = np.array([known.get(row.name, row.value) for row in table.rows])
        for e, slot in enumerate(table.layout.elements):
            if slot.name in orders:
                own = old.terms[e]
                times = values[own.times][:1] if alike else values[own.times]
                out[table.terms[e].times] = np.resize(times, slot.terms)
        for k in table.of_kind("delay"):
            out[k] *= share
        yield model.coordinates(out)
