"""Errors on unseen records: on those held out, predicted as a fit predicts them, by draws and with levels by
its rule, or with fitted ones left out in turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lcopa_bayes.core.arrays import Matrix
from lcopa_bayes.effectsearch.basefit import fitted_scales
from lcopa_bayes.effectsearch.drawsabout import likely_draws
from lcopa_bayes.effectsearch.leavingout import left_out_scores
from lcopa_bayes.effectsearch.scores import Score, State, score_of
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.declared import campaign_places
from lcopa_bayes.inference.noise import Noise, WhiteAR1
from lcopa_bayes.inference.parameter import Parameter, Place
from lcopa_bayes.model.effects.declared import Declared
from lcopa_bayes.model.effects.effect import UnstableError
from lcopa_bayes.results.prediction import axis_draws
from lcopa_bayes.sampling.draws import Draws

_DRAWS = 100
"""Draws about an optimum behind the prediction of a held-out record [-]."""
_MOST = 400
"""The same of a sampled posterior, at most [-]."""
_STREAM = 14
"""Mark of their randomness."""


def unseen_scores(state: State, problem: Problem) -> list[Score]:
    """On the study's held-out records; without any with each fit record left out in turn."""
    return held_out_scores(state, problem) if problem.study.held_out else left_out_scores(state)


def held_out_scores(state: State, problem: Problem) -> list[Score]:
    """On the study's held-out records.

    What effects differ in from record to record is as large as on the fit records, and adds to the variance.
    """
    study = problem.study
    samples, model = problem.simulated(study.held_out)
    if state.model.effects:
        places = campaign_places(study)
        own = Declared(
            tuple(type(effect) for effect in state.model.effects),
            state.model.effected.ranges,
            np.array([places[record.name] for record in study.held_out]),
            tuple(one.times for one in samples),
            (None,) * len(samples),
        )
        model = replace(model, effects=own)
    draws, noise = state.sampled or _about_optimum(state, study.seed)
    draws, out = replace(draws, values=draws.thinned(_MOST)[None]), []
    drawn = axis_draws(draws, model, samples, noise, held_out=True, seed=study.seed)
    for record, axis, _, plant, seen, (level, source, _), _ in drawn:
        bounded = np.isfinite(seen).all(axis=1)
        if not bounded.any():
            names = tuple(effect.name for effect in state.model.effects)
            raise UnstableError(names, record.record.name, "no draw has a bounded response")
        # what differs from record to record is 0 on average
        mean = plant[bounded].mean(axis=0) + level[bounded].mean()
        apart = (seen + level[:, None])[bounded]
        one = score_of(state, record, axis, (mean, apart.var(axis=0)), source, held_out=True)
        varied = None if seen is plant else (seen - plant)[bounded]
        out.append(replace(one, draws=apart - apart.mean(axis=0), varied=varied))
    return out


def given_their_records(scores: Sequence[Score], state: State) -> list[Score]:
    """Predictions given what each record itself says of what differs from record to record, such as when its
    trigger came: no other record tells that, and an error by it says nothing of the model.

    By the gain of a Kalman filter whose covariance is that of the draws (Burgers, van Leeuwen and Evensen
    1998, Mon. Weather Rev. 126).
    """
    return [one if one.varied is None else _given_its_record(one, one.varied, state) for one in scores]


def _given_its_record(score: Score, varied: Matrix, state: State) -> Score:
    assert score.draws is not None
    axes = [axis.name for axis in state.model.plant.table.layout.responses]
    law = state.whitening.weighed[axes.index(score.axis)]
    gaps = np.diff(score.time, prepend=np.nan) / fitted_scales(state.model.plant).period
    gaps[0] = 1.0
    columns = (varied - varied.mean(axis=0)) / np.sqrt(len(varied))
    white = law.whiten(columns, gaps)
    inner = white @ white.T + np.eye(len(white))

    def taken(residual: Matrix) -> Matrix:
        """What of residuals (batch, n) is put down to it."""
        return np.asarray(np.linalg.solve(inner, white @ law.whiten(residual, gaps).T).T @ columns)

    noise = WhiteAR1().draw(
        np.tile(law.parameters, (len(varied), 1)), gaps, np.random.default_rng([_STREAM, score.time.size])
    )
    draws = score.draws - taken(score.draws + noise)
    draws -= draws.mean(axis=0)
    return replace(
        score,
        predicted=score.predicted + taken((score.observed - score.predicted)[None])[0],
        variance=score.variance - score.draws.var(axis=0) + draws.var(axis=0),
        draws=draws,
        varied=None,
    )


def _about_optimum(state: State, seed: int) -> tuple[Draws, Noise]:
    """Draws about an optimum that follow the records, as draws of a table with the noise of the loop."""
    model = state.model
    x = likely_draws(state, np.random.default_rng([seed, _STREAM]), _DRAWS)
    table = model.posterior.table
    rows = [k for k, row in enumerate(table.rows) if not row.noise]
    values = np.array([model.values(each) for each in x])[:, rows]
    noise = [
        Parameter(name, "", name, Place(axis, 0), None, float(value))
        for axis, law in enumerate(state.whitening.weighed)
        for name, value in zip(WhiteAR1.names, law.parameters, strict=True)
    ]
    held = replace(table, rows=(*(table.rows[k] for k in rows), *noise))
    values = np.hstack([values, np.tile([row.value for row in noise], (len(values), 1))])
    return Draws(held, values[None], np.zeros((1, len(values))), (), float(_DRAWS)), WhiteAR1()
