"""Whole runs on posteriors whose answer is known by another method."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy import signal, stats
from small import TRUTH, Toy, U, Y, problem, record

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.data.record import Record
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.convergence import qualities
from lcopa_bayes.sampling.draws import Draws, gather
from lcopa_bayes.sampling.evidence import evidence
from lcopa_bayes.sampling.run import SamplePlan
from lcopa_bayes.sampling.sampler import sample

FAR = 1.95
"""Distance of Kolmogorov, times the root of the number of draws, exceeded once in a thousand [-]."""


def kolmogorov(draws: Vector, at: Vector, exact: Vector) -> float:
    """Largest distance between the distribution of draws and the exact one, looked at in some places."""
    share = np.searchsorted(np.sort(draws), at, side="right") / draws.size
    return float(np.abs(share - exact).max())


def plan(seed: int) -> SamplePlan:
    """The first seed is the short form, of a quarter as many effective draws; errors follow their number."""
    return SamplePlan(2, 48, 2000, 4, 400.0, seed) if seed else SamplePlan(2, 32, 2000, 4, 100.0, seed)


# -- several modes ---------------------------------------------------------------------------------

MODES, SHARES, WIDTH = np.array([-6.0, 6.0]), np.array([0.3, 0.7]), 0.5


def two_modes(z: Matrix) -> Vector:
    """Log density of two normal modes, 24 standard deviations apart in both directions."""
    each = -0.5 * ((z - MODES[:, None, None]) / WIDTH) ** 2 - np.log(WIDTH * np.sqrt(2 * np.pi))
    parts = each.sum(axis=2) + np.log(SHARES)[:, None]
    return np.asarray(np.logaddexp(*parts))


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 8))])
def test_modes_that_no_step_joins_are_found_in_their_shares(seed):
    toy = Toy(two_modes, {name: ("uniform", {"loc": -15.0, "scale": 30.0}) for name in "ab"})
    run = sample(toy, plan(seed))
    draws, (kept, _) = gather(toy, run), run.kept()
    assert draws.grade.level == "reliable", draws.grade.reason
    right = kept[..., 0] > 0
    assert_share(right, SHARES[1])
    for k in range(2):
        assert ((kept[..., k] > 0) == right).all()  # the diagonal modes only
        for at, there in ((MODES[0], ~right), (MODES[1], right)):
            drawn = kept[..., k][there]
            assert abs(drawn.mean() - at) < 0.1 * WIDTH
            assert abs(drawn.std() / WIDTH - 1) < 0.1
    weighed = evidence(toy, kept, draws.ess, seed)
    assert weighed is not None
    assert abs(weighed.value + 2 * np.log(30.0)) < 4.5 * weighed.sd
    assert weighed.sd < 0.3


def assert_share(inside: Matrix, exact: float) -> None:
    """A share within Monte Carlo error, and that is small enough to tell."""
    error = np.sqrt(exact * (1 - exact) / effective_of(inside))
    assert error < 0.06
    assert abs(inside.mean() - exact) < 4 * error, (inside.mean(axis=(1, 2)), error)


def effective_of(reported: Matrix) -> float:
    """Effective draws for the mean of what is reported at each (ensemble, walker, draw)."""
    return min(float(reported.size), qualities(["it"], reported[..., None].astype(float))[0].ess_bulk)


# -- a funnel --------------------------------------------------------------------------------------

MOUTH, ENDS = 1.5, (-6.0, 6.0)
"""Standard deviation of the log variance, and its bounds."""


def funnel(z: Matrix) -> Vector:
    """Neal (2003), Ann. Statist. 31: the first coordinate is the log variance of the others."""
    v, rest = z[:, 0], z[:, 1:]
    inner = -0.5 * (rest**2).sum(axis=1) * np.exp(-v) - 0.5 * rest.shape[1] * v
    return -0.5 * (v / MOUTH) ** 2 + inner


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 6))])
def test_the_neck_of_a_funnel_is_filled(seed):
    sides = {name: ("uniform", {"loc": -80.0, "scale": 160.0}) for name in "ab"}
    toy = Toy(funnel, {"v": ("uniform", {"loc": ENDS[0], "scale": ENDS[1] - ENDS[0]})} | sides)
    run = sample(toy, plan(seed))
    draws, kept = gather(toy, run), run.kept()[0][..., 0]
    exact = stats.truncnorm(ENDS[0] / MOUTH, ENDS[1] / MOUTH, scale=MOUTH)
    at = np.linspace(*ENDS, 121)
    assert draws.grade.level == "reliable", draws.grade.reason
    assert kolmogorov(kept.ravel(), at, exact.cdf(at)) < FAR / np.sqrt(effective_of(kept))
    for below in (-3.0, -2.0):  # there the sides are ten times as narrow as at the mouth, and narrower
        assert_share(kept < below, float(exact.cdf(below)))


# -- integer orders --------------------------------------------------------------------------------

SWITCH, DELAY, GAIN, NOISE = 0.4, 0.7, 2.0, 0.15
ORDERS = {"one": ((1,), (1.5,)), "two": ((2, 1), (1.1, 1.6))}
GRID = 0.1
"""Sample times lie on multiples of this from the moment the response begins [ms]."""
LEAST, MOST = 0.4, 4.0
"""Ends of the uniform prior of the time constants [ms]."""


def exact_step(times: tuple[float, ...], at: Vector) -> Vector:
    """Step response by the state space of scipy: ``1 / (T s + 1)`` or ``1 / (T1^2 s^2 + T2 s + 1)``."""
    system = [times[0], 1.0] if len(times) == 1 else [times[0] ** 2, times[1], 1.0]
    axis = GRID * np.arange(120)
    _, response = signal.step(signal.lti([1.0], system), T=axis)
    index = np.rint((at - SWITCH - DELAY) / GRID).astype(int)
    return np.where(index > 0, response[np.maximum(index, 0)], 0.0)


@cache
def integer(name: str) -> tuple[Posterior, Record]:
    """A posterior with integer orders fixed, and its record, which no part of the package has made."""
    orders, times = ORDERS[name]
    at = 0.2 * np.arange(61)
    noise = NOISE * np.random.default_rng(3).standard_normal(at.size)
    response = GAIN * exact_step(times, at) + noise
    drive = (at >= SWITCH - 1e-9).astype(float)
    made = Record("made", at, drive[:, None], response[:, None], (U,), (Y,), "ms")
    free = ("uniform", {"loc": LEAST, "scale": MOST - LEAST})
    priors = {f"time_{k + 1}": free for k in range(len(orders))}
    known = {"gain": GAIN, "delay": DELAY, "offset": 0.0, "sigma": NOISE}
    return problem(made, priors=priors | known, terms=len(orders), orders=orders).posterior, made


def on_grid(name: str, points: int) -> tuple[Vector, Matrix]:
    """Log likelihood by the exact step response, on a grid over all time constants."""
    _, made = integer(name)
    axis = np.linspace(LEAST, MOST, points + 1)
    axis = (axis[1:] + axis[:-1]) / 2
    grid = np.stack([a.ravel() for a in np.meshgrid(*[axis] * len(ORDERS[name][0]), indexing="ij")], axis=1)
    residual = np.array([made.response[:, 0] - GAIN * exact_step(tuple(t), made.time) for t in grid])
    found = stats.norm(0, NOISE).logpdf(residual).sum(axis=1)
    return axis, found.reshape(*[points] * grid.shape[1])


@pytest.mark.parametrize(("name", "points"), [("one", 200), pytest.param("two", 40, marks=pytest.mark.slow)])
def test_fractional_calculus_with_integer_orders_is_the_integer_model(name, points):
    """Likelihood point by point, then the marginals of a run against quadrature."""
    posterior, _ = integer(name)
    orders = [k for k, row in enumerate(posterior.table.rows) if row.kind == "order"]
    assert not any(posterior.table.rows[k].free for k in orders)
    axis, exact = on_grid(name, points)
    grid = np.stack([a.ravel() for a in np.meshgrid(*[axis] * exact.ndim, indexing="ij")], axis=1)
    likely = exact.ravel() > exact.max() - 12
    ours = posterior.log_likelihood(posterior.values(np.log(grid[likely])))
    np.testing.assert_allclose(ours, exact.ravel()[likely], atol=0.05)
    run = sample(posterior, SamplePlan(2, 16, 400, 3, 120.0, 4))
    draws = gather(posterior, run)
    weights = np.exp(exact - exact.max())
    for k in range(exact.ndim):
        others = tuple(j for j in range(exact.ndim) if j != k)
        marginal = weights.sum(axis=others) / weights.sum()
        quality = next(q for q in draws.qualities if q.name == f"time_{k + 1}")
        drawn = draws.column(quality.name)
        mean = float(marginal @ axis)
        sd = float(np.sqrt(marginal @ (axis - mean) ** 2))
        count = min(quality.ess, drawn.size)
        assert count > 100
        assert abs(drawn.mean() - mean) < 4 * sd / np.sqrt(count)
        assert abs(drawn.std() / sd - 1) < 4 / np.sqrt(2 * count)
        edges = axis + (axis[1] - axis[0]) / 2
        assert kolmogorov(drawn, edges, np.cumsum(marginal)) < FAR / np.sqrt(count)


# -- no correlation --------------------------------------------------------------------------------


def test_noise_without_correlation_is_white(rng):
    seen = record(camera=0.6)
    white = problem(seen).posterior
    still = problem(seen, noise="ar1", priors={"rho": 0.0}).posterior
    assert [still.table.names[k] for k in still.sampled] == [white.table.names[k] for k in white.sampled]
    z = white.coordinates(white.table.draw(200, rng))
    np.testing.assert_array_equal(still.coordinates(still.values(z)), white.coordinates(white.values(z)))
    np.testing.assert_allclose(still.log_density(z), white.log_density(z), rtol=1e-12)
    values = still.values(z[:20])
    rho = still.table.names.index("rho")
    gaps = []
    for small in (1e-4, 1e-5):
        values[:, rho] = small
        gaps.append(still.log_likelihood(values) - white.log_likelihood(white.values(z[:20])))
    assert (gaps[0] != 0).all()
    np.testing.assert_allclose(gaps[0] / gaps[1], 10.0, rtol=0.02)  # first order in the correlation


@pytest.mark.slow
def test_a_run_without_correlation_is_a_run_with_white_noise():
    seen, known = record(camera=0.6), {"order_1": TRUTH["order_1"], "delay": TRUTH["delay"]}
    found: list[Draws] = []
    for noise, more in (("white", {}), ("ar1", {"rho": 0.0})):
        posterior = problem(seen, noise=noise, priors=known | more).posterior
        found.append(gather(posterior, sample(posterior, SamplePlan(2, 24, 400, 2, 200.0, 8 + len(more)))))
    white, still = found
    for quality in white.qualities:
        ours, theirs = white.column(quality.name), still.column(quality.name)
        count = min(quality.ess, next(q.ess for q in still.qualities if q.name == quality.name), ours.size)
        assert count > 100
        assert stats.ks_2samp(ours, theirs).statistic < FAR * np.sqrt(2 / count)
