"""Bias by the width of the blocks: against records without noise made by the bench's own numerics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small import U, Y, draws_of, path, record, study, with_effect

from lcopa_bayes.bench.command import staircase, step
from lcopa_bayes.bench.device import Device
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.optimum import Optimum, again, find_optima
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.inference.simulation import Simulation
from lcopa_bayes.inference.surrogate import Surrogate
from lcopa_bayes.results import discretisation as module
from lcopa_bayes.results.discretisation import (
    LARGEST,
    Discretisation,
    discretisation,
    optimum_shift,
    resolved,
)
from lcopa_bayes.sampling.draws import Draws

TIME, GAIN = 3.4, 1.0


def exact_problem(order: float, delay: float, *, sigma: float = 0.002, **model: object) -> Problem:
    """One term, a step on a sample, 125 samples of 0.2, and not a trace of noise in the record."""
    device = Device(((path(GAIN, delay, (TIME,), (order,)),),), (U,), (Y,), (0.0,))
    own = record(device=device, command=step(1.0, at=0.0), camera=0.2, duration=25.0, noise_sd=0.0)
    return problem_of(study(own, noise="white", priors={"sigma": sigma}, **model))


def truth_of(problem: Problem, order: float, delay: float) -> np.ndarray:
    known = {"gain": GAIN, "time": TIME, "order": order, "delay": delay, "offset": 0.0}
    rows = problem.posterior.table.rows
    return np.array([row.value if row.kind == "sigma" else known[row.kind] for row in rows])


def optimum(problem: Problem, start: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Search coordinates of the optimum, their covariance, and table values."""
    least = LeastSquares(problem.posterior)
    values, jacobian = least.solve(start)
    return least.coordinates(values), np.linalg.inv(jacobian.T @ jacobian), values


def bias(problem: Problem, order: float, delay: float) -> np.ndarray:
    """Deviation of the optimum from the truth [posterior sd]."""
    start = truth_of(problem, order, delay)
    x, covariance, _ = optimum(problem, start)
    return (x - LeastSquares(problem.posterior).coordinates(start)) / np.sqrt(np.diag(covariance))


@pytest.mark.parametrize("order", [0.6, 0.9, 1.2, 1.8])
@pytest.mark.parametrize("delay", [1.0, 1.07, 1.199])
def test_no_parameter_is_biased_by_the_blocks_a_fit_chooses(order, delay):
    """Noise 0.2 % of the step; on blocks that held the onset the delay was off by 17 sd at order 0.6."""
    chosen = resolved(exact_problem(order, delay))
    assert np.abs(bias(chosen, order, delay)).max() < LARGEST


@pytest.mark.parametrize(
    ("order", "delay", "sigma"), [(1.8, 1.07, 5e-6), (0.4, 1.199, 0.002), (1.5, 1.0, 5e-6)]
)
def test_the_shift_of_the_optimum_is_its_bias(order, delay, sigma):
    problem = exact_problem(order, delay, sigma=sigma, blocks=2)
    actual = bias(problem, order, delay)
    assert np.abs(actual).max() > 0.1
    _, _, values = optimum(problem, truth_of(problem, order, delay))
    assert optimum_shift(problem, values) == pytest.approx(np.abs(actual).max(), rel=0.15)


def test_draws_move_as_the_optimum_does(rng):
    """Reweighted draws against a refit on blocks sixteen times narrower, with its sign."""
    problem = exact_problem(1.8, 1.07, sigma=1e-5, blocks=2)
    x, covariance, values = optimum(problem, truth_of(problem, 1.8, 1.07))
    least = LeastSquares(problem.posterior)
    drawn = np.array(
        [least.values(each, values) for each in rng.multivariate_normal(x, covariance, size=400)]
    )
    draws = draws_of(problem.posterior.table, drawn)
    found = discretisation(problem, draws)
    refit, _, _ = optimum(problem.refined(16), values)
    position = [problem.posterior.table.names[k] for k in least.columns].index(found.parameter)
    actual = (refit - x)[position] / np.sqrt(covariance[position, position])
    assert abs(actual) > 0.2
    assert found.shift == pytest.approx(actual, abs=0.03 + 3 * found.error)
    assert not found.negligible
    # limited are those that a refit moves, and no others
    shifts = np.abs(refit - x) / np.sqrt(np.diag(covariance))
    names = [problem.posterior.table.names[k] for k in least.columns]
    (limitation,) = found.limitations
    for name, shift in zip(names, shifts, strict=True):
        if abs(shift - LARGEST) > 0.1:
            assert limitation.concerns(name) == (shift > LARGEST)
    assert discretisation(resolved(problem), draws).negligible


