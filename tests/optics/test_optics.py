"""Far field, lobes and steering against exact answers and direct sums."""

import tracemalloc
from dataclasses import replace
from math import isnan, nan, pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.model.literature import PAPER
from lcopa_bayes.optics.array import (
    LinearArray,
    array_factor,
    element_factor,
    implied_array,
    intensity,
    largest_linearisation_error,
    linearisation_error,
    linearised_angle,
    lobes,
    main_lobe,
    paper_array,
    planar_pattern,
    planar_patterns,
    side_lobe_level,
    steered_patterns,
    strongest_grating_lobe,
)
from lcopa_bayes.paper.staticoptics import OpticsPlan, lobe_rows

ARRAY = paper_array()
SLIT = paper_array(fill_factor=1.0)
arrays = st.builds(
    LinearArray,
    elements=st.integers(2, 64),
    pitch=st.floats(0.2e-6, 12e-6),
    wavelength=st.floats(0.4e-6, 2e-6),
    fill_factor=st.floats(0.0, 1.0),
)


def array_sum(array: LinearArray, u, phases) -> np.ndarray:
    """Eq. 3, element by element."""
    directions = np.exp(-2j * pi / array.period * np.multiply.outer(np.asarray(u), np.arange(array.elements)))
    return directions @ np.exp(1j * np.asarray(phases)) / array.elements


# Far field


@settings(max_examples=60, deadline=None)
@given(array=arrays, step=st.floats(-7, 7), u=st.floats(-1, 1))
def test_sum_and_closed_form_agree(array, step, u):
    """Two methods, complex: the closed form carries the phase of the array centre."""
    psi = step - 2 * pi / array.period * u
    closed = array_factor(array, u, step) * np.exp(0.5j * (array.elements - 1) * psi)
    tolerance = 1e-15 * array.elements * (10 + abs(step) + 2 * pi / array.period)
    assert abs(array_sum(array, u, step * np.arange(array.elements)) - closed) < tolerance


def test_sum_and_closed_form_agree_to_1e_12_on_the_papers_array():
    u = np.linspace(-1, 1, 5001)
    step = float(ARRAY.phase_step(np.radians(20)))
    total = array_sum(ARRAY, u, step * np.arange(32))
    np.testing.assert_allclose(np.abs(total), np.abs(array_factor(ARRAY, u, step)), rtol=0, atol=1e-12)


def test_two_elements_are_a_cosine():
    array = LinearArray(2, 0.5, 1.0)
    u = np.linspace(-1, 1, 101)
    np.testing.assert_allclose(intensity(array, u, 0.3), np.cos((0.3 - pi * u) / 2) ** 2, atol=1e-15)


@pytest.mark.parametrize("elements", [2, 3, 32, 33])
def test_closed_form_is_exact_on_a_lobe(elements):
    array = LinearArray(elements, 1.0, 1.0)  # lobes at u = -1, 0, 1
    sign = (-1) ** (elements - 1)
    assert array_factor(array, [-1.0, 0.0, 1.0], 0.0).tolist() == [sign, 1.0, sign]
    near = 1 - np.array([1e-3, 1e-8, 1e-12, 1e-15])
    psi = 2 * pi * (1 - near)
    curvature = (elements**2 - 1) / 24
    np.testing.assert_allclose(array_factor(array, near, 0.0) * sign, 1 - curvature * psi**2, atol=3e-6)
    assert array_factor(array, near[2:], 0.0) * sign == pytest.approx(1.0, abs=1e-12)


def test_nulls_lie_at_multiples_of_the_lobe_width():
    u = ARRAY.period / 32 * np.arange(1, 32)
    np.testing.assert_allclose(array_factor(ARRAY, u[u <= 1], 0.0), 0.0, atol=1e-14)


def test_power_over_one_period_is_one_nth():
    """Parseval: the mean of the squared array factor over a period is 1 / N."""
    array = LinearArray(32, 1.0, 1.0)
    u = np.arange(64) / 64
    assert np.mean(array_factor(array, u, 0.7) ** 2) == pytest.approx(1 / 32, rel=1e-12)


@pytest.mark.parametrize("array", [ARRAY, SLIT])
@pytest.mark.parametrize("degrees", [0, 5, 10, 20])
def test_intensity_is_one_where_it_steers(array, degrees):
    step = float(array.phase_step(np.radians(degrees)))
    assert intensity(array, np.sin(np.radians(degrees)), step) == pytest.approx(1.0, abs=1e-13)


def test_steering_onto_a_zero_of_the_element_is_refused():
    array = LinearArray(8, 2.0, 1.0, fill_factor=1.0)  # sinc zero at u = 1/2
    with pytest.raises(InputError, match="zero of the element factor"):
        intensity(array, 0.0, float(array.phase_step(np.arcsin(0.5))))
    with pytest.raises(InputError, match="zero of the element factor"):
        lobes(array, float(array.phase_step(np.arcsin(0.5))))


