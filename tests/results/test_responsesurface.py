"""Responses of many draws from simulations of few: exact where a surface is, all simulated where none is."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from results.test_fit_with_effects import TRUTH, campaign
from small import with_effect

from lcopa_bayes.core.arrays import Array, Matrix
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.results.prediction import responses
from lcopa_bayes.results.responsesurface import surfaced

RNG = np.random.default_rng(3)
DRAWS = RNG.standard_normal((300, 4)) @ RNG.standard_normal((4, 4))
SHAPES = RNG.standard_normal((2, 4, 50))


def counted(response: Callable[[Matrix], Array]) -> tuple[Callable[[Matrix], Array], list[int]]:
    sizes: list[int] = []

    def simulated(values: Matrix) -> Array:
        sizes.append(len(values))
        return response(values)

    return simulated, sizes


def linear(values: Matrix) -> Array:
    return np.asarray(1.0 + values @ SHAPES)


@pytest.mark.parametrize(
    ("response", "simulations"),
    [
        (linear, 10),
        (lambda x: linear(x) + 0.02 * linear(x) ** 2, 300),
        (lambda x: np.abs(linear(x)), 300),
        (lambda x: np.where(x[:, :1] > 3.0, np.nan, linear(x)), 300),
    ],
    ids=["linear", "crosswise", "bent", "unbounded"],
)
def test_responses_are_those_of_the_simulation(response: Callable[[Matrix], Array], simulations: int) -> None:
    simulated, sizes = counted(response)
    out = surfaced(simulated, DRAWS, DRAWS, np.random.default_rng(0))
    assert sum(sizes) == simulations
    expected = response(DRAWS)
    error, sd = (out - expected), np.nanstd(expected, axis=1, keepdims=True)
    if simulations == len(DRAWS):
        np.testing.assert_array_equal(out, expected)
    assert np.nanmax(np.abs(error) / sd) < 1e-9


def test_squares_along_the_axes_of_the_draws_are_followed() -> None:
    apart = (DRAWS - DRAWS.mean(axis=0)) / DRAWS.std(axis=0)
    onto = np.linalg.svd(apart, full_matrices=False)[2].T

    def squared(values: Matrix) -> Array:
        axes = ((values - DRAWS.mean(axis=0)) / DRAWS.std(axis=0)) @ onto
        return linear(axes) + axes**2 @ SHAPES[::-1]

    simulated, sizes = counted(squared)
    out = surfaced(simulated, DRAWS, DRAWS, np.random.default_rng(0))
    assert sum(sizes) == 18
    assert np.abs(out - squared(DRAWS)).max() < 1e-9


def test_equal_draws_are_simulated_once() -> None:
    simulated, sizes = counted(lambda x: np.abs(linear(x)))
    twice = np.repeat(DRAWS, 2, axis=0)
    out = surfaced(simulated, twice, twice, np.random.default_rng(0))
    assert sum(sizes) == len(DRAWS)
    np.testing.assert_array_equal(out, np.abs(linear(twice)))


def test_a_stiff_plant_is_followed_within_the_stated_error() -> None:
    """Against a simulation of every draw; a third of the simulations suffices."""
    made, truth = with_effect(campaign(), ["cubic_stiffness"], TRUTH | {"coefficient": 0.4})
    problem = problem_of(made)
    table, model = problem.posterior.table, problem.posterior.model.only(0)
    rng = np.random.default_rng(5)
    values = np.tile(truth, (200, 1))
    moving = [k for k, row in enumerate(table.rows) if not row.noise and row.kind != "offset" and row.free]
    values[:, moving] *= 1 + 0.01 * rng.standard_normal((200, len(moving)))
    simulated, sizes = counted(lambda x: responses(table, model, x)[0])
    out = surfaced(simulated, values, values[:, moving], rng)
    assert sum(sizes) < 70
    whole = responses(table, model, values)[0]
    ratio = np.sqrt(np.mean((out - whole) ** 2, axis=1)) / np.maximum(whole.std(axis=1), 1e-6)
    assert np.sqrt(np.mean(ratio**2)) < 0.05
