"""A fit of a study that declares effects: interval, evidence, prediction and step metrics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import brentq
from small import draws_of, record, study, with_effect

from lcopa_bayes.bench.command import staircase
from lcopa_bayes.data.drive import Drive
from lcopa_bayes.data.settings import EffectsSettings, SamplerSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.results import stepcurves
from lcopa_bayes.results.fit import Fit, fit
from lcopa_bayes.results.frequency import frequency_response
from lcopa_bayes.results.newdrive import predict
from lcopa_bayes.results.prediction import bands
from lcopa_bayes.results.stepcurves import step_curves
from lcopa_bayes.results.steps import step_metrics

TRUTH = {"gain": 2.0, "time": 1.5, "order": 0.8, "delay": 0.73, "offset": 0.3, "sigma": 0.02}


def campaign(count: int = 2) -> Study:
    heights = (1.0, 0.5, -0.8)[:count]
    commands = [staircase([a, -0.7 * a, 0.4 * a, 0.0], hold=3.0, start=0.55) for a in heights]
    made = [record(k, command=c, camera=0.3, duration=15.0, name=f"r{k}") for k, c in enumerate(commands)]
    return study(*made, noise="white", seed=4)


@pytest.fixture(scope="module")
def stiff() -> tuple[Fit, np.ndarray]:
    made, truth = with_effect(campaign(), ["cubic_stiffness"], TRUTH | {"coefficient": 0.4})
    return fit(made, quick=True), truth


def test_the_interval_holds_the_truth(stiff: tuple[Fit, np.ndarray]):
    found, truth = stiff
    assert found.draws.grade.level != "unusable"
    reported = {one.name: one for one in found.draws.estimates()}
    own = reported["cubic_stiffness.c"]
    k = found.draws.table.names.index("cubic_stiffness.c")
    sd = found.draws.flat[:, k].std()
    assert abs(own.value - truth[k]) < 4 * sd
    assert 0.01 < sd < 0.1
    assert found.draws.ess > 300


def test_the_evidence_speaks_for_the_effect(stiff: tuple[Fit, np.ndarray]):
    """Against the same study without, by another sampler."""
    found, _ = stiff
    plain = replace(found.study, effects=EffectsSettings(), sampler=SamplerSettings(target_ess=50))
    other = fit(plain, quick=True)
    assert found.evidence is not None
    assert other.evidence is not None
    assert found.evidence.value > other.evidence.value + 10


@pytest.mark.parametrize("order", [None, 0.4, 1.0, 1.02, 1.3, 1.95])
def test_steady_state_of_a_stiff_plant(stiff: tuple[Fit, np.ndarray], order: float | None):
    """``y + c y^3 / ymax^2 = K u`` at the largest drive, whatever the order of the element."""
    found, _ = stiff
    table, ranges = found.draws.table, found.problem.ranges
    assert ranges is not None
    values = np.tile(np.median(found.draws.flat, axis=0), (4, 1))
    if order is not None:
        values[:, table.of_kind("order")] = order
    made = draws_of(table, values)
    reported = {one.name: one for one in step_metrics(made, step_curves(made, 10.0), time_unit="ms")}
    gain, c = values[0, 0], values[0, table.names.index("cubic_stiffness.c")]
    force, scale = gain * ranges.drive[0], ranges.response[0]
    level = brentq(lambda y: y + c * y**3 / scale**2 - force, 0, force)
    assert reported["steady_state[y]"].value == pytest.approx(level / ranges.drive[0], rel=1e-4)
    if order is None:
        assert reported["value_at_end[y]"].value < reported["steady_state[y]"].value


def test_curves_do_not_depend_on_how_many_draws_are_simulated_at_once(
    stiff: tuple[Fit, np.ndarray], monkeypatch: pytest.MonkeyPatch
):
    found, _ = stiff
    values = found.draws.flat[:: len(found.draws.flat) // 5][:5]
    whole = stepcurves.curves_of(found.draws.table, values, 10.0)
    monkeypatch.setattr(stepcurves, "_CELLS", 1)
    each = stepcurves.curves_of(found.draws.table, values, 10.0)
    assert_allclose(each.normalised, whole.normalised, rtol=0, atol=1e-6)
    assert_allclose(each.gains, whole.gains, rtol=1e-6)


@pytest.mark.parametrize("order", [0.4, 1.02, 1.95])
def test_steady_state_of_a_plant_that_creeps(order: float):
    """``(1 + k) K``, long after the record."""
    base = campaign(3)
    table = problem_of(replace(base, effects=EffectsSettings(use=("ion_creep",)))).posterior.table
    values = table.draw(1, np.random.default_rng(0))
    given = {"gain": 2.0, "order": order, "coefficient": 0.1}
    for kind, value in given.items():
        values[:, table.of_kind(kind)] = value
    made = draws_of(table, np.tile(values, (4, 1)))
    reported = {one.name: one for one in step_metrics(made, step_curves(made, 10.0), time_unit="ms")}
    assert reported["steady_state[y]"].value == pytest.approx(2.2, rel=1e-5)


def test_bands_hold_a_record_that_was_not_fitted():
    """The stiffness is part of the prediction: without it the error is several times the noise."""
    made, truth = with_effect(campaign(3), ["cubic_stiffness"], TRUTH | {"coefficient": 0.4})
    apart = replace(made, fit=made.fit[:2], held_out=made.fit[2:])
    problem = problem_of(apart)
    table = problem.posterior.table
    row = np.array([truth[problem_of(made).posterior.table.names.index(name)] for name in table.names])
    samples, model = problem.simulated(apart.held_out)
    noise = problem.posterior.noise

    def scored(values: np.ndarray) -> float:
        drawn = draws_of(table, np.tile(values, (40, 1)))
        return bands(drawn, model, samples, noise, held_out=True, seed=1)[0].rmse

    without = row.copy()
    without[table.names.index("cubic_stiffness.c")] = 0.0
    assert scored(row) < 1.2 * TRUTH["sigma"]
    assert scored(without) > 2 * TRUTH["sigma"]


def test_a_vibration_of_an_unseen_record_is_noise():
    """With noise the band is wider by its size, and holds the record."""
    base = campaign(3)
    made, truth = with_effect(base, ["vibration"], TRUTH | {"coefficient": 0.1, "constant": 0.4})
    apart = replace(made, fit=made.fit[:2], held_out=made.fit[2:])
    problem = problem_of(apart)
    table = problem.posterior.table
    whole = problem_of(made).posterior.table
    values = np.tile([truth[whole.names.index(name)] for name in table.names], (400, 1))
    samples, model = problem.simulated(apart.held_out)
    shown = bands(draws_of(table, values), model, samples, problem.posterior.noise, held_out=True, seed=1)[0]
    spread = (shown.noisy[4] - shown.noisy[0]) / (2 * 1.645)
    # cosine and sine of 0.1 each, less their value in the two quiet samples that set the level
    quiet = shown.time[: shown.offset_samples].mean()
    wave = 0.02 * (1 - np.cos(2 * np.pi * 0.4 * (shown.time - quiet)))
    assert_allclose(spread, np.sqrt(wave + 1.5 * TRUTH["sigma"] ** 2), rtol=0.2, atol=0.01)
    assert shown.coverage(0.9) > 0.75


def test_a_new_drive_is_predicted_with_the_effect():
    """Held long enough, ``y + c y^3 / ymax^2`` of the steady deflection; the frequency response says that it
    is that of the linear plant."""
    made, truth = with_effect(campaign(), ["odd_curvature"], TRUTH | {"order": 1.0, "coefficient": 0.2})
    problem = problem_of(made)
    draws = draws_of(problem.posterior.table, np.tile(truth, (8, 1)))
    (band,) = predict(problem, draws, Drive.steps(u=[(0.5, 0.8)], until=14.0), offset="zero").bands
    assert problem.ranges is not None
    steady = 2.0 * 0.8
    bent = steady + 0.2 * steady**3 / problem.ranges.response[0] ** 2
    assert band.plant[2, -1] == pytest.approx(bent, rel=1e-3)
    reported = frequency_response(draws, span=15.0, period=0.3, time_unit="ms")
    assert "odd_curvature" in reported.outside[0]


def test_a_record_disturbed_alike_widens_the_band_of_a_new_drive():
    made, truth = with_effect(campaign(), ["vibration"], TRUTH | {"coefficient": 0.1, "constant": 0.4})
    problem = problem_of(made)
    draws = draws_of(problem.posterior.table, np.tile(truth, (400, 1)))
    (band,) = predict(problem, draws, Drive.steps(u=[(0.5, 0.8)], until=14.0), offset="zero").bands
    spread = (band.noisy[4] - band.noisy[0]) / (2 * 1.645)
    assert_allclose(spread, np.hypot(0.1, TRUTH["sigma"]), rtol=0.2)
    assert np.ptp(band.plant, axis=0).max() < 1e-9