def test_planar_pattern_is_the_double_sum_of_eq_10():
    array, target = LinearArray(7, 1.3e-6, 1e-6), (0.3, 0.7)
    goal = np.sin(0.3) * np.array([np.cos(0.7), np.sin(0.7)])
    axis = np.array([np.sin(0.5) * np.cos(-1.1), np.sin(0.5) * np.sin(-1.1), 0.1])
    pattern = planar_pattern(array, axis, target).intensity
    m, n = np.meshgrid(np.arange(7), np.arange(7), indexing="ij")
    k = 2 * pi / 1e-6 * 1.3e-6
    for i, u in enumerate(axis):
        for j, v in enumerate(axis):
            field = np.exp(1j * k * (m * (goal[0] - u) + n * (goal[1] - v)))
            assert pattern[i, j] == pytest.approx(abs(field.mean()) ** 2, abs=1e-13)
    assert pattern.max() > 1e-3  # a comparison of zeros would prove nothing


def test_a_large_planar_grid_takes_little_memory():
    axis = np.linspace(-1, 1, 2000)
    tracemalloc.start()
    pattern = planar_pattern(ARRAY, axis, (np.radians(20), np.radians(10))).intensity
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1e9
    visible = ~np.isnan(pattern[::40, ::40])
    assert np.array_equal(visible, np.add.outer(axis[::40] ** 2, axis[::40] ** 2) <= 1)


# Steering


@given(array=arrays, angle=st.floats(-pi / 2, pi / 2))
def test_steering_law_inverts(array, angle):
    back = array.steering_angle(array.phase_step(angle))
    assert np.sin(back) == pytest.approx(np.sin(angle), abs=1e-14)


def test_no_wave_beyond_end_fire():
    with pytest.raises(InputError, match="no such wave propagates"):
        LinearArray(8, 0.25e-6, 1e-6).steering_angle(pi / 2 * 1.0001)
    assert LinearArray(8, 0.25e-6, 1e-6).steering_angle(pi / 2) == pytest.approx(pi / 2, abs=1e-7)


def test_impossible_arrays_tell_every_problem_at_once():
    with pytest.raises(InputError) as caught:
        LinearArray(1, 0.0, -1e-6, 1.5)
    assert len(caught.value.problems) == 4
    for bad in (nan, np.inf):
        with pytest.raises(InputError):
            LinearArray(8, bad, 1e-6)


# Lobes


@settings(max_examples=40, deadline=None)
@given(array=arrays, sine=st.floats(-0.95, 0.95))
def test_every_unit_maximum_is_listed(array, sine):
    """A fine scan of the array factor finds the listed lobes and no other."""
    bare = replace(array, fill_factor=0.0)
    step = float(bare.phase_step(np.arcsin(sine)))
    found = lobes(bare, step)
    assert [lobe.intensity for lobe in found] == [1.0] * len(found)
    assert 0 in [lobe.order for lobe in found]
    at = np.array([lobe.direction_cosine for lobe in found])
    assert np.abs(array_factor(bare, at, step)) == pytest.approx(1.0, abs=1e-9)
    u = np.linspace(-1, 1, 4001)
    level = np.abs(array_factor(bare, u, step))
    peak = (level[1:-1] > 0.999) & (level[1:-1] > level[:-2]) & (level[1:-1] > level[2:])
    assert all(np.abs(at - x).min() < 1e-3 for x in u[1:-1][peak])


def test_grating_lobes_at_the_normal():
    found = lobes(ARRAY, 0.0)
    assert [lobe.order for lobe in found] == [-1, 0, 1]
    assert found[2].angle == pytest.approx(np.arcsin(1 / 1.2), rel=1e-14)
    assert len(lobes(LinearArray(32, 0.49, 1.0), 0.0)) == 1  # below half a wavelength: none
    assert len(lobes(LinearArray(32, 1.0, 1.0), 0.0)) == 3  # grazing lobes count


def test_main_lobe_is_found_without_the_steering_law():
    for degrees in (0.0, 3.0, 10.0, 20.0, -17.0):
        step = float(ARRAY.phase_step(np.radians(degrees)))
        assert main_lobe(ARRAY, step) == pytest.approx(np.radians(degrees), abs=1e-13)
    assert main_lobe(LinearArray(8, 0.5, 1.0), pi) == pi / 2


def test_a_slit_pulls_the_main_lobe_towards_the_normal():
    step = float(SLIT.phase_step(np.radians(20)))
    peak = np.sin(main_lobe(SLIT, step))
    offset = 1e-4
    top = intensity(SLIT, peak, step)
    assert top > max(intensity(SLIT, peak + d, step) for d in (-offset, offset))
    assert 0 < np.sin(np.radians(20)) - peak < (SLIT.period / SLIT.elements) ** 2


