"""The posterior against dense normal marginals, change of variables and its own symmetries."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy import integrate, stats
from small import ONE, TRUTH, TWO, problem, record, row_values

from lcopa_bayes.bench.command import step
from lcopa_bayes.bench.device import Bench, simulate
from lcopa_bayes.data.record import Record
from lcopa_bayes.inference.posterior import Posterior

SHORT = record(camera=0.6)


def made(*fit: Record, **options) -> Posterior:
    return problem(*(fit or (SHORT,)), **options).posterior


def near_truth(posterior: Posterior, seed: int, count: int, width: float = 0.2) -> np.ndarray:
    """Coordinates around those of the truth."""
    reported = TRUTH | {"rho": 0.4, "nu": 6.0, "time_2": 0.9, "order_2": 0.3}
    values = row_values(posterior.table, reported)[None]
    shifts = width * np.random.default_rng(seed).normal(size=(count, posterior.dimension))
    return posterior.coordinates(values) + shifts


def independent_log_prior(posterior: Posterior, coordinates: np.ndarray) -> np.ndarray:
    """Scipy densities in the parameters' own scales and the change of variables, not truncated."""
    out = np.zeros(coordinates.shape[0])
    for c, k in zip(coordinates.T, posterior.sampled, strict=True):
        row = posterior.table.rows[k]
        x = np.exp(c) if row.log_scale else 1 / (1 + np.exp(-c)) if row.logit_scale else c
        slope = x if row.log_scale else x * (1 - x) if row.logit_scale else np.ones_like(x)
        out += getattr(stats, row.prior.dist)(**row.prior.parameters).logpdf(x) + np.log(slope)
    return out + resolved_log_level(posterior, coordinates)


def resolved_log_level(posterior: Posterior, coordinates: np.ndarray) -> np.ndarray:
    """Default priors leave out terms of order above 1 faster than period / pi: in closed form."""
    table, values, out = posterior.table, posterior.values(coordinates), np.zeros(coordinates.shape[0])
    fastest = np.median(np.diff(posterior.samples[0].times)) / np.pi
    for k in range(table.layout.elements[0].terms):
        time, order = table.at("time", 0, k), table.at("order", 0, k)
        if table.rows[time].default and table.rows[order].default:
            ends = table.rows[time].prior.parameters
            fast = np.log(fastest / ends["a"]) / np.log(ends["b"] / ends["a"])
            alias = (values[:, order] > 1) & (values[:, time] < fastest)
            out += np.where(alias, -np.inf, -np.log(1 - fast / 2))
    return out


def dense_covariance(values: dict[str, float], gaps: np.ndarray) -> np.ndarray:
    at = np.concatenate(([0.0], np.cumsum(gaps[1:])))
    return values["sigma"] ** 2 * values.get("rho", 0.0) ** np.abs(at[:, None] - at)


def with_holes() -> Record:
    """A record without its samples 5, 6 and 11."""
    whole = record(camera=0.6)
    response = np.array(whole.response)
    response[[7, 8, 13]] = np.nan
    return replace(whole, response=response)


@pytest.mark.parametrize("noise", ["white", "ar1"])
@pytest.mark.parametrize("fit", [SHORT, with_holes()], ids=["regular", "holes"])
def test_density_is_the_dense_normal_marginal_over_gain_and_offset(noise, fit):
    posterior = made(fit, noise=noise)
    table = posterior.table
    assert [table.names[k] for k in posterior.linear] == ["gain", "offset"]
    coordinates = near_truth(posterior, 0, 6)
    observed = posterior.samples[0].axes[0]
    reported = posterior.log_density(coordinates)
    for b, values in enumerate(posterior.values(coordinates)):
        unit = posterior.model.unit_responses(table.dynamics(values[None]))[0][0, 0, observed.index]
        columns = np.stack([unit, np.ones_like(unit)])
        gain, offset = (table.rows[table.names.index(name)].prior.frozen for name in ("gain", "offset"))
        mean = gain.mean() * columns[0] + offset.mean() * columns[1]
        covariance = columns.T @ np.diag([gain.var(), offset.var()]) @ columns
        covariance += dense_covariance(dict(zip(table.names, values, strict=True)), observed.gaps)
        exact = stats.multivariate_normal(mean, covariance).logpdf(observed.values)
        exact += independent_log_prior(posterior, coordinates[b : b + 1])[0]
        assert reported[b] == pytest.approx(exact, rel=3e-9)


