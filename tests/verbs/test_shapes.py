"""Every verb on campaigns of every shape: a result with finite numbers or a message, never an exception."""

import numpy as np
import pytest
from shapes import SHAPES

import lcopa_bayes as lb


@pytest.mark.parametrize("name", SHAPES)
def test_a_look_at_any_shape(name, tmp_path):
    study = SHAPES[name].study()
    understood, seen = lb.check(study), lb.look(study)
    assert "can be fitted" in understood.verdict
    assert np.isfinite(seen.summary()["value"].astype(float)).all()
    for result in (understood, seen):
        assert result.report(tmp_path).read_text("utf-8").count("<svg")


def test_units_of_time_change_only_times():
    """The same numbers on clocks of milliseconds and of hours: what has no unit of time is equal."""
    here, there = (lb.look(SHAPES[name].study()).summary() for name in ("repeats", "repeats, hours"))
    timed = here["unit"] == "ms"
    assert 0 < timed.sum() < len(timed)
    for end in ("value", "lower", "upper"):
        np.testing.assert_allclose(there[end], np.where(timed, 9_000.0, 1.0) * here[end], rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", SHAPES)
def test_every_verb_on_any_shape(name, tmp_path):
    study = SHAPES[name].study()
    fit = lb.fit(study, quick=True, folder=tmp_path)
    assert np.isfinite(fit.summary()["value"].astype(float)).all()
    drive = lb.Drive.steps(**{axis.name: [(0.0, 1.0)] for axis in study.fit[0].drive_axes})
    assert np.isfinite(fit.predict(drive).summary()["value_at_end"]).all()
    for verb in (lb.audit, lb.compare, lb.design):
        assert len(verb(fit).summary())
    assert lb.loop(study, quick=True).verdict
