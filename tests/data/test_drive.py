"""Block means of a delayed drive: exact areas, exact slopes, and what they do at edges."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from lcopa_bayes.data.drive import Drive

EDGES = 0.5 * np.arange(21)
drives = st.builds(
    lambda gaps, seed: Drive(np.cumsum(gaps) - 1.0, np.random.default_rng(seed).normal(size=len(gaps))),
    st.lists(st.floats(0.01, 3.0), min_size=1, max_size=8),
    st.integers(0, 1000),
)


def area_before(drive: Drive, time: np.ndarray, delay: float) -> np.ndarray:
    """Integral of the delayed drive up to `time`, change by change."""
    jumps = np.diff(drive.values, prepend=0.0)
    return np.sum(jumps * np.maximum(time[:, None] - delay - drive.times, 0.0), axis=1)


@settings(max_examples=100, deadline=None)
@given(drive=drives, delay=st.floats(0.0, 12.0))
def test_means_are_exact_areas(drive, delay):
    means, _ = drive.block_means(EDGES, np.array([delay]))
    assert_allclose(means[0], np.diff(area_before(drive, EDGES, delay)) / 0.5, rtol=0, atol=1e-12)


def test_a_change_inside_a_block_counts_for_the_rest_of_it():
    means, slope = Drive(np.array([1.2]), np.array([4.0])).block_means(EDGES[:5], np.array([0.0, 0.1, 0.9]))
    assert_allclose(means, [[0, 0, 2.4, 4], [0, 0, 1.6, 4], [0, 0, 0, 0]], atol=1e-14)
    assert_allclose(slope, [[0, 0, -8, 0], [0, 0, -8, 0], [0, 0, 0, 0]], atol=1e-14)
    # delayed by 0.9 the change is at 2.1, after the last edge
    late, _ = Drive(np.array([1.2]), np.array([4.0])).block_means(EDGES[:6], np.array([0.9]))
    assert late[0, -1] == pytest.approx(4.0 * 0.8)


def test_a_change_on_an_edge_has_the_slope_of_shorter_delays():
    drive = Drive(np.array([1.0]), np.array([1.0]))
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
    drive = Drive.of_rows(time, rows)
    assert_array_equal(drive.times, [2.0, 4.0])
    assert_array_equal(drive.values, [2.0, -1.0])
    assert drive.moves


def test_a_still_drive_has_means_of_zero():
    drive = Drive.of_rows(np.arange(3.0), np.full(3, 7.0))
    assert not drive.moves
    means, slope = drive.block_means(EDGES, np.array([0.0, 1.0]))
    assert means.shape == (2, 20)
    assert not means.any()
    assert not slope.any()


@pytest.mark.parametrize(
    ("times", "values", "why"),
    [
        ([0.0, 1.0], [1.0], "one value per change"),
        ([1.0, 1.0], [1.0, 2.0], "must increase"),
        ([0.0, np.nan], [1.0, 2.0], "finite"),
        ([0.0], [np.inf], "finite"),
    ],
)
def test_impossible_drives_are_refused(times, values, why):
    with pytest.raises(ValueError, match=why):
        Drive(np.array(times), np.array(values))


def test_arrays_are_locked():
    drive = Drive(np.zeros(1), np.ones(1))
    with pytest.raises(ValueError, match="read-only"):
        drive.values[0] = 2.0
