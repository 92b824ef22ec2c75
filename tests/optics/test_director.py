"""Director of the cell: threshold, two methods to the profile, order of convergence, tilt law."""

from dataclasses import replace
from math import inf, nan, pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from optics_quadrature import quadrature
from scipy.special import ellipk

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.model.literature import PAPER
from lcopa_bayes.optics import director
from lcopa_bayes.optics.director import (
    Cell,
    Field,
    NotConverged,
    equilibrium,
    expand,
    grid_threshold,
    newton_step,
    paper_cell,
)
from lcopa_bayes.optics.tiltlaw import (
    RANGES,
    TiltLaw,
    best_law,
    continuous_law,
    director_curve,
    fit_quality,
    printed_law,
    tilt_law_check,
)
from lcopa_bayes.paper.staticoptics import OpticsPlan

CELL = paper_cell()
ONE = Cell(1e-11, 1e-11, 4e-11, 1e-10)
both = pytest.mark.parametrize("field", list(Field))


# Exact answers


def test_threshold_closed_form():
    assert pytest.approx(pi * np.sqrt(11.1e-12 / 1.2e-10), rel=1e-14) == CELL.threshold
    assert pytest.approx(0.95548, abs=1e-5) == CELL.threshold


@pytest.mark.parametrize("ratio", [1.05, 1.5, 3.0, 6.0])
def test_one_constant_cell_is_an_elliptic_integral(ratio):
    """``V / V_th = (2 / pi) K(sin^2 th_m)`` in a uniform field."""
    middle = quadrature(ONE, ratio * ONE.threshold)
    assert 2 / pi * ellipk(1 - middle.cosine**2) == pytest.approx(ratio, rel=1e-9)


@both
def test_weak_tilt_is_a_half_sine(field):
    p = equilibrium(CELL, 1.0005 * CELL.threshold, field=field)
    np.testing.assert_allclose(p.tilt / p.largest, np.sin(pi * p.position), atol=2e-3)
    assert p.mean / p.largest == pytest.approx(2 / pi, rel=2e-3)


@both
def test_director_is_flat_below_threshold_and_tilted_above(field):
    assert not equilibrium(CELL, 0.999 * CELL.threshold, field=field).tilt.any()
    above = equilibrium(CELL, 1.001 * CELL.threshold, field=field)
    assert above.tilt[1:-1].min() > 0
    assert above.tilt[0] == above.tilt[-1] == 0


def test_grid_threshold_converges_to_the_closed_form():
    n = np.array([16, 32, 64, 128])
    gap = np.array([1 - grid_threshold(CELL, k) / CELL.threshold for k in n])
    slope = -np.polyfit(np.log(n), np.log(gap), 1)[0]
    assert 1.95 < slope < 2.05


@both
@pytest.mark.parametrize("side", [-1, 1])
def test_grid_threshold_is_where_the_flat_state_turns_unstable(field, side):
    """The smallest eigenvalue of the Hessian of the flat state changes sign there."""
    n = 40
    drive = pi * grid_threshold(CELL, n) / CELL.threshold * (1 + side * 1e-6)
    band = expand(CELL, field, drive, np.zeros(n + 1)).band
    full = np.diag(band[1]) + np.diag(band[0, 1:], 1) + np.diag(band[0, 1:], -1)
    assert np.sign(np.linalg.eigvalsh(full)[0]) == -side


@both
def test_strong_field_leaves_only_wall_layers(field):
    p = equilibrium(CELL, 30.0, field=field)
    assert p.largest == pytest.approx(pi / 2, abs=1e-6)
    assert p.mean > 1.5


def test_profile_is_symmetric():
    p = equilibrium(CELL, 2.3)
    np.testing.assert_allclose(p.tilt, p.tilt[::-1], atol=1e-10)


@both
def test_a_pretilt_has_no_threshold(field):
    cell = paper_cell(pretilt=0.05)
    np.testing.assert_array_equal(equilibrium(cell, 0.0, field=field).tilt, 0.05)
    means = [equilibrium(cell, v, field=field).mean for v in (0.0, 0.3, 0.6, 0.9)]
    assert (np.diff(means) > 0).all()


