"""Deflections that effects are measured in: in proportion to the plant that the search has come to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small import ONE, TRUTH, TWO, problem, record, row_values

from lcopa_bayes.bench.device import Device
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.noiselaw import Law
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.rounds import in_proportion
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.whitening import Whitening
from lcopa_bayes.inference.effects import effected
from lcopa_bayes.model.effects.response import OddCurvature

SIZE, SD = 0.1, 3e-4
OPTIONS = {"terms": {"direct": 2, "cross": 1}, "offset": "shared"}
TWO_AXES = {
    "gain_x_x": 1.0,
    "gain_x_y": 0.2,
    "gain_y_x": 0.3,
    "gain_y_y": 1.5,
    "time_1_direct": 1.2,
    "order_1_direct": 1.6,
    "time_2_direct": 2.5,
    "order_2_direct": 0.7,
    "time_1_cross": 2.0,
    "order_1_cross": 0.9,
    "delay": 0.4,
    "offset_x": 0.1,
    "offset_y": -0.2,
    "sigma_x": SD,
    "sigma_y": SD,
}


def curved(device: Device, truth: dict[str, float], wrong: float, **options: object) -> State:
    """The optimum of a curved plant whose last axis is measured in a deflection that is `wrong` times its
    own."""
    silent = record(1, device=device, noise_sd=0.0, camera=0.05)
    own = problem(silent, **options)
    values = row_values(own.posterior.table, truth)
    exact = effected(own.posterior, values, [OddCurvature()]).responses(values, np.array([SIZE]))[0]
    seen = exact + SD * np.random.default_rng(1).standard_normal(exact.shape)
    (samples,) = own.posterior.samples
    axes = (replace(one, values=seen[one.index, k]) for k, one in enumerate(samples.axes))
    posterior = replace(own.posterior, samples=(replace(samples, axes=tuple(axes)),))
    plain = ExtendedModel(posterior)
    x = plain.coordinates(values)
    model = plain.at_scales(x, {silent.name: 0.0}).having(OddCurvature())
    ranges = model.effected.ranges
    scale = np.append(np.ones(ranges.axes - 1), wrong)
    model = model.with_ranges(replace(ranges, response=ranges.response * scale))
    white = Whitening(posterior.samples, (Law(SD),) * ranges.axes)
    return State(model, Regression(model, white).descend(np.append(x, SIZE)), white)


@pytest.fixture(scope="module")
def wrong() -> State:
    return curved(TWO, TWO_AXES, 0.8, **OPTIONS)


def test_one_coefficient_fits_all_axes_once_deflections_are_in_proportion(wrong: State):
    found = in_proportion(wrong)
    excess = [2 * one.optimum.cost / one.whitening.size - 1 for one in (wrong, found)]
    chance = 5 * np.sqrt(2 / wrong.whitening.size)
    assert excess[0] > 2 * chance
    assert excess[1] < chance
    size, sd = found.optimum.x[-1], found.optimum.sd[-1]
    assert abs(size - SIZE * 0.8) < 4 * sd  # in units of a deflection sqrt(0.8) times as large, squared
    assert abs(wrong.optimum.x[-1] - SIZE * 0.8) > 4 * wrong.optimum.sd[-1]


def test_the_mean_deflection_stays(wrong: State):
    before, after = (one.model.effected.ranges for one in (wrong, in_proportion(wrong)))
    assert np.prod(after.response) == pytest.approx(np.prod(before.response), rel=1e-12)
    assert after.speed == before.speed


@pytest.mark.parametrize("wrong_by", [1.0, 0.8])
def test_a_single_axis_stays_as_it_is(wrong_by: float):
    state = curved(ONE, TRUTH, wrong_by)
    assert in_proportion(state) is state


def test_deflections_in_proportion_stay_as_they_are():
    state = curved(TWO, TWO_AXES, 1.0, **OPTIONS)
    assert in_proportion(state) is state
