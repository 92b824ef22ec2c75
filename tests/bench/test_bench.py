"""The virtual bench against closed forms, high-precision references and its own symmetries."""

from __future__ import annotations

import ast
from dataclasses import replace
from functools import partial
from math import gamma, inf, pi
from pathlib import Path

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.special import erfcx

import lcopa_bayes.bench
from lcopa_bayes.bench import device as bench_device
from lcopa_bayes.bench import inversion
from lcopa_bayes.bench.campaignfile import load_plan
from lcopa_bayes.bench.command import Command, joint, on_off, prbs, quiet, staircase, step
from lcopa_bayes.bench.device import (
    PAPER_BENCH,
    PAPER_DEVICE,
    Bench,
    Device,
    TableError,
    simulate,
    superposed,
    tabulated,
    truth,
)
from lcopa_bayes.bench.inversion import (
    InversionError,
    PoleSearchError,
    poles,
    step_response,
    unit_ramp,
    unit_step,
)
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.model.path import TransferPath

XX = PAPER_DEVICE.paths[0][0]
SLOW_ONSET = TransferPath(gain=2.0, delay=0.7, etas=(3.0, 0.4), orders=(0.3, 0.1), stiffness=1.5)
RINGING = TransferPath(gain=-1.0, delay=0.0, etas=(1.0, 0.02), orders=(2.0, 0.8), stiffness=4.0)


def element(etas, orders, stiffness) -> TransferPath:
    """A path of gain 1 without delay."""
    return TransferPath(1.0, 0.0, etas, orders, stiffness)


def single(path: TransferPath, offset: float = 0.0) -> Device:
    return Device(((path,),), (Axis("u", "V"),), (Axis("y", "rad"),), (offset,))


elements = st.builds(
    lambda terms, stiffness: element(
        tuple(10.0**eta for _, eta in terms), tuple(order for order, _ in terms), 10.0**stiffness
    ),
    st.lists(
        st.tuples(st.floats(0.05, 2.0), st.floats(-3, 3)),
        min_size=1,
        max_size=4,
        unique_by=lambda term: term[0],
    ),
    st.floats(-2, 2),
)
commands = st.builds(
    lambda gaps, seed: Command(
        np.cumsum(gaps) - 3.0,
        np.random.default_rng(seed).normal(size=(len(gaps), 2)),
        np.random.default_rng(seed + 1).normal(size=2),
    ),
    st.lists(st.floats(0.01, 5.0), max_size=6),
    st.integers(0, 1000),
)


# ---------------------------------------------------------------- inversion


@pytest.mark.parametrize(
    ("path", "time", "expected"),
    [
        (
            XX,
            [3.5, 5, 7.5, 10, 25],
            [
                0.0008158871940552879,
                0.006599891310313528,
                0.01378555938447909,
                0.01627713127161124,
                0.01739526378981913,
            ],
        ),
        (
            TransferPath(1.0, 0.0, (0.8, 0.5), (2.2, 0.9), 1.0),
            [1, 5, 10],
            [0.423976252450147, 0.5850829927426851, 0.8203325185879344],
        ),
        (
            TransferPath(1.0, 0.0, (1.0,), (1.8,), 1.0),
            [1, 5, 20],
            [0.5257755292955437, 0.9094762151984327, 0.977932015453384],
        ),
    ],
)
def test_reference_answers(path, time, expected):
    assert_allclose(step_response(path, time), expected, rtol=2e-12)


TIMES = np.geomspace(1e-6, 1e4, 300)


def test_order_one_is_exponential():
    exact = -np.expm1(-TIMES / 2)
    assert_allclose(unit_step(element((3.0,), (1.0,), 1.5), TIMES), exact / 1.5, rtol=1e-11)


def test_order_one_half_is_mittag_leffler():
    exact = 1 - erfcx(np.sqrt(TIMES))
    assert_allclose(unit_step(element((1.0,), (0.5,), 1.0), TIMES), exact, atol=1e-11)


