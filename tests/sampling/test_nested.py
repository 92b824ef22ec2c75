"""Nested sampling: the prior as a cube, walks that leave it unchanged, evidences known by quadrature."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from scipy.special import logsumexp
from small import TRUTH, problem, record

from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.constrainedwalk import Walk
from lcopa_bayes.sampling.deadpoints import Strands
from lcopa_bayes.sampling.homography import Element, elements
from lcopa_bayes.sampling.nested import Nested, NestedPlan, nested
from lcopa_bayes.sampling.unitcube import UnitCube

SHORT = record(camera=0.6)
KINDS = ("difference", "follow", "slide", "roam", "swap")
TAILS = {"time_1": ("gamma", {"a": 2.0, "scale": 3.0}), "delay": ("norm", {"loc": 0.5, "scale": 1.0})}
"""Priors that differ between the terms, one of them with mass outside its domain."""


@cache
def made(terms: int = 2, *, alike: bool = True, gain: str = "norm") -> Posterior:
    gains = {
        "norm": ("norm", {"loc": 0.0, "scale": 10.0}),
        "loguniform": ("loguniform", {"a": 0.1, "b": 30.0}),
        "lognorm": ("lognorm", {"s": 0.7, "scale": 1.5}),
    }
    priors = {"gain": gains[gain], "sigma": 0.1, "offset": 0.3} | ({} if alike else TAILS)
    return problem(SHORT, terms=terms, priors=priors).posterior


# -- the prior as a cube ---------------------------------------------------------------------------


@pytest.mark.parametrize("alike", [True, False])
def test_uniform_points_are_draws_of_the_prior(alike, rng):
    cube = UnitCube(made(3, alike=alike))
    coordinates = cube.coordinates(cube.draw(4000, rng))
    drawn = cube.posterior.coordinates(cube.posterior.table.draw(4000, rng))
    assert cube.inside(coordinates).all()
    for ours, theirs in zip(coordinates.T, drawn.T, strict=True):
        assert stats.ks_2samp(ours, theirs).pvalue > 1e-3


@pytest.mark.parametrize("alike", [True, False])
def test_points_and_coordinates_are_inverse(alike, rng):
    cube = UnitCube(made(3, alike=alike))
    coordinates = cube.coordinates(cube.draw(200, rng))
    points = cube.points(coordinates)
    assert ((points > 0) & (points < 1)).all()
    assert_allclose(cube.coordinates(points), coordinates, rtol=1e-9, atol=1e-9)


def test_what_is_outside_has_no_likelihood(rng):
    cube = UnitCube(made(2))
    inside = cube.coordinates(cube.draw(1, rng))
    orders = cube.posterior.sampled.index(cube.posterior.table.at("order", 0, 0)), -1
    outside = inside.copy()
    outside[0, orders[0]] = 2.5
    reported = cube.log_likelihood(np.concatenate([inside, outside]))
    assert np.isfinite(reported[0])
    assert reported[1] == -np.inf


# -- the homography --------------------------------------------------------------------------------


def moved(gain: str, rng: np.random.Generator) -> tuple[Element, np.ndarray, np.ndarray, np.ndarray, tuple]:
    """Some points, other orders for them, and frequencies and steps that all of them can take."""
    posterior = made(2, gain=gain)
    (element,) = elements(posterior)
    reported = TRUTH | {"time_2": 0.4, "order_2": 0.5, "order_1": 1.4}
    z = posterior.coordinates(np.array([[reported[name] for name in posterior.table.names]] * 6))
    z += 0.05 * rng.normal(size=z.shape)
    proposed = z.copy()
    proposed[:, element.orders] += 0.1 * rng.normal(size=(6, 2))
    frequencies = np.log([[0.05, 0.6, 3.0]]) + 0.1 * rng.normal(size=(6, 3))
    return element, z, proposed, frequencies, (0.02 * rng.normal(size=(6, 3)), posterior)


@pytest.mark.parametrize("gain", ["loguniform", "lognorm"])
def test_the_response_moves_by_the_steps_and_back(gain, rng):
    element, z, proposed, frequencies, (step, posterior) = moved(gain, rng)
    column = posterior.sampled.index(posterior.table.at("gain", 0, 0))
    found, log_jacobian = element.followed(z, proposed, frequencies, step)
    assert np.isfinite(log_jacobian).all()
    assert_array_equal(found[:, element.orders], proposed[:, element.orders])

    def log_response(at: np.ndarray) -> np.ndarray:
        log_gain = at[:, column] if gain == "loguniform" else np.log(at[:, column])
        return log_gain[:, None] - element.log_level(at, frequencies)

    assert_allclose(log_response(found), log_response(z) - step, atol=1e-10)
    back = found.copy()
    back[:, element.orders] = z[:, element.orders]
    back, log_back = element.followed(found, back, frequencies, -step)
    assert_allclose(back, z, atol=1e-9)
    assert_allclose(log_back, -log_jacobian, atol=1e-9)


@pytest.mark.parametrize("gain", ["norm", "loguniform", "lognorm"])
def test_the_jacobian_is_that_of_central_differences(gain, rng):
    element, z, proposed, frequencies, (step, _) = moved(gain, rng)
    _, log_jacobian = element.followed(z, proposed, frequencies, step)
    change = [*element.times, *(column for column, _ in element.gains)]
    shift = proposed - z

    def mapped(at: np.ndarray) -> np.ndarray:
        return element.followed(at, at + shift, frequencies, step)[0][:, change]

    slopes = np.empty((len(z), len(change), len(change)))
    for k, column in enumerate(change):
        nudge = np.zeros(z.shape[1])
        nudge[column] = 1e-5
        slopes[:, :, k] = (mapped(z + nudge) - mapped(z - nudge)) / 2e-5
    assert_allclose(np.linalg.slogdet(slopes)[1], log_jacobian, atol=1e-6)


def test_orders_that_cannot_be_give_no_move(rng):
    element, z, proposed, frequencies, (step, _) = moved("norm", rng)
    proposed[0, element.orders] = (0.4, 0.9)
    proposed[1, element.orders] = (2.3, 0.4)
    found, log_jacobian = element.followed(z, proposed, frequencies, step)
    assert_array_equal(found[:2], z[:2])
    assert (log_jacobian[:2] == -np.inf).all()


# -- the walk --------------------------------------------------------------------------------------


def band_of(cube: UnitCube, monkeypatch) -> None:
    """A likelihood that is cheap, on a curved ridge: high where the response at two frequencies is near
    that of the truth."""
    (element,) = elements(cube.posterior)
    at = np.log([0.2, 1.5])

    def height(self: UnitCube, z: np.ndarray) -> np.ndarray:
        level = element.log_level(z, np.tile(np.append(at, 0.0), (len(z), 1)))[:, :2]
        return -np.abs(level - (0.5, 2.0)).max(axis=1)

    monkeypatch.setattr(UnitCube, "log_likelihood_inside", height)


def walked(kinds, cube: UnitCube, monkeypatch, *, level: float = -0.5, steps: int = 30, count: int = 4000):
    """Prior draws above a level, and other such draws after a walk."""
    rng = np.random.default_rng(8)
    monkeypatch.setattr("lcopa_bayes.sampling.constrainedwalk._KINDS", dict.fromkeys(kinds, 1 / len(kinds)))
    band_of(cube, monkeypatch)
    above = []
    while sum(map(len, above)) < 2 * count + 500:
        drawn = cube.coordinates(cube.draw(20_000, rng))
        above.append(drawn[cube.log_likelihood_inside(drawn) > level])
    drawn = np.concatenate(above)
    population = drawn[2 * count :]
    start = drawn[:count]
    found, height, _ = Walk(cube, steps).travelled(start, level, population, rng)
    assert np.isfinite(height).mean() > 0.3
    assert (height[np.isfinite(height)] > level).all()
    return drawn[count : 2 * count], found


def least_p(kept: np.ndarray, found: np.ndarray) -> float:
    """Smallest p-value over marginals and over sums of pairs of coordinates."""
    pairs = [
        (a + b, c + d)
        for a, c in zip(kept.T, found.T, strict=True)
        for b, d in zip(kept.T, found.T, strict=True)
    ]
    return min(stats.ks_2samp(a, b).pvalue for a, b in pairs)


@pytest.mark.parametrize("kind", KINDS)
def test_each_proposal_leaves_the_prior_above_a_level_unchanged(kind, monkeypatch):
    assert least_p(*walked([kind], UnitCube(made(2, gain="lognorm")), monkeypatch)) > 1e-4


@pytest.mark.parametrize("kind", ["follow", "slide"])
def test_a_wrong_jacobian_is_seen(kind, monkeypatch):
    honest = Element.followed

    def wrong(*given):
        out, log_jacobian = honest(*given)
        return out, np.where(log_jacobian > -np.inf, 0.0, -np.inf)

    monkeypatch.setattr(Element, "followed", wrong)
    assert least_p(*walked([kind], UnitCube(made(2, gain="lognorm")), monkeypatch)) < 1e-6


def test_a_likelihood_that_is_not_a_number_is_an_error(monkeypatch, rng):
    cube = UnitCube(made(1))
    coordinates = cube.coordinates(cube.draw(4, rng))
    monkeypatch.setattr(Posterior, "log_likelihood", lambda _, values: np.full(len(values), np.nan))
    with pytest.raises(FloatingPointError, match="log density is NaN at gain"):
        cube.log_likelihood(coordinates)


# -- strands ---------------------------------------------------------------------------------------

WIDTH = 1e-3
EXACT = float(np.log(WIDTH * -np.expm1(-1 / WIDTH)))
"""Log of the integral of exp(-X / WIDTH) over the prior volume X."""


def ideal(live: int, rng: np.random.Generator) -> Strands:
    """Exact nested sampling of exp(-X / WIDTH): each strand's volume shrinks by uniform factors."""
    depth = 60
    volume = np.cumprod(rng.random((live, depth)), axis=1)
    return Strands.of(
        np.log(volume).reshape(-1, 1), -volume.ravel() / WIDTH, np.repeat(np.arange(live), depth)
    )


