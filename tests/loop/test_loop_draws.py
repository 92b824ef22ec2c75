"""The loop's sampler against targets whose moments are known, and its solver against the slow road."""

from __future__ import annotations

from types import SimpleNamespace

import emcee
import numpy as np
import pytest
from numpy.testing import assert_allclose

from lcopa_bayes.loop.draws import sample_loop
from lcopa_bayes.loop.proposals import Counted, Jump, Walk, learnt
from lcopa_bayes.loop.surrogate import Surrogate
from lcopa_bayes.model.effects import balance

SLOPE, SCALE = 0.7, 1.6


def skewed(z):
    """Log density of a banana: x standard normal, y given x normal about SLOPE (x^2 - 1)."""
    x, y = np.atleast_2d(z).T
    return -0.5 * x**2 - 0.5 * ((y - SLOPE * (x**2 - 1)) / 0.5) ** 2


def plain(z):
    """A stand-in that knows nothing of the bend and is too wide."""
    return -0.5 * (np.atleast_2d(z) ** 2).sum(axis=1) / SCALE**2


def drawn(proposal, target, steps=1500, walkers=20):
    """Draws after a burn-in, (steps * walkers, 2), and the share accepted."""
    move = Counted(proposal)
    sampler = emcee.EnsembleSampler(walkers, 2, lambda z: float(target(z)[0]), moves=[(move, 1.0)])
    random = np.random.RandomState(3)
    sampler.random_state = random.get_state()
    sampler.run_mcmc(0.5 * random.standard_normal((walkers, 2)), steps)
    return sampler.get_chain(discard=100, flat=True), move.acceptance


@pytest.mark.parametrize("near", [False, True])
@pytest.mark.parametrize("wrong", [False, True])
def test_walks_on_a_surrogate_leave_the_target_as_it_is(near, wrong):
    jump = Jump(np.zeros(2), 1.3 * np.eye(2))
    chain, accepted = drawn(Walk(plain if wrong else skewed, jump, near=near), skewed, 1500 if near else 700)
    if not wrong:  # the surrogate is the target: what it proposes is always accepted
        assert accepted > 0.999
    x, y = chain.T
    assert_allclose([x.mean(), y.mean()], 0.0, atol=0.12)
    assert_allclose([x.var(), y.var()], [1.0, 0.25 + 2 * SLOPE**2], rtol=0.17)
    assert_allclose(np.mean(y * (x**2 - 1)), 2 * SLOPE, rtol=0.2)


def test_a_walk_accepted_without_its_surrogate_is_noticed():
    """The test above can fail: without the ratio of the surrogate's densities the moments are others."""
    jump = Jump(np.zeros(2), 1.3 * np.eye(2))
    walk = Walk(plain, jump)

    def careless(here, random):
        there, ratio = walk(here, random)
        return there, np.zeros_like(ratio)

    x, y = drawn(careless, skewed, 500)[0].T
    assert abs(y.var() / (0.25 + 2 * SLOPE**2) - 1) > 0.3 or abs(x.var() - 1) > 0.3


def test_jumps_are_of_the_t_law_they_are_weighed_by():
    jump = Jump.of(np.array([1.0, -2.0]), np.array([[2.0, 0.5], [0.5, 1.0]]))
    draws = jump.drawn(40_000, np.random.RandomState(1))
    assert_allclose(np.cov(draws.T), np.array([[2.0, 0.5], [0.5, 1.0]]) * 12 / 10, rtol=0.05, atol=0.03)
    from scipy.stats import multivariate_t

    law = multivariate_t(jump.centre, jump.root @ jump.root.T, df=12)
    told = jump.log_density(draws[:50]) - law.logpdf(draws[:50])
    assert_allclose(told, told[0], atol=1e-9)


def test_mean_and_covariance_of_a_surrogate_are_learnt():
    wide = np.array([[1.0, 0.4], [0.4, 0.5]])
    inverse = np.linalg.inv(wide)

    def normal(z):
        return -0.5 * np.einsum("bi,ij,bj->b", z - 1.0, inverse, z - 1.0)

    law = learnt(normal, np.zeros(2), np.eye(2), np.random.RandomState(2))
    assert_allclose(law.centre, 1.0, atol=0.15)
    assert_allclose(law.root @ law.root.T, wide, rtol=0.25, atol=0.05)


