"""The frequency response against its closed form, and against the forward model under a sinusoid."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from small import TRUTH, TWO, draws_of, problem, record, row_values

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.drive import Drive
from lcopa_bayes.results.frequency import frequency_response, transfer_function
from lcopa_bayes.results.prediction import responses

FREQUENCY = np.geomspace(0.02, 2.0, 60)


def known(values: dict[str, float], **model: object):
    prepared = problem(record(camera=0.6), **model)
    return prepared, draws_of(
        prepared.posterior.table, np.tile(row_values(prepared.posterior.table, values), (8, 1))
    )


def answered(draws, frequencies=FREQUENCY):
    return frequency_response(draws, frequencies, span=11.65, period=0.6, time_unit="ms")


def test_one_lag_with_delay_is_the_closed_form():
    _, draws = known(TRUTH | {"order_1": 1.0})
    (path,) = answered(draws).paths
    angular = 2 * np.pi * FREQUENCY
    exact = TRUTH["gain"] * np.exp(-1j * angular * TRUTH["delay"]) / (1 + 1j * angular * TRUTH["time_1"])
    assert_allclose(path.gain.pointwise[2], np.abs(exact), rtol=1e-12)
    assert_allclose(path.phase.pointwise[2], np.degrees(np.unwrap(np.angle(exact))), rtol=1e-9)
    assert path.bandwidth.value == pytest.approx(1 / (2 * np.pi * TRUTH["time_1"]), rel=1e-3)
    assert (path.path, path.unit, path.bandwidth.unit) == ("y", "rad/V", "1/ms")


def test_every_path_of_a_coupled_plant_and_its_phase_stay_continuous():
    posterior = problem(record(device=TWO, camera=0.6), terms={"direct": 2, "cross": 1}).posterior
    table, values = posterior.table, posterior.table.draw(8, np.random.default_rng(1))
    magnitude, phase = transfer_function(table, values, FREQUENCY)
    s = 2j * np.pi * FREQUENCY
    for b in range(8):
        known = dict(zip(table.names, values[b], strict=True))
        for i, r in enumerate("xy"):
            for j, d in enumerate("xy"):
                kind = "direct" if i == j else "cross"
                terms = range(1, 3 if i == j else 2)
                below = 1 + sum((known[f"time_{k}_{kind}"] * s) ** known[f"order_{k}_{kind}"] for k in terms)
                exact = known[f"gain_{r}_{d}"] * np.exp(-s * known["delay"]) / below
                assert_allclose(magnitude[i, j, b] * np.exp(1j * phase[i, j, b]), exact, rtol=1e-9)
    late = 2 * np.pi * FREQUENCY * values[:, table.names.index("delay"), None]
    assert np.abs(np.diff(phase + late)).max() < np.pi
    names = [path.path for path in answered(draws_of(table, values)).paths]
    assert names == ["x_x", "x_y", "y_x", "y_y"]


@pytest.mark.parametrize("frequency", [0.05, 0.17, 0.4])
def test_the_forward_model_under_a_sinusoid_answers_with_this_gain_and_phase(frequency):
    """Steps of 1 / 200 of a cycle, held: half a step late and smaller by their sinc, both taken off."""
    prepared, draws = known(TRUTH)
    cycles, held = 12 + round(80 * frequency), 1 / (200 * frequency)
    time = held * np.arange(200 * cycles + 1)
    drive = Drive.of_arrays(time, u=np.sin(2 * np.pi * frequency * time), units="V", time_unit="ms")
    table = draws.table
    response = responses(table, prepared.driven(drive, time), draws.flat[:1])[0][0, 0]
    last = slice(-1 - 600, -1)
    wave = np.exp(-2j * np.pi * frequency * time[last])
    result = 2j * np.mean(response[last] * wave)
    result /= np.sinc(frequency * held) * np.exp(-1j * np.pi * frequency * held)
    magnitude, phase = transfer_function(table, draws.flat[:1], np.array([frequency]))
    exact = (magnitude * np.exp(1j * phase))[0, 0, 0, 0]
    assert abs(result - exact) < 5e-3 * abs(exact)  # an algebraic tail of the onset is left


def test_bands_are_the_quantiles_of_the_draws_and_simultaneous_ones_are_wider():
    prepared = problem(record(camera=0.6))
    table = prepared.posterior.table
    values = np.tile(row_values(table, TRUTH), (2000, 1))
    gain = values[:, table.names.index("gain")] = np.random.default_rng(3).lognormal(0.5, 0.2, 2000)
    (path,) = answered(draws_of(table, values)).paths
    low = transfer_function(table, values[:1], FREQUENCY)[0][0, 0, 0] / gain[0]
    assert_allclose(path.gain.pointwise, np.outer(np.quantile(gain, (0.05, 0.25, 0.5, 0.75, 0.95)), low))
    assert_allclose(np.ptp(path.phase.pointwise, axis=0), 0.0, atol=1e-9)
    # one number moves the whole curve: simultaneous is pointwise
    assert_allclose(path.gain.simultaneous[[0, 3]], path.gain.pointwise[[0, 4]], rtol=0.05)


def test_an_open_sign_is_said():
    prepared = problem(record(camera=0.6))
    table = prepared.posterior.table
    values = np.tile(row_values(table, TRUTH), (100, 1))
    values[:30, table.names.index("gain")] *= -1
    (path,) = answered(draws_of(table, values)).paths
    assert "30 % of draws are negative" in path.note
    assert_allclose(path.gain.pointwise[0], path.gain.pointwise[4])
    assert np.ptp(path.phase.pointwise[:, 0]) == pytest.approx(180.0)


def test_what_the_records_do_not_resolve_is_said_and_the_default_stays_within():
    _, draws = known(TRUTH)
    assert answered(draws, None).outside == ()
    assert answered(draws, [0.1, 0.5]).outside == ()
    outside = answered(draws, [0.01, 5.0]).outside
    assert [one.partition(" ")[0] for one in outside] == ["Below", "Above"]
    assert json.dumps(answered(draws).to_json(), allow_nan=False)
    assert len(answered(draws).table()) == FREQUENCY.size
    assert "bandwidth" in answered(draws)._repr_html_()


def test_a_bandwidth_does_not_hang_on_the_frequencies_and_is_open_when_far_beyond():
    _, draws = known(TRUTH | {"order_1": 1.0})
    exact = 1 / (2 * np.pi * TRUTH["time_1"])
    for frequencies in ([0.001, 0.002], [5.0]):
        assert answered(draws, frequencies).paths[0].bandwidth.value == pytest.approx(exact, rel=2e-3)
    _, draws = known(TRUTH | {"time_1": 1e9})
    assert answered(draws).paths[0].bandwidth.value == 0.0
    _, draws = known(TRUTH | {"time_1": 1e-5})
    assert answered(draws).paths[0].bandwidth.as_json()["value"] is None


@pytest.mark.parametrize("frequencies", [[], [0.0, 1.0], [2.0, 1.0], [-1.0], [np.nan], ["low"]])
def test_frequencies_that_are_none_are_refused(frequencies):
    _, draws = known(TRUTH)
    with pytest.raises(InputError, match="frequencies"):
        answered(replace(draws), frequencies)