def test_strands_know_evidence_its_error_and_the_posterior(rng):
    runs = [ideal(100, rng) for _ in range(40)]
    found = np.array([run.log_evidence() for run in runs])
    information = -np.log(WIDTH) - 1  # of exp(-X / WIDTH) against the uniform prior
    expected = np.sqrt(information / 100)
    assert abs(found.mean() - EXACT) < 4 * expected / np.sqrt(40)
    assert found.std(ddof=1) == pytest.approx(expected, rel=4 / np.sqrt(2 * 39))
    again = [runs[0].log_evidence(runs[0].redrawn(rng)) for _ in range(200)]
    assert np.std(again, ddof=1) == pytest.approx(expected, rel=0.4)
    joined = Strands.joined(runs)
    assert joined.strands == 4000
    assert joined.log_evidence() == pytest.approx(EXACT, abs=4 * expected / np.sqrt(40))
    weights = np.exp(joined.log_weights() - joined.log_evidence())
    volume = np.exp(joined.coordinates[:, 0])
    assert weights @ volume == pytest.approx(WIDTH, rel=0.15)


def test_strands_twice_there_count_twice(rng):
    one, other = ideal(30, rng), ideal(30, rng)
    both = Strands.joined([one, other])
    only = np.repeat([1, 0], 30)
    assert both.log_evidence(only) == pytest.approx(one.log_evidence(), abs=1e-12)
    assert both.log_evidence(2 * only) == pytest.approx(one.log_evidence(), abs=0.05)