@pytest.mark.parametrize("damping", [0.0, 1e-6, 1e-3, 0.03, 0.5, 0.9, 0.97, 0.999, 1.5])
def test_oscillator_up_to_thousands_of_cycles(damping):
    root = np.sqrt(complex(damping**2 - 1))
    slow, fast = -damping + root, -damping - root
    exact = 1 + ((fast * np.exp(slow * TIMES) - slow * np.exp(fast * TIMES)) / (slow - fast)).real
    terms = ((1.0, 2 * damping), (2.0, 1.0)) if damping else ((1.0,), (2.0,))
    assert_allclose(unit_step(element(*terms, 1.0), TIMES), exact, atol=3e-11)


@pytest.mark.parametrize("order", [0.1, 0.7, 1.4, 2.0])
def test_onset_is_a_power_of_time(order):
    """``y -> t^order / (eta Gamma(order + 1))``, relative to itself."""
    time = np.array([1e-9, 1e-7]) ** (1 / order)
    expected = time**order / (2.5 * gamma(order + 1))
    assert_allclose(unit_step(element((2.5,), (order,), 3.0), time), expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("etas", "orders", "stiffness"),
    [((0.3, 2.0, 0.5), (1.9, 1.1, 0.2), 0.7), ((1.0, 0.05), (1.97, 0.4), 2.0), ((4.0,), (0.25,), 1.0)],
)
def test_agrees_with_high_precision_inversion(etas, orders, stiffness):
    def transform(s):
        return 1 / (s * (sum(e * s ** mpmath.mpf(a) for e, a in zip(etas, orders, strict=True)) + stiffness))

    time = [0.05, 1.3, 6.0]
    expected = [float(mpmath.invertlaplace(transform, t, method="talbot", degree=40)) for t in time]
    assert_allclose(unit_step(element(etas, orders, stiffness), time), expected, rtol=1e-10)


@settings(max_examples=60, deadline=None)
@given(elements)
def test_any_plant_starts_at_zero_ends_at_rest_and_passes_its_own_check(path):
    time = np.array([-1.0, 0.0, *np.geomspace(1e-5, 1e5, 60)])
    response = unit_step(path, time)
    assert_array_equal(response[:2], 0.0)
    assert (response[2:] * path.stiffness < 2 + 1e-9).all()  # undamped: twice the rest
    assert len(poles(path)) <= 1
    assert (poles(path).real <= 1e-12 * np.abs(poles(path))).all()


@settings(max_examples=30, deadline=None)
@given(elements)
def test_ramp_is_the_integral_of_the_step(path):
    edges = np.array([0.3, 0.8])
    nodes, weights = np.polynomial.legendre.leggauss(30)
    slow = not poles(path).size or abs(poles(path)[0]) < 20
    if slow:  # 30 nodes resolve the oscillation
        middle, half = edges.mean(), np.diff(edges)[0] / 2
        expected = half * weights @ unit_step(path, middle + half * nodes)
        assert np.diff(unit_ramp(path, edges))[0] == pytest.approx(expected, rel=1e-7, abs=1e-9)


def test_a_pole_left_out_is_noticed(monkeypatch):
    """Without its residue the ringing is lost: the two contours must tell, or the pole count does."""
    monkeypatch.setattr(inversion, "poles", lambda path: np.empty(0, dtype=complex))
    with pytest.raises(InversionError) as caught:
        unit_step(element((1.0, 0.02), (2.0, 0.8), 4.0), np.linspace(0.1, 10, 50))
    assert caught.value.difference > caught.value.allowed
    assert 0.1 <= caught.value.time <= 10


def test_a_pole_search_without_luck_is_noticed(monkeypatch):
    monkeypatch.setattr(inversion, "round", lambda _: 2, raising=False)
    poles.cache_clear()
    with pytest.raises(PoleSearchError) as caught:
        unit_step(element((1.0,), (1.8,), 1.0), 1.0)
    assert caught.value.counted == 2
    assert caught.value.located == (pytest.approx(np.exp(1j * pi / 1.8)),)


