"""Student noise: levels of held-out records and bounds of the audit, against simulation and quadrature."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats
from scipy.integrate import cumulative_trapezoid
from small import TRUTH, TWO, problem, record, row_values

from lcopa_bayes.bench.command import quiet, step
from lcopa_bayes.identifiability.curvature import sensitivities
from lcopa_bayes.inference.likelihood import Landscape
from lcopa_bayes.inference.noise import Student
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.results.prediction import _student_levels, offset_draws, responses

DRAWS = 3000


@pytest.mark.parametrize("nu", [1.5, 2.5, 8.0])
@pytest.mark.parametrize(
    "misfit",
    [
        [0.3],
        [-1.0, 1.4],
        [-9.0, 9.0],  # two modes
        [0.1, -0.2, 0.4, 30.0],  # an outlier
        list(np.random.default_rng(2).standard_t(2.5, 25)),
    ],
    ids=["single", "pair", "two modes", "outlier", "many"],
)
def test_draws_of_a_level_are_of_its_exact_density(misfit, nu):
    """Against the density on a grid, by the Kolmogorov-Smirnov test."""
    sigma, rng = 0.7, np.random.default_rng(4)
    row = np.tile(misfit, (DRAWS, 1))
    levels = _student_levels(row, np.tile([sigma, nu], (DRAWS, 1)), rng)
    at = np.median(misfit) + 0.05 * np.sinh(np.linspace(-13.0, 13.0, 40_001))
    at = np.unique(np.concatenate([at, np.linspace(-12.0, 32.0, 20_001)]))
    log_density = stats.t(nu, loc=np.array(misfit)[:, None], scale=sigma).logpdf(at).sum(axis=0)
    share = cumulative_trapezoid(np.exp(log_density - log_density.max()), at, initial=0.0)
    result = stats.kstest(levels, lambda x: np.interp(x, at, share / share[-1]))
    assert result.pvalue > 1e-3, result


@pytest.mark.parametrize(
    ("nu", "command", "samples"),
    [
        pytest.param(2.5, step(1.0, at=2.0), 14, marks=pytest.mark.slow),
        (2.5, quiet(0.0), 39),
        (1.2, step(1.0, at=2.0), 14),
    ],
)
def test_levels_of_held_out_records_cover_as_often_as_they_say(nu, command, samples):
    """Truth known but for the level: 50 and 90 % intervals from simulated quiet samples, 300 replicates."""
    replicates, count = 300, 200
    made = problem(record(camera=0.6), noise="student")
    table = made.posterior.table
    held = record(2, command=command, camera=0.2, duration=7.8, noise_sd=0.0, name="held")
    (some,), model = made.simulated([held])
    values = np.tile(row_values(table, TRUTH | {"nu": nu}), (count, 1))
    response = responses(table, model, values)[0][0]
    begin = command.times[0] if command.times.size else np.inf
    assert np.sum(some.times <= begin + TRUTH["delay"]) == samples
    rng, inside = np.random.default_rng(6), []
    for _ in range(replicates):
        level = rng.normal()
        noise = Student().draw(np.array([[TRUTH["sigma"], nu]]), some.axes[0].gaps, rng)[0]
        axis = replace(some.axes[0], values=response[0] + level + noise)
        seen = Samples(some.record, some.times, (axis,))
        offsets, _, count_used = offset_draws(
            table, values, 0, 0, seen, response, made.posterior.noise, held_out=True, rng=rng
        )
        assert count_used == samples
        rank = np.mean(offsets < level)
        inside.append([abs(rank - 0.5) < 0.25, abs(rank - 0.5) < 0.45])
    error = np.sqrt(np.array([0.25, 0.09]) / replicates)
    assert np.all(np.abs(np.mean(inside, axis=0) - [0.5, 0.9]) < 3.5 * error + 0.5 / count)


NUS = {"nu_x": 2.5, "nu_y": 9.0}


def test_the_bound_of_the_audit_is_the_fisher_information_of_the_likelihood():
    """Numerically: slopes by differences of the responses, times the mean square of the score of a sample by
    quadrature over the density that the posterior itself evaluates."""
    made = problem(record(device=TWO, camera=0.8), noise="student", terms={"direct": 2, "cross": 1})
    posterior, table = made.posterior, made.posterior.table
    truth = {"sigma_x": 0.02, "sigma_y": 0.05, "offset_x": 0.1, "offset_y": -0.2, "delay": 0.4137, **NUS}
    truth |= {"gain_x_x": 1.0, "gain_x_y": 0.2, "gain_y_x": 0.3, "gain_y_y": 1.5}
    truth |= {"time_1_direct": 1.2, "time_2_direct": 2.5, "order_1_direct": 1.6, "order_2_direct": 0.7}
    truth |= {"time_1_cross": 2.0, "order_1_cross": 0.9}
    values = row_values(table, truth)
    landscape = Landscape(posterior)
    bound = sensitivities(landscape, values).matrix
    numeric = np.zeros((bound.shape[1], bound.shape[1]))
    least = landscape.least
    x = least.coordinates(values)
    for axis, name in enumerate("xy"):
        sigma, nu = truth[f"sigma_{name}"], truth[f"nu_{name}"]
        z = sigma * np.sinh(np.linspace(-12.0, 12.0, 20_001))

        def log_density(at, parameters=(sigma, nu)):
            return posterior.noise.pointwise(at[None], np.array([parameters]), np.ones(at.size))[0]

        score = (log_density(z + 1e-5 * sigma) - log_density(z - 1e-5 * sigma)) / (2e-5 * sigma)
        information = np.trapezoid(score**2 * np.exp(log_density(z)), z)
        columns = []
        for k in range(x.size):
            sides = [least.values(x + sign * 1e-5 * np.eye(x.size)[k], values) for sign in (1, -1)]
            up, down = (
                responses(table, posterior.model, side[None])[0][axis][0] + table.offset(side[None], axis, 0)
                for side in sides
            )
            columns.append((up - down) / 2e-5)
        slopes = np.array(columns)[:, posterior.samples[0].axes[axis].index]
        numeric += information * slopes @ slopes.T
    assert_allclose(bound.T @ bound, numeric, rtol=1e-5, atol=1e-6 * np.abs(numeric).max())


def test_scatter_of_maximum_likelihood_is_that_of_the_bound():
    """1000 simulated records of 400 samples whose level alone is unknown, at nu = 2.5."""
    made = problem(
        record(command=quiet(0.0), camera=0.03, noise_sd=0.0, name="still"), record(), noise="student"
    )
    values = row_values(made.posterior.table, _known(made.posterior.table.names))
    landscape = Landscape(made.posterior)
    found = sensitivities(landscape, values)
    slopes = found.matrix[:, [name.startswith("offset") for name in found.names]][:, 0]
    rng, n = np.random.default_rng(8), made.posterior.samples[0].axes[0].values.size
    noise = TRUTH["sigma"] * rng.standard_t(2.5, (1000, n))
    level = np.median(noise, axis=1)
    for _ in range(60):  # expectation maximisation at known scale and degrees of freedom
        weights = 3.5 / (2.5 + ((noise - level[:, None]) / TRUTH["sigma"]) ** 2)
        level = (weights * noise).sum(axis=1) / weights.sum(axis=1)
    bound = 1 / np.sqrt(slopes @ slopes)
    assert level.std() / bound == pytest.approx(1.0, abs=4 / np.sqrt(2 * 1000) + 1 / n)


def _known(names):
    """The truth, with an offset for every record."""
    return {
        name: TRUTH["offset"] if name.startswith("offset") else (TRUTH | {"nu": 2.5})[name] for name in names
    }
