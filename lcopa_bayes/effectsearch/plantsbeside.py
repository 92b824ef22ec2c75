"""Plants that follow the records as well as the one a loop ends with, or better: richer ones, the same with
integer orders, and the same with linear dynamics that have no name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Self, final

from lcopa_bayes.core.crew import ALONE, Crew
from lcopa_bayes.core.wording import listed
from lcopa_bayes.effectsearch.integerplants import IntegerPlant, integer_plant
from lcopa_bayes.effectsearch.lags import fitted_plant
from lcopa_bayes.effectsearch.openeffects import Weighed
from lcopa_bayes.effectsearch.richerplants import RicherPlants
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.unnameddynamics import UnnamedDynamics
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.parameter import Parameter
from lcopa_bayes.results.sumsoflags import Alternative, held_against


@final
@dataclass(frozen=True, eq=False)
class PlantsBeside:
    """All of them."""

    richer: RicherPlants = field(default_factory=RicherPlants)
    """None where a study states the structure of its plant."""
    integer: IntegerPlant | None = None
    """None there too."""
    unnamed: UnnamedDynamics = field(default_factory=UnnamedDynamics)
    """With linear dynamics without a name, where these are missing and the final model has none."""

    @classmethod
    def of(cls, state: State, problem: Problem, wider: Sequence[State] | None, crew: Crew = ALONE) -> Self:
        """Those beside a final state: of a base fit's `wider` states, and with integer orders; none of a
        plant whose structure is stated, where `wider` is None."""
        if wider is None:
            return cls()
        return cls(RicherPlants.beside(state, wider), integer_plant(state, problem, crew))

    def figures(self, figures: Sequence[Weighed], *, span: float, time_unit: str) -> tuple[Weighed, ...]:
        """Figures of the response to a unit step over `span` [time unit], over these plants too."""
        if self.integer is not None:
            figures = self.integer.figures(figures, span=span, time_unit=time_unit)
        figures = self.richer.figures(figures, span=span, time_unit=time_unit)
        return self.unnamed.figures(figures, span=span, time_unit=time_unit)

    def number(self, number: Weighed, row: Parameter) -> Weighed:
        """A gain or delay over these plants too."""
        if self.integer is not None:
            number = self.integer.number(number, row)
        number = self.richer.number(number, row)
        return self.unnamed.number(number, row)

    def held_against(
        self, lags: Sequence[Alternative], chosen: State, problem: Problem
    ) -> tuple[Alternative, ...]:
        """Sums of lags beside the chosen plant, or beside that with dynamics without a name if there is one,
        held against that with integer orders where it follows a response better by Akaike's criterion."""
        if self.integer is None or not lags:
            return tuple(lags)
        integer = fitted_plant(self.integer.plant.state, problem)
        best = max(self.unnamed.plants, key=lambda one: one.log_bayes_factor, default=None)
        chosen = chosen if best is None else best.state
        return held_against(lags, fitted_plant(chosen, problem), integer)

    @property
    def shares(self) -> tuple[tuple[str, float], ...]:
        """Each plant in words, and its share of the draws of all [-]; the chosen one first."""
        richer = self.richer.said
        known = 1 - self.unnamed.weight
        left = known * (1 - self.richer.weight)
        integer = 0.0 if self.integer is None else left * self.integer.weight
        beside = [] if self.integer is None else [(f"a plant with {self.integer.said}", integer)]
        beside += [(f"a plant of {said}", known * self.richer.weight / len(richer)) for said in richer]
        if self.unnamed.plants:
            added = "the plant chosen with linear dynamics without a name, which are part of its response"
            beside.append((added, self.unnamed.weight))
        return ("the plant chosen", left - integer), *beside

    @property
    def sentence(self) -> str:
        """What they are and what part they have; empty without any."""
        shares = self.shares
        if len(shares) == 1:
            return ""
        said = listed(
            [f"{100 * share:.0f} % {'are ' * (not k)}of {one}" for k, (one, share) in enumerate(shares)]
        )
        return (
            "Gains, delays and figures of the step responses are over plants that the records do not reject. "
            f"Of their draws {said}."
        )
