"""Drives: exact block means of one axis under a delay, drives that nobody has measured, what is refused."""

from __future__ import annotations

import pickle

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.drive import AxisDrive, Drive, drive_of
from lcopa_bayes.data.record import Axis, load_columns

X, Y = Axis("x", "rad"), Axis("y", "rad")
EDGES = 0.5 * np.arange(21)
drives = st.builds(
    lambda gaps, seed: AxisDrive(np.cumsum(gaps) - 1.0, np.random.default_rng(seed).normal(size=len(gaps))),
    st.lists(st.floats(0.01, 3.0), min_size=1, max_size=8),
    st.integers(0, 1000),
)


def area_before(drive: AxisDrive, time: np.ndarray, delay: float) -> np.ndarray:
    """Integral of the delayed drive up to `time`, change by change."""
    jumps = np.diff(drive.values, prepend=0.0)
    return np.sum(jumps * np.maximum(time[:, None] - delay - drive.times, 0.0), axis=1)


@settings(max_examples=100, deadline=None)
@given(drive=drives, delay=st.floats(0.0, 12.0))
def test_means_are_exact_areas(drive, delay):
    means, _ = drive.block_means(EDGES, np.array([delay]))
    assert_allclose(means[0], np.diff(area_before(drive, EDGES, delay)) / 0.5, rtol=0, atol=1e-12)


def test_a_change_inside_a_block_counts_for_the_rest_of_it():
    drive = AxisDrive(np.array([1.2]), np.array([4.0]))
    means, slope = drive.block_means(EDGES[:5], np.array([0.0, 0.1, 0.9]))
    assert_allclose(means, [[0, 0, 2.4, 4], [0, 0, 1.6, 4], [0, 0, 0, 0]], atol=1e-14)
    assert_allclose(slope, [[0, 0, -8, 0], [0, 0, -8, 0], [0, 0, 0, 0]], atol=1e-14)
    # delayed by 0.9 the change is at 2.1, after the last edge
    late, _ = AxisDrive(np.array([1.2]), np.array([4.0])).block_means(EDGES[:6], np.array([0.9]))
    assert late[0, -1] == pytest.approx(4.0 * 0.8)


def test_a_change_on_an_edge_has_the_slope_of_shorter_delays():
    drive = AxisDrive(np.array([1.0]), np.array([1.0]))
    _, slope = drive.block_means(EDGES[:6], np.array([0.5]))
    shorter, at = (drive.block_means(EDGES[:6], np.array([delay]))[0] for delay in (0.5 - 1e-6, 0.5))
    assert_allclose(slope, (at - shorter) / 1e-6, atol=1e-6)
    assert_array_equal(slope, [[0, 0, -2, 0, 0]])


@settings(max_examples=100, deadline=None)
@given(drive=drives, delay=st.floats(0.0, 8.0))
def test_slope_in_the_delay_agrees_with_differences(drive, delay):
    nudge = 1e-6
    late = EDGES[:, None] - delay - drive.times
    delay += 3 * nudge if np.abs(late).min() < 2 * nudge else 0.0  # the slope jumps at an edge
    _, slope = drive.block_means(EDGES, np.array([delay]))
    (more, less), _ = drive.block_means(EDGES, np.array([delay + nudge, delay - nudge]))
    near = np.abs(EDGES[:, None] - delay - drive.times).min(axis=1) < 2 * nudge
    smooth = ~(near[1:] | near[:-1])
    assert_allclose(slope[0][smooth], ((more - less) / (2 * nudge))[smooth], rtol=0, atol=1e-7)


@settings(max_examples=60, deadline=None)
@given(drive=drives, delay=st.floats(0.0, 8.0))
def test_means_are_continuous_in_the_delay(drive, delay):
    (here, there), _ = drive.block_means(EDGES, np.array([delay, delay + 1e-7]))
    steepest = np.abs(np.diff(drive.values, prepend=0.0)).sum() / 0.5
    assert np.abs(here - there).max() <= 1.01e-7 * steepest


def test_rows_hold_from_their_instant_and_rest_is_the_first():
    time, rows = np.array([0.0, 1.0, 2.0, 2.5, 4.0]), np.array([3.0, 3.0, 5.0, 5.0, 2.0])
    drive = AxisDrive.of_rows(time, rows)
    assert_array_equal(drive.times, [2.0, 4.0])
    assert_array_equal(drive.values, [2.0, -1.0])
    assert drive.moves


def test_a_still_drive_has_means_of_zero():
    drive = AxisDrive.of_rows(np.arange(3.0), np.full(3, 7.0))
    assert not drive.moves
    means, slope = drive.block_means(EDGES, np.array([0.0, 1.0]))
    assert means.shape == (2, 20)
    assert not means.any()
    assert not slope.any()


@pytest.mark.parametrize(
    ("times", "values", "why"),
    [
        ([0.0, np.nan], [1.0, 2.0], "finite"),
        ([0.0], [np.inf], "finite"),
    ],
)
def test_impossible_drives_are_refused(times, values, why):
    with pytest.raises(ValueError, match=why):
        AxisDrive(np.array(times), np.array(values))


def test_arrays_are_locked():
    drive = AxisDrive(np.zeros(1), np.ones(1))
    with pytest.raises(ValueError, match="read-only"):
        drive.values[0] = 2.0


