"""Step responses from their onset on, and their superposition, against Laplace inversions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from lcopa_bayes.bench.inversion import unit_ramp, unit_step
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.data.record import Axis
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.model.blockpulses import Circle
from lcopa_bayes.model.forward import Dynamics, Experiment, ForwardModel
from lcopa_bayes.model.grid import Mesh
from lcopa_bayes.model.layout import Layout
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.model.stepresponse import Slopes, StepResponse, step_response, taps
from lcopa_bayes.model.superposition import phases

STEP, BLOCKS = 0.1, 160
ELEMENTS = [
    ((3.4,), (0.6,)),
    ((3.4,), (0.9,)),
    ((3.4,), (1.2,)),
    ((3.4,), (1.8,)),
    ((3.0, 1.6), (1.0, 0.7)),
    ((3.0, 1.0), (1.6, 0.7)),
]
Element = tuple[tuple[float, ...], tuple[float, ...]]


def exact(element: Element, time: np.ndarray, integral: bool = False) -> np.ndarray:
    """Zero up to the onset."""
    etas = tuple(time**order for time, order in zip(*element, strict=True))
    path = TransferPath(1.0, 0.0, etas, element[1], 1.0)
    return (unit_ramp if integral else unit_step)(path, time)


def solved(element: Element, *, step: float = STEP, slopes: Slopes = None) -> StepResponse:
    times, orders = (np.array([part]) for part in element)
    return step_response(times, orders, Circle(round(BLOCKS * STEP / step)), step, slopes=slopes)


@pytest.mark.parametrize("theta", [0.0, 0.3, 0.999])
def test_reading_is_exact_for_quartics(theta):
    """Five block means fix a polynomial of degree four."""
    edges = np.arange(-2.0, 4.0)
    for power in range(5):
        means = np.diff(edges ** (power + 1)) / (power + 1)
        at = np.array([theta])
        assert_allclose(means @ taps(at, "value")[:, 0], theta**power, atol=1e-12)
        assert_allclose(means @ taps(at, "integral")[:, 0], theta ** (power + 1) / (power + 1), atol=1e-12)
        slope = power * theta ** (power - 1) if power else 0.0
        assert_allclose(means @ taps(at, "slope")[:, 0], slope, atol=1e-12)


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("theta", [1e-3, 0.01, 0.03, 0.1, 0.5, 0.97])
def test_the_onset_is_read_as_it_is(element, theta):
    """Wherever the first sample falls after it: within 2e-4 of the step, a tenth of a noise of 0.2 %."""
    read = solved(element).on_lattice(np.array([[theta]]))[0, 0, 0]
    time = STEP * (np.arange(read.size) + theta)
    assert np.abs(read - exact(element, time))[:12].max() < (2e-4 if element[1][0] < 0.7 else 5e-5)


@pytest.mark.parametrize("element", ELEMENTS)
def test_the_integral_is_that_of_the_bench(element):
    response = solved(element)
    for theta in (0.02, 0.6):
        read = response.on_lattice(np.array([[theta]]), "integral")[0, 0, 0] * STEP
        time = STEP * (np.arange(read.size) + theta)
        assert np.abs(read - exact(element, time, integral=True)).max() < 4e-4


@pytest.mark.parametrize("element", ELEMENTS)
def test_errors_fall_with_the_third_or_fourth_power_of_the_width(element):
    time = np.arange(0.37, 15.0, 0.5)
    first, last = (
        np.linalg.norm(solved(element, step=step).at(time[None] / step)[0, 0] - exact(element, time))
        for step in (0.4, 0.05)
    )
    slope = np.log2(first / last) / 3  # right after the onset the place of a sample in its block matters too
    assert (1.9 if element[1][0] < 0.7 else 2.9) < slope < 4.1
    assert last < 5e-7


@settings(max_examples=25, deadline=None)
@given(
    theta=st.floats(0.0, 0.999),
    element=st.sampled_from(ELEMENTS),
    slopes=st.sampled_from([None, "times", "all"]),
)
def test_both_readings_agree(theta, element, slopes):
    response = solved(element, slopes=slopes)
    for kind in ("value", "integral", "slope"):
        lattice = response.on_lattice(np.array([[theta]]), kind)[:, 0]
        x = np.arange(lattice.shape[2])[None] + theta
        assert_allclose(response.at(x, kind), lattice, rtol=1e-12, atol=1e-12)


def test_nothing_before_the_onset():
    response = solved(ELEMENTS[0])
    x = np.array([[-7.3, -0.2, 0.0, 1e-6]])
    for kind in ("value", "integral", "slope"):
        assert not response.at(x, kind)[0, 0, :3].any()
        assert response.at(x, kind)[0, 0, 3] > 0


@pytest.mark.parametrize("element", ELEMENTS)
def test_slopes_are_differences_also_right_after_the_onset(element):
    times, orders = np.array([element[0]]), np.array([element[1]])
    x = np.array([[0.004, 0.02, 0.1, 0.7, 1.6, 5.3, 9.2, 60.3]])
    rows = solved(element, slopes="all").at(x)
    nudge = 1e-5

    def at(t: np.ndarray, o: np.ndarray) -> np.ndarray:
        return step_response(t, o, Circle(BLOCKS), STEP).at(x)[0, 0]

    terms = times.shape[1]
    for k in range(terms):
        by = nudge * np.eye(terms)[k]
        longer, shorter = at(times * np.exp(by), orders), at(times * np.exp(-by), orders)
        assert_allclose(rows[1 + k, 0], (longer - shorter) / (2 * nudge), atol=2e-7)
        higher, lower = at(times, orders + by), at(times, orders - by)
        assert_allclose(rows[1 + terms + k, 0], (higher - lower) / (2 * nudge), atol=2e-7)
    response = solved(element)
    slope = (response.at(x + nudge)[0, 0] - response.at(x - nudge)[0, 0]) / (2 * nudge)
    assert_allclose(response.at(x, "slope")[0, 0], slope, rtol=2e-4, atol=1e-7)


# Superposition


def respond(drive: AxisDrive, times: np.ndarray, delay: float, *, exposure: float = 0.0) -> np.ndarray:
    axis = Axis("x", "rad")
    layout = Layout.of((axis,), (axis,), ModelSettings(terms=1))
    mesh = Mesh.of_samples(times, float(drive.times[0]), exposure=exposure)
    model = ForwardModel(layout, (Experiment("one", mesh, (drive,), np.zeros(1)),))
    element = Dynamics((np.array([[3.4]]),), (np.array([[0.9]]),), np.array([[delay]]))
    return model.unit_responses(element)[0][0, 0]


def superposed(drive: AxisDrive, times: np.ndarray, delay: float, exposure: float = 0.0) -> np.ndarray:
    total = np.zeros(times.size)
    for change, jump in zip(drive.times, np.diff(drive.values, prepend=0.0), strict=True):
        late = times - change - delay
        if exposure == 0.0:
            total += jump * exact(ELEMENTS[1], late)
        else:
            areas = exact(ELEMENTS[1], late, True) - exact(ELEMENTS[1], late - exposure, True)
            total += jump * areas / exposure
    return total


@pytest.mark.parametrize("irregular", [False, True])
@pytest.mark.parametrize("exposure", [0.0, 0.15])
@pytest.mark.parametrize("changes", ["lattice", "few", "binary", "many phases", "dense"])
def test_superposition_is_that_of_the_bench(irregular, exposure, changes, rng):
    """Changes on the samples and anywhere between them, few and many, sampled evenly or not."""
    times = 0.2 * np.arange(1, 126)
    if irregular:
        times = np.sort(times + rng.uniform(-0.07, 0.07, times.size))
    at = {
        "lattice": np.array([0.0, 4.0, 8.2]),
        "few": np.array([0.03, 4.11, 8.27]),
        "binary": 0.2 * np.cumsum(rng.integers(1, 5, 40)),
        "many phases": np.cumsum(rng.uniform(0.1, 1.0, 20)),
        "dense": np.cumsum(rng.uniform(0.05, 0.3, 90)),
    }[changes]
    drive = AxisDrive(at, rng.normal(size=at.size))
    off = respond(drive, times, 1.0, exposure=exposure) - superposed(drive, times, 1.0, exposure)
    exactly = changes in ("lattice", "few", "many phases") or not irregular
    assert np.abs(off).max() < (4e-4 if exactly else 0.02) * np.abs(drive.values).max()


def test_phases_hold_every_change(rng):
    for size in (1, 5, 20, 200):
        drive = AxisDrive(np.cumsum(rng.uniform(0.1, 1.0, size)), rng.normal(size=size))
        parts = phases(drive, 0.05)
        jumps = np.concatenate([part.jumps for part in parts])
        when = np.concatenate([part.time + 0.05 * part.blocks for part in parts])
        assert jumps.sum() == pytest.approx(drive.values[-1])
        centre = np.diff(drive.values, prepend=0.0) @ drive.times
        assert jumps @ when == pytest.approx(centre, abs=1e-9)
        assert all((np.diff(part.blocks) > 0).all() for part in parts)


@pytest.mark.parametrize("irregular", [False, True])
def test_small_changes_added_to_a_drive_leave_the_rest_as_it_is(irregular, rng):
    """Of 20 changes and 20 of a millionth of their size, read at samples of any spacing, not all are kept
    apart; the response is linear."""
    times, at = np.arange(0.0, 20.0, 0.1), np.cumsum(rng.uniform(0.3, 0.9, 20))
    if irregular:
        times[1:-1] += rng.uniform(-0.03, 0.03, times.size - 2)
    jumps, small = rng.choice([-1.0, 1.0], 20), 1e-6 * rng.normal(size=20)
    late = at + 0.1234 + rng.uniform(0.0, 0.2, 20)
    both = AxisDrive.of_jumps(np.concatenate((at, late)), np.concatenate((jumps, small)))
    added = respond(both, times, 1.0) - respond(AxisDrive.of_jumps(at, jumps), times, 1.0)
    assert added == pytest.approx(superposed(AxisDrive.of_jumps(late, small), times, 1.0), abs=2e-8)