@pytest.mark.parametrize("order", [2.5, 3.7, 5.0])
def test_poles_of_one_term_are_the_roots_of_minus_one(order):
    angles = np.array([pi * (2 * n + 1) / order for n in range(3)])
    expected = np.exp(1j * angles[angles < 0.85 * pi])
    found = poles(element((1.0,), (order,), 1.0))
    assert_allclose(np.sort_complex(found), np.sort_complex(expected), rtol=1e-12)


@pytest.mark.parametrize(
    ("etas", "orders", "stiffness", "words"),
    [
        ((-1.0,), (1.0,), 1.0, "positive"),
        ((0.0,), (1.0,), 1.0, "positive"),
        ((1.0,), (1.0,), -2.0, "positive"),
        ((1.0, 2.0), (1.0, 1.0), 1.0, "distinct"),
    ],
)
def test_elements_that_cannot_be_inverted_are_refused(etas, orders, stiffness, words):
    """By themselves and in a device."""
    path = element(etas, orders, stiffness)
    with pytest.raises(InputError, match=words):
        unit_step(path, 1.0)
    with pytest.raises(InputError, match=words):
        single(path)


# ---------------------------------------------------------------- superposition


@pytest.mark.parametrize("path", [XX, SLOW_ONSET, RINGING])
def test_table_is_as_accurate_as_promised(path):
    table = tabulated(partial(unit_step, path), 1e-9, 200.0, tolerance=1e-9 / path.stiffness)
    time = np.concatenate([[-1.0, 0.0], np.geomspace(1e-9, 200, 20_011), np.linspace(0.01, 200, 5_003)])
    error = np.abs(table(time) - unit_step(path, time)) * path.stiffness
    assert error.max() < 3e-9
    assert_array_equal(table(time[:2]), 0.0)


def test_table_of_noise_is_refused(rng):
    with pytest.raises(TableError) as caught:
        tabulated(lambda time: rng.normal(size=time.shape), 1.0, 2.0, tolerance=1e-3)
    assert caught.value.error > 1e-3


@pytest.mark.parametrize("path", [XX, SLOW_ONSET, RINGING])
def test_table_and_direct_sums_agree(path, rng, monkeypatch):
    time = np.sort(rng.uniform(0, 60, 300))
    changes, jumps = np.sort(rng.uniform(0, 50, 13)), rng.normal(size=13)
    response = partial(unit_step, path)
    direct = superposed(response, time, changes, jumps, tolerance=0.0)  # a table could not reach 0
    monkeypatch.setattr(bench_device, "_DISTINCT", 0)
    table = superposed(response, time, changes, jumps, tolerance=1e-9 / path.stiffness)
    assert 0 < np.abs(direct - table).max() < 1e-8 * np.abs(jumps).sum() / path.stiffness


def test_many_edges_and_samples_off_every_grid(rng):
    time = np.sort(rng.uniform(0, 900, 3000))
    changes, jumps = np.sort(rng.uniform(0, 900, 1000)), rng.choice([-1.0, 1.0], 1000)
    sums = superposed(partial(unit_step, XX), time, changes, jumps, tolerance=1e-9 / XX.stiffness)
    for k in (0, 1500, 2999):
        exact = jumps @ unit_step(XX, time[k] - changes)
        assert sums[k] == pytest.approx(exact, abs=1e-7 / XX.stiffness)


def test_rounding_of_times_does_not_see_a_steep_onset():
    """At the instant of the change, up to rounding, nothing has happened yet."""
    late = single(replace(SLOW_ONSET, delay=0.0, orders=(0.05, 0.01)))
    assert late.response(step(1.0, at=0.3), [0.1 * 3])[0, 0] == 0.0


# ---------------------------------------------------------------- commands


