"""Forward responses against high-precision references, the bench, and the model's own symmetries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from lcopa_bayes.bench.command import Command, prbs, staircase, step
from lcopa_bayes.bench.device import Device
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.model.forward import Dynamics, Experiment, ForwardModel, forward_model
from lcopa_bayes.model.grid import Mesh
from lcopa_bayes.model.layout import Layout
from lcopa_bayes.model.literature import PAPER
from lcopa_bayes.model.path import TransferPath

X, Y = Axis("x", "rad"), Axis("y", "rad")
UNIT_STEP = AxisDrive(np.zeros(1), np.ones(1))
KELVIN = ((3.0, 1.0), (1.6, 0.7))


def single(
    drive: AxisDrive, times: np.ndarray, terms: int, *, begin: float | None = None, **options
) -> ForwardModel:
    layout = Layout.of((X,), (X,), ModelSettings(terms=terms))
    mesh = Mesh.of_samples(times, float(drive.times[0]) if begin is None else begin, **options)
    return ForwardModel(layout, (Experiment("one", mesh, (drive,), np.zeros(1)),))


def respond(element, delay: float, drive: AxisDrive, times: np.ndarray, **options) -> np.ndarray:
    model = single(drive, times, len(element[0]), **options)
    dynamics = Dynamics((np.array([element[0]]),), (np.array([element[1]]),), np.array([[delay]]))
    return model.unit_responses(dynamics)[0][0, 0]


def on_bench(element, delay: float, command: Command, times: np.ndarray, exposure: float = 0.0) -> np.ndarray:
    path = TransferPath.of_times(1.0, delay, *element).merged()
    device = Device(((path,),), (X,), (X,), (0.0,))
    return device.response(command, times, exposure=exposure)[:, 0] - command.rest[0]


def drive_of(command: Command) -> AxisDrive:
    return AxisDrive(command.times, command.values[:, 0] - command.rest[0])


def order_of(errors: Sequence[float]) -> float:
    """Order of convergence from errors at step widths that halve."""
    return float(-np.polyfit(np.arange(len(errors)), np.log2(errors), 1)[0])


# References


def test_reference_of_the_paper_at_1024_blocks():
    path = PAPER.plant.xx
    exact = {
        3.5: 0.0008158871940552879,
        5.0: 0.006599891310313528,
        7.5: 0.01378555938447909,
        10.0: 0.01627713127161124,
        25.0: 0.01739526378981913,
    }
    times = 0.5 * np.arange(1, 51)
    gain, both = path.steady, (path.times, path.orders)
    read = gain * respond(both, path.delay, UNIT_STEP, times, blocks=1024)
    off = [(read[round(2 * t) - 1] - value) / gain for t, value in exact.items()]
    assert np.abs(off).max() < 1e-5  # 6.3e-6 at 3.5, right after the onset
    assert np.abs(off[2:]).max() < 3e-6


@pytest.mark.parametrize(
    ("etas", "orders", "exact"),
    [
        ((0.8, 0.5), (2.2, 0.9), {1: 0.423976252450147, 5: 0.5850829927426851, 10: 0.8203325185879344}),
        ((1.0,), (1.8,), {1: 0.5257755292955437, 5: 0.9094762151984327, 20: 0.977932015453384}),
    ],
)
def test_references_without_delay(etas, orders, exact):
    """Also of an order above 2, which fits do not allow but the algebra does."""
    element = tuple(eta ** (1 / order) for eta, order in zip(etas, orders, strict=True)), orders
    times = np.arange(1.0, max(exact) + 1)
    places = [t - 1 for t in exact]
    errors = [
        np.abs(respond(element, 0.0, UNIT_STEP, times, blocks=blocks)[places] - [*exact.values()]).max()
        for blocks in (250, 500, 1000)
    ]
    assert errors[-1] < 2e-8
    assert 3.4 < order_of(errors) < 4.3


@pytest.mark.parametrize("element", [((2.0,), (1.0,)), KELVIN, ((2.0,), (0.5,))])
def test_step_responses_are_third_to_fourth_order(element):
    times = np.arange(1.0, 26.0)
    if element[1] == (1.0,):
        exact = 1 - np.exp(-times / element[0][0])
    else:
        exact = on_bench(element, 0.0, step(1.0), times)
    errors = [
        np.abs(respond(element, 0.0, UNIT_STEP, times, blocks=blocks) - exact).max()
        for blocks in (250, 500, 1000)
    ]
    assert errors[0] < 7e-6
    assert (2.2 if element[1] == (0.5,) else 3.6) < order_of(errors) < 4.2


def test_a_delay_off_the_grid_costs_no_accuracy():
    """Rounding it to blocks would leave first order."""
    times = 0.125 * np.arange(16, 200)  # well after the onset
    delays = np.random.default_rng(0).uniform(0, 1, 8)
    exact = np.array([on_bench(KELVIN, delay, step(1.0), times) for delay in delays])
    widths, errors = [], []
    for blocks in (250, 500, 1000):
        widths.append(single(UNIT_STEP, times, 2, blocks=blocks).experiments[0].mesh.grid.step)
        read = [respond(KELVIN, delay, UNIT_STEP, times, blocks=blocks) for delay in delays]
        errors.append(float(np.sqrt(np.mean(np.square(read - exact)))))
    slope = np.polyfit(np.log(widths), np.log(errors), 1)[0]
    assert 2.8 < slope < 4.2


# Two methods: the bench inverts Laplace transforms and shares no code with the operational algebra


@st.composite
def elements(draw: st.DrawFn) -> tuple[tuple[float, ...], tuple[float, ...]]:
    terms = draw(st.integers(1, 3))
    orders = draw(st.lists(st.integers(6, 40), min_size=terms, max_size=terms))  # twentieths; may be equal
    times = draw(st.lists(st.floats(0.0, 0.9), min_size=terms, max_size=terms))
    return tuple(10.0**time for time in times), tuple(order / 20 for order in sorted(orders, reverse=True))


@settings(max_examples=40, deadline=None)
@given(
    element=elements(),
    delay=st.floats(0.0, 4.0),
    hold=st.sampled_from([1.0, 1.2345]),
    start=st.sampled_from([0.0, 0.0377]),
    rest=st.sampled_from([0.0, -0.4]),
    seed=st.integers(0, 1000),
)
def test_agrees_with_the_bench(element, delay, hold, start, rest, seed):
    """PRBS on and off the grid. Right after a change a low order moves too fast for any grid."""
    rng = np.random.default_rng(seed)
    command = prbs(-0.4, 0.7, hold=hold, duration=15.0, rng=rng, start=start, rest=rest)
    times = 0.05 * np.arange(1, 501)
    lag = times[:, None] - delay - command.times
    calm = ~((lag > -0.1) & (lag < 0.5)).any(axis=1)
    exact = on_bench(element, delay, command, times)
    scale = max(1, command.times.size) ** 0.5
    for blocks, bound in ((500, 1.5e-3), (2000, 1.5e-4)):
        read = respond(element, delay, drive_of(command), times, blocks=blocks)
        assert np.abs(read - exact)[calm].max() < bound * scale


@pytest.mark.parametrize("spacing", ["even", "uneven"])
def test_an_exposure_of_any_length_is_read_without_overflow(spacing):
    """Beyond the record a mean falls as its exposure grows, on a lattice and off it."""
    times = 0.1 * np.arange(1.0, 81.0)
    times = times if spacing == "even" else times**1.01
    command = step(1.0, at=0.35)
    longer, longest = (respond(KELVIN, 0.2, drive_of(command), times, exposure=one) for one in (1e3, 1e300))
    assert 0.0 < longer[-1] < 0.02
    assert_allclose(longest * 1e300, longer * 1e3, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("exposure", [0.001, 0.05, 0.1, 0.5, 3.0])
def test_exposure_agrees_with_the_bench(exposure):
    command = staircase([0.7, -0.3, 0.4], hold=6.2345, start=0.0377)
    times = 0.1 * np.arange(1, 251)
    exact = on_bench(KELVIN, 2.2, command, times, exposure)
    errors = [
        np.abs(respond(KELVIN, 2.2, drive_of(command), times, blocks=blocks, exposure=exposure) - exact).max()
        for blocks in (250, 500, 1000)
    ]
    assert errors[0] < 2e-5
    assert errors[2] < max(errors[0] / 30, 2e-8)


def test_irregular_samples_agree_with_the_bench(rng):
    times = np.sort(rng.uniform(0.5, 25, 60))
    exact = on_bench(KELVIN, 0.0, step(1.0), times)
    errors = [
        np.abs(respond(KELVIN, 0.0, UNIT_STEP, times, blocks=blocks) - exact).max()
        for blocks in (200, 400, 800)
    ]
    assert 3.0 < order_of(errors) < 4.5


def test_a_single_sample_and_very_many_agree_with_the_bench():
    one = np.array([7.3])
    assert respond(KELVIN, 1.0, UNIT_STEP, one) == pytest.approx(
        on_bench(KELVIN, 1.0, step(1.0), one), abs=3e-4
    )
    many = 0.002 * np.arange(1, 20_001)
    exact = on_bench(KELVIN, 1.0, step(1.0), many[::500])
    assert_allclose(respond(KELVIN, 1.0, UNIT_STEP, many)[::500], exact, rtol=0, atol=2e-6)


# Properties


@pytest.fixture
def moving(rng: np.random.Generator) -> AxisDrive:
    return AxisDrive(np.cumsum(rng.uniform(0.1, 2.0, 8)) - 0.5, rng.normal(size=8))


TIMES = 0.1 * np.arange(1, 121)


def test_response_is_linear_in_the_drive(moving, rng):
    other = AxisDrive(moving.times, rng.normal(size=8))
    total = AxisDrive(moving.times, 2.0 * moving.values - 3.0 * other.values)
    a, b, both = (respond(KELVIN, 0.7, drive, TIMES) for drive in (moving, other, total))
    assert_allclose(both, 2.0 * a - 3.0 * b, rtol=0, atol=1e-8)


@settings(max_examples=30, deadline=None)
@given(start=st.floats(-0.5, 6.0), delay=st.floats(0.0, 6.0))
def test_nothing_moves_before_drive_and_delay(start, delay):
    drive = AxisDrive(np.array([start]), np.ones(1))
    for times in (TIMES, TIMES + 0.02 * np.sin(100 * TIMES)):
        read = respond(((2.0,), (0.6,)), delay, drive, times)
        reach = 2 * 12.0 / 200  # blocks that share a sample with the onset
        assert np.abs(read[times < start + delay - reach]).max(initial=0.0) < 1e-8
        assert_array_equal(read[times <= start], 0.0)
        later = times > start + delay + reach
        assert (read[later] > 0.05).all()


def test_a_later_change_does_not_alter_the_past(moving):
    longer = AxisDrive(np.append(moving.times, 11.0), np.append(moving.values, 40.0))
    before = TIMES < 11.0
    a, b = (respond(KELVIN, 0.0, drive, TIMES)[before] for drive in (moving, longer))
    assert_allclose(a, b, rtol=0, atol=1e-6)


def test_whole_blocks_shift_the_response(moving):
    model = single(moving, TIMES, 2, begin=-0.5)
    width, n_skip = model.experiments[0].mesh.grid.step, 12
    later = AxisDrive(moving.times + n_skip * width, moving.values)
    here = respond(KELVIN, 0.3, moving, TIMES, begin=-0.5)
    there = respond(KELVIN, 0.3, later, TIMES, begin=-0.5)
    delayed = respond(KELVIN, 0.3 + n_skip * width, moving, TIMES, begin=-0.5)
    split = round(0.1 / width)
    assert_allclose(there[n_skip // split :], here[: -(n_skip // split)], rtol=0, atol=1e-8)
    assert_allclose(delayed, there, rtol=0, atol=1e-8)
    everything = AxisDrive(moving.times + 100.0, moving.values)
    assert_allclose(respond(KELVIN, 0.3, everything, TIMES + 100.0, begin=99.5), here, rtol=0, atol=1e-8)


def test_response_is_continuous_in_the_delay(moving):
    delays = np.linspace(0.95, 1.05, 401)
    model = single(moving, TIMES, 2)
    batch = np.ones((delays.size, 1))
    read = model.unit_responses(Dynamics((KELVIN[0] * batch,), (KELVIN[1] * batch,), delays[:, None]))[0][0]
    assert np.abs(np.diff(read, axis=0)).max() < 3.0 * np.diff(delays)[0] * np.ptp(moving.values)
    assert np.abs(np.diff(read, axis=0)).max() > 0


def two_axes(share: str, delay: str, rng: np.random.Generator) -> tuple[ForwardModel, Dynamics]:
    """2 x 2 layout, two records of different length, one with a y drive that rests."""
    layout = Layout.of((X, Y), (X, Y), ModelSettings(terms=2, share=share, delay=delay))
    time = 0.1 * np.arange(60)
    drive = np.column_stack([np.where(time >= 0.3, 1.0, 0.2), np.where(time >= 1.7, -0.5, 0.5)])
    records = [
        Record(name, time[:n], values[:n], np.zeros((n, 2)), (X, Y), (X, Y), "ms")
        for name, n, values in (("a", 60, drive), ("b", 45, drive * [1.0, 0.0]))
    ]
    model = forward_model(layout, records, [record.time for record in records])
    batch = 5
    times = tuple(np.exp(rng.normal(0.3, 0.4, (batch, 2))) for _ in layout.elements)
    orders = tuple(
        np.column_stack([rng.uniform(1.2, 1.9, batch), rng.uniform(0.4, 1.0, batch)]) for _ in times
    )
    delays = rng.uniform(
        0.2630, 0.2636, (batch, len(layout.delays))
    )  # no sample on an onset or where levels meet
    return model, Dynamics(times, orders, delays)


@pytest.mark.parametrize("share", ["paper", "all", "none"])
def test_a_drive_that_rests_gives_zeros(share, rng):
    model, dynamics = two_axes(share, "shared", rng)
    moved, rested = model.unit_responses(dynamics)
    for index, unit in enumerate(model.layout.units):
        assert moved[index].any()
        assert rested[index].any() == (unit.drive == 0)
    assert_array_equal(model.experiments[0].rest, [0.2, 0.5])


@pytest.mark.parametrize(("share", "delay"), [("paper", "shared"), ("none", "path")])
def test_a_batch_is_its_members(share, delay, rng):
    model, dynamics = two_axes(share, delay, rng)
    together = model.unit_responses(dynamics)
    for member in range(dynamics.batch):
        alone = model.unit_responses(dynamics[member : member + 1])
        for all_of, one in zip(together, alone, strict=True):
            assert_allclose(all_of[:, member], one[:, 0], rtol=0, atol=1e-9)


def test_a_large_batch_is_its_parts():
    """Batches are evaluated in portions."""
    n = 200
    times, orders = np.geomspace(0.3, 5.0, n)[:, None], np.linspace(0.4, 2.0, n)[:, None]
    delays = np.linspace(0.0, 3.0, n)[:, None]
    model = single(UNIT_STEP, TIMES, 1)
    whole = model.unit_responses(Dynamics((times,), (orders,), delays))[0]
    for k in (0, 7, 8, 111, 199):
        lone = respond(((times[k, 0],), (orders[k, 0],)), delays[k, 0], UNIT_STEP, TIMES)
        assert_allclose(whole[0, k], lone, rtol=0, atol=1e-9)


def test_paths_of_two_axes_are_single_paths(rng):
    model, dynamics = two_axes("none", "path", rng)
    read = model.unit_responses(dynamics)[0]
    experiment = model.experiments[0]
    begin = experiment.drives[0].times[0]
    for index, (element, delay, axis) in enumerate(model.layout.units):
        pair = dynamics.times[element][2], dynamics.orders[element][2]
        times = 0.1 * np.arange(60)
        alone = respond(pair, dynamics.delays[2, delay], experiment.drives[axis], times, begin=begin)
        assert_allclose(read[index, 2], alone, rtol=0, atol=1e-9)


def test_records_on_blocks_of_any_width_are_as_if_each_stood_alone(rng):
    """Step responses of a single plant on blocks of several widths are evaluated together."""
    model, dynamics = two_axes("none", "path", rng)
    plant, drives = dynamics[1:2], model.experiments[0].drives
    experiments = tuple(
        replace(model.experiments[0], mesh=Mesh.of_samples(step * np.arange(count), drives[0].times[0]))
        for step, count in ((0.1, 60), (0.13, 70), (0.02, 300))
    )
    together = ForwardModel(model.layout, experiments)
    widths = {experiment.mesh.lattice.step for experiment in experiments}
    assert len(widths) == len(experiments)
    parts = [ForwardModel(model.layout, (experiment,)) for experiment in experiments]
    for found, part in zip(together.unit_responses(plant), parts, strict=True):
        assert_allclose(found, part.unit_responses(plant)[0], rtol=0, atol=1e-9)
    for (_, slopes), part in zip(together.unit_slopes(plant), parts, strict=True):
        for own, wanted in zip(slopes, part.unit_slopes(plant)[0][1], strict=True):
            assert_allclose(own, wanted, rtol=0, atol=1e-9)


def test_rounded_time_stamps_are_one_clock(rng):
    """A drive that changes in every row costs one phase, and its response is that of the exact clock."""
    time = 0.48828125 * np.arange(300)
    drive = rng.normal(size=(300, 1))
    layout = Layout.of((X,), (X,), ModelSettings(terms=1))
    models = [
        forward_model(layout, [Record("r", at, drive, drive, (X,), (Y,), "ms")], [at])
        for at in (time, np.round(time, 6))
    ]
    assert [len(model.experiments[0].phases[0]) for model in models] == [1, 1]
    dynamics = Dynamics((np.array([[4.0]]),), (np.array([[0.9]]),), np.array([[0.7]]))
    exact, rounded = (model.unit_responses(dynamics)[0] for model in models)
    assert_allclose(rounded, exact, rtol=0, atol=1e-5)


def test_a_change_that_is_not_on_the_clock_stays_where_it_is():
    lattice = Mesh.of_samples(0.1 * np.arange(300), 0.5).lattice
    beside = np.array([0.5, 0.5 + 2e-5, 0.502, 0.55])
    assert_allclose(lattice.aligned(beside), [0.5, 0.5, 0.502, 0.55], rtol=0, atol=1e-12)


# Derivatives


def nudged(dynamics: Dynamics, element: int, kind: str, term: int, by: float) -> Dynamics:
    parts = {"times": [*dynamics.times], "orders": [*dynamics.orders]}
    moved = parts[kind][element].copy()
    moved[:, term] = moved[:, term] * np.exp(by) if kind == "times" else moved[:, term] + by
    parts[kind][element] = moved
    return Dynamics(tuple(parts["times"]), tuple(parts["orders"]), dynamics.delays)


@settings(max_examples=15, deadline=None)
@given(
    share=st.sampled_from(["paper", "all", "none"]),
    delay=st.sampled_from(["shared", "element", "path"]),
    seed=st.integers(0, 1000),
)
def test_every_derivative_agrees_with_differences(share, delay, seed):
    model, dynamics = two_axes(share, delay, np.random.default_rng(seed))
    slopes = model.unit_slopes(dynamics)
    for (value, _), plain in zip(slopes, model.unit_responses(dynamics), strict=True):
        assert_allclose(value, plain, rtol=0, atol=1e-9)
    nudge = 1e-4

    def differences(late: Dynamics, early: Dynamics) -> list[np.ndarray]:
        pairs = zip(model.unit_responses(late), model.unit_responses(early), strict=True)
        return [(a - b) / (2 * nudge) for a, b in pairs]

    for element in range(len(model.layout.elements)):
        for row, (kind, term) in enumerate([("times", 0), ("times", 1), ("orders", 0), ("orders", 1)]):
            found = differences(*(nudged(dynamics, element, kind, term, by) for by in (nudge, -nudge)))
            for difference, (_, parts) in zip(found, slopes, strict=True):
                for index, unit in enumerate(model.layout.units):
                    wanted = (
                        parts[index][row] if unit.element == element else np.zeros_like(difference[index])
                    )
                    assert_allclose(difference[index], wanted, rtol=0, atol=3e-6)
    for slot in range(len(model.layout.delays)):
        moved = []
        for by in (nudge, -nudge):
            delays = dynamics.delays.copy()
            delays[:, slot] += by
            moved.append(replace(dynamics, delays=delays))
        for difference, (_, parts) in zip(differences(*moved), slopes, strict=True):
            for index, unit in enumerate(model.layout.units):
                wanted = parts[index][-1] if unit.delay == slot else np.zeros_like(difference[index])
                assert_allclose(difference[index], wanted, rtol=0, atol=3e-6)


def test_slopes_without_orders_are_the_same_times_and_delays(rng):
    model, dynamics = two_axes("none", "path", rng)
    some = model.unit_slopes(dynamics, in_orders=False)
    for (value, parts), (wanted, every) in zip(some, model.unit_slopes(dynamics), strict=True):
        assert_allclose(value, wanted, rtol=0, atol=1e-12)
        for index, unit in enumerate(model.layout.units):
            assert_allclose(parts[index][[0, 1, -1]], every[index][[0, 1, -1]], rtol=0, atol=1e-12)
            assert np.isnan(parts[index][2:4]).any() == value[index].any(), unit


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("share", ["none", "paper"])
def test_an_axis_that_is_asked_for_alone_responds_as_among_all(rng, share, axis):
    model, dynamics = two_axes(share, "path", rng)
    alone, own = replace(model, axis=axis), set(model.layout.unit_of[axis])
    both = zip(alone.unit_slopes(dynamics), model.unit_slopes(dynamics), strict=True)
    for (value, slopes), (wanted, every) in both:
        for index in range(len(model.layout.units)):
            part = float(index in own)
            assert_allclose(value[index], part * wanted[index], rtol=0, atol=1e-12)
            assert_allclose(slopes[index], part * every[index], rtol=0, atol=1e-12)
    for value, wanted in zip(alone.unit_responses(dynamics), model.unit_responses(dynamics), strict=True):
        for index in range(len(model.layout.units)):
            assert_allclose(value[index], float(index in own) * wanted[index], rtol=0, atol=1e-12)


def test_slopes_of_a_resting_drive_are_zero(rng):
    model, dynamics = two_axes("paper", "shared", rng)
    value, parts = model.unit_slopes(dynamics)[1]
    for index, unit in enumerate(model.layout.units):
        assert parts[index].shape == (5, dynamics.batch, 45)
        assert parts[index].any() == value[index].any() == (unit.drive == 0)


def test_proportional_drives_are_simulated_once_and_all_the_same():
    """Steps of several heights and signs, and one record that differs: as if each stood alone."""
    heights = (1.5, -0.75, 0.3)
    times = 0.1 * np.arange(1, 120)
    steps = [AxisDrive(np.array([0.0, 4.0]), height * np.array([1.0, 0.5])) for height in heights]
    other = AxisDrive(np.array([0.0, 4.0]), np.array([1.0, 0.6]))
    mesh = Mesh.of_samples(times, 0.0)
    layout = Layout.of([Axis("x", "rad")], [Axis("x", "rad")], ModelSettings(terms=2))
    experiments = tuple(Experiment("", mesh, (drive,), np.zeros(1)) for drive in (*steps, other))
    dynamics = Dynamics(
        (np.array([[1.3, 0.4], [2.0, 1.0]]),), (np.array([[1.6, 0.7], [1.2, 0.9]]),), np.full((2, 1), 0.3)
    )
    together = ForwardModel(layout, experiments).unit_responses(dynamics)
    for experiment, found in zip(experiments, together, strict=True):
        alone = ForwardModel(layout, (experiment,)).unit_responses(dynamics)[0]
        assert_allclose(found, alone, rtol=0, atol=1e-10)
    assert steps[1].over(steps[0]) == -0.5
    assert other.over(steps[0]) is None
    assert AxisDrive(np.array([0.0, 5.0]), steps[0].values).over(steps[0]) is None


@pytest.mark.parametrize("uneven", [False, True])
def test_a_path_alone_responds_as_among_the_others(uneven, rng):
    """Also where its drive moves long after another one, and whatever the delay."""
    time = 0.2 * np.arange(300) + (0.05 * rng.random(300) if uneven else 0.0)
    first, second = (
        np.where(time > 4, 1.0, 0.3),
        np.where(time > 31, 0.5, 0.0) + np.where(time > 40, 0.5, 0.0),
    )
    drives = (Axis("u", "V"), Axis("v", "V"))
    record = Record("r", time, np.stack([first, second], axis=1), np.zeros((300, 2)), drives, (X, Y), "s")
    whole = forward_model(
        Layout.of(drives, (X, Y), ModelSettings(share="all", delay="path")), [record], [time]
    )
    delays, lag = np.array([0.0, 0.33, 2.4, 11.0]), np.full((4, 1), 1.7)
    found = whole.unit_responses(Dynamics((lag,), (np.ones((4, 1)),), np.tile(delays[:, None], 4)))[0]
    for response in range(2):
        for drive in range(2):
            path = whole.path(response, drive)
            (alone,) = path.unit_responses(Dynamics((lag,), (np.ones((4, 1)),), delays[:, None]))
            assert_allclose(alone[0], found[whole.layout.unit_of[response][drive]], rtol=0, atol=1e-9)
            assert path.experiments[0].rest == record.drive[0, drive]
    closed = -0.7 * np.expm1(-np.maximum(time - time[np.argmax(first > 0.5)] - delays[:, None], 0.0) / 1.7)
    assert_allclose(found[whole.layout.unit_of[1][0]], closed, rtol=0, atol=2e-4)


# What other commands share


@pytest.mark.parametrize("exposure", [0.0, 0.3])
def test_commands_of_other_heights_and_times_share_what_was_read(exposure):
    """Responses with the step responses of earlier commands are those without, to rounding."""
    times = 0.25 * np.arange(1, 81)
    dynamics = Dynamics((np.array([KELVIN[0]]),), (np.array([KELVIN[1]]),), np.array([[0.4]]))
    known = {}
    drives = [
        AxisDrive(np.array([0.0, 3.1, 9.27]), np.array(heights) * sign)
        for sign in (1.0, -2.0)
        for heights in ([1.0, -0.5, 0.25], [2.0, 1.0, -1.0])
    ]
    drives.append(AxisDrive(np.array([0.0, 3.100001, 9.27]), np.array([1.0, -0.5, 0.25])))
    for drive in drives:
        model = single(drive, times, 2, exposure=exposure)
        shared = model.unit_responses(dynamics, known)[0]
        assert_allclose(shared, model.unit_responses(dynamics)[0], rtol=0, atol=1e-14)
    (response,) = known.values()
    assert len(response.readings) == 4  # of three changes, and of one that is later by a millionth


def test_readings_are_not_kept_of_many_plants():
    times = 0.25 * np.arange(1, 81)
    pair = Dynamics((np.array([KELVIN[0]] * 2),), (np.array([KELVIN[1]] * 2),), np.array([[0.4], [0.9]]))
    model, known = single(UNIT_STEP, times, 2), {}
    apart = [model.unit_responses(pair[slice(k, k + 1)])[0] for k in range(2)]
    assert_allclose(model.unit_responses(pair, known)[0], np.concatenate(apart, axis=1), rtol=0, atol=1e-14)
    assert not any(response.readings for response in known.values())