# Parts: energy, gradient, Hessian


@both
def test_gradient_and_hessian_match_central_differences(field):
    rng = np.random.default_rng(3)
    n, drive = 12, 7.0
    tilt = rng.uniform(0.1, 1.3, n + 1)
    state = expand(CELL, field, drive, tilt)

    def moved(i, by):
        other = tilt.copy()
        other[1 + i] += by
        return expand(CELL, field, drive, other)

    h = 1e-5
    gradient = [(moved(i, h).energy - moved(i, -h).energy) / (2 * h) for i in range(n - 1)]
    np.testing.assert_allclose(state.gradient, gradient, rtol=1e-6, atol=1e-6)
    hessian = [(moved(i, h).gradient - moved(i, -h).gradient) / (2 * h) for i in range(n - 1)]
    full = np.diag(state.band[1]) + np.diag(state.band[0, 1:], 1) + np.diag(state.band[0, 1:], -1)
    full -= np.outer(state.push, state.push)
    np.testing.assert_allclose(full, hessian, rtol=1e-6, atol=1e-5)
    step, _ = newton_step(state)
    assert step @ state.gradient < 0


@both
def test_newton_step_solves_with_the_whole_hessian(field):
    """Near a minimum no shift is needed; the rank-one part must be in the solution."""
    p = equilibrium(CELL, 2.0, field=field, cells=40)
    state = expand(CELL, field, pi * 2.0 / CELL.threshold, p.tilt + 0.01 * np.sin(pi * p.position))
    step, stable = newton_step(state)
    full = np.diag(state.band[1]) + np.diag(state.band[0, 1:], 1) + np.diag(state.band[0, 1:], -1)
    full -= np.outer(state.push, state.push)
    assert stable
    np.testing.assert_allclose(full @ step, -state.gradient, atol=1e-10)


# Two methods, and the order of convergence


@both
@pytest.mark.parametrize("volts", [1.0, 1.5, 3.0, 5.0])
@pytest.mark.parametrize("pretilt", [0.0, 0.1])
def test_solver_and_first_integral_agree(field, volts, pretilt):
    cell = paper_cell(pretilt=pretilt)
    p, q = equilibrium(cell, volts, field=field), quadrature(cell, volts, field=field)
    assert p.mean == pytest.approx(q.mean, abs=2e-5)
    assert p.largest == pytest.approx(q.largest, abs=1e-5)
    some = np.arange(1, 380, 30)
    np.testing.assert_allclose(q.positions(p.tilt[some]), p.position[some], atol=5e-5)


@settings(max_examples=15, deadline=None)
@given(
    bend=st.floats(0.5, 3.0),
    anisotropy=st.floats(0.3, 4.0),
    ratio=st.floats(1.1, 4.0),
    field=st.sampled_from(Field),
)
def test_methods_agree_for_any_material(bend, anisotropy, ratio, field):
    cell = Cell(1e-11, bend * 1e-11, 4e-11, anisotropy * 4e-11)
    volts = ratio * cell.threshold
    assert equilibrium(cell, volts, field=field).mean == pytest.approx(
        quadrature(cell, volts, field=field).mean, abs=2e-4
    )


@both
@pytest.mark.parametrize("volts", [1.2, 3.0, 5.0])
def test_mean_tilt_is_second_order_in_the_grid(field, volts):
    n = np.array([100, 200, 400])
    exact = quadrature(CELL, volts, field=field).mean
    errors = [abs(equilibrium(CELL, volts, field=field, cells=k).mean - exact) for k in n]
    slope = -np.polyfit(np.log(n), np.log(errors), 1)[0]
    assert 1.9 < slope < 2.1


@both
def test_equilibrium_does_not_depend_on_the_start(field):
    start = np.linspace(0.01, 1.5, 801)
    one = equilibrium(CELL, 2.0, field=field, guess=start)
    np.testing.assert_allclose(one.tilt, equilibrium(CELL, 2.0, field=field).tilt, atol=1e-9)


