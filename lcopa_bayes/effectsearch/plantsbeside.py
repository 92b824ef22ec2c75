"""Plants that follow the records as well as the one a loop ends with: richer ones, and the same with integer
orders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Self, final

from lcopa_bayes.effectsearch.integerplants import IntegerPlant, integer_plant
from lcopa_bayes.effectsearch.openeffects import Weighed
from lcopa_bayes.effectsearch.richerplants import RicherPlants
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.parameter import Parameter


@final
@dataclass(frozen=True, eq=False)
class PlantsBeside:
    """All of them; none where a study states the structure of its plant."""

    richer: RicherPlants = field(default_factory=RicherPlants)
    integer: IntegerPlant | None = None

    @classmethod
    def of(cls, state: State, problem: Problem, wider: Sequence[State] | None) -> Self:
        """Those beside a final state: of a base fit's `wider` states, and with integer orders; none of a
        plant whose structure is stated, where `wider` is None."""
        if wider is None:
            return cls()
        return cls(RicherPlants.beside(state, wider), integer_plant(state, problem))

    def figures(self, figures: Sequence[Weighed], *, span: float, time_unit: str) -> tuple[Weighed, ...]:
        """Figures of the response to a unit step over `span` [time unit], over these plants too."""
        if self.integer is not None:
            figures = self.integer.figures(figures, span=span, time_unit=time_unit)
        return self.richer.figures(figures, span=span, time_unit=time_unit)

    def number(self, number: Weighed, row: Parameter) -> Weighed:
        """A gain or delay over these plants too."""
        if self.integer is not None:
            number = self.integer.number(number, row)
        return self.richer.number(number, row)