def test_commands_hold_from_their_instant_on():
    command = on_off((1.0, 2.0), hold=3.0, at=1.0, rest=(0.5, 0.0))
    assert_array_equal(command.at([0.99, 1.0, 3.99, 4.0]), [[0.5, 0], [1, 2], [1, 2], [0.5, 0]])
    assert_array_equal(command.jumps, [[0.5, 2], [-0.5, -2]])
    assert_array_equal(staircase([1.0, 3.0, 2.0], hold=2.0).times, [0, 2, 4])
    assert_array_equal(step((1.0, 2.0), at=4.0).values, [[1, 2]])


def test_two_axes_keep_their_own_instants():
    both = joint(step(1.0, at=2.0), on_off(5.0, hold=1.0, at=1.0))
    assert_array_equal(both.times, [1, 2])
    assert_array_equal(both.values, [[0, 5], [1, 0]])


def test_refresh_waits_for_the_next_multiple():
    command = Command(np.array([-0.4, 0.0, 1.2, 1.9, 3.0, 3.1]), np.arange(6.0)[:, None] + 1, np.zeros(1))
    obeyed = command.refreshed(1.0)
    assert_array_equal(obeyed.times, [0, 2, 3, 4])  # of two commands within one period the last acts
    assert_array_equal(obeyed.values[:, 0], [2, 4, 5, 6])
    assert command.refreshed(0.0) is command
    assert quiet(1.0).refreshed(1.0).times.size == 0
    assert_allclose(step(1.0, at=0.1 * 3).refreshed(0.1).times, [0.3], rtol=1e-12)


def test_prbs_is_even_and_white(rng):
    command = prbs((0.0, -1.0), (1.0, 2.0), hold=0.5, duration=2000.0, rng=rng)
    bits = (command.at(0.5 * np.arange(4000) + 0.25) - [0.0, -1.0]) / [1.0, 3.0]
    assert set(np.unique(bits)) == {0.0, 1.0}
    signs, mcse = 2 * bits - 1, 1 / np.sqrt(4000)
    assert (np.abs(signs.mean(axis=0)) < 4 * mcse).all()
    assert (np.abs((signs[1:] * signs[:-1]).mean(axis=0)) < 4 * mcse).all()
    assert abs((signs[:, 0] * signs[:, 1]).mean()) < 4 * mcse
    assert (np.abs(command.jumps).max(axis=1) > 0).all()


@pytest.mark.parametrize("hold", [0.0, float("nan"), -1.0])
def test_bad_holds_are_refused(hold, rng):
    with pytest.raises(InputError):
        staircase([1.0, 2.0], hold=hold)
    with pytest.raises(InputError):
        prbs(0.0, 1.0, hold=hold, duration=5.0, rng=rng)


# ---------------------------------------------------------------- device

SAMPLES = np.linspace(-4, 30, 69)


def test_each_path_leads_from_its_drive_to_its_response():
    device = Device(
        ((XX, SLOW_ONSET), (RINGING, replace(XX, gain=0.0)), (XX, XX)),
        (Axis("a", "V"), Axis("b", "V")),
        tuple(Axis(name, "rad") for name in "xyz"),
        (1.0, 2.0, 3.0),
    )
    response = device.response(step((0.0, 2.0)), SAMPLES) - [1.0, 2.0, 3.0]
    expected = [2 * step_response(SLOW_ONSET, SAMPLES), 0 * SAMPLES, 2 * step_response(XX, SAMPLES)]
    assert_allclose(response.T, expected, atol=1e-8)
    assert_allclose(
        device.response(step((1.0, 0.0)), SAMPLES)[:, 1] - 2, step_response(RINGING, SAMPLES), atol=1e-8
    )