def test_density_is_the_integral_over_gain_and_offset():
    sharp = {"gain": ("norm", {"loc": 1.5, "scale": 1.0}), "offset": ("norm", {"loc": 0.0, "scale": 0.5})}
    posterior = made(priors=sharp | {"sigma": 0.3})
    coordinates = near_truth(posterior, 1, 1, 0.05)
    values = posterior.values(coordinates)
    middle = posterior.complete(coordinates, None)[0, posterior.linear]
    observed = posterior.samples[0].axes[0]
    unit = posterior.model.unit_responses(posterior.table.dynamics(values))[0][0, 0, observed.index]
    nodes, weights = np.polynomial.legendre.leggauss(200)
    gain, offset = (m + 2 * nodes for m in middle)  # beyond 8 conditional deviations
    residual = observed.values - gain[:, None, None] * unit - offset[:, None]
    log_joint = stats.norm.logpdf(residual, scale=0.3).sum(axis=2)
    log_joint += stats.norm.logpdf(gain, 1.5, 1.0)[:, None] + stats.norm.logpdf(offset, 0.0, 0.5)
    exact = np.log(4 * weights @ np.exp(log_joint) @ weights)
    assert posterior.log_likelihood(values)[0] == pytest.approx(exact, abs=1e-9)


def test_linear_draws_follow_their_exact_conditional():
    posterior = made(noise="ar1")
    table, count = posterior.table, 20_000
    coordinates = near_truth(posterior, 2, 1)
    values = posterior.values(coordinates)[0]
    observed = posterior.samples[0].axes[0]
    unit = posterior.model.unit_responses(table.dynamics(values[None]))[0][0, 0, observed.index]
    columns = np.stack([unit, np.ones_like(unit)])
    priors = [table.rows[k].prior.frozen for k in posterior.linear]
    precision = np.linalg.inv(dense_covariance(dict(zip(table.names, values, strict=True)), observed.gaps))
    prior = np.diag([1 / p.var() for p in priors])
    covariance = np.linalg.inv(columns @ precision @ columns.T + prior)
    mean = covariance @ (columns @ precision @ observed.values + prior @ [p.mean() for p in priors])
    assert_allclose(posterior.complete(coordinates, None)[0, posterior.linear], mean, rtol=1e-8)
    many = np.repeat(coordinates, count, axis=0)
    drawn = posterior.complete(many, np.random.default_rng(0))[:, posterior.linear] - mean
    variances = np.diagonal(covariance)
    error = np.sqrt((np.outer(variances, variances) + covariance**2) / count)
    assert np.all(np.abs(drawn.mean(axis=0)) < 4 * np.sqrt(variances / count))
    assert np.all(np.abs(drawn.T @ drawn / count - covariance) < 4 * error)


