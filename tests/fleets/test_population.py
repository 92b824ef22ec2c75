"""The population of normal devices, against closed forms, in repetition, and where weights fail."""

import numpy as np
import pytest
from scipy.stats import beta, binom, cauchy, norm

from lcopa_bayes.fleets.population import population_of
from lcopa_bayes.sampling.importanceweights import LARGEST_K

MEAN, SPREAD = 3.0, 0.5
DRAWS = 400


def fleet(devices, rng, *, spread=SPREAD, odd=0, sd=0.4):
    """Estimates of devices with their standard errors, and draws of each under a flat prior."""
    truth = rng.normal(MEAN, spread, devices)
    truth[devices - odd :] += 8 * np.hypot(spread, sd)
    errors = sd * rng.uniform(0.5, 1.5, devices)
    estimates = rng.normal(truth, errors)
    draws = [rng.normal(one, error, DRAWS) for one, error in zip(estimates, errors, strict=True)]
    draws = [one + (middle - one.mean()) for one, middle in zip(draws, estimates, strict=True)]
    draws = [
        middle + (one - middle) * error / one.std()
        for one, middle, error in zip(draws, estimates, errors, strict=True)
    ]
    return truth, estimates, errors, draws


def flat(draws):
    return [np.zeros(one.size) for one in draws]


def exact(estimates, errors):
    """Spreads (n,), means (n, m), their posterior mass (n, m) and the probability of each device not to
    belong (devices,): sums over the model as it is stated, with likelihoods in closed form."""
    middle = np.median(estimates)
    off = np.median(np.abs(estimates - middle)) / 0.6744897501960817
    unit = np.hypot(off, np.sqrt(np.median(errors**2))) * (1 + 4 / estimates.size)
    spreads = unit * np.geomspace(1e-3, 60, 300)
    wide = np.sqrt(spreads[:, None] ** 2 + errors**2)
    scale = np.sqrt(spreads**2 + unit**2) / np.sqrt(estimates.size)
    means = middle + scale[:, None] * np.linspace(-12, 12, 161)
    inside = norm.pdf(estimates, means[..., None], wide[:, None, :])
    outside = norm.pdf(estimates, middle, np.sqrt((10 * unit) ** 2 + errors**2))
    mass, odd = np.zeros(means.shape), 0.0
    for share in (np.arange(150) + 0.5) / 300:
        both = (1 - share) * inside + share * outside
        density = np.prod(both / outside, axis=-1) * beta.pdf(share, 1, 19)
        density *= (cauchy.pdf(spreads, 0, unit) * spreads * scale)[:, None]
        mass += density
        odd = odd + np.einsum("nm,nmd->d", density, share * outside / both)
    return spreads, means, mass / mass.sum(), odd / mass.sum()


@pytest.mark.parametrize(("devices", "spread"), [(6, 0.5), (30, 0.5), (30, 0.01), (30, 5.0)])
def test_mean_spread_and_outliers_are_those_of_the_normal_normal_model(devices, spread):
    rng = np.random.default_rng(4)
    _, estimates, errors, draws = fleet(devices, rng, spread=spread)
    found = population_of(draws, flat(draws), rng)
    spreads, means, mass, odd = exact(estimates, errors)
    mean = (mass * means).sum()
    sd = np.sqrt((mass * (means - mean) ** 2).sum())
    assert abs(np.mean(found.mean) - mean) < 0.1 * sd
    assert np.std(found.mean) == pytest.approx(sd, rel=0.1)
    each = mass.sum(axis=1)
    below = np.cumsum(each) - each / 2
    for share in (0.05, 0.25, 0.5, 0.75, 0.95):
        at = np.interp(share, below, spreads)
        assert abs(np.mean(found.spread < at) - share) < 0.03
    np.testing.assert_allclose(found.odd, odd, atol=0.02)


def test_a_device_is_shrunk_as_the_normal_normal_model_shrinks_it():
    rng = np.random.default_rng(5)
    truth, estimates, errors, draws = fleet(30, rng)
    found = population_of(draws, flat(draws), rng)
    spreads, means, mass, _ = exact(estimates, errors)
    weight = 1 / (1 + (errors / spreads[:, None, None]) ** 2)
    wanted = np.einsum("nm,nmd->d", mass, weight * estimates + (1 - weight) * means[..., None])
    np.testing.assert_allclose(found.shrunk.mean(axis=1), wanted, atol=0.1)
    own = np.sqrt(np.mean((estimates - truth) ** 2))
    assert np.sqrt(np.mean((np.median(found.shrunk, axis=1) - truth) ** 2)) < 0.95 * own
    assert np.median(found.following) == pytest.approx(np.mean(found.mean), abs=0.1)
    middle, sd = found.prior
    assert middle == pytest.approx(MEAN, abs=0.4)
    assert sd > np.median(found.spread)  # the mean is not known either


