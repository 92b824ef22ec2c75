"""Blocks for a record and the reading of its samples, against functions whose block means are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from lcopa_bayes.model.grid import FEWEST_BLOCKS, MOST_BLOCKS, Grid, Mesh

RATE = 0.9


def response(time: np.ndarray) -> np.ndarray:
    """Smooth, at rest up to time 0."""
    return 1 - np.cos(RATE * np.maximum(time, 0.0))


def area(time: np.ndarray) -> np.ndarray:
    late = np.maximum(time, 0.0)
    return late - np.sin(RATE * late) / RATE


def means(grid: Grid) -> np.ndarray:
    return np.diff(area(grid.edges))[None] / grid.step


def error(mesh: Mesh, times: np.ndarray, exposure: float = 0.0) -> float:
    exact = response(times) if exposure == 0 else (area(times) - area(times - exposure)) / exposure
    exact = np.where(times <= 0, 0.0, exact)
    return float(np.abs(mesh.reading(means(mesh.grid))[0] - exact).max())


def order_of(errors: list[float]) -> float:
    return float(-np.polyfit(np.arange(len(errors)), np.log2(errors), 1)[0])


@pytest.mark.parametrize("begin", [0.0, 0.037, -0.21])
@pytest.mark.parametrize("period", [0.1, 1 / 3])
def test_equidistant_samples_sit_at_midpoints(begin, period):
    times = period * np.arange(1, 301)
    mesh = Mesh.of_samples(times, begin)
    assert mesh.reading.matrix is None
    assert mesh.grid.step == pytest.approx(period, rel=1e-12)
    midpoints = (mesh.grid.edges[:-1] + mesh.grid.step / 2)[mesh.reading.blocks]
    assert_allclose(midpoints, times, rtol=0, atol=1e-10)
    first = mesh.grid.start + mesh.grid.step  # one spare block stands before the one that holds `begin`
    assert first <= begin < first + 1.001 * mesh.grid.step


@pytest.mark.parametrize("blocks", [None, 100, 1000, 1001])
def test_blocks_are_at_least_as_many_as_asked(blocks):
    times = 0.5 * np.arange(1, 51)
    mesh = Mesh.of_samples(times, 0.0, blocks=blocks)
    asked = blocks or FEWEST_BLOCKS
    assert asked <= mesh.grid.n - 2 <= asked + 51
    assert mesh.reading.matrix is None
    assert error(mesh, times) < 1.05 * RATE**4 * mesh.grid.step**4 * 9 / 1920


@pytest.mark.parametrize("exposure", [0.0, 0.2])
@pytest.mark.parametrize("blocks", [60, 400])
def test_irregular_samples_use_exactly_the_blocks_asked(exposure, blocks):
    times = np.sort(np.random.default_rng(3).uniform(0, 10, 80))
    mesh = Mesh.of_samples(times, 0.0, blocks=blocks, exposure=exposure)
    assert mesh.grid.n == blocks + 2
    assert mesh.grid.step == pytest.approx(times[-1] / blocks)


def test_rounded_time_stamps_are_equidistant_and_jittered_ones_are_not(rng):
    times = np.round(0.1 * np.arange(1, 5001), 6)
    assert Mesh.of_samples(times + rng.normal(0, 1e-7, times.size), 0.0).reading.matrix is None
    assert Mesh.of_samples(times + rng.uniform(-1e-3, 1e-3, times.size), 0.0).reading.matrix is not None
    few = times[:10] + 2e-3 * (np.arange(10) % 2)
    assert Mesh.of_samples(few, 0.0).reading.matrix is not None


def test_a_lattice_with_gaps_is_read_at_midpoints():
    times = np.delete(0.1 * np.arange(1, 251), [3, 4, 5, 17, 100, 248])
    mesh = Mesh.of_samples(times, 0.0)
    assert mesh.reading.matrix is not None
    assert mesh.grid.step == pytest.approx(0.1, rel=1e-10)
    assert_allclose(mesh.reading.matrix @ (mesh.grid.edges[:-1] + 0.05), times, atol=1e-10)
    full = Mesh.of_samples(0.1 * np.arange(1, 251), 0.0)
    both = [m.reading(means(m.grid))[0] for m in (mesh, full)]
    assert_allclose(both[0], np.delete(both[1], [3, 4, 5, 17, 100, 248]), rtol=0, atol=1e-12)


@pytest.mark.parametrize("exposure", [0.0, 0.1])
def test_samples_up_to_the_first_change_are_exactly_at_rest(exposure):
    times = 0.1 * np.arange(-20, 60)
    for at in (times, np.sort(times + np.random.default_rng(1).uniform(0, 0.05, times.size))):
        mesh = Mesh.of_samples(at, 0.0, exposure=exposure)
        read = mesh.reading(np.ones((2, mesh.grid.n)))
        assert_array_equal(read[:, at <= 0], 0.0)
        assert read[:, at > 0].min() > 0
        assert read.shape == (2, at.size)


def test_aligned_reading_is_fourth_order():
    times = 0.5 * np.arange(1, 41)
    errors = [error(Mesh.of_samples(times, 0.0, blocks=b), times) for b in (200, 400, 800, 1600)]
    assert 3.9 < order_of(errors) < 4.1


def test_cubic_reading_is_third_order():
    times = np.sort(np.random.default_rng(5).uniform(1.0, 20.0, 400))
    errors = [error(Mesh.of_samples(times, -1.0, blocks=b), times) for b in (100, 200, 400, 800)]
    assert 2.7 < order_of(errors) < 3.4
    assert errors[-1] < 1.6e-6  # samples in the middle of their four edges; off it three times as much


@pytest.mark.parametrize("exposure", [1e-3, 0.04, 0.3, 2.0, 15.0])
def test_exposure_is_at_least_third_order(exposure):
    """Also for an exposure far shorter than a block."""
    times = np.sort(np.random.default_rng(6).uniform(exposure + 1.0, exposure + 20.0, 400))
    meshes = [
        Mesh.of_samples(times, -1.0, blocks=blocks, exposure=exposure) for blocks in (100, 200, 400, 800)
    ]
    errors = [error(mesh, times, exposure) for mesh in meshes]
    assert 2.7 < order_of(errors) < 4.4
    assert errors[-1] < 1e-4


@pytest.mark.parametrize("exposure", [0.07, 0.3, 1.0])
def test_exposure_takes_rest_before_the_record(exposure):
    """A constant after time 0: the mean is the part of the exposure after it, in every block cut."""
    times = np.linspace(0.01, 3.0, 57)
    mesh = Mesh.of_samples(times, 0.0, blocks=41, exposure=exposure)
    read = mesh.reading(np.ones((1, mesh.grid.n)))[0]
    assert_allclose(read, np.minimum(times / exposure, 1.0), rtol=0, atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(
    gaps=st.lists(st.floats(1e-3, 2.0), min_size=2, max_size=30),
    begin=st.floats(-1.0, 5.0),
    exposure=st.sampled_from([0.0, 0.01, 0.4]),
)
def test_a_parabola_of_area_is_read_exactly(gaps, begin, exposure):
    """Whatever the samples: rows of weights sum to one and a straight line is read without error."""
    times = np.cumsum(gaps)
    mesh = Mesh.of_samples(times, begin, exposure=exposure)
    late = times > max(begin, mesh.grid.start + exposure)
    middle = (mesh.grid.edges[:-1] + mesh.grid.edges[1:])[None] / 2
    assert_allclose(mesh.reading(np.ones_like(middle))[0][late], 1.0, rtol=0, atol=1e-10)
    assert_allclose(
        mesh.reading(middle)[0][late], (times - exposure / 2)[late], rtol=0, atol=2e-3 * min(gaps)
    )
    assert mesh.grid.edges[-1] >= times[-1] - 1e-9


@pytest.mark.parametrize("exposure", [0.0, 0.1])
def test_a_single_sample(exposure):
    mesh = Mesh.of_samples(np.array([8.0]), 0.0, exposure=exposure)
    assert mesh.reading(means(mesh.grid)).shape == (1, 1)
    assert error(mesh, np.array([8.0]), exposure) < 1e-3
    for begin in (8.0, 9.0):
        resting = Mesh.of_samples(np.array([8.0]), begin, exposure=exposure)
        assert_array_equal(resting.reading(np.ones((3, resting.grid.n))), np.zeros((3, 1)))


def test_samples_that_all_precede_the_first_change():
    mesh = Mesh.of_samples(np.arange(5.0), 9.0)
    assert mesh.reading(np.zeros((2, mesh.grid.n))).shape == (2, 5)


def test_the_last_sample_is_inside_the_grid(rng):
    for times in (0.1 * np.arange(1, 101), np.sort(rng.uniform(0, 10, 40)), np.array([1.0, 2.0, 10.0])):
        mesh = Mesh.of_samples(times, 0.0, blocks=500)
        assert mesh.grid.edges[-1] > times[-1]
        assert abs(mesh.reading(means(mesh.grid))[0, -1] - response(times[-1])) < 1e-3


def test_very_many_samples(rng):
    times = 0.01 * np.arange(1, 60_001)
    mesh = Mesh.of_samples(times, 0.0)
    assert (mesh.reading.matrix, mesh.grid.n) == (None, 60_003)
    assert error(mesh, times) < 1e-5
    jittered = np.sort(times + rng.uniform(-0.002, 0.002, times.size))
    assert Mesh.of_samples(jittered, 0.0).grid.n == times.size + 2  # blocks keep up with the samples
    assert Mesh.of_samples(jittered[:50], -9e3).grid.n == MOST_BLOCKS + 2
