"""Step metrics against the closed forms of first- and second-order responses."""

from __future__ import annotations

import json
from dataclasses import replace
from math import exp, log, pi, sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from small import TRUTH, TWO, draws_of, problem, record, row_values

from lcopa_bayes.core.estimate import Estimate
from lcopa_bayes.results import stepcurves
from lcopa_bayes.results.stepcurves import step_curves
from lcopa_bayes.results.steps import crossing, settling, share_unsettled, step_metrics, too_fast

TIME = 20.0 * np.arange(1, 1001) / 1000
STEP = TIME[1] - TIME[0]


def first_order(*constants: float, delay: float = 0.0) -> np.ndarray:
    return np.array([1 - np.exp(-np.maximum(TIME - delay, 0.0) / constant) for constant in constants])


def second_order(damping: float, frequency: float) -> np.ndarray:
    fast = frequency * sqrt(1 - damping**2)
    phase = np.arccos(damping)
    return (1 - np.exp(-damping * frequency * TIME) * np.sin(fast * TIME + phase) / np.sin(phase))[None]


@given(st.floats(0.5, 4.0), st.floats(0.01, 3.0))
def test_crossings_of_an_exponential(constant, delay):
    curve = first_order(constant, delay=delay)
    for level in (0.1, 0.5, 0.9):
        exact = delay + constant * log(1 / (1 - level))
        assert crossing(TIME, curve, level)[0] == pytest.approx(exact, abs=STEP**2 / constant + STEP * 0.5)
    rise = crossing(TIME, curve, 0.9) - crossing(TIME, curve, 0.1)
    assert rise[0] == pytest.approx(constant * log(9), abs=STEP)


def test_interpolated_crossing_and_settling_are_second_order_in_the_sampling():
    errors = []
    for n in (50, 100, 200, 400):
        time = 10.0 * np.arange(1, n + 1) / n
        curve = 1 - np.exp(-time)[None]
        rise = (crossing(time, curve, 0.9) - crossing(time, curve, 0.1))[0] - log(9)
        errors.append(abs(rise) + abs(settling(time, curve, 0.02)[0] - log(50)))
    assert_allclose(np.array(errors) * np.array([50, 100, 200, 400]) ** 2 / 400, 0, atol=0.2)


@given(st.floats(0.3, 4.0))
def test_settling_of_an_exponential(constant):
    curve = first_order(constant)
    assert settling(TIME, curve, 0.02)[0] == pytest.approx(constant * log(50), abs=2 * STEP**2 / constant)
    assert settling(TIME, curve, 0.05)[0] == pytest.approx(constant * log(20), abs=2 * STEP**2 / constant)


def test_what_settles_before_the_first_sample_settles_between_rest_and_it():
    curve = np.full((1, 1000), 1.0)
    assert 0 < settling(TIME, curve, 0.02)[0] <= TIME[0]
    assert 0 < crossing(TIME, curve, 0.9)[0] <= TIME[0]


@pytest.mark.parametrize("damping", [0.2, 0.5])
def test_overshoot_and_settling_of_a_ringing_response(damping):
    frequency = 1.5
    curve = second_order(damping, frequency)
    overshoot = exp(-pi * damping / sqrt(1 - damping**2))
    assert curve.max() - 1 == pytest.approx(overshoot, rel=1e-3)
    found = settling(TIME, curve, 0.02)[0]
    dense = np.linspace(0, 20, 2_000_001)
    fast, phase = frequency * sqrt(1 - damping**2), np.arccos(damping)
    away = np.abs(np.exp(-damping * frequency * dense) * np.sin(fast * dense + phase) / np.sin(phase))
    assert found == pytest.approx(dense[np.flatnonzero(away > 0.02)[-1]], abs=2e-3)


def test_what_is_never_reached_is_infinite_and_open_in_json():
    curve = first_order(1.0, 12.0, 400.0)
    assert np.isfinite(crossing(TIME, curve, 0.9)).tolist() == [True, False, False]
    assert np.isfinite(settling(TIME, curve, 0.02)).tolist() == [True, False, False]
    assert share_unsettled(curve) == pytest.approx(2 / 3)
    rises = np.r_[crossing(TIME, first_order(*np.linspace(1, 2, 80)), 0.9), np.full(20, np.inf)]
    out = Estimate.of("rise", "ms", rises, ess=100, grade="reliable").as_json()
    assert out["upper"] is None
    assert out["lower"] > 2.0
    assert json.loads(json.dumps(out, allow_nan=False))["upper"] is None


def curves_of(values: dict[str, float], span: float, draws: int = 8):
    posterior = problem(record(camera=0.6), terms=1).posterior
    made = draws_of(posterior.table, np.tile(row_values(posterior.table, values), (draws, 1)))
    return made, step_curves(made, span)