@pytest.mark.parametrize(
    ("sd", "count"),
    [(0.4, 24), *(pytest.param(sd, 60, marks=pytest.mark.slow) for sd in (0.05, 0.4))],
)
def test_intervals_of_mean_and_spread_cover_and_few_devices_are_called_odd(sd, count):
    """Fleets of ten: 50 and 90 % intervals each hold the truth as often as they say, within what chance
    leaves with a probability of 1e-3, and at most 1 % of the devices are called odd."""
    devices, inside, odd = 10, np.zeros((2, 2)), 0
    rng = np.random.default_rng(6)
    for _ in range(count):
        _, _, _, draws = fleet(devices, rng, sd=sd)
        found = population_of(draws, flat(draws), rng)
        odd += int((found.odd > 0.5).sum())
        for k, (of, truth) in enumerate(((found.mean, MEAN), (found.spread, SPREAD))):
            for i, level in enumerate((0.5, 0.9)):
                low, high = np.quantile(of, ((1 - level) / 2, (1 + level) / 2))
                inside[k, i] += low < truth < high
    for i, level in enumerate((0.5, 0.9)):
        low, high = binom.interval(1 - 1e-3, count, level)
        assert ((low <= inside[:, i]) & (inside[:, i] <= high)).all(), inside
    assert odd <= 0.01 * count * devices


def test_three_odd_devices_are_found_and_leave_the_population_alone():
    rng = np.random.default_rng(7)
    _, _, _, draws = fleet(40, rng, odd=3)
    found = population_of(draws, flat(draws), rng)
    assert list(np.flatnonzero(found.odd > 0.5)) == [37, 38, 39]
    without = population_of(draws[:37], flat(draws[:37]), rng)
    assert np.mean(found.mean) == pytest.approx(np.mean(without.mean), abs=0.5 * np.std(without.mean))
    assert np.median(found.spread) == pytest.approx(np.median(without.spread), rel=0.15)
    # an odd device keeps its own value
    assert np.median(found.shrunk[39]) == pytest.approx(np.median(draws[39]), abs=0.2)


@pytest.mark.parametrize("seed", range(4))
def test_a_device_far_away_is_odd_with_a_probability_of_one_and_no_more(seed):
    rng = np.random.default_rng(seed)
    _, _, _, draws = fleet(20, rng)
    odd = population_of([*draws[:-1], draws[-1] + 40.0], flat(draws), rng).odd
    assert odd.min() > 0
    assert 1 - 1e-12 < odd[-1] <= 1


def test_the_prior_that_draws_were_made_under_is_divided_out():
    """Devices under a normal prior whose mean is wrong by its standard deviation."""
    rng = np.random.default_rng(8)
    _, estimates, errors, draws = fleet(40, rng, sd=0.8)
    prior, width = MEAN - 1.5, 1.5
    variance = 1 / (errors**-2 + width**-2)
    centre = variance * (estimates / errors**2 + prior / width**2)
    under = [rng.normal(c, np.sqrt(v), 1000) for c, v in zip(centre, variance, strict=True)]
    density = [-0.5 * ((one - prior) / width) ** 2 for one in under]
    wanted = population_of(draws, flat(draws), rng)
    found = population_of(under, density, rng)
    kept = population_of(under, flat(under), rng)
    sd = np.std(wanted.mean)
    assert abs(np.mean(found.mean) - np.mean(wanted.mean)) < 0.35 * sd
    assert abs(np.mean(kept.mean) - np.mean(wanted.mean)) > sd


def test_weights_that_fail_are_reported_and_a_normal_likelihood_stands_for_the_draws():
    """A precise population in the tail of one device's draws."""
    rng = np.random.default_rng(9)
    draws = [rng.normal(rng.normal(0.0, 0.02), 0.02, 1000) for _ in range(20)]
    draws.append(rng.normal(3.2, 1.0, 1000))
    found = population_of(draws, flat(draws), rng)
    assert list(np.flatnonzero(found.failed)) == [20]
    assert found.pareto_k[20] > LARGEST_K
    assert abs(np.mean(found.mean)) < 0.02
    assert found.shrunk.shape[0] == found.odd.size == 21


def test_the_same_seed_gives_the_same_population():
    _, _, _, draws = fleet(5, np.random.default_rng(1))
    one, two = (population_of(draws, flat(draws), np.random.default_rng(2)) for _ in range(2))
    np.testing.assert_array_equal(one.mean, two.mean)
    np.testing.assert_array_equal(one.shrunk, two.shrunk)


def test_one_device_and_draws_that_do_not_vary_have_no_population():
    with pytest.raises(ValueError, match="two devices or more; got 1"):
        population_of([np.arange(9.0)], [np.zeros(9)], np.random.default_rng(1))
    for draws in (np.ones(50), np.arange(9.0)):
        with pytest.raises(ValueError, match=f"32 draws or more that vary; got {draws.size}"):
            population_of([draws] * 2, [0 * draws] * 2, np.random.default_rng(1))
