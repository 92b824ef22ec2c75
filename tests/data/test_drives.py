"""Drives that nobody has measured: what they hold, and what is refused."""

from __future__ import annotations

import pickle

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_array_equal

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.drives import Drive, load_drive
from lcopa_bayes.data.record import Axis

X, Y = Axis("x", "rad"), Axis("y", "rad")


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
    for drive in (prepared, load_drive(tmp_path / "plan.csv"), load_drive(tmp_path / "plan.parquet")):
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
        (lambda: Drive.steps(x=[(0, 1.0)], time_unit="min"), ["time unit 'min'"]),
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


def test_a_bad_file_is_told_with_its_place(tmp_path):
    path = tmp_path / "plan.csv"
    path.write_text("time_ms,drive_x_rad\n0,0\n2,1\n1,high\n")
    with pytest.raises(InputError) as raised:
        load_drive(path)
    known = " ".join(raised.value.problems)
    assert "line 4, column 'time_ms': 1.0 does not come after" in known
    assert "line 4, column 'drive_x_rad': 'high' is not a finite number" in known
    path.write_text("time_ms,response_x_rad\n0,0\n2,1\n")
    with pytest.raises(InputError, match="has no drive column"):
        load_drive(path)