def test_narrower_blocks_only_where_they_are_needed():
    smooth, steep = exact_problem(1.2, 1.07, sigma=0.02), exact_problem(1.8, 1.07, sigma=5e-6, blocks=2)
    assert resolved(smooth).refinement == 1
    narrow = resolved(steep)
    assert narrow.refinement > 1
    widths = [each.posterior.model.experiments[0].mesh.lattice.step for each in (steep, narrow)]
    assert widths[0] / widths[1] == pytest.approx(narrow.refinement)
    samples, model = narrow.simulated(narrow.study.fit)
    assert model.experiments[0].mesh.lattice.step == widths[1]
    assert len(samples) == 1


def test_a_shift_caps_the_grade():
    small = Discretisation("delay", -0.05, 0.01, 1, 250)
    assert small.negligible
    assert small.limitations == ()
    for shift, level in ((-0.4, "tentative"), (2.3, "unusable")):
        (limitation,) = replace(small, shift=shift).limitations
        assert limitation.level == level
        assert "delay" in limitation.reason
        assert "blocks" in limitation.remedy
    assert replace(small, shift=0.15, error=0.05).negligible  # not more than its error beyond


@pytest.mark.parametrize(("sigma", "looked_at"), [(0.02, 34), (1e-5, 400)])
def test_few_draws_are_looked_at_where_the_width_hardly_matters(rng, monkeypatch, sigma, looked_at):
    problem = exact_problem(1.8, 1.07, sigma=sigma, blocks=2)
    x, covariance, values = optimum(problem, truth_of(problem, 1.8, 1.07))
    least, counts = LeastSquares(problem.posterior), []
    drawn = np.array(
        [least.values(each, values) for each in rng.multivariate_normal(x, covariance, size=400)]
    )
    actual = Posterior.joint_log_likelihood

    def counted(self, values):
        counts.append(len(values))
        return actual(self, values)

    monkeypatch.setattr(Posterior, "joint_log_likelihood", counted)
    found = discretisation(problem, draws_of(problem.posterior.table, drawn))
    assert sum(counts) == 2 * looked_at  # on narrow blocks and on those used
    assert (abs(found.shift) + 2 * found.error < 0.05) == (looked_at < 400)


Stiff = tuple[Problem, Optimum, Draws, Surrogate]


def stiff(sigma: float) -> Stiff:
    """A plant that hardens, on blocks as wide as its samples are apart; normal draws about its optimum."""
    commands = [staircase([a, -0.7 * a, 0.4 * a, 0.0], hold=3.0, start=0.55) for a in (1.0, 0.5)]
    made = [record(k, command=c, camera=0.3, duration=15.0, name=f"r{k}") for k, c in enumerate(commands)]
    base = study(*made, noise="white", seed=4, blocks=2, priors={"sigma": sigma})
    truth = {"gain": 2.0, "time": 1.5, "order": 0.8, "delay": 0.73, "offset": 0.3, "coefficient": 0.4}
    problem = problem_of(with_effect(base, ["cubic_stiffness"], truth | {"sigma": sigma})[0])
    posterior, rng = problem.posterior, np.random.default_rng(1)
    best = find_optima(posterior, rng, starts=2)[0]
    z = rng.multivariate_normal(posterior.coordinates(best.values[None])[0], best.covariance, size=2000)
    draws = draws_of(posterior.table, posterior.complete(z, rng))
    surrogate = Surrogate.of(posterior, best, np.random.default_rng(2))
    assert surrogate is not None
    return problem, best, draws, surrogate


