"""Integer orders for the elements of a fitted plant: which ones, the study that holds them, and their odds.

Orders 2 and 1 are a corner of the prior: a second-order plant has all of its posterior on one side, orders
below 2 with a longer delay, and intervals of delay and rise miss it. Whether orders are integers is a
question of structure like the number of terms.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from itertools import product
from typing import Protocol, TypeVar

import numpy as np
from scipy.special import expit

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.wording import listed
from lcopa_bayes.data.settings import PriorSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.parameters import ParameterTable

Orders = Mapping[str, tuple[float, ...]]
"""Those of each element that is held, by its name [-]."""

LEAST = 3e-3
"""Odds below which integer orders are left out [-]."""
_FIRST = (1.0,)
_SECOND = (2.0, 1.0)
"""Orders of a lag and of a second-order element, which rings or is a product of two lags [-]."""
_SHORTER = (1.0, 0.5)
"""Factors on the delays where a descent begins [-]: orders below those of the plant lengthen them."""


class Held(Protocol):
    """A plant with the orders of some elements at integers."""

    @property
    def orders(self) -> Orders:
        """Which."""

    @property
    def log_odds(self) -> float:
        """By the Bayesian information criterion, against the plant with free orders [nat]."""


_Held = TypeVar("_Held", bound=Held)


def most_likely(orders: Orders, held: Callable[[Orders], _Held | None]) -> _Held | None:
    """The plant with integer orders of all elements of one or two terms that the records let have them; None
    without any. `held` gives one with some `orders`, None where it cannot follow the records."""
    if not orders:
        return None
    every = held(orders)
    if every is not None and every.log_odds > 0.0:
        return every
    apart = [held({name: own}) for name, own in orders.items()] if len(orders) > 1 else []
    borne = [one.orders for one in apart if one is not None and one.log_odds > 0.0]
    some = {name: own for one in borne for name, own in one.items()}
    found = [every, *apart, held(some) if 1 < len(some) < len(orders) else None]
    best = max((one for one in found if one is not None), key=lambda one: one.log_odds, default=None)
    return best if best is not None and best.log_odds > np.log(LEAST) else None


def weight_of(log_odds: float, gained: float) -> float:
    """Part of a plant with integer orders beside the one with free orders [-]: half of it where the records
    do not speak against it, and more where its likelihood is higher, by `gained` [nat]; that it has fewer
    parameters does not count beyond half."""
    return float(expit(min(log_odds, max(gained, 0.0))))


def said_of(orders: Orders) -> str:
    """Integer orders of each element in words."""
    return listed(
        [
            f"{' and '.join(f'{order:g}' for order in own)}{f' of {name}' if name else ''}"
            for name, own in orders.items()
        ]
    )


def nearest(table: ParameterTable, values: Vector) -> Iterator[tuple[str, tuple[float, ...]]]:
    """Integer orders of each element of one or two free orders at table values (rows,), by its name; an order
    whose prior is stated stays as that says."""
    for slot, (_, own) in zip(table.layout.elements, table.terms, strict=True):
        rows = [table.rows[k] for k in own]
        if slot.terms <= len(_SECOND) and all(row.free and row.default for row in rows):
            yield slot.name, _FIRST if slot.terms == 1 and values[own[0]] <= 1.0 else _SECOND


def with_orders(study: Study, table: ParameterTable, orders: Orders) -> Study:
    """The study of a plant's table with elements of these orders."""
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


def problem_with(problem: Problem, table: ParameterTable, orders: Orders) -> Problem:
    """A problem with elements of these orders, on blocks as narrow; InputError as `problem_of`."""
    own = problem_of(with_orders(problem.study, table, orders))
    return own if problem.refinement == 1 else own.refined(problem.refinement)


def starts(
    old: ParameterTable, values: Vector, table: ParameterTable, orders: Collection[str]
) -> Iterator[Vector]:
    """Table values (rows,) of a plant with integer orders of some elements near `values` of that with free
    ones, which the `old` table is of."""
    known = dict(zip(old.names, values, strict=False))
    several = any(
        slot.name in orders and len(own.times) > 1
        for slot, own in zip(table.layout.elements, old.terms, strict=True)
    )
    for share, alike in product(_SHORTER, (False, True) if several else (False,)):
        out = np.array([known.get(row.name, row.value) if row.free else row.value for row in table.rows])
        for e, slot in enumerate(table.layout.elements):
            if slot.name in orders:
                own = old.terms[e]
                times = values[own.times][:1] if alike else values[own.times]
                out[table.terms[e].times] = np.resize(times, slot.terms)
        for k in table.of_kind("delay"):
            out[k] *= share
        yield out