def test_paper_device_is_the_stated_plant():
    steady = [[path.steady for path in row] for row in PAPER_DEVICE.paths]
    expected = [[0.100008 / 5.57, 0.005228 / 2.82], [0.003235 / 2.82, 0.100001 / 5.57]]
    assert_allclose(steady, expected, rtol=1e-12)
    assert {path.delay for row in PAPER_DEVICE.paths for path in row} == {3.027}


@settings(max_examples=25, deadline=None)
@given(commands, commands, st.floats(-3, 3))
def test_the_device_is_linear_in_the_command(first, second, factor):
    times = np.union1d(first.times, second.times)
    mixed = Command(times, first.at(times) + factor * second.at(times), first.rest + factor * second.rest)
    parts = [PAPER_DEVICE.response(command, SAMPLES) for command in (first, second)]
    assert_allclose(PAPER_DEVICE.response(mixed, SAMPLES), parts[0] + factor * parts[1], atol=1e-8)


@settings(max_examples=25, deadline=None)
@given(commands, st.floats(0.1, 9.0))
def test_the_device_does_not_know_the_future_nor_the_clock(command, shift):
    device = replace(PAPER_DEVICE, offsets=(0.2, -0.1))
    whole = device.response(command, SAMPLES)
    now = 6.0
    past = command.times <= now - XX.delay
    reported = device.response(Command(command.times[past], command.values[past], command.rest), SAMPLES)
    assert_allclose(whole[now >= SAMPLES], reported[now >= SAMPLES], atol=1e-12)
    later = Command(command.times + shift, command.values, command.rest)
    assert_allclose(device.response(later, SAMPLES + shift), whole, atol=1e-8)


@pytest.mark.parametrize("path", [XX, SLOW_ONSET, RINGING])
def test_off_is_the_rest_minus_on(path):
    device = single(path, offset=0.25)
    on = device.response(step(1.7), SAMPLES) - 0.25
    off = device.response(step(0.0, rest=1.7), SAMPLES) - 0.25
    assert_allclose(off, 1.7 * path.steady - on, atol=1e-12)
    assert_allclose(off[SAMPLES <= 0], 1.7 * path.steady, rtol=1e-12)


@pytest.mark.parametrize("path", [XX, SLOW_ONSET, RINGING])
def test_exposure_is_the_mean_up_to_the_sample(path):
    device, exposure = single(path), 0.4
    command = on_off(1.0, hold=5.0)
    nodes, weights = np.polynomial.legendre.leggauss(40)
    time = np.array([0.0, 3.0, 4.6, 9.1, 20.0])  # exposures that no edge falls into
    within = time[:, None] + exposure * (nodes - 1) / 2
    mean = device.response(command, np.sort(within.ravel()))[:, 0].reshape(within.shape) @ weights / 2
    assert_allclose(device.response(command, time, exposure=exposure)[:, 0], mean, atol=2e-7)
    across = device.response(step(1.0), [path.delay + exposure / 4], exposure=exposure)[0, 0]
    part = path.gain * unit_ramp(path, exposure / 4) / exposure
    assert across == pytest.approx(float(part), rel=1e-6)


@pytest.mark.parametrize(
    "change",
    [{"gain": inf}, {"delay": -1.0}, {"delay": float("nan")}, {"stiffness": 0.0}, {"orders": (1.0, 0.5)}],
)
def test_bad_paths_are_refused(change):
    with pytest.raises(InputError):
        replace(XX, **change)


def test_bad_devices_are_refused():
    with pytest.raises(InputError) as caught:
        replace(PAPER_DEVICE, paths=((XX,),), offsets=(0.0,))
    assert len(caught.value.problems) == 2


# ---------------------------------------------------------------- bench