@pytest.fixture(scope="module", params=[0.004, 0.008])
def stiffened(request: pytest.FixtureRequest) -> Stiff:
    return stiff(request.param)


def measured(stiff: Stiff, surrogate: object) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Shifts, their errors and names of all free parameters; by weighted draws without a surrogate."""
    problem, _, draws, _ = stiff
    used, finer = problem.posterior, problem.refined(module.FACTORS[-1]).posterior
    rows = [k for k, row in enumerate(draws.table.rows) if row.free]
    names = [draws.table.names[k] for k in rows]
    with module.workers(None) as crew:
        if surrogate is None:
            return *module._weighted(used, finer, draws, rows, crew), names
        return *module._controlled(used, finer, draws, rows, crew, surrogate), names


def test_a_control_variate_shifts_draws_as_a_refit_does(stiffened):
    """Against the optimum on blocks four times narrower, and against weights of eight times as many draws."""
    problem, best, _, surrogate = stiffened
    shifts, errors, names = measured(stiffened, surrogate)
    other, wider, _ = measured(stiffened, None)
    assert np.abs(shifts).max() > 0.08
    assert np.all(np.abs(shifts - other) < 4 * np.hypot(errors, wider))
    assert errors.max() < wider.max()
    posterior = problem.refined(module.FACTORS[-1]).posterior
    refit = again(posterior, [best])[0]
    moved = np.subtract(*(posterior.coordinates(one.values[None])[0] for one in (refit, best)))
    moved /= np.sqrt(np.diag(best.covariance)) / module._REST
    at = [names.index(posterior.table.names[k]) for k in posterior.sampled]
    assert np.all(np.abs(shifts[at] - moved) < 4 * errors[at] + 0.02)


def test_a_control_variate_that_is_wrong_does_not_shift_the_measurement(stiffened):
    """Responses that move to the other side: the shift has its sign, and a larger error."""
    _, best, _, surrogate = stiffened
    centre = surrogate(best.values[None])

    def mirrored(values):
        pairs = zip(surrogate(values), centre, strict=True)
        return [one._replace(base=2 * middle.base - one.base) for one, middle in pairs]

    right, fine, _ = measured(stiffened, surrogate)
    wrong, rough, _ = measured(stiffened, mirrored)
    assert np.all(np.abs(right - wrong) < 4 * np.hypot(fine, rough))
    assert rough.max() > 1.5 * fine.max()


def narrow_draws(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Numbers of plants that are simulated, as they are asked for."""
    counts, actual = [], Simulation.__call__

    def counted(self, values):
        counts.append(len(values))
        return actual(self, values)

    monkeypatch.setattr(Simulation, "__call__", counted)
    return counts


@pytest.mark.parametrize(
    ("sigma", "precise", "looked_at"), [(0.05, 1.0, 16), (0.05, 0.0, 16), (0.008, 1.0, 16), (0.008, 0.0, 128)]
)
def test_a_measurement_ends_when_it_is_clear_or_precise(monkeypatch, sigma, precise, looked_at):
    """Hardly any shift is clear at once; one near the limit takes as many draws as there are, unless its
    error is small enough."""
    problem, _, draws, surrogate = stiff(sigma)
    monkeypatch.setattr(module, "_PRECISE", precise)
    counts = narrow_draws(monkeypatch)
    found = discretisation(problem, draws, surrogate=surrogate)
    assert sum(counts) == 2 * looked_at  # on narrow blocks and on those used
    assert (abs(abs(found.shift) - LARGEST) > 2 * found.error) == (sigma == 0.05)


def test_a_measurement_does_not_depend_on_the_number_of_processes(stiffened):
    problem, _, draws, surrogate = stiffened
    alone, shared = (discretisation(problem, draws, surrogate=surrogate, jobs=jobs) for jobs in (1, 2))
    assert alone == shared


@pytest.mark.parametrize("count", [128, 100])
def test_the_first_draws_of_a_measurement_are_spread_over_all(count):
    order = module._nested(count)
    assert sorted(order.tolist()) == list(range(count))
    for first in (16, 32, 64):
        ends = np.sort(order[:first])
        assert np.diff([*ends, count]).max() <= 2 * 128 // first
