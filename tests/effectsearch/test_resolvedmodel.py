"""Blocks narrow enough for a plant may be too wide for an effect: the final model has those it asks for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from small import TRUTH, problem, record, row_values, study

from lcopa_bayes.bench.command import staircase
from lcopa_bayes.data.record import Record
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.loop import _Begun, loop
from lcopa_bayes.effectsearch.noiselaw import Law
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.resolvedmodel import moved, narrowed_for
from lcopa_bayes.effectsearch.rounds import Search
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.whitening import Whitening
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.effects import effected
from lcopa_bayes.model.effects.dynamics import RiseFallAsymmetry

SIZE, SD = 0.3, 2e-4


def asymmetric(seed: int, levels: Sequence[float]) -> Record:
    """The record of an asymmetric plant on 3 200 blocks."""
    command = staircase(levels, hold=3.0, start=0.35)
    silent = record(seed, command=command, camera=0.1, duration=14.0, noise_sd=0.0, name=f"r{seed}")
    own = problem(silent, blocks=100)
    fine, values = own.refined(32).posterior, row_values(own.posterior.table, TRUTH)
    exact = effected(fine, values, [RiseFallAsymmetry()]).responses(values, np.array([SIZE]))[0]
    noise = SD * np.random.default_rng(seed).standard_normal(len(exact))
    seen = np.full(silent.response.shape, np.nan)
    seen[~np.isnan(silent.response)] = exact[:, 0] + noise
    return replace(silent, response=seen)


@pytest.fixture(scope="module")
def wide() -> tuple[State, Problem]:
    """The optimum of an asymmetric plant on 100 blocks, and its problem."""
    seen = asymmetric(1, [1.0, -0.7, 0.4, 0.0])
    own = problem(seen, blocks=100)
    values = row_values(own.posterior.table, TRUTH)
    plain, white = ExtendedModel(own.posterior), Whitening(own.posterior.samples, (Law(SD),))
    x = plain.coordinates(values)
    model = plain.at_scales(x, {seen.name: 0.0}).having(RiseFallAsymmetry())
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


def test_a_loop_ends_on_the_blocks_that_its_effects_ask_for():
    seen, unseen = asymmetric(1, [1.0, -0.7, 0.4, 0.0]), asymmetric(3, [0.8, -1.0, 0.2, 0.9])
    own = study(seen, held_out=[unseen], blocks=100)
    found = loop(own, library=[RiseFallAsymmetry], sample=False, quick=True, as_stated=True)
    assert found.verdict.kind == "explained"
    assert found.problem.refinement > 1
    assert found.base.optimum is found.before.state.optimum
    model = found.after.state.model
    assert model.plant.model is found.problem.posterior.model
    assert off(found.after.state) < 3.0


def test_only_what_the_width_of_blocks_may_have_left_is_searched_for_again(wide):
    """On narrower blocks the residual loses 12 nat or more."""
    state, own = wide
    found = moved(state, narrowed_for(state, own))
    lost = state.optimum.cost - found.optimum.cost
    searched = Search((), state, dict, gained=0.0, dropped=3.0 * lost, left=lost, brought=np.inf)
    assert searched.share == 0.75
    assert [replace(searched, left=left * lost).left_by_blocks(found) for left in (0, 4.9, 5.1)] == [
        False,
        True,
        False,
    ]


@pytest.mark.parametrize("blocks", [False, True])
def test_a_search_is_repeated_once_where_that_is_so(blocks: bool, monkeypatch):
    """As often as the blocks get narrower, which is once."""
    searched, asked, inner = [], [], _Begun._rounds

    def left_by_blocks(search: Search, narrower: State) -> bool:
        asked.append(search.state.optimum.cost - narrower.optimum.cost)
        return blocks

    monkeypatch.setattr(Search, "left_by_blocks", left_by_blocks)
    monkeypatch.setattr(_Begun, "_rounds", lambda begun, how: searched.append(begun) or inner(begun, how))
    seen, unseen = asymmetric(1, [1.0, -0.7, 0.4, 0.0]), asymmetric(3, [0.8, -1.0, 0.2, 0.9])
    own = study(seen, held_out=[unseen], blocks=100)
    found = loop(own, library=[RiseFallAsymmetry], sample=False, quick=True, as_stated=True)
    assert found.problem.refinement > 1
    assert len(searched) == (2 if blocks else 1)
    assert asked[0] > 5.0
    assert len(asked) == 1
    assert off(found.after.state) < 3.0