@pytest.mark.parametrize("rho", [0.0, 0.8, -0.5])
def test_noise_is_stationary_ar1(rho, rng):
    n, sd = 40, np.array([0.3, 2.0, 0.3])
    bench = Bench(noise_sd=tuple(np.tile(sd, 4000)), noise_correlation=rho)
    noise = bench.noise(n, 12_000, rng).reshape(n, 4000, 3) / sd
    mcse = np.sqrt(2 / 12_000)
    assert (np.abs((noise**2).mean(axis=(1, 2)) - 1) < 4.5 * mcse).all()  # at every row, the first too
    for lag in (1, 3):
        products = noise[lag:] * noise[:-lag]
        at_first = products[0]
        assert abs(at_first.mean() - rho**lag) < 4.5 * at_first.std() / np.sqrt(at_first.size)
        blocks = products.mean(axis=(0, 2))
        assert abs(blocks.mean() - rho**lag) < 4.5 * blocks.std() / np.sqrt(blocks.size)
    assert abs((noise[:, :, 0] * noise[:, :, 1]).mean()) < 4.5 / np.sqrt(4000)


def test_rows_are_an_early_rest_and_the_camera_samples():
    record = truth(single(XX, 0.5), Bench(), on_off(2.0, hold=1.0, rest=0.3), duration=2.5, name="r")
    assert_array_equal(record.time, np.round(np.arange(-1, 25) * 0.1, 12))
    assert_array_equal(np.isnan(record.response[:, 0]), [True] + 25 * [False])
    assert_array_equal(record.drive[:, 0], [0.3] + 10 * [2.0] + 15 * [0.3])
    assert_allclose(record.response[1:, 0], 0.5 + 0.3 * XX.steady, rtol=1e-12)  # within the delay


def test_changes_between_samples_and_before_them_are_logged():
    command = Command([-0.25, 0.33, 0.4, 9.0], [[1.0], [2.0], [3.0], [4.0]], [0.0])
    record = truth(single(XX), Bench(), command, duration=0.5, name="r")
    assert_allclose(record.time, [-0.35, -0.25, 0, 0.1, 0.2, 0.3, 0.33, 0.4], atol=1e-12)
    assert_array_equal(record.drive[:, 0], [0, 1, 1, 1, 1, 1, 2, 3])
    assert_array_equal(np.isnan(record.response[:, 0]), [1, 1, 0, 0, 0, 0, 1, 0])


def test_a_change_at_a_sample_in_another_rounding_is_at_that_sample():
    record = truth(single(XX), Bench(), step(1.0, at=0.7 - 1e-13), duration=1.0, name="r")
    assert_array_equal(record.time, np.round(np.arange(-1, 10) * 0.1, 12))
    assert_array_equal(record.drive[:, 0], 8 * [0.0] + 3 * [1.0])


def test_changes_logged_with_samples_are_late_and_act_when_they_did():
    command = step(1.0, at=0.234)
    at_once, logged = Bench(), Bench(logged=True)
    prompt, late = (truth(single(XX), one, command, duration=2.0, name="r") for one in (at_once, logged))
    seen = np.isfinite(prompt.response[:, 0])
    assert_array_equal(late.time, prompt.time[seen | (np.arange(seen.size) == 0)])
    assert_array_equal(late.drive[:, 0], np.where(late.time >= 0.3, 1.0, 0.0))
    assert_array_equal(late.response[1:], prompt.response[seen])
    early = truth(single(XX), logged, step(1.0, at=-0.35), duration=1.0, name="r")
    assert_allclose(early.time[1], -0.35)
    assert early.drive[1, 0] == 1.0


def test_refresh_delays_the_response_but_not_the_log():
    at_once, held = Bench(), Bench(refresh=1.0)
    device = single(XX)
    prompt = truth(device, at_once, step(1.0, at=1.0), duration=20.0, name="r")
    waiting = truth(device, held, step(1.0, at=0.4), duration=20.0, name="r")
    assert_array_equal(waiting.response, prompt.response)
    assert_array_equal(waiting.drive[:, 0], np.where(waiting.time >= 0.4, 1.0, 0.0))
    on_grid = truth(device, held, step(1.0, at=1.0), duration=20.0, name="r")
    assert_array_equal(on_grid.response, prompt.response)


