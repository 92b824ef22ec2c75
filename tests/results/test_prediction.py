"""Bands: exact when nothing is uncertain, and as wide as they say when something is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats
from small import ONE, TRUTH, TWO, draws_of, problem, record, row_values

from lcopa_bayes.bench.command import Command, on_off, quiet, step
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.results.prediction import Band, bands, responses

AXIS = Axis("x", "V")
KNOWN = TRUTH | {"rho": 0.6, "nu": 4.0}


def predicted(
    held: Record, *, values: np.ndarray | None = None, count: int = 400, seed: int = 0, fit=None, **options
) -> list[Band]:
    """Bands of a held-out record from draws that all equal the truth, or from `values`."""
    made = problem(fit or record(camera=0.6), **options)
    table = made.posterior.table
    if values is None:
        values = np.tile(row_values(table, KNOWN), (count, 1))
    samples, model = made.simulated([held])
    return bands(draws_of(table, values), model, samples, made.posterior.noise, held_out=True, seed=seed)


def test_equal_draws_give_a_plant_without_width_that_follows_the_bench():
    held = record(2, command=on_off(0.7, hold=4.0, at=1.0), noise_sd=0.0, name="held")
    (band,) = predicted(held, offset="shared")
    assert np.ptp(band.plant, axis=0).max() < 1e-10  # rows of a batch are equal up to rounding
    assert np.abs(band.plant[2] - band.observed).max() < 5e-3
    assert (band.record, band.axis, band.unit, band.held_out) == ("held", "y", "rad", True)
    assert band.offset_from == "shared with the fit records"
    assert band.rmse == pytest.approx(np.sqrt(np.mean((band.observed - band.plant[2]) ** 2)))
    assert band.time.size == band.observed.size == 60


@pytest.mark.parametrize("noise", ["white", "ar1", "student"])
def test_the_noise_bands_are_the_quantiles_of_the_noise(noise):
    held = record(2, noise_sd=0.0, name="held")
    (band,) = predicted(held, noise=noise, offset="shared", count=4000)
    exact = stats.t(4.0) if noise == "student" else stats.norm
    levels = np.array([0.05, 0.25, 0.5, 0.75, 0.95])
    reported = (band.noisy - band.plant[2]) / TRUTH["sigma"]
    error = np.sqrt(levels * (1 - levels) / 4000) / exact.pdf(exact.ppf(levels))
    assert np.all(np.abs(reported - exact.ppf(levels)[:, None]) < 4.5 * error[:, None])


def test_shares_inside_the_bands_are_binomial_when_the_draws_are_the_truth():
    made = problem(record(camera=0.6), offset="shared")
    held = record(7, camera=0.01, duration=30.0, name="held")
    _, model = made.simulated([held])
    truth = row_values(made.posterior.table, KNOWN)
    clean = responses(made.posterior.table, model, truth[None])[0][0, 0] + TRUTH["offset"]
    drawn = clean + TRUTH["sigma"] * np.random.default_rng(1).normal(size=clean.size)
    response = np.array(held.response)
    response[~np.isnan(held.response[:, 0]), 0] = drawn
    (band,) = predicted(replace(held, response=response), offset="shared", count=2000)
    n = band.observed.size
    assert n == 3000
    for level in (0.5, 0.9):
        assert abs(band.coverage(level) - level) < 4 * np.sqrt(level * (1 - level) / n) + 0.005


@pytest.mark.parametrize(
    ("replicates", "command"),
    [
        (50, step(1.0, at=1.7)),
        (50, step(1.0)),
        pytest.param(400, step(1.0, at=1.7), marks=pytest.mark.slow),
    ],
)
def test_bands_of_an_exact_posterior_cover_new_records_as_often_as_they_say(replicates, command):
    """Gain and offset unknown: truth from the prior, posterior exact, new record from the same truth."""
    priors = {name: TRUTH[name] for name in ("time_1", "order_1", "delay")}
    priors |= {"gain": ("norm", {"loc": 1.0, "scale": 1.0}), "sigma": 0.3, "offset": ("norm", {"scale": 0.5})}
    fit, held = record(1, camera=1.0), record(2, command=command, camera=0.5, name="held")
    made = problem(fit, priors=priors | {"order_1": ("uniform", {"loc": 0.799, "scale": 0.002})})
    posterior, table = made.posterior, made.posterior.table
    samples, model = made.simulated([held])
    rng, inside = np.random.default_rng(3), []
    for _ in range(replicates):
        truth = table.draw(1, rng)
        noisy = []
        for a_model, some in ((posterior.model, posterior.samples[0]), (model, samples[0])):
            clean = responses(table, a_model, truth)[0][0] + table.offset(truth, 0, 0)[:, None]
            seen = replace(some.axes[0], values=(clean + 0.3 * rng.normal(size=clean.shape))[0])
            noisy.append(Samples(some.record, some.times, (seen,)))
        knowing = replace(posterior, samples=(noisy[0],))
        order = table.rows[table.at("order", 0, 0)].draw(400, rng)
        values = knowing.complete(order[:, None], rng)
        drawn, seed = draws_of(table, values), int(rng.integers(1 << 30))
        made_bands = bands(drawn, model, noisy[1:], posterior.noise, held_out=True, seed=seed)
        inside.append([made_bands[0].coverage(0.5), made_bands[0].coverage(0.9)])
    share, error = np.mean(inside, axis=0), np.std(inside, axis=0) / np.sqrt(replicates)
    extra = 0.0 if command.times[0] > 0 else 0.03  # an offset from the scored samples themselves covers more
    assert np.all(np.abs(share - [0.5, 0.9]) < 4 * error + extra)


def test_an_offset_is_read_from_samples_before_the_drive_acts():
    device = replace(ONE, offsets=(0.9,))  # another offset than the fit record had
    held = record(2, device=device, command=step(1.0, at=4.05), name="held")
    (band,) = predicted(held, count=2000)
    assert band.offset_from == "samples before the drive acts"
    quiet_samples = band.observed[band.time <= 4.05 + TRUTH["delay"]]  # nor does it while it is delayed
    assert quiet_samples.size == band.offset_samples == 24
    assert not band.own_offset
    drawn = band.plant[:, 0]  # at rest under zero drive the plant shows its offset alone
    error = TRUTH["sigma"] / np.sqrt(24)
    assert drawn[2] == pytest.approx(quiet_samples.mean(), abs=4 * 1.25 * error / np.sqrt(2000))
    assert drawn[4] - drawn[0] == pytest.approx(2 * 1.645 * error, rel=0.15)


@pytest.mark.parametrize(
    ("held", "early", "given"), [(1, False, 200), (4, False, 200), (1, True, 2), (9, False, 10)]
)
def test_the_first_samples_of_a_drive_that_keeps_moving_show_no_level(held, early, given):
    """It may have moved before the record too, unless an early row states what it rested under, or it holds
    for 8 samples and more."""
    drive = np.repeat(np.random.default_rng(0).normal(size=200), held)[:200]
    response = np.cumsum(drive)
    response[0] = np.nan if early else 1.0
    moving = Record("noise", np.arange(200) * 0.1, drive[:, None], response[:, None], (AXIS,), (AXIS,), "ms")
    used, source = Samples.of(moving, 0.1).level_samples(0)
    assert used.sum() == (1 if early else given)
    assert ("moves from the start" in source) == (given == 200)


def test_an_offset_without_quiet_samples_is_integrated_out():
    device = replace(ONE, offsets=(0.9,))
    held = record(2, device=device, command=step(1.0), camera=0.1, noise_sd=0.0, name="held")
    held = Record("held", held.time, held.drive, np.where(held.time[:, None] > 0.05, held.response, np.nan),
                  held.drive_axes, held.response_axes, held.time_unit)  # fmt: skip
    (band,) = predicted(held)
    assert band.offset_from == "all samples of the held-out record, none of which is before the drive acts"
    assert band.own_offset
    assert band.offset_samples == band.time.size
    assert np.abs(band.plant[2] - band.observed).max() < 6e-3
    assert np.ptp(band.plant, axis=0).max() < 8 * TRUTH["sigma"] / np.sqrt(band.time.size)


def test_a_drive_that_never_moves_is_all_quiet():
    held = record(2, device=replace(ONE, offsets=(0.4,)), command=quiet(0.5), noise_sd=0.0, name="held")
    (band,) = predicted(held)
    assert "whose drive does not change" in band.offset_from
    assert band.own_offset
    assert_allclose(band.plant[2], 0.4 + 0.5 * TRUTH["gain"], atol=2e-3)


def test_no_offset_is_no_offset():
    held = record(2, device=replace(ONE, offsets=(0.0,)), noise_sd=0.0, name="held")
    (band,) = predicted(held, offset="none")
    assert (band.offset_from, band.offset_samples) == ("no offset", 0)
    assert np.abs(band.plant[2] - band.observed).max() < 5e-3


def test_uneven_and_missing_samples_are_read_at_their_own_times():
    whole = record(2, command=step(1.0, at=1.0), camera=0.05, noise_sd=0.0, name="held")
    rng = np.random.default_rng(0)
    keep = np.flatnonzero(rng.random(whole.time.size) < 0.4)
    keep = np.union1d(keep, [0, *np.flatnonzero(np.diff(whole.drive[:, 0])) + 1])
    response = np.array(whole.response[keep])
    response[5:9] = np.nan
    held = Record(
        "held", whole.time[keep], whole.drive[keep], response, whole.drive_axes, whole.response_axes, "ms"
    )
    (band,) = predicted(held, offset="shared")
    taken = ~np.isnan(response[:, 0])
    assert_allclose(band.time, held.time[taken])
    assert_allclose(band.observed, response[taken, 0])
    assert np.abs(band.plant[2] - band.observed).max() < 1e-2
    assert np.sqrt(np.mean((band.plant[2] - band.observed) ** 2)) < 2e-3


def test_each_axis_has_its_own_band_and_an_empty_one_has_none():
    held = record(2, device=TWO, camera=0.4, noise_sd=0.0, name="held")
    response = np.array(held.response)
    response[::3, 0] = np.nan
    truth = dict.fromkeys(("sigma_x", "sigma_y"), 0.02) | {"offset_x": 0.1, "offset_y": -0.2, "delay": 0.4}
    truth |= {"gain_x_x": 1.0, "gain_x_y": 0.2, "gain_y_x": 0.3, "gain_y_y": 1.5}
    truth |= {"time_1_direct": 1.2, "time_2_direct": 2.5, "order_1_direct": 1.6, "order_2_direct": 0.7}
    truth |= {"time_1_cross": 2.0, "order_1_cross": 0.9}
    options = {"fit": record(device=TWO, camera=0.6), "terms": {"direct": 2, "cross": 1}, "offset": "shared"}
    table = problem(options["fit"], terms=options["terms"], offset="shared").posterior.table
    values = np.tile(row_values(table, truth), (200, 1))
    x, y = predicted(replace(held, response=response), values=values, **options)
    assert (x.axis, y.axis) == ("x", "y")
    assert x.time.size == np.isfinite(response[:, 0]).sum() < y.time.size
    for band in (x, y):
        assert np.abs(band.plant[2] - band.observed).max() < 5e-3
    response[:, 0] = np.nan
    (only,) = predicted(replace(held, response=response), values=values, **options)
    assert only.axis == "y"


def test_the_command_is_the_only_thing_the_plant_answers_to():
    """Responses are linear in the drive deviation."""
    made = problem(record(camera=0.6))
    table = made.posterior.table
    values = table.draw(5, np.random.default_rng(0))
    reported = []
    for scale in (1.0, -2.5):
        command = Command(np.array([1.0, 3.0]), scale * np.array([[1.0], [0.4]]), np.zeros(1))
        _, model = made.simulated([record(command=command, name="held")])
        reported.append(responses(table, model, values)[0])
    assert_allclose(reported[1], -2.5 * reported[0], rtol=1e-9, atol=1e-12)
