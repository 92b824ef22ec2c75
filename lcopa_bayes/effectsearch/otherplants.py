"""A plant that a loop does not end with and that follows the records as well: its part in gains, delays and
figures of the step responses."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self, final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.effectsearch.drawsabout import draws_about
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.openeffects import Mixture, step_figures
from lcopa_bayes.effectsearch.regression import Optimum
from lcopa_bayes.effectsearch.scores import State

_DRAWS = 120
"""Draws whose likelihood is computed [-]."""
_SEED = 29


@final
@dataclass(frozen=True, eq=False)
class OtherPlant:
    """Another plant than the chosen one, with its effects and under its noise."""

    state: State
    gained: float
    """Log likelihood over that of the chosen one [nat]."""
    log_bayes_factor: float
    """Laplace evidence over that of the chosen one [nat]."""

    @classmethod
    def beside(cls, chosen: State, model: ExtendedModel, optimum: Optimum) -> Self:
        """At its optimum, beside the chosen plant at its own."""
        squares = (at.white @ at.white for at in (chosen.optimum, optimum))
        state = State(model, optimum, chosen.whitening)
        evidence = state.log_evidence - chosen.log_evidence
        return cls(state, float(np.subtract(*squares)) / 2, evidence)

    @cached_property
    def draws(self) -> Matrix:
        """Draws about its optimum that follow the records, (draws, coordinates)."""
        return draws_about(self.state, np.random.default_rng(_SEED), _DRAWS)

    def figures(self, *, span: float, time_unit: str) -> dict[str, Vector]:
        """Those of its response to a unit step over `span` [time unit], by name."""
        found = step_figures(self.state, Mixture([self.draws], np.ones(1)), span=span, time_unit=time_unit)
        return {one.name: one.values for one in found}

    def number(self, name: str) -> Vector | None:
        """A coordinate at the draws; None of one that it does not have."""
        model = self.state.model
        if name not in model.names:
            return None
        k = model.names.index(name)
        return model.posterior.table.rows[model.columns[k]].value_at(self.draws[:, k])