@pytest.mark.parametrize("periods", [5.0, 300.0, 3_000.0, 50_000.0])
@pytest.mark.parametrize("damping", [0.1, 0.4])
def test_figures_of_a_ringing_plant_do_not_depend_on_how_long_it_is_watched(damping, periods):
    """Closed forms of second order, over spans of so many time constants: blocks as wide as the samples would
    leave the response alternating, and a peak between two of these was missed."""
    time = 0.01
    values = {"gain": 2.0, "delay": 0.3 * time, "time_1": time, "order_1": 2.0, "order_2": 1.0}
    values["time_2"] = 2 * damping * time
    posterior = problem(record(camera=0.6), terms=2).posterior
    made = draws_of(posterior.table, np.tile(row_values(posterior.table, TRUTH | values), (2, 1)))
    curves = step_curves(made, (40.0 + periods) * time)
    shown = {one.name: one.value for one in step_metrics(made, curves, time_unit="ms")}
    assert shown["overshoot[y]"] == pytest.approx(exp(-pi * damping / sqrt(1 - damping**2)), abs=0.01)
    dense = np.linspace(0, 4, 400_001)
    fast, phase = sqrt(1 - damping**2), np.arccos(damping)
    exact = (1 - np.exp(-damping * dense) * np.sin(fast * dense + phase) / np.sin(phase))[None]
    rise = (crossing(dense, exact, 0.9) - crossing(dense, exact, 0.1))[0]
    assert shown["rise_10_90[y]"] == pytest.approx(rise * time, rel=0.01)
    assert shown["value_at_end[y]"] == pytest.approx(2.0, rel=0.02)


@pytest.mark.parametrize("order", [1.02, 1.3, 1.9])
def test_a_plant_much_faster_than_the_samples_of_its_response_has_settled(order):
    made, curves = curves_of(TRUTH | {"order_1": order, "time_1": 1e-3, "delay": 0.0}, 20.0)
    assert_allclose(curves.normalised[..., 10:], 1.0, atol=0.02)  # from 0.2 ms on, 200 time constants
    shown = {one.name: one.value for one in step_metrics(made, curves, time_unit="ms")}
    slow, slower = curves_of(TRUTH | {"order_1": order, "time_1": 1.0, "delay": 0.0}, 200.0)
    same = {one.name: one.value for one in step_metrics(slow, slower, time_unit="ms")}
    assert shown["rise_10_90[y]"] == pytest.approx(1e-3 * same["rise_10_90[y]"], rel=0.02)
    assert shown["overshoot[y]"] == pytest.approx(same["overshoot[y]"], abs=0.01)


def test_each_draw_is_read_as_by_itself():
    """Slow ones among some whose terms end within a millionth of the span."""
    table = problem(record(camera=0.6), terms=1).posterior.table
    kinds = [(1.7, 2.0), (1.7, 1e-6), (0.8, 1.5), (1.4, 1e-4), (1.2, 3.0)]
    rows = [row_values(table, TRUTH | {"order_1": order, "time_1": time}) for order, time in kinds]
    together = stepcurves.curves_of(table, np.array(rows), 20.0).normalised
    for k, row in enumerate(rows):
        alone = stepcurves.curves_of(table, row[None], 20.0).normalised
        assert_allclose(together[:, k], alone[:, 0], rtol=0, atol=1e-4)


def test_curves_are_the_step_response_of_the_plant():
    made, curves = curves_of(TRUTH | {"order_1": 1.0}, 20.0)
    assert curves.normalised.shape == (1, 8, 1000)
    exact = 1 - np.exp(-np.maximum(curves.time - TRUTH["delay"], 0.0) / TRUTH["time_1"])
    late = curves.time > TRUTH["delay"] + 0.1
    assert np.abs(curves.normalised[0] - exact)[:, late].max() < 2e-4
    assert_allclose(curves.normalised[0][:, curves.time < TRUTH["delay"] - 0.1], 0.0, atol=1e-12)
    assert_allclose(curves.gains[:, 0, 0], TRUTH["gain"])
    reported = {metric.name: metric for metric in step_metrics(made, curves, time_unit="ms")}
    assert reported["rise_10_90[y]"].value == pytest.approx(TRUTH["time_1"] * log(9), rel=1e-3)
    assert reported["settling_2[y]"].value == pytest.approx(
        TRUTH["delay"] + TRUTH["time_1"] * log(50), rel=1e-3
    )
    assert reported["settling_5[y]"].value == pytest.approx(
        TRUTH["delay"] + TRUTH["time_1"] * log(20), rel=1e-3
    )
    assert reported["delay[y]"].value == pytest.approx(TRUTH["delay"])
    assert reported["overshoot[y]"].value == 0.0
    assert reported["steady_state[y]"].value == pytest.approx(TRUTH["gain"])
    assert reported["value_at_end[y]"].value == pytest.approx(TRUTH["gain"], rel=1e-3)
    units = {name.partition("[")[0]: metric.unit for name, metric in reported.items()}
    assert (units["rise_10_90"], units["overshoot"], units["steady_state"]) == ("ms", "-", "rad/V")


def test_a_slow_tail_is_open_above_and_said():
    made, curves = curves_of(TRUTH | {"order_1": 0.4}, 20.0)
    reported = {metric.name: metric for metric in step_metrics(made, curves, time_unit="ms")}
    settled = reported["settling_2[y]"]
    assert settled.as_json()["upper"] is None
    assert "100 % of draws have not settled to 2 % of steady state by the end of the record" in settled.note


