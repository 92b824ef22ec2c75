"""Records without noise, as a simulation writes them: what is left of them is the error of a calculation."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from test_loop import AXIS, LIBRARY

from lcopa_bayes.data.record import Record
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.effectsearch.loopresult import Loop
from lcopa_bayes.effectsearch.noise import AxisNoise, no_less
from lcopa_bayes.effectsearch.noiselaw import Law
from lcopa_bayes.inference.defaultpriors import Scales
from lcopa_bayes.inference.observations import Observed, PlausibleNoise

GAIN, TIME, DELAY, LEVEL = 1.5, 8.0, 2.0, 300.1
BENT = 0.03
"""Cubic part of a reading [1 / rad^2]."""
STEPS = [[(10, 1.0)], [(10, -1.0), (50, 1.0)], [(10, 0.5), (40, 0.5), (70, -1.0)], [(20, 0.7), (60, -0.2)]]
_READ = np.arange(0.0, 100.0, 0.5)


def lag(steps: list[tuple[float, float]], level: float = 0.0, bent: float = 0.0) -> Record:
    """One lag in closed form, read at a level as exactly as numbers of that size are written."""
    response = np.zeros_like(_READ)
    for at, height in steps:
        since = np.maximum(_READ - at - DELAY, 0.0)
        response += GAIN * height * (1.0 - np.exp(-since / TIME))
    drive = np.sum([np.where(at <= _READ, height, 0.0) for at, height in steps], axis=0)
    seen = level + response + bent * response**3
    return Record(f"r{steps[0][0]}{len(steps)}", _READ, drive[:, None], seen[:, None], AXIS, AXIS, "ms")


def found(level: float = 0.0, bent: float = 0.0) -> Loop:
    """What a loop says of four such records."""
    *fit, last = (lag(steps, level, bent) for steps in STEPS)
    model = ModelSettings(terms=1, offset="shared")
    study = Study("exact", None, "ms", 1, tuple(fit), (last,), model)
    return loop(study, library=LIBRARY, sample=False, quick=True, as_stated=True)


@pytest.mark.parametrize("level", [0.0, LEVEL])
def test_the_error_of_a_calculation_is_no_effect(level: float):
    """Beside a level the last digit of what is written is a noise of 1e-14 of the response."""
    clean = found(level)
    assert (clean.verdict.kind, clean.verdict.confidence) == ("clean", "firm")
    assert clean.base.noise[0].least
    assert "no noise above" in clean.base.noise[0].sentence
    names, x = clean.problem.posterior.table.names, clean.base.optimum.x
    values = dict(zip(names, clean.after.state.model.values(x), strict=False))
    assert_allclose([values["gain"], values["time_1"], values["delay"]], [GAIN, TIME, DELAY], rtol=1e-5)


def test_an_effect_of_exact_records_is_found_and_leaves_nothing():
    """Noise and effect are found in turn, until no noise is left."""
    bent = found(bent=BENT)
    assert bent.names == ("odd_curvature",)
    assert bent.verdict.kind == "explained"
    assert bent.after.state.whitening.least
    assert not bent.before.state.whitening.least
    size = bent.after.state.optimum.x[-1] / bent.after.state.model.effected.ranges.response[0] ** 2
    assert size == pytest.approx(BENT, rel=1e-3)
    assert max(one.rmse for one in bent.after.unseen) < 1e-6


@pytest.mark.parametrize(
    ("rest", "residual", "least"),
    [(1e-9, 1e-9, True), (1e-9, 1e-3, True), (1e-3, 1e-9, True), (1e-3, 1e-3, False)],
)
def test_noise_is_no_less_than_a_millionth_of_the_range(rest: float, residual: float, least: bool):
    """Whatever samples at rest and the residual say."""
    pieces = [Observed(np.arange(100), residual * np.ones(100), np.ones(99))]
    measured = AxisNoise(Law(rest), PlausibleNoise.white(rest, 100), 100, "quiet", "as measured")
    noise = no_less(measured, pieces, AXIS[0], 1e-6)
    assert isinstance(noise, AxisNoise)
    assert noise.least is least
    assert noise.law.sd == (1e-6 if least else rest)
    assert noise.firm
    said = no_less("too few", pieces, AXIS[0], 1e-6)
    assert isinstance(said, AxisNoise) is (residual < 1e-6)


def test_known_white_noise_is_as_uncertain_as_its_samples_leave_it(rng: np.random.Generator):
    drawn = PlausibleNoise.white(0.2, 50).draw(4000, rng)
    assert_allclose(drawn[:, 1:], 0.0)
    assert np.median(drawn[:, 0]) == pytest.approx(0.2, rel=0.02)
    assert np.std(np.log(drawn[:, 0])) == pytest.approx(1 / np.sqrt(2 * 50), rel=0.05)


def test_what_rounding_leaves_is_no_noise_at_rest():
    """Priors of a noise come from samples at rest only where these have one."""
    exact = lag(STEPS[0], LEVEL)
    noise = 1e-3 * np.random.default_rng(3).standard_normal(exact.response.shape)
    noisy = replace(exact, response=exact.response + noise)
    assert Scales.of([exact]).quiet(0) is None
    quiet = Scales.of([noisy]).quiet(0)
    assert quiet is not None
    assert quiet.sigma == pytest.approx(1e-3, rel=0.4)