def test_steps_of_two_axes_hold_until_the_next_and_rest_before_the_first():
    drive = Drive.steps(x=[(0, 1.57), (20, 0.0)], y=[(5, 0.3)])
    fitted = drive.fitted_to([Y, X], "ms", [0.1, 0.0], 0.5)
    assert_array_equal(fitted.time, [-0.5, 0, 5, 20])
    assert_array_equal(fitted.drive, [[0.1, 0], [0.1, 1.57], [0.3, 1.57], [0.3, 0]])
    assert (fitted.axes, fitted.units, fitted.rest) == (("y", "x"), ("rad", "rad"), (0.1, 0.0))
    assert fitted.until is None


def test_axes_that_are_not_named_stay_at_rest_and_a_stated_rest_holds():
    fitted = Drive.steps(x=[(1, 2.0)], rest={"x": 0.5}).fitted_to([X, Y], "ms", [0.0, 0.7], 1.0)
    assert_array_equal(fitted.drive, [[0.5, 0.7], [2.0, 0.7]])


def test_times_are_converted_and_axes_of_any_name_can_be_given():
    drive = Drive.steps({"until": [(0.001, 2.0)]}, units="V", time_unit="s", until=0.004)
    fitted = drive.fitted_to([Axis("until", "V")], "ms", [0.0], 0.5)
    np.testing.assert_allclose(fitted.time, [0.5, 1.0])
    assert fitted.until == pytest.approx(4.0)


def test_arrays_and_files_rest_under_their_first_row(tmp_path):
    time, x = np.array([0.0, 1.0, 2.5]), np.array([0.2, 0.9, 0.4])
    prepared = Drive.of_arrays(time, x=x, units={"x": "rad"}, time_unit="ms", name="plan")
    frame = pd.DataFrame({"time_ms": time, "drive_x_rad": x})
    frame.to_csv(tmp_path / "plan.csv", index=False)
    frame.to_parquet(tmp_path / "plan.parquet", index=False)
    files = [load_columns(tmp_path / f"plan.{kind}", responses=False) for kind in ("csv", "parquet")]
    for drive in (prepared, *map(drive_of, files)):
        fitted = drive.fitted_to([X], "ms", [0.0], 0.5)
        assert_array_equal(fitted.time, time)
        assert_array_equal(fitted.drive[:, 0], x)
        assert (fitted.rest, fitted.until, fitted.name) == ((0.2,), 2.5, "plan")


def test_a_copy_for_another_process_is_the_same_and_locked():
    drive = pickle.loads(pickle.dumps(Drive.steps(x=[(0, 1.0)], until=3.0)))
    assert (drive.until, drive.partial) == (3.0, True)
    with pytest.raises(ValueError, match="read-only"):
        drive.time[0] = 1.0


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Drive.steps(), ["names no axis"]),
        (lambda: Drive.steps(x=[]), ["no (time, value)"]),
        (lambda: Drive.steps(x=[(0, 1, 2)]), ["pairs"]),
        (lambda: Drive.steps(x=[(0, "high")]), ["pairs of numbers"]),
        (lambda: Drive.steps(x=[(1, 1.0), (1, 0.0)]), ["must increase"]),
        (lambda: Drive.steps(x=[(0, np.nan)]), ["finite"]),
        (lambda: Drive.steps(x=[(0, 1.0)], until=-1.0), ["until"]),
        (lambda: Drive.steps(x=[(0, 1.0)], rest={"z": 0.0}, units={"w": "rad"}), ["'z'", "'w'"]),
        (lambda: Drive.steps(x=[(0, 1.0)], time_unit="day"), ["time unit 'day'"]),
        (lambda: Drive.steps(x=[(0, 1.0)], rest={"x": np.inf}), ["finite resting value"]),
        (lambda: Drive.of_arrays([0, 2, 1], x=[0, 0, 1]), ["1 comes after 2"]),
        (lambda: Drive.of_arrays([0, 1], x=[0, np.nan]), ["finite"]),
        (lambda: Drive.of_arrays([0, 1], x=[0, 1, 2]), ["one column per axis"]),
        (lambda: Drive.of_arrays([0, 1], x=[0, 1], y=[0, 1, 2]), ["one number per time"]),
        (lambda: Drive.of_arrays([], x=[]), ["one or more times"]),
    ],
)
def test_what_is_no_drive_is_refused_in_words(make, words):
    with pytest.raises(InputError) as raised:
        make()
    assert all(any(word in problem for problem in raised.value.problems) for word in words)


def test_axes_and_units_of_another_plant_are_refused_together():
    drive = Drive.of_arrays([0, 1], x=[0, 1], w=[0, 1], units={"x": "V"})
    with pytest.raises(InputError) as raised:
        drive.fitted_to([X, Y], "ms", [0.0, 0.0], 1.0)
    known = " ".join(raised.value.problems)
    for words in ("no drive axis 'w'", "axis 'x' is in V, in the study it is in rad", "'y' [rad]"):
        assert words in known
    assert len(raised.value.problems) == 3


def test_a_bad_file_is_reported_with_its_place(tmp_path):
    path = tmp_path / "plan.csv"
    path.write_text("time_ms,drive_x_rad\n0,0\n2,1\n1,high\n")
    with pytest.raises(InputError) as raised:
        drive_of(load_columns(path, responses=False))
    known = " ".join(raised.value.problems)
    assert "line 4, column 'time_ms': 1.0 does not come after" in known
    assert "line 4, column 'drive_x_rad': 'high' is not a finite number" in known
    path.write_text("time_ms,response_x_rad\n0,0\n2,1\n")
    with pytest.raises(InputError, match="has no drive column"):
        drive_of(load_columns(path, responses=False))
