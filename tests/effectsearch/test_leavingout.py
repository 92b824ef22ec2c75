"""Samples left out in turn: the linear step where it is short, a descent where it is long, against refits to
records that lack them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small import TRUTH, record, study

from lcopa_bayes.bench.command import step
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.leavingout import groups, left_out_scores
from lcopa_bayes.effectsearch.noiselaw import Law
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.whitening import Whitening
from lcopa_bayes.inference.assembly import problem_of


def state_of(of, noise_sd: float) -> State:
    """At the optimum near the truth, under white noise."""
    posterior = problem_of(of).posterior
    model, white = ExtendedModel(posterior), Whitening(posterior.samples, (Law(noise_sd),))
    known = TRUTH | {"sigma": noise_sd}
    values = np.array([known.get(row.name, row.value) for row in posterior.table.rows])
    return State(model, Regression(model, white).descend(model.coordinates(values), gain=1e-9), white)


@pytest.mark.parametrize(("noise_sd", "far"), [(0.2, False), (0.002, True)])
def test_a_part_left_out_is_predicted_as_by_a_fit_without_it(noise_sd, far):
    """A lag follows a plant of order 0.8 roughly: with little noise the fit without a part of the onset is
    many standard deviations off, where tangents say nothing."""
    own = study(record(camera=0.05, noise_sd=noise_sd), priors={"order_1": 1.0})
    state = state_of(own, noise_sd)
    (score,) = left_out_scores(state)
    optimum, steps, worst = state.optimum, [], 0.0
    for rows in groups(state.whitening):
        response = np.array(own.fit[0].response)
        sampled = np.flatnonzero(~np.isnan(response[:, 0]))
        response[sampled[rows]] = np.nan
        rest = state_of(replace(own, fit=(replace(own.fit[0], response=response),)), noise_sd)
        refit = state.model.predict(rest.optimum.x)[rows]
        tangents, residual = optimum.jacobian[rows], optimum.settled[rows]
        step = -np.linalg.solve(optimum.information - tangents.T @ tangents, tangents.T @ residual)
        linear = state.fitted[rows] + optimum.tangents[rows] @ step
        steps.append(np.abs(step / optimum.sd).max())
        errors = [np.abs(one - refit).max() / noise_sd for one in (score.predicted[rows], linear)]
        assert errors[0] < (0.01 if far else 0.2)
        worst = max(worst, errors[1])
    assert (min(steps) > 3.0) == (max(steps) > 3.0) == far
    assert (worst > 2.0) == far


def test_a_record_left_out_is_predicted_as_by_a_fit_of_the_others():
    """A lag that follows steps of two lengths from two instants is not the same one."""
    records = [
        record(k, command=step(1.0, at=at), camera=0.05, duration=end, noise_sd=0.002, name=f"run{k}")
        for k, (at, end) in enumerate([(0.35, 3.0), (1.0, 12.0)])
    ]
    own = study(*records, priors={"order_1": 1.0}, offset="shared")
    state = state_of(own, 0.002)
    rows, noise = groups(state.whitening), 0.002
    for score, own_rows, other in zip(left_out_scores(state), rows, records[::-1], strict=True):
        rest = state_of(replace(own, fit=(other,)), noise)
        assert (np.abs(rest.optimum.x - state.optimum.x) > 10.0 * state.optimum.sd).any()
        refit = state.model.predict(rest.optimum.x)[own_rows]
        # a descent ends 1e-3 nat from its optimum
        np.testing.assert_allclose(score.predicted, refit, rtol=0.0, atol=np.sqrt(2e-3) * noise)
        assert np.isfinite(score.variance).all()
