"""A mixture: its density, its draws and its fit."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from scipy.integrate import quad
from scipy.special import logsumexp

from lcopa_bayes.sampling.mixture import Mixture, spread_evenly

FREEDOM = 5.0
SEEDS = (0, 7, 2**32 - 1, 2**32, 2**63, 2**80 + 1)


@pytest.fixture
def three(rng) -> Mixture:
    """Three components in three dimensions, all different."""
    factors = np.tril(rng.normal(size=(3, 3, 3)))
    factors[:, range(3), range(3)] = rng.uniform(0.3, 2.0, (3, 3))
    return Mixture(np.array([0.2, 0.5, 0.3]), rng.normal(scale=3.0, size=(3, 3)), factors)


def components(mixture: Mixture) -> list:
    return [
        stats.multivariate_t(mean, factor @ factor.T, df=FREEDOM)
        for mean, factor in zip(mixture.means, mixture.factors, strict=True)
    ]


def test_the_density_is_that_of_scipy(three, rng):
    points = rng.normal(scale=5.0, size=(200, 3))
    parts = np.array([one.logpdf(points) for one in components(three)]) + np.log(three.weights)[:, None]
    assert_allclose(three.log_parts(points), parts, rtol=1e-10)
    assert_allclose(three.log_density(points), logsumexp(parts, axis=0), rtol=1e-10)
    assert_allclose(logsumexp(three.log_shares(points), axis=0), 0.0, atol=1e-12)
    assert_allclose(three.log_shares(points), parts - logsumexp(parts, axis=0), atol=1e-9)


def test_the_marginal_of_some_columns_has_their_means_and_scales(three, rng):
    columns, points = np.array([2, 0]), rng.normal(scale=5.0, size=(50, 2))
    own = [
        stats.multivariate_t(mean[columns], (factor @ factor.T)[np.ix_(columns, columns)], df=FREEDOM)
        for mean, factor in zip(three.means, three.factors, strict=True)
    ]
    exact = logsumexp([one.logpdf(points) for one in own], axis=0, b=three.weights[:, None])
    assert_allclose(three.marginal(columns).log_density(points), exact, rtol=1e-9)


def test_the_density_is_normalised():
    one = Mixture(np.array([0.3, 0.7]), np.array([[-2.0], [1.0]]), np.array([[[0.5]], [[1.5]]]))
    total, _ = quad(lambda x: float(np.exp(one.log_density(np.array([[x]]))[0])), -np.inf, np.inf)
    assert total == pytest.approx(1.0, abs=1e-7)


def test_draws_have_the_density(three):
    """The scaled squared distance from a component has an F distribution; shares are the weights."""
    count = 6000
    apart = Mixture(three.weights, three.means + 1e3 * np.arange(3)[:, None], three.factors)
    drawn = apart.draw(count, np.random.RandomState(np.random.MT19937(3)))
    owner = np.exp(apart.log_shares(drawn)).argmax(axis=0)
    found = np.bincount(owner, minlength=3)
    assert stats.chisquare(found, count * apart.weights).pvalue > 1e-3
    for k in range(3):
        white = np.linalg.solve(apart.factors[k], (drawn[owner == k] - apart.means[k]).T)
        assert stats.kstest((white**2).sum(axis=0) / 3, stats.f(3, FREEDOM).cdf).pvalue > 1e-3
        for direction in white:
            assert stats.kstest(direction, stats.t(FREEDOM).cdf).pvalue > 1e-3


def test_draws_agree_with_the_density_where_components_overlap(three):
    """Mean of another density over ours at our draws is one."""
    drawn = three.draw(20_000, np.random.RandomState(np.random.MT19937(4)))
    other = stats.multivariate_normal(three.means[1] + 0.3, 0.3 * np.eye(3))
    ratio = np.exp(other.logpdf(drawn) - three.log_density(drawn))
    assert abs(ratio.mean() - 1) < 4 * ratio.std() / np.sqrt(ratio.size)
    assert ratio.std() / np.sqrt(ratio.size) < 0.1


def clusters(count: int, rng: np.random.Generator) -> np.ndarray:
    """A narrow and a wide cluster far apart, in mixed order, a quarter and three quarters."""
    narrow = rng.random(count) < 0.25
    points = rng.normal(size=(count, 2)) * np.where(narrow, 0.1, 3.0)[:, None]
    points[:, 1] += 0.8 * points[:, 0]
    return points + np.where(narrow, -40.0, 40.0)[:, None]


def test_a_fit_finds_two_clusters(rng):
    found = Mixture.fitted(clusters(4000, rng), 1)
    left = found.means[:, 0] < 0
    assert found.weights.sum() == pytest.approx(1.0)
    assert found.weights[left].sum() == pytest.approx(0.25, abs=4 * np.sqrt(0.25 * 0.75 / 4000))
    assert_allclose(found.weights[left] @ found.means[left] / found.weights[left].sum(), -40.0, atol=0.05)
    fresh = clusters(2000, rng)
    exact = np.logaddexp(
        *(
            np.log(share)
            + stats.multivariate_normal(at, width**2 * np.array([[1, 0.8], [0.8, 1.64]])).logpdf(fresh)
            for share, at, width in ((0.25, (-40, -40), 0.1), (0.75, (40, 40), 3.0))
        )
    )
    lost = exact - found.log_density(fresh)
    assert -0.05 < lost.mean() < 0.4  # tails heavier than the normal's cost a little, and nothing is missed
    assert lost.max() < 8.0


def test_a_fit_is_indifferent_to_the_units_of_its_coordinates(rng):
    points, unit = clusters(1500, rng), np.array([1e-6, 1e5])
    small, large = Mixture.fitted(points, 3), Mixture.fitted(points * unit, 3)
    assert_allclose(
        large.log_density(points * unit) + np.log(unit).sum(), small.log_density(points), rtol=1e-6, atol=1e-6
    )


@pytest.mark.parametrize("seed", SEEDS)
def test_the_seed_decides_the_fit(seed):
    points = clusters(800, np.random.default_rng(1))
    one, again = Mixture.fitted(points, seed), Mixture.fitted(points, seed)
    for name in ("weights", "means", "factors"):
        assert_array_equal(getattr(one, name), getattr(again, name))
    others = {seed + 1, seed % 2**32} - {seed}
    assert not any(np.array_equal(one.means, Mixture.fitted(points, other).means) for other in others)


@pytest.mark.parametrize(("count", "expected"), [(5, 1), (59, 1), (60, 2), (299, 9), (5000, 20)])
def test_few_points_have_few_components(count, expected, rng):
    found = Mixture.fitted(rng.normal(size=(count, 3)), 0)
    assert found.weights.size == expected
    assert found.dimension == 3


def test_a_coordinate_that_does_not_vary_is_no_obstacle(rng):
    points = np.column_stack([rng.normal(size=200), np.full(200, 4.0)])
    found = Mixture.fitted(points, 0)
    assert np.isfinite(found.log_density(points)).all()
    assert_allclose(found.means[:, 1], 4.0)


def test_blended_and_levelled(three, rng):
    points = rng.normal(scale=5.0, size=(50, 3))
    other = Mixture(np.array([1.0]), np.zeros((1, 3)), np.eye(3)[None])
    blend = three.blended(other, 0.25)
    expected = np.logaddexp(
        np.log(0.75) + three.log_density(points), np.log(0.25) + other.log_density(points)
    )
    assert_allclose(blend.log_density(points), expected, rtol=1e-12)
    level = three.levelled()
    assert_allclose(level.weights, 1 / 3)
    assert_allclose(
        level.log_parts(points) - three.log_parts(points),
        np.tile((np.log(1 / 3) - np.log(three.weights))[:, None], 50),
        atol=1e-10,
    )


def test_a_component_without_weight_has_no_share(three, rng):
    without = Mixture(np.array([0.0, 1.0, 0.0]), three.means, three.factors)
    points = without.draw(100, np.random.RandomState(np.random.MT19937(5)))
    assert_array_equal(without.log_shares(points)[1], 0.0)
    assert (without.log_shares(points)[[0, 2]] == -np.inf).all()
    assert_array_equal(
        without.shares(without.distances(points)), np.array([[0.0], [1.0], [0.0]]) * np.ones(100)
    )
    assert_allclose(without.log_density(points), without.log_parts(points)[1], rtol=1e-12)


@pytest.mark.parametrize("dimension", range(1, 8))
@pytest.mark.parametrize("far", [1.0, 1e9, 1e60])
def test_products_give_what_logarithms_give(dimension, far, rng):
    """Also where others are less than any number: at the mean of a component of hardly any weight."""
    factors = np.tile(0.5 * np.eye(dimension), (4, 1, 1))
    means = far * rng.normal(size=(4, dimension))
    mixture = Mixture(np.array([0.7, 0.2, 0.1 - 1e-290, 1e-290]), means, factors)
    points = np.concatenate([means, far * rng.normal(scale=10.0, size=(40, dimension))])
    assert_allclose(mixture.log_density(points), logsumexp(mixture.log_parts(points), axis=0), rtol=1e-12)
    shares = mixture.shares(mixture.distances(points))
    assert_allclose(shares, np.exp(mixture.log_shares(points)), rtol=1e-9, atol=1e-60)


def test_a_component_of_hardly_any_width_leaves_the_density_of_the_others(rng):
    """That of a component of a width of 1e-60 is e^800 times that of the other, which a point is near."""
    factors = np.array([np.eye(6), 1e-60 * np.eye(6)])
    mixture = Mixture(np.array([0.5, 0.5]), np.array([np.zeros(6), 3.0 * np.ones(6)]), factors)
    points = rng.standard_normal((20, 6))
    alone = stats.multivariate_t(np.zeros(6), np.eye(6), df=FREEDOM)
    assert_allclose(mixture.log_density(points), alone.logpdf(points) + np.log(0.5), rtol=1e-12)
    assert_allclose(mixture.shares(mixture.distances(points)), [[1.0] * 20, [0.0] * 20], atol=1e-300)
    assert mixture.log_density(3.0 * np.ones((1, 6)))[0] > 700.0


def test_points_are_spread_evenly():
    points = np.arange(100.0)[:, None]
    assert_array_equal(spread_evenly(points, 200), points)
    few = spread_evenly(points, 12)
    assert_array_equal(few[[0, -1], 0], [0, 99])
    assert np.ptp(np.diff(few[:, 0])) <= 1.0
