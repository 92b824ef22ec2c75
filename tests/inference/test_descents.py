"""Descents between bounds, against closed forms and scipy's solutions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.optimize import lsq_linear

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.inference.descents import Place, descended


@dataclass(frozen=True)
class Bowl:
    """``-|A x - b|^2 / 2`` between bounds."""

    matrix: Matrix
    right: Vector
    low: Vector
    high: Vector

    def at(self, points: Matrix) -> Place:
        residual = points @ self.matrix.T - self.right
        information = np.tile(self.matrix.T @ self.matrix, (len(points), 1, 1))
        return Place(points, -0.5 * (residual**2).sum(axis=1), -residual @ self.matrix, information)

    def room(self, points: Matrix) -> tuple[Matrix, Matrix]:
        return self.low - points, self.high - points

    def moved(self, points: Matrix, steps: Matrix) -> Matrix:
        return points + steps


class Valley:
    """Rosenbrock's, as least squares: a curved ridge to (1, 1)."""

    def at(self, points: Matrix) -> Place:
        x, y = points.T
        residual = np.stack([10 * (y - x**2), 1 - x], axis=1)
        jacobian = np.empty((len(x), 2, 2))
        jacobian[:, 0, 0], jacobian[:, 0, 1], jacobian[:, 1, 0], jacobian[:, 1, 1] = -20 * x, 10.0, -1.0, 0.0
        return Place(
            points,
            -0.5 * (residual**2).sum(axis=1),
            -(jacobian.swapaxes(1, 2) @ residual[..., None])[..., 0],
            jacobian.swapaxes(1, 2) @ jacobian,
        )

    def room(self, points: Matrix) -> tuple[Matrix, Matrix]:
        return -3.0 - points, 3.0 - points

    def moved(self, points: Matrix, steps: Matrix) -> Matrix:
        return points + steps


def bowl(seed: int) -> tuple[Bowl, Matrix]:
    """A bowl whose bounds often hold its optimum, and four starts."""
    rng = np.random.default_rng(seed)
    matrix, right = rng.standard_normal((6, 3)), 3 * rng.standard_normal(6)
    low, high = -rng.uniform(0.1, 1.0, 3), rng.uniform(0.1, 1.0, 3)
    return Bowl(matrix, right, low, high), rng.uniform(low, high, (4, 3))


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 10**6))
def test_a_bowl_between_bounds_ends_at_the_solution_of_bounded_least_squares(seed):
    one, start = bowl(seed)
    ends = descended(one, start, steps=15, least=1e-10)
    solution = lsq_linear(one.matrix, one.right, (one.low, one.high), tol=1e-13)
    assert_allclose(ends.points, np.tile(solution.x, (4, 1)), atol=1e-4)
    assert (ends.level >= one.at(start).level).all()
    assert ((ends.points >= one.low - 1e-12) & (ends.points <= one.high + 1e-12)).all()


def test_bounds_cost_a_bowl_few_steps():
    counts = []
    for seed in range(100):
        (one, start), calls = bowl(seed), []

        class Counted(Bowl):
            def at(self, points: Matrix, calls: list[int] = calls) -> Place:
                calls.append(len(points))
                return super().at(points)

        descended(Counted(one.matrix, one.right, one.low, one.high), start, steps=50, least=1e-8)
        counts.append(len(calls))
    assert np.median(counts) <= 3
    assert max(counts) <= 10


def test_a_curved_valley_is_followed_to_its_end():
    start = np.array([[-1.2, 1.0], [2.0, -2.0], [0.0, 0.0]])
    before = start.copy()
    ends = descended(Valley(), start, steps=100, least=1e-14)
    assert_allclose(ends.points, 1.0, atol=1e-5)
    assert (start == before).all()


def test_no_step_is_made_beyond_those_that_are_asked_for():
    calls = []

    class Counted(Valley):
        def at(self, points: Matrix) -> Place:
            calls.append(len(points))
            return super().at(points)

    descended(Counted(), np.array([[-1.2, 1.0]]), steps=3, least=0.0)
    assert len(calls) == 4


def test_a_point_of_no_density_is_left_where_it_is():
    class Cut(Valley):
        def at(self, points: Matrix) -> Place:
            place = super().at(points)
            return place._replace(level=np.where(points[:, 0] > 0.5, -np.inf, place.level))

    ends = descended(Cut(), np.array([[-1.2, 1.0]]), steps=60, least=1e-12)
    assert ends.points[0, 0] <= 0.5
    assert ends.level[0] == pytest.approx(-0.5 * 0.5**2, abs=0.02)