def test_side_lobe_level_of_many_elements_is_that_of_a_slit():
    """First side lobe of sinc^2: 0.0471904 (13.26 dB), reached as the element count grows."""
    levels = [side_lobe_level(LinearArray(n, 0.5, 1.0), 0.0) for n in (50, 100, 200)]
    gaps = np.array(levels) - 0.04719044999
    assert 3.8 < gaps[0] / gaps[1] < 4.2
    assert 3.8 < gaps[1] / gaps[2] < 4.2
    assert isnan(side_lobe_level(LinearArray(2, 1.0, 1.0), 0.0))


def test_side_lobe_of_three_elements_is_one_ninth():
    assert side_lobe_level(LinearArray(3, 1.0, 1.0), 0.3) == pytest.approx(1 / 9, rel=1e-10)


def test_grating_lobes_equal_the_main_lobe_unless_elements_have_width():
    """Claim S2: ratios of sinc^2(1.2 u) by hand."""
    goals = np.radians([0, 5, 10, 15, 20])
    np.testing.assert_allclose(strongest_grating_lobe(goals, fill_factor=0.0), 1.0)
    sine = np.sin(goals)
    by_hand = (np.sinc(1.2 * (sine - 1 / 1.2)) / np.sinc(1.2 * sine)) ** 2
    np.testing.assert_allclose(strongest_grating_lobe(goals), by_hand, atol=1e-14)
    assert by_hand[-1] == pytest.approx(0.4846, abs=1e-4)
    rows = lobe_rows(OpticsPlan())
    assert {row["order"] for row in rows} == {-1, 0, 1}
    worst = max(row["with_element"] for row in rows if row["order"])
    assert worst == pytest.approx(by_hand.max(), rel=1e-14)
    tight = replace(PAPER.optics, pitch_in_wavelengths=0.5)
    assert strongest_grating_lobe([0.1], tight).tolist() == [0.0]


def test_element_factor_is_flat_for_points():
    u = np.linspace(-1, 1, 7)
    np.testing.assert_array_equal(element_factor(ARRAY, u), 1.0)
    assert element_factor(SLIT, 1 / 1.2) == pytest.approx(0.0, abs=1e-30)


# Figures 3 and 5


def test_figure_data_peak_at_their_targets():
    data = steered_patterns()
    assert data.intensity.shape == (5, 4001)
    for target, row in zip(data.target, data.intensity, strict=True):
        near = np.abs(data.angle - target) < np.radians(5)
        assert data.angle[near][np.argmax(row[near])] == pytest.approx(target, abs=np.radians(0.05))
    normal, steered = planar_patterns(points=401)
    assert normal.intensity[200, 200] == pytest.approx(1.0)
    polar, azimuth = steered.target
    goal = np.sin(polar) * np.array([np.cos(azimuth), np.sin(azimuth)])
    strong = np.nan_to_num(steered.intensity) > 0.5
    distance = np.hypot.outer(steered.axis - goal[0], steered.axis - goal[1])
    assert strong[distance < 0.01].all()


# Linearised steering and geometry, S3, S4


def test_linearisation_is_exact_at_one_radian_and_has_its_limit_at_rest():
    a = 1 / (2.4 * pi)
    assert linearisation_error(ARRAY, 1.0) == 0.0
    assert linearisation_error(ARRAY, 0.0) == pytest.approx(np.arcsin(a) / a - 1, rel=1e-12)
    assert linearisation_error(ARRAY, 1e-6) == pytest.approx(float(linearisation_error(ARRAY, 0.0)), rel=1e-8)


def test_linearisation_error_is_largest_at_an_end():
    phases = np.linspace(-pi, pi, 999)
    scan = np.abs(linearisation_error(ARRAY, phases)).max()
    assert largest_linearisation_error(ARRAY, pi) == pytest.approx(scan, rel=1e-12)
    exact = np.arcsin(1 / 4.8)
    at_limit = float(linearisation_error(ARRAY, pi / 2))
    assert at_limit == pytest.approx(np.arcsin(1 / (2.4 * pi)) * pi / 2 / exact - 1, rel=1e-10)
    assert linearised_angle(ARRAY, pi / 2) == pytest.approx(exact * (1 + at_limit), rel=1e-14)


def test_implied_pitch_reproduces_the_measured_angle():
    step = PAPER.records.step_drive
    assert implied_array().steering_angle(step) == pytest.approx(0.0272, rel=1e-13)
    assert ARRAY.steering_angle(step) == pytest.approx(np.arcsin(1 / 4.8), rel=1e-14)


def test_a_consistent_paper_would_have_ratio_one():
    records = replace(
        PAPER.records, measured=replace(PAPER.records.measured, steady=float(np.arcsin(1 / 4.8)))
    )
    implied = implied_array(replace(PAPER, records=records))
    assert implied.pitch == pytest.approx(ARRAY.pitch, rel=1e-13)
