"""Predictions of records held out by a plant with terms that the records do not need."""

from dataclasses import replace

import numpy as np
import pytest

from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch import explained
from lcopa_bayes.effectsearch.basemodel import _based
from lcopa_bayes.effectsearch.heldoutscores import held_out_scores
from lcopa_bayes.effectsearch.loop import loop

PERIOD, FREQUENCY, DAMPING, NOISE = 0.2, 1.1, 0.08, 0.03


def record(name: str, seed: int) -> Record:
    """A damped resonance by its closed form, driven by steps."""
    rng, time = np.random.default_rng(seed), PERIOD * np.arange(300)
    decay, swing = DAMPING * FREQUENCY, FREQUENCY * np.sqrt(1 - DAMPING**2)
    drive, response = np.zeros(time.size), NOISE * rng.standard_normal(time.size)
    for at in np.sort(rng.choice(np.arange(20, 280), 8, replace=False)):
        level, late = rng.choice([-2.0, -1.0, 0.0, 1.0, 2.0]), np.maximum(time - time[at] - 1.4, 0.0)
        wave = np.cos(swing * late) + decay / swing * np.sin(swing * late)
        response += 3.2 * (level - drive[-1]) * (1 - np.exp(-decay * late) * wave)
        drive[at:] = level
    return Record(name, time, drive[:, None], response[:, None], (Axis("u", "V"),), (Axis("y", "um"),), "us")


@pytest.mark.parametrize("terms", [2, 3])
def test_terms_too_many_do_not_lead_predictions_astray(terms: int) -> None:
    """By the noise that made the record and by what so many parameters leave open of a prediction; normal
    draws along the ridge of a term too many leave five times as much."""
    model, records = ModelSettings(terms=terms), (record("a", 1), record("b", 2))
    base = _based(Study("ridge", None, "us", 3, records, (record("held", 3),), model), terms)
    (score,) = held_out_scores(base.start, base.problem)
    assert score.rmse == pytest.approx(NOISE, rel=0.15)
    assert 0.8 < score.coverage < 0.97
    assert score.draws is not None
    left_open = NOISE * np.sqrt(base.start.optimum.x.size / base.start.whitening.size)
    assert 0.5 * left_open < np.sqrt(np.mean(score.draws**2)) < 2 * left_open


def test_what_constants_of_effects_leave_open_moves_no_prediction() -> None:
    """Draws are of the model with these constants; moved as others would move them they are none of it."""
    records = (record("a", 1), record("b", 2)), (record("held", 3),)
    base = _based(Study("ridge", None, "us", 3, *records, ModelSettings(terms=1)), 1)
    open_too = replace(base.start, spread=100 * base.start.covariance)
    (known,), (other,) = (held_out_scores(state, base.problem) for state in (base.start, open_too))
    np.testing.assert_array_equal(known.predicted, other.predicted)
    np.testing.assert_array_equal(known.variance, other.variance)


def test_draws_along_a_ridge_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """They predict the record held out as the optimum does, and normal draws about it do not. Those of
    a first proposal do: a search takes four times as long."""
    monkeypatch.setattr(explained, "_SEARCHED", 0)
    records = (record("a", 1), record("b", 2)), (record("held", 3),)
    study = Study("ridge", None, "us", 3, *records, ModelSettings(terms=2))
    found = loop(study, library=[], as_stated=True, quick=True)
    assert found.draws is not None
    assert found.cautions == ()
    assert found.after.unseen[0].rmse == pytest.approx(NOISE, rel=0.15)