@pytest.mark.parametrize(
    ("noise", "prior"),
    [
        ("white", {"gain": ("lognorm", {"s": 0.7, "scale": 1.5})}),
        ("ar1", {"gain": ("loguniform", {"a": 0.1, "b": 30.0}), "offset": 0.31}),
        ("student", {}),
    ],
)
def test_what_is_not_linear_is_sampled_and_its_density_is_direct(noise, prior):
    posterior = made(noise=noise, priors={"offset": 0.29} | prior)
    table = posterior.table
    assert posterior.linear == ()
    assert "gain" in [table.names[k] for k in posterior.sampled]
    coordinates = near_truth(posterior, 3, 5, 0.05)
    reported = posterior.log_density(coordinates)
    observed = posterior.samples[0].axes[0]
    for b, values in enumerate(posterior.values(coordinates)):
        at = dict(zip(table.names, values, strict=True))
        unit = posterior.model.unit_responses(table.dynamics(values[None]))[0][0, 0, observed.index]
        residual = observed.values - at["gain"] * unit - at["offset"]
        if noise == "student":
            exact = stats.t.logpdf(residual, at["nu"], scale=at["sigma"]).sum()
        else:
            covariance = dense_covariance(at, observed.gaps)
            exact = stats.multivariate_normal(np.zeros(residual.size), covariance).logpdf(residual)
        exact += independent_log_prior(posterior, coordinates[b : b + 1])[0]
        assert reported[b] == pytest.approx(exact, abs=1e-7)


def test_two_ways_to_say_a_normal_gain_agree():
    """With beta 2 the generalised normal is the normal, but it is sampled instead of integrated out."""
    fixed = {"sigma": 0.3, "offset": 0.3}
    normal = ("norm", {"loc": 1.0, "scale": 2.0})
    same = ("gennorm", {"beta": 2.0, "loc": 1.0, "scale": 2.0 * np.sqrt(2)})
    marginal, joint = made(priors=fixed | {"gain": normal}), made(priors=fixed | {"gain": same})
    assert joint.dimension == marginal.dimension + 1
    coordinates = near_truth(joint, 0, 1)[0]
    grid = np.linspace(-2.0, 6.0, 4001)
    lines = np.tile(coordinates, (grid.size, 1))
    lines[:, 0] = grid
    density = joint.log_density(lines)
    integral = np.log(integrate.trapezoid(np.exp(density - density.max()), grid)) + density.max()
    assert integral == pytest.approx(marginal.log_density(coordinates[None, 1:])[0], abs=1e-6)


EVERY_KIND = [
    ("time_1", None, "white"),
    ("time_1", ("norm", {"loc": 1.0, "scale": 2.0}), "white"),
    ("order_1", None, "white"),
    ("order_1", ("loguniform", {"a": 0.1, "b": 1.9}), "white"),
    ("delay", ("expon", {"scale": 0.7}), "white"),
    ("gain", ("loguniform", {"a": 0.1, "b": 30.0}), "white"),
    ("sigma", ("lognorm", {"s": 0.5}), "white"),
    ("rho", None, "ar1"),
    ("rho", ("loguniform", {"a": 0.01, "b": 0.99}), "ar1"),
    ("rho", ("norm", {"loc": 0.5, "scale": 0.6}), "ar1"),
    ("nu", None, "student"),
]


@pytest.mark.parametrize(("name", "prior", "noise"), EVERY_KIND)
def test_the_prior_of_every_sampled_coordinate_has_mass_one(name, prior, noise):
    known = TRUTH | {"rho": 0.4, "nu": 6.0}
    rest = {key: known[key] for key in made(noise=noise).table.names if key != name}
    posterior = made(noise=noise, priors=rest | ({name: prior} if prior else {}))
    assert posterior.dimension == 1
    row = posterior.table.rows[posterior.sampled[0]]
    low, high = row.domain
    if row.log_scale:
        low, high = np.log(max(low, 1e-12)), np.log(min(high, 1e6))
    elif row.logit_scale:
        low, high = -30.0, 30.0
    mass, _ = integrate.quad(
        lambda c: float(np.exp(posterior.log_prior(np.array([[c]])))[0]), low, high, limit=400, epsabs=1e-9
    )
    assert mass == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("coordinate", [-2.0, 0.3, 3.0])