def ringing(damping: float, frequency: float) -> dict[str, float]:
    """``1 / ((T_1 s)^2 + T_2 s + 1)``, the second-order response with this damping and frequency."""
    times = {"time_1": 1 / frequency, "time_2": 2 * damping / frequency}
    return {"gain": 2.0, **times, "order_1": 2.0, "order_2": 1.0, "delay": 0.0, "offset": 0.3, "sigma": 0.02}


def test_settled_or_not_is_decided_as_the_response_after_the_record_shows():
    """100 second-order responses, half of them cut where they cross their steady value: no settling time
    unless the closed form stays within the band for ever after."""
    rng, span = np.random.default_rng(3), 12.0
    damping = rng.uniform(0.08, 0.8, 100)
    beyond = np.sqrt(1 - damping**2)
    phase = np.arccos(damping)
    number = rng.integers(1, 4, 100)
    crossing_at = (number * pi - phase) / beyond  # times the frequency
    frequency = np.where(np.arange(100) % 2, crossing_at, rng.uniform(1.0, 40.0, 100)) / span
    dense = span * np.linspace(0.0, 20.0, 400_001)
    posterior = problem(record(camera=0.6), terms=2, orders=(2.0, 1.0)).posterior
    table = posterior.table
    values = np.array([row_values(table, ringing(d, f)) for d, f in zip(damping, frequency, strict=True)])
    made = draws_of(table, values)
    curves = step_curves(made, span)
    wrong = []
    for k in range(100):
        fast = frequency[k] * beyond[k]
        wave = np.exp(-damping[k] * frequency[k] * dense) * np.sin(fast * dense + phase[k]) / np.sin(phase[k])
        exact = dense[np.flatnonzero(np.abs(wave) > 0.02)[-1]]
        assert abs(exact - span) > 1e-3 * span  # the answer is known
        found = settled_of(made, curves, k)
        if not (found == pytest.approx(exact, abs=2e-2) if exact < span else np.isinf(found)):
            wrong.append((k, exact, found))
    assert wrong == []


def settled_of(made, curves, k):
    """`settling_2` of one draw, reported as if it were all."""
    alone = draws_of(made.table, np.repeat(made.flat[k][None], 2, axis=0))
    one = replace(
        curves,
        normalised=curves.normalised[:, [k, k]],
        gains=curves.gains[[k, k]],
        delays=curves.delays[[k, k]],
        values=curves.values[[k, k]],
    )
    reported = {metric.name: metric for metric in step_metrics(alone, one, time_unit="ms")}
    return reported["settling_2[y]"].value


def test_overshoot_after_the_record_counts():
    values = ringing(0.2, (pi - np.arccos(0.2)) / sqrt(1 - 0.04) / 12.0)  # crosses 1 at the end
    posterior = problem(record(camera=0.6), terms=2, orders=(2.0, 1.0)).posterior
    made = draws_of(posterior.table, np.tile(row_values(posterior.table, values), (4, 1)))
    reported = {metric.name: metric for metric in step_metrics(made, step_curves(made, 12.0), time_unit="ms")}
    assert reported["settling_2[y]"].as_json()["value"] is None
    assert "100 % of draws have not settled" in reported["settling_2[y]"].note
    assert reported["overshoot[y]"].value == pytest.approx(exp(-pi * 0.2 / sqrt(1 - 0.04)), rel=1e-3)


def test_crosstalk_is_the_ratio_of_gains():
    posterior = problem(record(device=TWO, camera=0.6)).posterior
    values = posterior.table.draw(8, np.random.default_rng(0))
    made = draws_of(posterior.table, values)
    reported = {metric.name: metric for metric in step_metrics(made, step_curves(made, 10.0), time_unit="ms")}
    gains = posterior.table.gains(values)
    assert reported["crosstalk[y/x by x]"].value == pytest.approx(np.median(gains[:, 1, 0] / gains[:, 0, 0]))
    assert reported["crosstalk[x/y by y]"].value == pytest.approx(np.median(gains[:, 0, 1] / gains[:, 1, 1]))
    assert {"rise_10_90[x_y]", "steady_state[y_x]"} < reported.keys()


@pytest.mark.parametrize(("time", "order", "fast"), [(0.01, 1.0, True), (0.01, 0.7, True), (1.5, 0.8, False)])
def test_what_rises_between_two_samples_is_named_with_its_parameters(time, order, fast):
    made, curves = curves_of(TRUTH | {"time_1": time, "order_1": order}, 20.0)
    found = too_fast(made, curves, 0.6)
    assert [one.parameters for one in found] == ([("time_1", "order_1")] if fast else [])
    limited = made.limited(found)
    assert [e.grade for e in limited.estimates() if e.name == "time_1"] == [
        "tentative" if fast else "reliable"
    ]
    assert [e.grade for e in limited.estimates() if e.name == "gain"] == ["reliable"]