# -- the whole -------------------------------------------------------------------------------------

PLAN = NestedPlan(runs=2, live=80, steps=20, seed=4)


def by_quadrature(posterior: Posterior, ends: dict[str, tuple[float, float]], count: int = 150) -> float:
    """Log evidence by Gauss-Legendre over two coordinates, where the integrand lives."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    axes = [(low + (high - low) * (nodes + 1) / 2, weights * (high - low) / 2) for low, high in ends.values()]
    first, second = np.meshgrid(*(axis for axis, _ in axes), indexing="ij")
    z = np.stack([first.ravel(), second.ravel()], axis=1)
    log_weight = np.log(np.outer(*(weight for _, weight in axes))).ravel()
    return float(logsumexp(posterior.log_density(z) + log_weight))


@pytest.fixture(scope="module")
def delay_and_sigma() -> tuple[Posterior, Nested]:
    reported = {name: TRUTH[name] for name in ("time_1", "order_1")}
    posterior = problem(SHORT, priors=reported).posterior
    return posterior, nested(posterior, PLAN)


def test_the_evidence_is_that_of_quadrature(delay_and_sigma):
    posterior, found = delay_and_sigma
    assert [posterior.table.names[k] for k in posterior.sampled] == ["delay", "sigma"]
    exact = by_quadrature(posterior, {"delay": (0.4, 1.1), "sigma": (np.log(0.008), np.log(0.08))})
    assert 0.02 < found.log_evidence_sd < 0.4
    assert abs(found.log_evidence - exact) < 4 * found.log_evidence_sd
    assert len(found.run_log_evidences) == 2
    assert found.evaluations > 2 * 80


def test_the_draws_have_the_marginals_of_quadrature(delay_and_sigma):
    posterior, found = delay_and_sigma
    names = posterior.table.names
    free = [k for k, row in enumerate(posterior.table.rows) if row.free]
    assert np.isnan(np.delete(found.ess, free)).all()
    assert ((found.ess[free] > 50) & (found.ess[free] <= len(found.values))).all()
    delays = np.linspace(0.4, 1.1, 300)
    sigmas = np.linspace(np.log(0.008), np.log(0.08), 60)
    grid = np.stack([axis.ravel() for axis in np.meshgrid(delays, sigmas, indexing="ij")], axis=1)
    density = np.exp(posterior.log_density(grid) - found.log_evidence).reshape(300, 60)
    marginal = density.sum(axis=1) / density.sum()
    share = np.cumsum(marginal) - marginal / 2
    k = names.index("delay")
    drawn = np.searchsorted(np.sort(found.values[:, k]), delays, side="right") / len(found.values)
    assert np.abs(drawn - share).max() < 1.95 / np.sqrt(found.ess[k])  # exceeded once in a thousand
    gain = names.index("gain")
    assert abs(np.median(found.values[:, gain]) - TRUTH["gain"]) < 4 * found.values[:, gain].std()


@pytest.mark.parametrize("alike", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_the_evidence_is_of_the_prior_with_decreasing_orders(alike):
    """Against the mean likelihood of prior draws; noise so large that these find the posterior."""
    posterior = made(2, alike=alike)
    noisy = replace(posterior.table.rows[-1], value=0.5)
    posterior = replace(posterior, table=replace(posterior.table, rows=(*posterior.table.rows[:-1], noisy)))
    assert posterior.table.exchangeable == (alike,)
    drawn = posterior.table.draw(30_000, np.random.default_rng(0))
    drawn[:, posterior.linear] = np.nan
    heights = posterior.log_likelihood(drawn)
    relative = np.exp(heights - heights.max())
    exact = float(np.log(relative.mean()) + heights.max())
    error = relative.std() / relative.mean() / np.sqrt(len(drawn))
    found = nested(posterior, PLAN)
    assert error < 0.05
    assert found.log_evidence_sd < 0.3
    assert abs(found.log_evidence - exact) < 4 * np.hypot(found.log_evidence_sd, error)
    assert posterior.table.supported(found.values).all()


def test_seed_and_plan_decide_the_result_and_jobs_do_not():
    reported = {name: TRUTH[name] for name in ("time_1", "order_1", "sigma")}
    posterior, plan = problem(SHORT, priors=reported).posterior, NestedPlan(2, 16, 5, 1)
    one, other = nested(posterior, plan), nested(posterior, plan, jobs=2)
    assert_array_equal(one.values, other.values)
    assert one.log_evidence == other.log_evidence
    assert one.run_log_evidences == other.run_log_evidences
    assert nested(posterior, replace(plan, seed=2)).log_evidence != one.log_evidence


def test_a_quick_plan_has_a_quarter_of_the_live_points():
    whole, quick = NestedPlan.of(8, seed=1), NestedPlan.of(8, seed=1, quick=True)
    assert (whole.live, quick.live) == (500, 125)
    assert (whole.runs, whole.steps) == (quick.runs, quick.steps)
