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

import numpy as np
from scipy.special import expit, logit

from lcopa_bayes.effectsearch.lesseffects import descended_with_effects, following, less_effects
from lcopa_bayes.effectsearch.openeffects import Weighed
from lcopa_bayes.effectsearch.otherplants import OtherPlant
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.spareterms import static_elements
from lcopa_bayes.inference.elementterms import terms_in_words
from lcopa_bayes.inference.parameter import Parameter

WEIGHT, _MOST = 0.2, 0.5
"""Prior probability of all richer plants beside the chosen one, which is their least weight, and the most
that evidence makes of it where it does not suffice to change an assumption [-]. Of 58 paths of plants outside
the family 90 % intervals hold the steady value 44 times without them, and 52 or 53 times with any weight from
0.1 to 0.5, when they are 1.3 to 2.1 times as wide."""


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
                if static_elements(plant, x):
                    continue
                model, optimum = descended_with_effects(state, one.model, x)
            except ArithmeticError:
                continue
            if not static_elements(model, optimum.x):
                out.append(OtherPlant.beside(state, model, optimum))
        return cls(tuple(out))

    @property
    def weight(self) -> float:
        """Of all of them together [-]: the probability of the best one beside the chosen plant, by Laplace's
        evidence, where that speaks for it; 0 without any."""
        if not self.plants:
            return 0.0
        best = max(one.log_bayes_factor for one in self.plants)
        return float(np.clip(expit(logit(WEIGHT) + best), WEIGHT, _MOST))

    def figures(self, figures: Sequence[Weighed], *, span: float, time_unit: str) -> tuple[Weighed, ...]:
        """Figures of the response to a unit step over `span` [time unit], over richer plants too."""
        theirs = [one.figures(span=span, time_unit=time_unit) for one in self.plants]
        return tuple(
            one.beside([own[one.name] for own in theirs if one.name in own], self.weight) for one in figures
        )

    def number(self, number: Weighed, row: Parameter) -> Weighed:
        """A gain or delay over richer plants too; times and orders of unlike plants are not the same
        numbers."""
        if row.kind not in ("gain", "delay"):
            return number
        theirs = [one.number(row.name) for one in self.plants]
        return number.beside([values for values in theirs if values is not None], self.weight)

    @property
    def said(self) -> tuple[str, ...]:
        """What each is."""
        return tuple(map(_said, self.plants))


def _said(one: OtherPlant) -> str:
    counts = one.state.model.plant.table.layout.terms
    own = f"{len(counts)} elements" if len(counts) > 1 else "one element"
    return f"{own} with {terms_in_words(counts)} (log likelihood higher by {max(one.gained, 0.0):.1f} nat)"
