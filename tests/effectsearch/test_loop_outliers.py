"""Samples far outside the noise are told from effects of the device, and left out."""

from dataclasses import replace

import numpy as np
import pytest
from test_loop import LIBRARY, NOISE, study

from lcopa_bayes.data.settings import NoiseSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.basefit import base_fit
from lcopa_bayes.effectsearch.explained import explained_study
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.effectsearch.outliers import outlying, without_outliers
from lcopa_bayes.effectsearch.scores import Score
from lcopa_bayes.effectsearch.summary import results
from lcopa_bayes.effectsearch.verdict import Verdict, beside
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.model.effects.catalogue import catalogue

SHARE = 0.03


def struck(
    made: Study, seed: int, *, share: float = SHARE, at_rest: bool = True
) -> tuple[Study, list[np.ndarray]]:
    """The study with a share of its samples ten times the noise away, and which ones."""
    rng = np.random.default_rng(seed)
    out, where = [], []
    for record in made.fit:
        hit = rng.random(record.time.size) < share
        if not at_rest:
            hit &= record.time > record.time[np.flatnonzero(np.diff(record.drive[:, 0]))[0]]
        y = record.response.copy()
        y[hit, 0] += 10 * NOISE * rng.choice((-1.0, 1.0), int(hit.sum()))
        out.append(replace(record, response=y))
        where.append(hit)
    return replace(made, fit=tuple(out)), where


def fitted(made: Study):
    return base_fit(ExtendedModel(problem_of(made).posterior), np.random.default_rng(1))


def test_outliers_are_found_where_they_are():
    made, where = struck(study(1), 5)
    found = outlying(made, fitted(made))
    assert found is not None
    pairs = zip(found.study.fit, made.fit, where, strict=True)
    taken = [(np.isnan(new.response[:, 0]) & ~np.isnan(old.response[:, 0]), hit) for new, old, hit in pairs]
    hits = sum(int((out & hit).sum()) for out, hit in taken)
    false = found.count - hits
    assert hits > 0.9 * sum(int(hit.sum()) for hit in where)
    assert false <= 3
    assert 5 < found.width < 15
    assert found.log_bayes_factor > 50


@pytest.mark.parametrize(("step", "above"), [(6.0, 0.3), (10.0, 0.4), (10.0, 0.45)])
def test_a_coarse_sensor_has_no_outliers(step, above):
    """Most of its samples are those beside them, from which the next value is one step of the sensor away."""
    made, height = study(1), step * NOISE
    coarse = [replace(r, response=height * np.round(r.response / height + above)) for r in made.fit]
    made = replace(made, fit=tuple(coarse))
    assert outlying(made, fitted(made)) is None


@pytest.mark.parametrize("made", [study(1), study(2, 0.3)], ids=["clean", "bent"])
def test_noise_and_effects_are_no_outliers(made):
    assert outlying(made, fitted(made)) is None


def test_what_strikes_only_where_the_device_moves_is_left_to_the_trace():
    made, _ = struck(study(1), 5, at_rest=False)
    assert outlying(made, fitted(made)) is None


def test_an_effect_is_found_beside_outliers():
    made, _ = struck(study(2, 0.06), 7)
    found = loop(made, library=[*LIBRARY, catalogue()["outliers"]], sample=False, quick=True, as_stated=True)
    assert found.names == ("odd_curvature", "outliers")
    reported = results(found)
    assert reported["outliers"]["count"] > 0
    assert "outliers" in reported["sentence"]
    assert found.study.effects.use == ("odd_curvature", "outliers")
    for record, given in zip(found.study.fit, made.fit, strict=True):
        np.testing.assert_array_equal(record.response, given.response)
    table = problem_of(found.study).posterior.table
    assert {"odd_curvature.c", "outliers.nu"} <= set(table.names)
    stated = replace(found.problem.study, noise=NoiseSettings("student"))
    assert explained_study(stated, found.after.state.model, found.outliers).effects.use == ("odd_curvature",)


def test_outliers_alone_are_a_disturbance():
    said = beside(Verdict("clean", "firm", "Nothing."), "Two samples.")
    assert (said.kind, said.sentence) == ("disturbance", "Two samples. Nothing.")
    assert beside(Verdict("unexplained", "firm", "x"), "y").kind == "unexplained"


def test_outliers_of_held_out_records_are_no_error_of_the_model():
    """Struck on every record, as a sensor does; before, the held-out ones counted against every name."""
    made, _ = struck(study(1), 5)
    apart, _ = struck(replace(made, fit=made.held_out, held_out=()), 6, share=0.05)
    found = loop(replace(made, held_out=apart.fit), library=LIBRARY, sample=False, quick=True, as_stated=True)
    assert found.outliers is not None
    assert found.verdict.kind == "disturbance"
    assert found.names == ("outliers",)


def test_two_models_are_compared_on_the_same_samples():
    """A sample that is far from its neighbours beside one of them only counts for neither."""
    rng = np.random.default_rng(4)
    t, noise = np.arange(200.0), rng.normal(size=200)
    base = Score("a", "y", "V", True, t, noise, np.zeros(200), np.zeros(200), 1.0, "the fit")
    before = replace(base, predicted=np.where(t == 50.0, 40.0, 0.0), draws=rng.normal(size=(3, 200)))
    after = replace(base, predicted=np.where(t == 120.0, 40.0, 0.0))
    (was,), (now,) = without_outliers([before], [after])
    np.testing.assert_array_equal(was.time, now.time)
    assert not {50.0, 120.0} & set(was.time)
    assert was.draws.shape == (3, was.time.size)
    assert was.time.size > 180


def test_scores_of_a_coarse_sensor_keep_their_samples():
    """Nine samples in ten repeat the one before; the tenth is a step of the sensor away."""
    rng = np.random.default_rng(3)
    observed = 0.3 * np.round(np.linspace(0.0, 6.0, 200) + (rng.random(200) < 0.1))
    predicted = 0.3 * np.round(np.linspace(0.0, 6.0, 200))
    t, nothing = np.arange(200.0), np.zeros(200)
    score = Score("a", "y", "V", True, t, observed, predicted, nothing, 0.1, "the fit")
    (was,), _ = without_outliers([score], [score])
    assert was.time.size == 200
