"""Plants with one term more, or with less shared, beside the one that a loop ends with.

A richer plant that is not chosen has too little evidence: Occam's factor says what it costs to look for it,
not that it is wrong. Where a response has not settled its steady value and rise may be elsewhere, and the
interval of the chosen plant by itself is too narrow. So a richer plant has a part in these numbers, as it has
in none of the verdict.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.lesseffects import descended_with_effects, following, less_effects
from lcopa_bayes.effectsearch.openeffects import Weighed
from lcopa_bayes.effectsearch.otherplants import OtherPlant
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.inference.parameter import Parameter

WEIGHT = 0.2
"""Of all richer plants beside the chosen one [-]. Of 58 paths of plants outside the family 90 % intervals
hold the steady value 44 times without them, and 52 or 53 times with any weight from 0.1 to 0.5, when they are
1.3 to 2.1 times as wide."""
_STATIC = 0.1
"""Order below which a further term is a gain to any record: over three decades of time it changes by a factor
of two. The steady value is then a matter of words: over such plants the rise of 20 of 36 paths of plants
outside the family was open, without them of 11, and as many hold the true one [-]."""


@final
@dataclass(frozen=True, eq=False)
class RicherPlants:
    """All of them beside one final model, and their part in its numbers."""

    plants: tuple[OtherPlant, ...] = ()

    @classmethod
    def beside(cls, state: State, wider: Sequence[State]) -> RicherPlants:
        """Those of a base fit's `wider` states that follow the records with the effects of a final model, by
        terms of which none is a gain."""
        try:
            bare = less_effects(state)
        except ArithmeticError:
            return cls()
        out = []
        for one in wider:
            plant = following(one.model.having(), bare.whitening.samples)
            try:
                x, _ = Regression(plant, bare.whitening).reached(one.optimum.x)
                if _least_order(plant, x) < _STATIC:
                    continue
                model, optimum = descended_with_effects(state, one.model, x)
            except ArithmeticError:
                continue
            if _least_order(model, optimum.x) >= _STATIC:
                out.append(OtherPlant.beside(state, model, optimum))
        return cls(tuple(out))

    def figures(self, figures: Sequence[Weighed], *, span: float, time_unit: str) -> tuple[Weighed, ...]:
        """Figures of the response to a unit step over `span` [time unit], over richer plants too."""
        theirs = [one.figures(span=span, time_unit=time_unit) for one in self.plants]
        return tuple(
            one.beside([own[one.name] for own in theirs if one.name in own], WEIGHT) for one in figures
        )

    def number(self, number: Weighed, row: Parameter) -> Weighed:
        """A gain or delay over richer plants too; times and orders of unlike plants are not the same
        numbers."""
        if row.kind not in ("gain", "delay"):
            return number
        theirs = [one.number(row.name) for one in self.plants]
        return number.beside([values for values in theirs if values is not None], WEIGHT)

    @property
    def said(self) -> tuple[str, ...]:
        """What each is."""
        return tuple(map(_said, self.plants))


def _least_order(model: ExtendedModel, x: Vector) -> float:
    """Least order of a plant at coordinates [-]."""
    return float(model.values(x)[model.plant.table.of_kind("order")].min())


def _said(one: OtherPlant) -> str:
    elements = one.state.model.plant.table.layout.elements
    terms, count = max(element.terms for element in elements), len(elements)
    own = f"{count} elements" if count > 1 else "one element"
    return (
        f"{own} with {terms} {'terms' if terms > 1 else 'term'} (log likelihood higher by "
        f"{max(one.gained, 0.0):.1f} nat)"
    )