# Refusals


def test_unfinished_iteration_raises_with_its_evidence(monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(director, "_ITERATIONS", 2)
        with pytest.raises(NotConverged) as caught:
            equilibrium(CELL, 2.0)
    assert caught.value.voltage == 2.0
    assert caught.value.iterations == 2
    assert caught.value.residual > 1e-6
    done = equilibrium(CELL, 2.0)
    assert done.residual < 1e-8 < caught.value.residual


@pytest.mark.parametrize("volts", [-1.0, nan, inf])
def test_impossible_voltages_are_refused(volts):
    with pytest.raises(InputError):
        OpticsPlan(voltages=(1.0, volts))


def test_impossible_cells_tell_every_problem_at_once():
    with pytest.raises(InputError) as caught:
        Cell(-1.0, 0.0, nan, -1e-10, 2.0)
    assert len(caught.value.problems) == 5


# Tilt law


def test_curve_rises():
    curve = director_curve(CELL, np.linspace(0, 5, 26))
    assert curve.tilt.shape == (26, 801)
    assert (np.diff(curve.mean[curve.voltage > CELL.threshold]) > 0).all()


def test_continuation_ends_where_a_fresh_start_does():
    curve = director_curve(CELL, np.linspace(0, 5, 11))
    fresh = [equilibrium(CELL, v).mean for v in curve.voltage]
    np.testing.assert_allclose(curve.mean, fresh, atol=1e-10)


def test_laws_as_printed():
    printed, continuous = printed_law(), continuous_law()
    assert printed(2.0) == pytest.approx(0.8038)
    assert printed(3.0) == pytest.approx(0.095215 * 3 + 1.2058)
    assert continuous(3.0) == pytest.approx(1.2058)
    assert printed.jump == pytest.approx(3 * 0.095215 + 1.2058 - 3 * 0.4019, abs=1e-12)
    assert abs(continuous.jump) < 2e-4


def test_fit_quality_of_a_perfect_law_and_of_a_shifted_one():
    straight = replace(
        director_curve(CELL, np.linspace(0, 5, 51), cells=100), mean=np.linspace(0, 5, 51) * 0.2
    )
    perfect = TiltLaw(0.2, 0.2, 0.0, 0.0, 3.0)
    fit = fit_quality(straight, perfect, 0.0, 5.0)
    assert fit.r_squared == pytest.approx(1.0, abs=1e-12)
    assert fit.largest_relative_error < 1e-12
    tenth = fit_quality(straight, replace(perfect, low=0.22, high=0.22), 1.0, 5.0)
    assert tenth.largest_relative_error == pytest.approx(0.1, rel=1e-9)
    assert best_law(straight).low == pytest.approx(0.2, rel=1e-12)


@both
def test_tilt_law_check(field):
    check = tilt_law_check(field=field, points=251, cells=400)
    assert len(check.printed) == len(check.continuous) == len(check.best) == len(RANGES)
    assert check.best[0].r_squared >= max(check.printed[0].r_squared, check.continuous[0].r_squared)
    assert check.printed[0].largest_relative_error == inf  # flat director, sloping law
    volts = check.curve.voltage[check.curve.voltage >= 3]
    solved = np.array([quadrature(CELL, v, field=field).mean for v in volts[::20]])
    worst = np.abs(continuous_law()(volts[::20]) / solved - 1).max()
    assert check.continuous[2].largest_relative_error == pytest.approx(worst, rel=2e-2)
    assert check.printed_jump > 100 * check.solved_change > 0
    assert check.largest_printed_tilt > pi / 2


def test_tilt_law_check_follows_the_stated_numbers():
    soft = replace(PAPER.optics, tilt_slope_high=0.05)
    changed = tilt_law_check(soft, points=51, cells=400)
    assert changed.largest_printed_tilt == pytest.approx(0.05 * 5 + 1.2058)
    assert changed.printed_jump == pytest.approx(0.05 * 3 + 1.2058 - 3 * 0.4019, abs=1e-12)
