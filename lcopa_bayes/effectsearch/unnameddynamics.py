"""Linear dynamics without a name that a plant lacks: their part in gains, delays and figures of the step
responses.

Where a verdict says that they are missing and no more, the final model has no effects, and its numbers are
those of a plant that is known to be another. A further lag is one of several linear effects that stand for
the same dynamics, each with internal constants of its own: the response that was measured is that of the
plant with any of them, whatever it is called.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Self, final

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.effectsearch.basefit import settled
from lcopa_bayes.effectsearch.freedconstants import loosened
from lcopa_bayes.effectsearch.openeffects import LEAST, Weighed
from lcopa_bayes.effectsearch.otherplants import OtherPlant
from lcopa_bayes.effectsearch.refits import Refit
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.rounds import Search
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.inference.parameter import Parameter
from lcopa_bayes.results.stepcurves import curves_of
from lcopa_bayes.results.steps import metrics_of


@final
@dataclass(frozen=True, eq=False)
class UnnamedDynamics:
    """A plant with each linear effect that stands for them."""

    plants: tuple[OtherPlant, ...] = ()

    @classmethod
    def of(cls, searched: Search) -> Self:
        """Those of a search that added no other effect: as they were refitted in its first round, with their
        internal constants free."""
        first, last = searched.rounds[0], searched.rounds[-1]
        if first.chosen is None or not first.chosen.dynamics:
            return cls()
        linear = [one for one in first.refits if one.dynamics or one.linear]
        best = max(one.log_bayes_factor for one in linear)
        likely = [one for one in linear if one.log_bayes_factor > best + np.log(LEAST)]
        return cls(tuple(_loosened(one, remains=last.trace.alarmed) for one in likely))

    @property
    def weight(self) -> float:
        """Probability of any of them against none [-]; 0 without any."""
        return float(1 - np.prod([1 - share for share in self._shares]))

    @property
    def ess(self) -> float:
        """Effective draws of a number over them: the fewest of any [-]; infinite without any."""
        return min((float(len(one.draws)) for one in self.plants), default=np.inf)

    @property
    def _shares(self) -> list[float]:
        """Part of each beside the chosen plant and those before it [-]."""
        logs = np.logaddexp.accumulate([0.0, *(one.log_bayes_factor for one in self.plants)])
        pairs = zip(self.plants, logs[1:], strict=True)
        return [float(np.exp(one.log_bayes_factor - whole)) for one, whole in pairs]

    def figures(self, figures: Sequence[Weighed], *, span: float, time_unit: str) -> tuple[Weighed, ...]:
        """Figures of the response to a unit step over `span` [time unit], over them too."""
        theirs = [_figures(one, span, time_unit) for one in self.plants]
        return tuple(self._beside(one, [own.get(one.name) for own in theirs]) for one in figures)

    def number(self, number: Weighed, row: Parameter) -> Weighed:
        """A delay over them too; their gains are steady values of the figures."""
        if row.kind != "delay":
            return number
        return self._beside(number, [one.number(row.name) for one in self.plants])

    def _beside(self, number: Weighed, theirs: Sequence[Vector | None]) -> Weighed:
        for own, share in zip(theirs, self._shares, strict=True):
            number = number if own is None else number.beside([own], share)
        return number


def _loosened(one: Refit, *, remains: bool) -> OtherPlant:
    """The plant of a refit with its internal constants free; under the noise that its residual has where
    something `remains`."""
    state, wide = one.state, loosened(one.model, one.added)
    if len(wide.columns) > len(one.model.columns):
        start = wide.coordinates(one.model.values(one.optimum.x))
        with suppress(ArithmeticError):  # constants stay where a descent meets no bounded response
            state = replace(state, model=wide, optimum=Regression(wide, one.whitening).descend(start))
    if remains:
        optimum, whitening = settled(state.model, state.optimum, state.whitening)
        state = State(state.model, optimum, whitening)
    dropped = one.before.cost - one.optimum.cost
    return OtherPlant(state, dropped, one.log_bayes_factor)


def _figures(one: OtherPlant, span: float, time_unit: str) -> dict[str, Vector]:
    """Figures of the whole response of a plant with linear effects, by name."""
    model = one.state.model
    table = model.posterior.table
    values = model.tabulated(one.draws[model.supported(one.draws)])
    return {f.name: f.values for f in metrics_of(table, curves_of(table, values, span), time_unit=time_unit)}
