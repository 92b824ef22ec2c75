"""Constants of effects are found from where a search of their grid begins, and reach as far as records do."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from test_loop_unseen import fitted

from lcopa_bayes.bench.undeclared import LARGEST, campaign, drawn
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.freedconstants import freed
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.model.effects.parallel import MissingCrossPath
from lcopa_bayes.model.effects.response import Clipping


@pytest.mark.slow
def test_a_limit_is_found_from_a_part_of_a_lower_one():
    rng = np.random.default_rng([42002, 77])
    made = campaign(drawn(("clipping",), rng), rng)
    study = Study("clipped", None, "ms", 1, made.fit, (), ModelSettings(terms={"direct": 2, "cross": 1}))
    _, state = fitted(study)
    state = replace(state, model=state.model.at_scales(state.optimum.x, {one.name: 0.0 for one in study.fit}))
    model = state.model.having(Clipping(0.9))
    part = Regression(replace(model, exact=False), state.whitening)
    start, _ = part.reached(np.append(state.optimum.x, 0.5))
    assert start[-1] < 0.7
    moved, x = freed(model, start, state.whitening, ("clipping",))
    (found,) = moved.effects
    limit = made.hidden[0].numbers["level"] * made.device.paths[0][0].steady * LARGEST
    assert found.level * moved.effected.ranges.response[0] == pytest.approx(limit, rel=0.005)
    assert x[-1] == pytest.approx(1.0, abs=0.1)


def test_a_path_between_axes_may_be_as_slow_as_half_a_record():
    times = [one.time for one in MissingCrossPath.grid(SimpleNamespace(speed=2.0, span=100.0))]
    assert times[0] == pytest.approx(0.6)
    assert times[-1] == pytest.approx(50.0)
    assert max(np.divide(times[1:], times[:-1])) < 2.6
    short = [one.time for one in MissingCrossPath.grid(SimpleNamespace(speed=2.0, span=10.0))]
    assert short[-1] == pytest.approx(20.0)
    assert len(short) == 5