def test_simulated_is_truth_plus_seeded_noise():
    bench = Bench(noise_sd=(0.1, 0.2), noise_correlation=0.6, exposure=0.05, refresh=1.0)
    command = joint(step(1.0, at=0.234), quiet())
    clean = truth(PAPER_DEVICE, bench, command, duration=10.0, name="r")
    noisy = [
        simulate(PAPER_DEVICE, bench, command, duration=10.0, name="r", rng=np.random.default_rng(seed))
        for seed in (5, 5, 6)
    ]
    assert_array_equal(noisy[0].response, noisy[1].response)
    sampled = ~np.isnan(clean.response[:, 0])
    assert sampled.sum() == 100
    expected = bench.noise(100, 2, np.random.default_rng(5))
    assert_allclose((noisy[0].response - clean.response)[sampled], expected, atol=1e-15)
    assert not np.allclose(noisy[2].response[sampled], noisy[0].response[sampled])


@pytest.mark.parametrize(
    "change",
    [
        {"refresh": -1.0},
        {"camera": 0.0},
        {"exposure": 0.2},
        {"noise_sd": (0.1, -0.1)},
        {"noise_sd": float("nan")},
        {"noise_correlation": 1.0},
        {"logged": "yes"},
    ],
)
def test_bad_benches_are_refused(change):
    with pytest.raises(InputError):
        Bench(**change)


def test_bad_durations_and_noise_shapes_are_refused(rng):
    with pytest.raises(InputError, match="duration"):
        truth(single(XX), Bench(), step(1.0), duration=0.05, name="r")
    with pytest.raises(InputError, match="noise_sd"):
        Bench(noise_sd=(1.0, 1.0)).noise(5, 3, rng)


# ---------------------------------------------------------------- campaign


def paper_step_records(rng) -> tuple[Record, ...]:
    """The step records of the paper's Section 5, as the bundled campaign describes them."""
    return load_plan(Path(__file__).parents[2] / "studies/paper-step/campaign.toml").run(rng)


def test_paper_records_are_the_stated_experiments(rng):
    records = {record.name: record for record in paper_step_records(rng)}
    assert list(records) == ["x_on", "x_off", "x_quarter", "y_quarter", "xy"]
    drives = {
        "x_on": ([0, 0], [pi / 2, 0]),
        "x_off": ([pi / 2, 0], [0, 0]),
        "x_quarter": ([0, 0], [pi / 4, 0]),
        "y_quarter": ([0, 0], [0, pi / 4]),
        "xy": ([0, 0], [pi / 3, pi / 5]),
    }
    residuals = []
    for name, (before, after) in drives.items():
        record = records[name]
        assert_array_equal(record.time, np.round(np.arange(-1, 250) * 0.1, 12))
        assert_array_equal(record.drive[0], before)
        assert_array_equal(record.drive[1:], np.tile(after, (250, 1)))
        command = step(after, rest=before)
        residuals.append(
            (record.response - truth(PAPER_DEVICE, PAPER_BENCH, command, duration=25.0, name=name).response)[
                1:
            ]
        )
    residual = np.concatenate(residuals)
    assert abs(((residual / 1.8e-4) ** 2).mean() - 1) < 4 * np.sqrt(2 / residual.size)


# ---------------------------------------------------------------- independence


@pytest.mark.parametrize(
    "path", sorted(Path(lcopa_bayes.bench.__path__[0]).glob("*.py")), ids=lambda p: p.stem
)
def test_the_bench_shares_no_numerics_with_the_fit(path):
    allowed = {"core.arrays", "core.errors", "core.files", "core.rules", "data.record"}
    allowed |= {"model.literature", "model.path"}
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        for name in names:
            if name.startswith("lcopa_bayes"):
                room, *module = name.split(".")[1:]
                assert room == "bench" or ".".join([room, *module]) in allowed
        assert not (isinstance(node, ast.ImportFrom) and node.level)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20260710)
