"""Held-out records judged given what differs from record to record, which no other record tells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small import TRUTH, problem, record, row_values

from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.heldoutscores import given_their_records
from lcopa_bayes.effectsearch.noiselaw import Law
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.scores import Score, State
from lcopa_bayes.effectsearch.whitening import Whitening

SD, SPREAD, DRAWS = 0.02, 0.3, 600


@pytest.fixture(scope="module", params=[Law(SD), Law(0.6 * SD, 0.8 * SD, 0.9)], ids=["white", "coloured"])
def state(request: pytest.FixtureRequest) -> State:
    posterior = problem(record()).posterior
    model, white = ExtendedModel(posterior), Whitening(posterior.samples, (request.param,))
    x = model.coordinates(row_values(posterior.table, TRUTH))
    return State(model, Regression(model, white).descend(x), white)


def scored(state: State, size: float) -> tuple[Score, np.ndarray]:
    """A prediction of 0 of a record of noise and `size` of a known shape, which varies by `SPREAD`."""
    rng = np.random.default_rng(3)
    period = float(np.median(np.diff(state.whitening.samples[0].times)))
    time = period * np.arange(200)
    shape = np.sin(2 * np.pi * time / time[-1])
    varied = SPREAD * rng.standard_normal(DRAWS)[:, None] * shape
    other = 0.1 * SD * rng.standard_normal((DRAWS, 1)) * np.cos(time)
    draws = varied + other
    seen = size * shape + SD * rng.standard_normal(time.size)
    variance = draws.var(axis=0)
    zero = np.zeros(time.size)
    score = Score("held", "y", "rad", True, time, seen, zero, variance, SD, "rest", draws, varied)
    return score, shape


def test_what_is_taken_is_the_estimate_of_a_normal_prior(state: State):
    score, shape = scored(state, 0.5)
    (given,) = given_their_records([score], state)
    law = state.whitening.weighed[0]
    white, seen = law.whiten(np.stack([shape, score.observed]), np.ones(shape.size))
    precision = white @ white + SPREAD**-2
    closed = white @ seen / precision
    assert given.varied is None
    np.testing.assert_allclose(given.predicted, closed * shape, rtol=0, atol=0.1 * SD)
    own = given.draws @ shape / (shape @ shape)
    assert own.std() == pytest.approx(precision**-0.5, rel=0.1)
    assert given.rmse < 1.1 * SD < 0.1 * score.rmse


def test_what_it_does_not_vary_by_stays_an_error(state: State):
    score, shape = scored(state, 0.0)
    late = np.cos(np.pi * np.arange(shape.size) / shape.size * 6) * 10 * SD
    late -= shape * (late @ shape) / (shape @ shape)
    wrong = replace(score, observed=score.observed + late)
    (given,) = given_their_records([wrong], state)
    assert given.rmse > 0.8 * wrong.rmse


def test_predictions_without_it_stay_as_they_are(state: State):
    score = replace(scored(state, 0.5)[0], varied=None)
    assert given_their_records([score], state) == [score]
