"""Blocks narrow enough for a plant may be too wide for an effect: the final model has those it asks for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small import TRUTH, problem, record, row_values

from lcopa_bayes.bench.command import staircase
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.noise import Law
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.resolvedmodel import moved, narrowed_for
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.whitening import Whitening
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.effects import effected
from lcopa_bayes.model.effects.dynamics import RiseFallAsymmetry

SIZE, SD = 0.3, 2e-4


@pytest.fixture(scope="module")
def wide() -> tuple[State, Problem]:
    """The optimum of an asymmetric plant on 100 blocks, and its problem; the record is of 3 200."""
    command = staircase([1.0, -0.7, 0.4, 0.0], hold=3.0, start=0.35)
    silent = record(1, command=command, camera=0.1, duration=14.0, noise_sd=0.0)
    own = problem(silent, blocks=100)
    fine, values = own.refined(32).posterior, row_values(own.posterior.table, TRUTH)
    exact = effected(fine, values, [RiseFallAsymmetry()]).responses(values, np.array([SIZE]))[0]
    seen = np.full(silent.response.shape, np.nan)
    seen[~np.isnan(silent.response)] = exact[:, 0] + SD * np.random.default_rng(1).standard_normal(len(exact))
    own = problem(replace(silent, response=seen), blocks=100)
    plain, white = ExtendedModel(own.posterior), Whitening(own.posterior.samples, (Law(SD),))
    x = plain.coordinates(values)
    model = plain.at_scales(x, {silent.name: 0.0}).having(RiseFallAsymmetry())
    optimum = Regression(model, white).descend(np.append(x, SIZE))
    return State(model, optimum, white), own


def off(state: State) -> float:
    """Distance of the size of the asymmetry from its truth [sd]."""
    return float(abs(state.optimum.x[-1] - SIZE) / state.optimum.sd[-1])


def test_an_effect_has_the_blocks_that_it_asks_for(wide):
    state, own = wide
    narrow = narrowed_for(state, own)
    found = moved(state, narrow)
    assert narrow.refinement > 1
    assert off(state) > 5.0
    assert off(found) < 3.0
    assert found.optimum.cost < state.optimum.cost - 10.0
    assert narrowed_for(found, narrow) is narrow
