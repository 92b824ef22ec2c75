"""Prediction for a new drive and scores of a new record, each number by a second method."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from small import ONE, TRUTH, TWO, draws_of, problem, record, row_values, study

from lcopa_bayes.bench.command import Command, on_off, step
from lcopa_bayes.bench.device import Bench, simulate
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.drive import Drive
from lcopa_bayes.data.record import Axis, Record, save_record
from lcopa_bayes.results.fit import Fit, fit
from lcopa_bayes.results.fittedrange import FittedRange, energies
from lcopa_bayes.results.newdrive import fitted_range, predict
from lcopa_bayes.results.prediction import responses
from lcopa_bayes.results.summary import results

TINY = {"target_ess": 50}
KNOWN = {"delay": 0.73, "order_1": 0.8}
HELD = record(2, command=on_off(-0.7, hold=4.0, at=1.3), name="held")
STEPS = Drive.steps(u=[(0.35, 0.8), (5.0, 0.1)], until=11.0)


def uncertain(prepared, count=2000, seed=4, **spread):
    """Draws about the truth with a given spread of some parameters."""
    table, rng = prepared.posterior.table, np.random.default_rng(seed)
    values = np.tile(row_values(table, TRUTH), (count, 1))
    for name, sd in spread.items():
        values[:, table.names.index(name)] += sd * rng.standard_normal(count)
    return draws_of(table, values)


def test_equal_draws_follow_the_bench_under_a_drive_of_steps():
    prepared = problem(record(camera=0.2))
    (band,) = predict(prepared, uncertain(prepared), STEPS).bands
    command = Command(np.array([0.35, 5.0]), np.array([[0.8], [0.1]]), np.zeros(1))
    shown = simulate(
        ONE, Bench(camera=0.01), command, duration=11.0, name="truth", rng=np.random.default_rng(0)
    )
    taken = np.isfinite(shown.response[:, 0])
    exact = np.interp(band.time, shown.time[taken], shown.response[taken, 0])
    assert np.abs(band.plant[2] - exact).max() < 6e-3
    assert np.ptp(band.plant, axis=0).max() < 1e-10
    assert_allclose(band.plant_simultaneous, band.plant[[0, 1, 3, 4]], atol=1e-9)
    assert np.isnan(band.observed).all()
    assert (band.time[0], band.time[-1]) == (pytest.approx(-0.65), pytest.approx(11.0, abs=0.2))
    assert (np.abs(band.time - 0.35) < 1e-9).any()


def test_bands_are_the_quantiles_of_offset_and_noise():
    """Offset with a known spread, noise of a known scale: both bands by hand, before the drive acts."""
    prepared = problem(record(camera=0.2))
    (band,) = predict(prepared, uncertain(prepared, offset=0.1), STEPS).bands
    assert band.offset_from == "that of the fit record that rests alike"
    early = band.time < 1.0
    for rows, sd in ((band.plant, 0.1), (band.noisy, np.hypot(0.1, TRUTH["sigma"]))):
        exact = TRUTH["offset"] + sd * np.array([-1.645, -0.6745, 0.0, 0.6745, 1.645])
        assert_allclose(rows[:, early], np.tile(exact[:, None], early.sum()), atol=0.1 * sd)
    # an offset moves the whole curve: there the simultaneous band of the plant is the pointwise one
    assert_allclose(band.plant_simultaneous[[0, 3]], band.plant[[0, 4]], atol=0.03)
    # noise does not: its largest deviation over all times is wider than that at one time
    noise = (band.noisy_simultaneous[3] - band.noisy[2]).mean()
    assert noise > 1.1 * (band.noisy[4] - band.noisy[2]).mean()
    (alone,) = predict(prepared, uncertain(prepared, offset=0.1), STEPS, offset="zero").bands
    assert alone.offset_from == "no offset"
    assert_allclose(alone.plant[2], band.plant[2] - TRUTH["offset"], atol=0.01)


def test_whole_new_curves_lie_in_the_bands_as_often_as_said():
    """Curves of parameters and noise that are drawn anew, with the plant simulated on its own."""
    prepared = problem(record(camera=0.2))
    spread = {"offset": 0.1, "gain": 0.2, "delay": 0.1}
    result = predict(prepared, uncertain(prepared, **spread), STEPS)
    (band,) = result.bands
    fresh = uncertain(prepared, seed=9, **spread)
    plant = responses(fresh.table, prepared.driven(result.driven, band.time), fresh.flat)[0][0]
    plant = plant + fresh.flat[:, fresh.table.names.index("offset"), None]
    noisy = plant + TRUTH["sigma"] * np.random.default_rng(8).standard_normal(plant.shape)
    # 1000 draws size the band and 2000 test it
    for curves, ends, quantiles in (
        (plant, band.plant_simultaneous, band.plant),
        (noisy, band.noisy_simultaneous, band.noisy),
    ):
        for level, k in ((0.5, 1), (0.9, 0)):
            whole = ((curves >= ends[k]) & (curves <= ends[3 - k])).all(axis=1).mean()
            spot = ((curves >= quantiles[k]) & (curves <= quantiles[4 - k])).mean()
            error = np.sqrt(level * (1 - level) * (1 / 1000 + 1 / 2000))
            assert abs(whole - level) < 4 * error
            assert abs(spot - level) < 4 * error
        assert ((curves >= quantiles[0]) & (curves <= quantiles[4])).all(axis=1).mean() < 0.85


def test_offsets_of_several_records_are_drawn_from_all_of_them():
    prepared = problem(record(1, camera=0.3, name="a"), record(2, camera=0.3, name="b"))
    table = prepared.posterior.table
    known = TRUTH | {"offset_a": -1.0, "offset_b": 2.0}
    values = np.tile(row_values(table, known), (400, 1))
    (band,) = predict(prepared, draws_of(table, values), STEPS).bands
    assert "one of the 2 fit records" in band.offset_from
    assert_allclose(band.plant[[0, 4], 0], [-1.0, 2.0], atol=1e-9)


def test_the_offset_is_of_the_records_that_rest_as_the_drive_does():
    high = record(2, command=step(0.2, at=1.0, rest=1.0), camera=0.3, name="b")
    prepared = problem(record(1, camera=0.3, name="a"), high)
    table = prepared.posterior.table
    values = np.tile(row_values(table, TRUTH | {"offset_a": -1.0, "offset_b": 2.0}), (40, 1))
    for rest, level in ((0.0, -1.0), (1.0, 2.0)):
        drive = Drive.steps(u=[(0.0, 0.5)], rest={"u": rest}, until=5.0)
        (band,) = predict(prepared, draws_of(table, values), drive).bands
        assert band.offset_from == "that of the fit record that rests alike"
        assert_allclose(band.plant[:, 0], level + TRUTH["gain"] * rest)
    between = Drive.steps(u=[(0.0, 0.5)], rest={"u": 0.4}, until=5.0)
    assert "2 fit records" in predict(prepared, draws_of(table, values), between).bands[0].offset_from


def test_a_drive_that_the_records_hold_is_inside_and_a_scaled_longer_faster_one_is_not():
    prepared = problem(record(camera=0.2))
    draws = uncertain(prepared)
    same = predict(prepared, draws, Drive.steps(u=[(0.0, 1.0)], until=11.0))
    assert same.outside == ()
    assert "lies within the fitted range" in same.verdict
    assert bool(same.table()["inside"].all())
    larger = predict(prepared, draws, Drive.steps(u=[(0.0, 0.5), (3.0, -2.0)], until=11.0))
    assert [(one.kind, one.axis, one.since) for one in larger.outside] == [("amplitude", "u", 3.0)]
    assert "from -2 to 0.5 V, in the fit records from 0 to 1 V" in larger.verdict
    table = larger.table()
    assert (table["inside"] == (table["time"] < 3.0)).all()
    longer = predict(prepared, draws, Drive.steps(u=[(0.0, 1.0)], until=40.0))
    (late,) = longer.outside
    assert (late.kind, late.since) == ("time", pytest.approx(prepared.scales.span))
    time = np.arange(0.0, 11.0, 0.1)
    rapid = Drive.of_arrays(time, u=0.5 - 0.5 * np.cos(2 * np.pi * 2.5 * time), time_unit="ms")
    kinds = {one.kind: one for one in predict(prepared, draws, rapid).outside}
    assert set(kinds) == {"frequency"}
    assert "drive u brings" in kinds["frequency"].sentence


@pytest.mark.parametrize(("frequency", "marked"), [(0.15, False), (2.0, True)])
def test_frequencies_are_marked_where_the_records_hold_less_than_a_hundredth(frequency, marked):
    """In a band of width ``b f`` a step of 1 V over T holds ``b / (pi^2 f)``, a sinusoid of 1 V ``T / 2``.

    Their ratio ``pi^2 f T / (2 b)`` is 21 and 280 here at b = 0.38.
    """
    prepared = problem(record(camera=0.2))
    time = np.arange(0.0, 11.0, 0.02)
    wave = Drive.of_arrays(time, u=np.sin(2 * np.pi * frequency * time), time_unit="ms")
    kinds = {one.kind for one in predict(prepared, uncertain(prepared), wave).outside}
    assert ("frequency" in kinds) == marked


def test_noise_between_rows_that_are_closer_than_samples_is_correlated_by_their_distance():
    prepared = problem(record(camera=0.2), noise="ar1")
    table = prepared.posterior.table
    values = np.tile(row_values(table, TRUTH | {"rho": 0.8}), (2000, 1))
    time = np.arange(0.0, 4.0, 0.02)
    drive = Drive.of_arrays(time, u=np.zeros(time.size), time_unit="ms")
    (band,) = predict(prepared, draws_of(table, values), drive).bands
    rng, link = np.random.default_rng(3), 0.8 ** (0.02 / prepared.scales.period)
    noise = rng.standard_normal((4000, time.size))
    for k in range(1, time.size):
        noise[:, k] = link * noise[:, k - 1] + np.sqrt(1 - link**2) * noise[:, k]
    exact = TRUTH["sigma"] * np.quantile(np.abs(noise).max(axis=1), 0.9)
    half = (band.noisy_simultaneous[3] - band.noisy_simultaneous[0]).mean() / 2
    assert half == pytest.approx(exact, rel=0.05)


def test_the_energy_of_a_drive_over_all_frequencies_is_that_over_all_times():
    """Parseval: a pulse of height 2 over 3 ms holds 12 V^2 ms, and a hold of 1 from 1 to 5 ms holds 4."""
    prepared = problem(record(camera=0.2))
    fitted = fitted_range(prepared)
    pulse = Drive.steps(u=[(1.0, 2.0), (4.0, 0.0)]).fitted_to(fitted.axes, "ms", [0.0], 1.0)
    hold = Drive.steps(u=[(1.0, 1.0)]).fitted_to(fitted.axes, "ms", [0.0], 1.0)
    edges = np.geomspace(1e-9, 200.0, 40)
    assert energies(pulse, 6.0, edges).sum() == pytest.approx(12.0, rel=0.01)
    assert energies(hold, 5.0, edges).sum() == pytest.approx(4.0, rel=0.01)
    half = energies(pulse, 6.0, np.array([0.5, 0.6]))[0, 0]
    f = np.linspace(0.5, 0.6, 400)
    exact = 2 * np.trapezoid((2 * np.sin(3 * np.pi * f) / (np.pi * f)) ** 2, f)
    assert half == pytest.approx(exact, rel=0.05)


def test_a_drive_of_two_axes_needs_no_second_one_and_gives_both_responses():
    prepared = problem(record(device=TWO, camera=0.6), terms={"direct": 2, "cross": 1})
    table = prepared.posterior.table
    draws = draws_of(table, table.draw(40, np.random.default_rng(2)))
    result = predict(prepared, draws, Drive.steps(x=[(0, 0.5)], until=4.0))
    assert [band.axis for band in result.bands] == ["x", "y"]
    assert_array_equal(result.drives().query("axis == 'y'")["drive"].unique(), [0.2])  # as the records rest
    assert list(result.summary()["axis"]) == ["x", "y"]
    assert "half_width_simultaneous" in result._repr_html_()
    json.dumps(result.to_json(), allow_nan=False)


@pytest.mark.parametrize(
    ("drive", "words"),
    [
        (Drive.steps(v=[(0, 1.0)]), "no drive axis 'v'"),
        (Drive.steps(u=[(0, 1.0)], units="mV"), "is in mV, in the study it is in V"),
        (Drive.steps(u=[(0, 1.0)], rest={"u": 0.5}), "is at 0.5 V before its first change, but the study's"),
        (Drive.of_arrays([0, 1], u=[0.5, 1.0]), "rest at 0 V"),
        (Drive.steps(u=[(0, 1.0)], until=1e6), "sampling periods"),
    ],
)
def test_drives_of_another_plant_are_refused(drive, words):
    prepared = problem(record(camera=0.2))
    with pytest.raises(InputError, match=words) as raised:
        predict(prepared, uncertain(prepared), drive)
    assert len(raised.value.problems) == 1


def test_a_rest_at_negative_zero_is_zero():
    drive = Drive.of_arrays([0, 1], u=[-0.0, 1.0])
    (clause,) = FittedRange((drive,), (Axis("u", "V"),), 1.0, 0.1, "ms").other_rest([0.5])
    assert clause.endswith("rest at 0 V")


@pytest.fixture(scope="module")
def fitted() -> Fit:
    return fit(study(record(), held_out=(HELD,), sampler=TINY, priors=KNOWN))


@pytest.fixture(scope="module")
def alone() -> Fit:
    return fit(study(record(), sampler=TINY, priors=KNOWN))


def test_a_record_scored_later_has_the_numbers_of_one_held_out_from_the_start(fitted, alone, tmp_path):
    assert_array_equal(alone.draws.values, fitted.draws.values)
    declared = pd.DataFrame(results(fitted)["held_out"])
    pd.testing.assert_frame_equal(alone.score(HELD), declared)
    save_record(HELD, tmp_path / "held.csv")
    pd.testing.assert_frame_equal(alone.score(tmp_path / "held.csv"), declared)
    (band,) = (band for band in fitted.bands if band.held_out)
    assert_array_equal(alone.predict(HELD).bands[0].noisy, band.noisy)
    # nor does another record beside it move them
    both = replace(alone.study, held_out=(record(9, command=step(0.4, at=2.0), name="other"), HELD))
    again = fit(both)
    assert results(again)["held_out"][1] == results(fitted)["held_out"][0]


def test_a_score_is_the_error_of_the_median_and_the_share_inside(alone):
    result = alone.predict(HELD)
    (band,) = result.bands
    observed = HELD.response[np.isfinite(HELD.response[:, 0]), 0]
    (known,) = result.scores
    assert known["rmse"] == pytest.approx(np.sqrt(np.mean((observed - band.plant[2]) ** 2)))
    inside = (observed >= band.noisy[0]) & (observed <= band.noisy[4])
    assert known["coverage_90"] == pytest.approx(inside.mean())
    assert "RMSE" in result.verdict


def test_a_record_that_a_fit_would_refuse_is_not_scored(alone):
    wrong = replace(HELD, drive_axes=(replace(HELD.drive_axes[0], unit="mV"),))
    with pytest.raises(InputError, match="in mV"):
        alone.score(wrong)
    with pytest.raises(InputError, match="is in s, the study is in ms; convert its times"):
        alone.score(replace(HELD, time_unit="s"))


@pytest.mark.parametrize("order", [1.02, 1.3, 1.9])
def test_rows_far_apart_are_predicted_as_close_ones_are(order):
    """Second method: every twentieth row of a record read closely. On blocks as wide as the rows are apart
    the response of an order above 1 alternates and grows."""
    prepared = problem(record(camera=0.2, duration=30.0))
    values = row_values(prepared.posterior.table, TRUTH | {"order_1": order, "time_1": 0.4})
    time = 0.1 * np.arange(8_001)
    drive = np.where((time >= 30.0) & (time < 400.0), 1.0, 0.0)[:, None]
    axes = (Axis("u", "V"),), (Axis("y", "rad"),)
    close = Record("close", time, drive, np.zeros((time.size, 1)), *axes, "ms")
    apart = replace(close, name="apart", time=time[::20], drive=drive[::20], response=close.response[::20])
    read = [prepared.simulated([one])[1] for one in (close, apart)]
    table = prepared.posterior.table
    whole, some = (responses(table, model, values[None])[0][0, 0] for model in read)
    assert np.abs(whole).max() < 4.0
    late = time[::20] % 400.0 > 60.0  # a row of the drive holds until the next
    assert_allclose(some[late], whole[::20][late], atol=2e-3)


def test_a_record_that_would_take_millions_of_blocks_is_refused():
    prepared = problem(record(camera=0.2))
    time = np.array([0.0, 1.0, 1e7])
    long = Record(
        "years",
        time,
        np.array([[0.0], [1.0], [1.0]]),
        np.zeros((3, 1)),
        (Axis("u", "V"),),
        (Axis("y", "rad"),),
        "ms",
    )
    with pytest.raises(InputError, match=r"years: lasts 1e\+07 ms, where the fit resolves 0\.\d+ ms"):
        prepared.simulated([long])


def test_a_new_record_may_have_the_name_of_a_fitted_one_but_not_its_samples(alone):
    """The score does not depend on the name, but for the noise that is drawn."""
    (fitted,) = alone.study.fit
    named = alone.predict(replace(HELD, name=fitted.name))
    assert named.driven.name == named.bands[0].record == fitted.name
    assert named.bands[0].rmse == pytest.approx(alone.predict(HELD).bands[0].rmse, rel=0.01)
    for name in ("step", "again"):
        with pytest.raises(InputError, match=f"'{name}' is 'step' of the fit, .* give another record"):
            alone.predict(replace(fitted, name=name))