def test_coordinates_and_values_are_inverse(coordinate):
    posterior = made(noise="ar1", priors={"rho": ("loguniform", {"a": 1e-4, "b": 0.9999})}, terms=2)
    coordinates = np.full((1, posterior.dimension), coordinate)
    coordinates[0, 2] -= 0.1  # the second order below the first: canonical already
    values = posterior.values(coordinates)
    order = [posterior.table.names[k] for k in posterior.sampled].index("order_2")
    assert order == 3
    coordinates[0] = posterior.coordinates(values)[0]
    assert_allclose(posterior.values(coordinates), values, rtol=1e-12)


OWN_ORDERS = {
    "order_1": ("norm", {"loc": 1.2, "scale": 0.3}),
    "order_2": ("norm", {"loc": 0.9, "scale": 0.3}),
}


@pytest.mark.parametrize("priors", [{}, OWN_ORDERS], ids=["exchangeable", "not exchangeable"])
def test_two_terms_have_prior_mass_one(priors):
    posterior = made(terms=2, priors=priors)
    rows = [posterior.table.rows[k] for k in posterior.sampled]
    rng, count = np.random.default_rng(0), 20_000
    full = np.full((count, len(posterior.table.rows)), np.nan)
    full[:, posterior.sampled] = np.stack([row.draw(count, rng) for row in rows], axis=1)
    coordinates = posterior.coordinates(full)
    independent = independent_log_prior(posterior, coordinates)
    known = independent > -np.inf
    assert known.all() == bool(priors)
    if not priors:
        level = resolved_log_level(posterior, coordinates)
        assert abs(np.exp(level).mean() - 1) < 4 * np.exp(level).std() / np.sqrt(count)
        assert_array_equal(posterior.log_prior(coordinates)[~known], -np.inf)
        assert_allclose(posterior.log_prior(coordinates)[known], independent[known], rtol=1e-9)
    else:
        weight = np.exp(posterior.log_prior(coordinates) - independent)
        truncation = 1e-2  # the cut at 0 and 2 is not in the comparison density
        assert 0 < np.mean(weight == 0) < 0.5
        assert abs(weight.mean() - 1) < 4 * weight.std() / np.sqrt(count) + truncation


def test_exchanging_terms_changes_nothing_when_their_priors_agree():
    posterior = made(terms=2)
    coordinates = near_truth(posterior, 4, 20, 0.4)
    swapped = coordinates[:, [2, 3, 0, 1, *range(4, posterior.dimension)]]
    assert [posterior.table.names[k] for k in posterior.sampled[:4]] == [
        "time_1",
        "order_1",
        "time_2",
        "order_2",
    ]
    assert_array_equal(posterior.log_density(swapped), posterior.log_density(coordinates))
    own = made(terms=2, priors=OWN_ORDERS)
    inside = own.log_prior(coordinates) > -np.inf
    assert inside.any()
    assert_array_equal(own.log_prior(swapped)[inside], -np.inf)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(["white", "ar1", "student"]))
def test_only_the_prior_gives_minus_infinity(seed, noise):
    posterior = DENSITIES[noise]
    coordinates = near_truth(posterior, seed, 40, 1.5)
    prior, density = posterior.log_prior(coordinates), posterior.log_density(coordinates)
    assert_array_equal(density == -np.inf, prior == -np.inf)
    assert np.isfinite(density[prior > -np.inf]).all()


DENSITIES = {noise: made(noise=noise, terms=2) for noise in ("white", "ar1", "student")}


def test_a_correlation_that_rounds_to_one_is_outside_the_prior():
    posterior = made(noise="ar1")
    coordinates = near_truth(posterior, 0, 2, 0.0)
    coordinates[0, [posterior.table.names[k] for k in posterior.sampled].index("rho")] = 40.0
    reported = posterior.log_density(coordinates)
    assert reported[0] == -np.inf
    assert np.isfinite(reported[1])


@dataclass(frozen=True, eq=False)
class BrokenModel:
    """A forward model that answers NaN for its second plant."""

    inner: object

    def __getattr__(self, name: str) -> object:
        return getattr(self.inner, name)

    def unit_responses(self, dynamics) -> list[np.ndarray]:
        out = self.inner.unit_responses(dynamics)
        out[0][:, 1:] = np.nan
        return out