class Linear:
    """A density as `LoopDensity` with an exactly linear residual in three coordinates, one more integrated
    out: the posterior is a Student t law known in closed form."""

    def __init__(self, curved=0.0):
        rng = np.random.default_rng(5)
        self.tangents = rng.standard_normal((300, 4)) * [1.0, 2.0, 0.5, 1.0]
        self.noise, self.curved = rng.standard_normal(300), curved
        self.sampled, self.linear = np.arange(3), np.array([3])
        fit = np.linalg.lstsq(self.tangents, self.noise, rcond=None)[0]
        self.noise -= self.tangents @ fit  # the optimum is at 0
        optimum = SimpleNamespace(
            x=np.zeros(4),
            covariance=np.linalg.inv(self.tangents.T @ self.tangents),
            cost=0.5 * self.noise @ self.noise,
        )
        rows = [SimpleNamespace(kind="gain")] * 4
        base = SimpleNamespace(
            posterior=SimpleNamespace(table=SimpleNamespace(rows=rows)),
            least=SimpleNamespace(columns=range(4)),
        )
        model = SimpleNamespace(
            plant_size=4, base=base, bounds=(np.full(4, -np.inf), np.full(4, np.inf)), effects=()
        )
        whitening = SimpleNamespace(size=self.noise.size)
        self.state = SimpleNamespace(optimum=optimum, model=model, whitening=whitening)
        self.columns, self.pull = self.tangents[:, 3:], np.zeros(1)
        self.inverse = np.linalg.inv(self.columns.T @ self.columns)

    def residual(self, z):
        bent = z + self.curved * np.array([0.0, z[0] ** 2, 0.0])
        return self.noise - self.tangents[:, :3] @ bent

    def pulled(self, white):
        return white @ self.columns

    def log_priors(self, z, *, ordered=True):
        return np.zeros(len(z))

    def log_likelihood(self, power):
        cost = 2 * self.state.optimum.cost
        return -0.5 * 300 * np.log1p((power - cost) / cost)

    def with_conditional(self, z):
        white = self.residual(z)
        inner = self.pulled(white)
        shift = self.inverse @ inner
        power = white @ white - inner @ shift
        return float(self.log_likelihood(power)), np.append(shift, power)

    def __call__(self, z):
        return self.with_conditional(z)[0]

    def completed(self, z, conditional, rng):
        noise = rng.standard_normal((len(z), 1)) * np.sqrt(self.inverse[0, 0])
        return np.concatenate([z, conditional[:, :1] + noise], axis=1)


@pytest.mark.parametrize("curved", [0.0, 3.0])
def test_a_surrogate_of_a_residual_along_its_columns_is_exact(curved):
    density = Linear(curved)
    surrogate = Surrogate.of(density)
    told = surrogate(np.zeros((1, 3)))[0] - density(np.zeros(3))
    for u in np.eye(3):  # columns by themselves; the bend is a parabola in the first
        for size in (-1.7, 0.4, 2.9):
            z = size * surrogate.root @ u
            assert_allclose(surrogate(z[None])[0] - density(z), told, atol=1e-8)


def test_draws_have_the_moments_of_the_posterior(monkeypatch):
    density = Linear()
    monkeypatch.setattr("lcopa_bayes.loop.draws.unit_of", lambda model, k: (f"x{k}", "-", 1.0))
    made = sample_loop(density, 7)
    again = sample_loop(density, 7)
    assert np.array_equal(made.coordinates, again.coordinates)
    assert made.grade.level == "reliable"
    wanted = density.state.optimum.covariance
    worst = min(q.ess for q in made.qualities)
    assert worst >= 400
    sd = np.sqrt(np.diag(wanted))
    assert_allclose(made.flat.mean(axis=0) / sd, 0.0, atol=0.2)
    assert_allclose(made.flat.std(axis=0) / sd, 1.0, rtol=0.15)


def rise_and_fall(f, e):
    """Force with slopes in y and both earlier values, as of a viscosity that depends on the rate."""

    def force(blocks, y, one, two):
        rate = 1.5 * y - 2.0 * one + 0.5 * two
        falling = 0.5 * (1.0 - np.tanh(y * rate / 3e-3))
        return y + (f[:, blocks] - y) / (1.0 + e * falling)

    return force


@pytest.mark.parametrize("e", [0.1, 0.4])
def test_balance_satisfies_its_equation_where_windows_are_needed(e):
    n = 500
    kernel = np.stack([0.05 * np.exp(-0.05 * np.arange(n)), 0.03 * np.exp(-0.03 * np.arange(n))])
    f = np.stack([np.where(np.arange(n) // 90 % 2, 1.0, 0.2), np.where(np.arange(n) // 70 % 2, -0.5, 1.0)])
    force = rise_and_fall(f, e)
    y = balance.balanced(kernel, force, np.ones(2))
    assert_allclose(balance.balanced(kernel, force, np.ones(2)), y, rtol=0, atol=0)
    one, two = np.pad(y, ((0, 0), (1, 0)))[:, :-1], np.pad(y, ((0, 0), (2, 0)))[:, :-2]
    v = force(slice(0, n), y, one, two)
    told = np.stack([np.convolve(k, row)[:n] for k, row in zip(kernel, v, strict=True)])
    assert_allclose(told, y, atol=1e-10)


def test_newton_from_another_start_is_the_same_solution():
    n = 100
    kernel = np.stack([0.05 * np.exp(-0.05 * np.arange(n))])
    f = np.where(np.arange(n) > 50, 0.2, 1.0)[None]
    force, before, scale = rise_and_fall(f, 0.3), np.zeros((1, 2)), np.ones((1, 1))
    from scipy.linalg import toeplitz

    operators = [np.asfortranarray(toeplitz(kernel[0], np.zeros(n)))]
    rest = np.zeros((1, n))
    found = balance._newton(operators, force, rest, before, scale, slice(0, n), rest)
    assert found is not None
    other = balance._newton(operators, force, rest, before, scale, slice(0, n), found[0] + 1e-3)
    assert other is not None
    assert_allclose(other[0], found[0], atol=1e-10)
