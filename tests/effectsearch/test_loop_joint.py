"""The loop where no record shows rest or noise apart from the response."""

import os
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.data.studyfile import load_study
from lcopa_bayes.effectsearch.acceptance import SINGLE
from lcopa_bayes.effectsearch.basefit import base_fit
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.effectsearch.mendedstudy import started
from lcopa_bayes.effectsearch.signature import Projection, Scale, Signature
from lcopa_bayes.effectsearch.trace import Traced, _chance
from lcopa_bayes.effectsearch.whitening import Whitening
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.model.effects.catalogue import catalogue

RECORDS = Path(os.environ.get("LCOPA_BAYES_DATA", Path(__file__).parents[2] / ".." / "shared")) / "records"
AXIS = (Axis("x", "V"),)
PERIOD, TIME, GAIN = 0.5, 8.0, 2.0
"""Sampling period [ms], time constant [ms] and gain [-] of the plant."""


def walked(name, start, seed, n=600, noise=0.02, bend=0.0):
    """A first-order plant, exactly, that rested at drive `start` before a drive that changes every 5 ms;
    `bend` times the cube of the response is added."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(1.0, 0.5, n // 10), 10)
    keep, y = np.exp(-PERIOD / TIME), np.empty(n)
    y[0] = GAIN * start
    for k in range(1, n):
        y[k] = GAIN * u[k - 1] + (y[k - 1] - GAIN * u[k - 1]) * keep
    y = y + bend * y**3 + noise * rng.standard_normal(n)
    return Record(name, np.arange(n) * PERIOD, u[:, None], y[:, None], AXIS, AXIS, "ms")


def study_of(start, **more):
    fit, other = walked("a", start, 1, **more), walked("b", start, 2, **more)
    return Study("tank", None, "ms", 3, (fit,), (other,), ModelSettings(offset="shared"))


def fitted(study):
    return base_fit(ExtendedModel(problem_of(study).posterior), np.random.default_rng(0))


@cache
def away():
    """A study whose records began away from rest, and its fit."""
    study = study_of(3.5, n=300)
    return study, fitted(study)


def test_a_start_away_from_rest_is_found():
    made = started(*away())
    assert made is not None
    for record in (*made.study.fit, *made.study.held_out):
        assert record.drive[0, 0] == pytest.approx(3.5, abs=0.02)
        assert np.isnan(record.response[0]).all()
        assert record.time[0] == -PERIOD
    assert "before the first row" in made.sentence


def test_a_start_at_rest_or_a_stated_one_is_left_alone():
    resting = study_of(float(walked("a", 0.0, 1, n=300).drive[0, 0]), n=300)
    assert started(resting, fitted(resting)) is None
    made = started(*away())
    assert started(made.study, fitted(made.study)) is None


def test_a_start_level_predicts_records_held_out():
    found = loop(study_of(3.5, n=300), library=[], sample=False, quick=True, as_stated=True)
    assert "V of x" in found.enlarged
    assert found.before.unseen[0].rmse == pytest.approx(0.02, rel=0.15)


def test_a_bend_is_named_from_a_residual_that_holds_it():
    """Its own power is part of the noise until a refit takes it out."""
    library = [catalogue()[name] for name in ("odd_curvature", "unmodelled_smooth", "pointing_drift")]
    records = [
        walked(name, float(walked(name, 0.0, seed).drive[0, 0]), seed, bend=-0.02)
        for name, seed in (("a", 1), ("b", 2))
    ]
    study = Study("rest", None, "ms", 3, (records[0],), (records[1],), ModelSettings(offset="shared"))
    found = loop(study, library=library, sample=False, quick=True, as_stated=True)
    assert [effect.name for effect in found.effects] == ["odd_curvature"]
    assert found.verdict.confidence == "tentative"
    assert found.after.unseen[0].rmse < 0.6 * found.before.unseen[0].rmse
    refit = found.rounds[0].chosen
    assert refit.whitening.noise[0].sd == pytest.approx(0.02, rel=0.1)
    assert refit.whitening.noise[0].sd < 0.8 * found.base.noise[0].law.sd


def test_a_residual_without_independent_samples_names_nothing():
    t = np.arange(400) * PERIOD
    drive = np.where(t > 20.0, 1.0, 0.0)
    rng = np.random.default_rng(4)
    y = -np.expm1(-np.maximum(t - 20.0, 0) / TIME) + 3e-3 * np.cumsum(np.cumsum(rng.normal(size=400))) / 20
    record = Record("walk", t, drive[:, None], y[:, None], AXIS, AXIS, "ms")
    early = replace(record, time=t[30:], drive=drive[30:, None], response=y[30:, None])
    study = Study("walk", None, "ms", 5, (early,), (), ModelSettings(offset="shared"))
    library = [catalogue()[name] for name in ("odd_curvature", "pointing_drift", "unmodelled_smooth")]
    found = loop(study, library=library, sample=False, quick=True, as_stated=True)
    assert found.verdict.kind == "unexplained"
    assert "independent ones" in found.base.failed
    assert found.effects == ()


def test_chance_residuals_are_judged_as_the_residual_is():
    """Beside tangents as weak as their priors: what these leave of a chance residual, and its power."""
    _, fit = away()
    white = Whitening(fit.regression.whitening.samples, fit.regression.whitening.noise)
    along = np.ones((white.size, 1)) / np.sqrt(white.size)
    project = Projection(0.7 * along)
    kind = catalogue()["odd_curvature"]
    signature = Signature.of(kind(), project(3.0 * along), 0.8, False)
    found = [Traced(kind.card, (signature,), 0.0, 0)]
    freedom = white.size - 1.0
    made = _chance(project, white, found, np.random.default_rng(4), 40, Scale(0.0, freedom, np.ones(1)))
    left = project(np.random.default_rng(4).standard_normal((white.size, 40)))
    scale = Scale(0.0, freedom, (left**2).sum(axis=0))
    np.testing.assert_allclose(made, signature.evidence(signature.span.T @ left, scale), atol=1e-4)


def panel(k, seed=1):
    """A step with `k` of overdrive during a frame of 6 ms, noise known from before it."""
    rng, t = np.random.default_rng(seed), np.arange(250) * 0.2

    def rise(s):
        return -np.expm1(-np.maximum(s, 0) / 3.0)

    y = (1 + k) * rise(t - 15) - k * rise(t - 21) + 0.002 * rng.standard_normal(t.size)
    drive = np.where(t > 0, 1.0, 0.0)
    record = Record("step", t, drive[:, None], y[:, None], AXIS, AXIS, "ms")
    return Study("panel", None, "ms", seed, (record,), (), ModelSettings(offset="shared"))


def test_a_small_effect_of_a_single_record_is_not_named():
    library = [catalogue()["overdrive_pulse"]]
    found = loop(panel(0.02), library=library, sample=False, quick=True, as_stated=True)
    made = found.rounds[0].refits[0]
    assert found.trace.alarmed
    assert 0.05 < made.taken < SINGLE
    assert found.verdict.kind == "unexplained"
    assert any(f"{100 * SINGLE:.0f} %" in caution for caution in found.cautions)


@pytest.mark.slow
@pytest.mark.skipif(not RECORDS.is_dir(), reason="measured records are absent; set LCOPA_BAYES_DATA")
def test_tanks_that_overflow_are_named():
    """Cascaded tanks (Schoukens et al. 2016): their start is unknown, and both overflow."""
    names = ("overflow", "clipping", "odd_curvature", "backflow", "unmodelled_smooth", "unmodelled_linear")
    study = load_study(RECORDS / "cascaded_tanks")
    found = loop(study, library=[catalogue()[name] for name in names], sample=False, quick=True)
    assert "before the first row" in found.enlarged
    assert [effect.name for effect in found.effects] == ["overflow"]
    assert found.after.unseen[0].rmse < 0.6
    assert found.verdict.confidence == "tentative"


def test_a_record_without_a_sampling_period_is_looped_to_a_verdict():
    """Logarithmic times: every stretch of equal spacing is one sample long."""
    rng = np.random.default_rng(8)
    t = np.concatenate(
        [np.linspace(0.0, 19.0, 60) + rng.uniform(0, 0.1, 60), 20.0 + np.geomspace(0.1, 60, 80)]
    )
    y = 2.0 * -np.expm1(-np.maximum(t - 20.0, 0) / TIME) + 0.02 * rng.standard_normal(t.size)
    record = Record("uneven", t, np.where(t > 20.0, 1.0, 0.0)[:, None], y[:, None], AXIS, AXIS, "ms")
    study = Study("uneven", None, "ms", 3, (record,), (), ModelSettings(offset="shared"))
    library = [catalogue()[name] for name in ("odd_curvature", "unmodelled_smooth")]
    found = loop(study, library=library, sample=False, quick=True, as_stated=True)
    assert found.base.failed == ""
    assert found.verdict.kind == "clean"
    assert found.base.noise[0].source == "quiet"
    assert found.base.noise[0].law.sd == pytest.approx(0.02, rel=4 / np.sqrt(2 * 60))
    wrong = replace(record, response=rng.permutation(y)[:, None])
    bad = loop(replace(study, fit=(wrong,)), library=library, sample=False, quick=True, as_stated=True)
    assert "less than half" in bad.base.failed