@pytest.mark.parametrize("noise", ["white", "ar1", "student"])
def test_a_likelihood_that_is_nan_is_an_error_with_the_values(noise):
    posterior = made(noise=noise)
    broken = replace(posterior, model=BrokenModel(posterior.model))
    coordinates = near_truth(posterior, 0, 3, 0.01)
    assert np.isfinite(broken.log_density(coordinates[:1])).all()
    order = posterior.values(coordinates)[1, posterior.table.names.index("order_1")]
    with pytest.raises(FloatingPointError, match=rf"NaN at .*order_1 = {order:.6g}"):
        broken.log_density(coordinates)


def test_pointwise_densities_add_up_to_the_likelihood():
    posterior = made(priors={"gain": 2.0, "offset": 0.3}, noise="ar1")
    coordinates = near_truth(posterior, 5, 4)
    values = posterior.values(coordinates)
    assert_allclose(
        posterior.pointwise(values)[0][0].sum(axis=1), posterior.log_likelihood(values), rtol=1e-11
    )


def test_a_batch_is_its_members():
    posterior = made(record(device=TWO, camera=0.6), noise="ar1", terms={"direct": 2, "cross": 1})
    coordinates = posterior.coordinates(posterior.table.draw(5, np.random.default_rng(0)))
    one_by_one = [posterior.log_density(row[None])[0] for row in coordinates]
    assert_allclose(posterior.log_density(coordinates), one_by_one, rtol=1e-10)


def test_two_records_and_a_shared_offset_are_one_dense_normal():
    pair = (record(1, camera=0.8, name="a"), record(2, camera=0.8, name="b"))
    shared, own = made(*pair, offset="shared"), made(*pair)
    assert len(shared.linear) == 2
    assert len(own.linear) == 3
    coordinates = near_truth(shared, 0, 1)
    values = shared.values(coordinates)[0]
    sigma = values[shared.table.names.index("sigma")]
    for posterior in (shared, own):
        units = posterior.model.unit_responses(posterior.table.dynamics(posterior.values(coordinates)))
        observed = [samples.axes[0] for samples in posterior.samples]
        n = [o.values.size for o in observed]
        unit = np.concatenate([u[0, 0, o.index] for u, o in zip(units, observed, strict=True)])
        first = np.concatenate([np.ones(n[0]), np.zeros(n[1])])
        offsets = [np.ones(sum(n))] if posterior is shared else [first, 1 - first]
        priors = [posterior.table.rows[k].prior.frozen for k in posterior.linear]
        columns = np.stack([unit, *offsets])
        covariance = columns.T @ np.diag([p.var() for p in priors]) @ columns + sigma**2 * np.eye(sum(n))
        data = np.concatenate([o.values for o in observed]) - np.array([p.mean() for p in priors]) @ columns
        exact = stats.multivariate_normal(np.zeros(sum(n)), covariance).logpdf(data)
        assert posterior.log_likelihood(posterior.values(coordinates))[0] == pytest.approx(exact, abs=1e-7)


def test_the_likelihood_prefers_the_truth_of_the_bench():
    """The bench shares no numerics with the model: at the truth the residual is the noise, to its spread."""
    rng = np.random.default_rng(0)
    quiet = simulate(ONE, Bench(camera=0.1), step(1.0, at=0.35), duration=12.0, name="step", rng=rng)
    posterior = made(quiet)
    values = row_values(posterior.table, TRUTH)[None]
    units = posterior.model.unit_responses(posterior.table.dynamics(values))
    residual = posterior.residual(0, 0, posterior.samples[0].axes[0], values, units[0])
    assert np.abs(residual).max() < 5e-3 * TRUTH["gain"]
    assert np.sqrt(np.mean(residual**2)) < 5e-4 * TRUTH["gain"]
