"""Least squares: exact Jacobian, recovery of the bench's truth, the right mode among several."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from small import TRUTH, TWO, path, problem, record

from lcopa_bayes.bench.command import joint, prbs
from lcopa_bayes.bench.device import Device
from lcopa_bayes.core.parallel import workers
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.inference.conditional import Conditional
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.likelihood import Landscape
from lcopa_bayes.inference.noise import White
from lcopa_bayes.inference.optimum import along_orders, find_optima, optima_near
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.shapecoordinates import element_columns

SHORT = record(camera=0.6)
COUPLED = record(device=TWO, camera=0.5)
LONG_TAILED = {"gain": ("lognorm", {"s": 0.5, "scale": 2.0})}


def made(*fit: Record, **options) -> Posterior:
    return problem(*fit, **options).posterior


def finite_differences(problem_: LeastSquares, x: np.ndarray, template: np.ndarray) -> np.ndarray:
    """Central differences of fourth order."""
    h, columns = 3e-4, []
    for k in range(x.size):
        shift = np.zeros(x.size)
        shift[k] = h * max(1.0, abs(x[k]))
        near, far = (
            problem_.residual(x + m * shift, template)[0] - problem_.residual(x - m * shift, template)[0]
            for m in (1, 2)
        )
        columns.append((8 * near - far) / (12 * shift[k]))
    return np.array(columns).T


CASES = {
    "one path": made(SHORT),
    "one path, two terms": made(SHORT, terms=2),
    "one path, three terms": made(SHORT, terms=3),
    "correlated noise": made(SHORT, noise="ar1", terms=2),
    "a gain on a log scale": made(
        SHORT, priors={"gain": ("loguniform", {"a": 0.1, "b": 9.0}), "offset": 0.3}
    ),
    "fixed orders": made(SHORT, orders=(1.0,), priors={"delay": 0.5}),
    "coupled, shared element": made(COUPLED, share="all", noise="ar1"),
    "coupled, as in the paper": made(COUPLED, terms={"direct": 2, "cross": 1}),
    "coupled, all apart": made(COUPLED, share="none", delay="path", noise="ar1"),
    "two records": made(record(camera=0.6, name="a"), record(2, camera=0.4, name="b"), offset="shared"),
    "Student noise": made(SHORT, noise="student"),
}


@pytest.mark.parametrize("posterior", CASES.values(), ids=CASES.keys())
def test_jacobian_is_that_of_central_differences(posterior):
    least = LeastSquares(posterior)
    rng = np.random.default_rng(7)
    for values in posterior.table.draw(2, rng):
        values = values.copy()
        for kind, level in (("sigma", 0.05), ("rho", 0.6), ("nu", 5.0), ("delay", 0.633)):
            for k in posterior.table.of_kind(kind):
                if posterior.table.rows[k].free:
                    values[k] = level
        x = least.coordinates(values)
        # draws are canonical: rotate the terms of every element whose terms can be exchanged
        for e, exchangeable in enumerate(posterior.table.exchangeable):
            if exchangeable:
                terms = range(posterior.table.layout.elements[e].terms)
                for kind in ("time", "order"):
                    columns = [least.columns.index(posterior.table.at(kind, e, term)) for term in terms]
                    x[columns] = x[np.roll(columns, 1)]
        residual, jacobian = least.residual(x, values)
        assert jacobian.shape == (residual.size, x.size)
        exact = finite_differences(least, x, values)
        scale = np.abs(exact).max(axis=0) + 1e-3 * np.abs(exact).max()
        assert np.abs((jacobian - exact) / scale).max() < 2e-5


def test_exchanged_terms_have_the_same_residual_and_exchanged_jacobian():
    posterior = CASES["correlated noise"]
    least = LeastSquares(posterior)
    values = posterior.table.draw(1, np.random.default_rng(0))[0]
    x = least.coordinates(values)
    names = [posterior.table.names[k] for k in least.columns]
    rank = [names.index(n) for n in ("gain", "time_2", "order_2", "time_1", "order_1", "delay", "offset")]
    (a, ja), (b, jb) = least.residual(x, values), least.residual(x[rank], values)
    assert_allclose(b, a, rtol=1e-12, atol=1e-12)
    assert_allclose(jb, ja[:, rank], rtol=1e-9, atol=1e-9 * np.abs(ja).max())


def best(posterior: Posterior, **options) -> dict[str, float]:
    optimum = find_optima(posterior, np.random.default_rng(0), **options)[0]
    return dict(zip(posterior.table.names, optimum.values, strict=True))


def test_recovers_a_noise_free_truth_with_an_error_that_falls_as_fast_as_the_model_converges():
    """Nearly second order: what follows the onset t^0.8 within one block takes a little off it."""
    clean = record(noise_sd=0.0, camera=0.1)
    names = ("gain", "time_1", "order_1", "delay", "offset")
    coarse, fine = (
        np.array([abs(found[name] - TRUTH[name]) for name in names])
        for found in (best(made(clean, blocks=blocks), starts=2) for blocks in (240, 3840))
    )
    assert coarse.max() < 1e-4
    assert fine.max() < 2e-6
    assert 1.3 < np.log(np.linalg.norm(coarse) / np.linalg.norm(fine)) / np.log(16) < 2.3


def test_two_terms_are_recovered_from_a_clean_record():
    device = Device(
        ((path(1.0, 0.4, (1.2, 2.5), (1.6, 0.7)),),), TWO.drive_axes[:1], TWO.response_axes[:1], (0.1,)
    )
    rng = np.random.default_rng(0)
    command = prbs(0.0, 1.0, hold=0.7, duration=20.0, rng=rng)
    clean = record(device=device, command=command, camera=0.1, duration=25.0, noise_sd=0.0)
    found = best(made(clean, terms=2, blocks=1000))
    exact = {"time_1": 1.2, "order_1": 1.6, "time_2": 2.5, "order_2": 0.7, "delay": 0.4, "gain": 1.0}
    for name, value in exact.items():
        assert found[name] == pytest.approx(value, abs=0.01), name


def test_finds_the_delay_among_the_local_minima_of_a_random_binary_drive():
    rng = np.random.default_rng(1)
    command = prbs(-1.0, 1.0, hold=0.8, duration=30.0, rng=rng)
    fast = Device(((path(1.0, 2.37, (0.15,), (0.9,)),),), TWO.drive_axes[:1], TWO.response_axes[:1], (0.0,))
    posterior = made(record(device=fast, command=command, camera=0.1, duration=32.0, noise_sd=0.05))
    (mode, *_) = find_optima(posterior, np.random.default_rng(2))
    at = posterior.table.at("delay", 0)
    assert mode.values[at] == pytest.approx(2.37, abs=0.02)
    least, trapped = LeastSquares(posterior), []
    for delay in (0.5, 4.5, 6.5):
        start = mode.values.copy()
        start[at] = delay
        end, _ = least.solve(start)
        trapped.append(abs(end[at] - 2.37) > 0.5)
        high = posterior.log_density(posterior.coordinates(least.with_noise(end)[None]))[0]
        assert high < mode.log_density - 50 or not trapped[-1]
    assert any(trapped)  # one start would not have been enough


def test_a_plant_nearby_is_a_start_whatever_noise_it_comes_with():
    """Also under a noise model without some of the noise parameters, which then stay as they were: outside
    their prior they would leave no density where the descent ends."""
    rng = np.random.default_rng(1)
    command = prbs(-1.0, 1.0, hold=0.8, duration=30.0, rng=rng)
    fast = Device(((path(1.0, 2.37, (0.15,), (0.9,)),),), TWO.drive_axes[:1], TWO.response_axes[:1], (0.0,))
    noisy = record(device=fast, command=command, camera=0.1, duration=32.0, noise_sd=0.05)
    posterior = replace(made(noisy, noise="white+ar1"), noise=White())
    table, seen = posterior.table, []
    at, near = table.at("delay", 0), table.draw(1, rng)[0]
    near[[table.at("time", 0, 0), table.at("order", 0, 0)]] = 0.15, 0.9
    near[[table.at("sigma_ar", 0), table.at("rho", 0)]] = 10.0, 0.0
    for delay in (0.5, 4.5, 6.5):  # descents from some of these end beside the optimum
        near[at] = delay
        found = find_optima(posterior, np.random.default_rng(0), starts=1, near=[near])
        assert found[0].values[at] == pytest.approx(2.37, abs=0.02)
        seen += [one.values[at] for one in found[1:]]
    assert any(abs(delay - 2.37) > 0.5 for delay in seen)


def test_optima_are_distinct_finite_sorted_and_describe_their_surroundings():
    posterior = made(SHORT, terms=2, noise="ar1")
    optima = find_optima(posterior, np.random.default_rng(0))
    heights = [optimum.log_density for optimum in optima]
    assert heights == sorted(heights, reverse=True)
    coordinates = posterior.coordinates(np.stack([optimum.values for optimum in optima]))
    assert_allclose(posterior.log_density(coordinates), heights, rtol=1e-9)
    for k, here in enumerate(coordinates):
        assert all(np.abs(here - other).max() >= 1e-2 for other in coordinates[:k])
    for optimum in optima:
        assert_allclose(optimum.covariance, optimum.covariance.T, atol=1e-12)
        assert np.linalg.eigvalsh(optimum.covariance).min() > 0


@pytest.mark.parametrize("case", ["one path, two terms", "Student noise"])
def test_the_covariance_is_that_of_the_optimum_itself(case):
    """Not of the order its terms had on the way, nor of the noise of an earlier round."""
    posterior = CASES[case]
    least = LeastSquares(posterior)
    plant = [k for k, row in enumerate(posterior.sampled) if row in least.columns]
    columns = [least.columns.index(posterior.sampled[k]) for k in plant]
    for optimum in find_optima(posterior, np.random.default_rng(0), starts=8):
        jacobian = least.residual(least.coordinates(optimum.values), optimum.values)[1]
        exact = np.linalg.inv(
            jacobian.T @ jacobian + np.diag(12.0 / (least.bounds[1] - least.bounds[0]) ** 2)
        )
        widths = np.sqrt(np.diag(exact)[columns])
        assert_allclose(np.sqrt(np.diag(optimum.covariance)[plant]), widths, rtol=1e-3)


def test_the_linearised_covariance_is_the_curvature_of_the_log_density():
    posterior = made(record(camera=0.1), priors={"sigma": TRUTH["sigma"]})
    optimum = find_optima(posterior, np.random.default_rng(0), starts=3)[0]
    top = posterior.coordinates(optimum.values[None])[0]
    widths = np.sqrt(np.diagonal(optimum.covariance))
    size = top.size
    steps = 0.3 * np.diag(widths)
    points = np.array([top + a + b for a in (*steps, *-steps) for b in (*steps, *-steps)])
    plus = posterior.log_density(points).reshape(2 * size, 2 * size)
    hessian = (plus[:size, :size] - plus[:size, size:] - plus[size:, :size] + plus[size:, size:]) / (
        4 * 0.09 * np.outer(widths, widths)
    )
    covariance = np.linalg.inv(-hessian)
    assert_allclose(np.sqrt(np.diagonal(covariance)), widths, rtol=0.1)


@pytest.mark.parametrize(
    "priors",
    [{"time_1": ("lognorm", {"s": 1.0, "scale": 2.0})}, {"order_2": 0.6}, {"order_1": 0.9}],
    ids=["both free", "second fixed", "first fixed"],
)
def test_terms_that_cannot_be_exchanged_stay_in_order(priors):
    posterior = made(SHORT, terms=2, priors=priors)
    least, rng = LeastSquares(posterior), np.random.default_rng(0)
    ends = []
    for start in posterior.table.draw(4, rng):
        start = start.copy()
        start[posterior.table.of_kind("sigma")] = 0.05
        ends.append(least.solve(start)[0])
    orders = posterior.table.of_kind("order")
    assert np.all(np.diff(np.array(ends)[:, orders], axis=1) <= 0)
    assert find_optima(posterior, rng, starts=1)


@pytest.mark.parametrize(
    ("noise", "name", "prior"),
    [
        ("white", "time_1", ("norm", {"loc": 2.0, "scale": 3.0})),
        ("white", "sigma", ("norm", {"loc": 0.02, "scale": 0.02})),
        ("student", "nu", ("norm", {"loc": 8.0, "scale": 8.0})),
        ("ar1", "rho", ("norm", {"loc": 0.3, "scale": 0.5})),
        ("white+ar1", "rho", ("halfnorm", {"scale": 0.5})),
    ],
)
def test_a_prior_that_reaches_beyond_its_parameters_domain_is_searched_inside(noise, name, prior):
    posterior = made(record(), noise=noise, priors={name: prior})
    ends = [*LeastSquares(posterior).bounds, *Landscape(posterior).search(posterior.table.names.index(name))]
    assert not np.isnan(np.hstack(ends)).any()
    assert np.isfinite(Conditional(posterior, delays=True).widths).all()
    assert np.isfinite(element_columns(posterior)[0].reach).all()
    assert best(posterior, starts=2)["time_1"] == pytest.approx(TRUTH["time_1"], rel=0.05)


def test_noise_is_estimated_from_the_residual():
    noisy = record(camera=0.05, noise_sd=0.05, correlation=0.7, duration=30.0)
    found = best(made(noisy, noise="ar1"), starts=4)
    n = 600  # below, the standard errors of an AR(1)
    assert found["rho"] == pytest.approx(0.7, abs=4 * np.sqrt((1 - 0.49) / n))
    assert found["sigma"] == pytest.approx(0.05, rel=4 * np.sqrt((1 + 0.49) / (1 - 0.49) / (2 * n)))


def test_a_nearly_noise_free_record_keeps_its_small_noise():
    found = best(made(record(camera=0.05, noise_sd=1e-4), blocks=2000), starts=3)
    assert found["sigma"] < 3e-4


def test_a_plant_alone_descends_from_near_its_optimum_once(monkeypatch):
    posterior = made(SHORT)
    known = find_optima(posterior, np.random.default_rng(0), starts=2)[0]
    start = known.values.copy()
    start[posterior.table.names.index("time_1")] *= 1.3

    def searched(*_, **__):
        raise AssertionError("a second method descends from the same start")

    monkeypatch.setattr(LeastSquares, "search", searched)
    (found,) = optima_near(posterior, [start])
    assert found.log_density == pytest.approx(known.log_density, abs=0.1)


def test_processes_that_descend_side_by_side_find_the_same_optima():
    posterior = problem(record(1)).posterior
    alone = find_optima(posterior, np.random.default_rng(3), starts=4)
    with workers(posterior, jobs=2) as crew:
        together = find_optima(posterior, np.random.default_rng(3), starts=4, crew=crew)
    assert [one.log_density for one in together] == [one.log_density for one in alone]
    assert_allclose([one.values for one in together], [one.values for one in alone], rtol=0)


def test_along_an_order_everything_else_is_at_its_optimum():
    """To both sides and as far as the log density falls by ten; no small change of the rest is better."""
    posterior = made(SHORT, terms=2)
    best = find_optima(posterior, np.random.default_rng(1), starts=3)[0]
    found, rows = along_orders(posterior, best), posterior.table.rows
    assert len(found) > 4
    assert all(best.log_density - 10.0 < one.log_density <= best.log_density + 1e-3 for one in found)
    orders = [k for k in posterior.sampled if rows[k].kind == "order"]
    for k in orders:
        reached, (low, high) = [one.values[k] for one in found], rows[k].domain
        assert min(reached) < best.values[k] or best.values[k] < low + 0.01
        assert max(reached) > best.values[k] or best.values[k] > high - 0.01
    rest = [p for p, k in enumerate(posterior.sampled) if rows[k].kind not in ("order", "time")]
    for one in found:
        z = posterior.coordinates(one.values[None])
        for position in rest:
            size = 0.3 * np.sqrt(one.covariance[position, position])
            shifts = np.zeros((2, z.shape[1]))
            shifts[:, position] = size, -size
            assert posterior.log_density(z + shifts).max() < one.log_density + 0.2


@pytest.mark.parametrize("seed", range(4))
def test_a_term_that_is_a_constant_and_one_that_is_not_are_both_found_from_a_single_start(seed):
    """Of a one-term plant two terms fit nearly as well in either mode, gains apart by a factor of about 2."""
    posterior = made(record(noise_sd=0.01, camera=0.1), terms=2)
    last, gain = posterior.table.at("order", 0, 1), posterior.table.at("gain", 0)
    optima = find_optima(posterior, np.random.default_rng(seed), starts=1)
    near = [one.values for one in optima if one.log_density > optima[0].log_density - 5.0]
    constant = [values for values in near if values[last] < 0.1]
    other = [values for values in near if values[last] > 0.3]
    assert constant
    assert other
    assert constant[0][gain] > 1.5 * other[0][gain]


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 4))])
def test_every_response_of_paths_that_share_nothing_is_found(seed):
    rng = np.random.default_rng(seed)
    axes = [tuple(Axis(f"{letter}{k}", "V") for k in range(count)) for letter, count in (("u", 2), ("y", 3))]
    paths = tuple(
        tuple(
            path(rng.uniform(0.5, 2), rng.uniform(0.1, 3), (rng.uniform(0.5, 3),), (0.95,)) for _ in range(2)
        )
        for _ in range(3)
    )
    device = Device(paths, *axes, (0.1, 0.2, 0.3))
    command = joint(*(prbs(-1.0, 1.0, hold=hold, duration=30.0, rng=rng) for hold in (2.3, 3.1)))
    posterior = made(record(seed, device=device, command=command, duration=30.0), noise="white")
    best = find_optima(posterior, rng)[0].values
    sds = [best[posterior.table.at("sigma", axis)] for axis in range(3)]
    assert_allclose(sds, TRUTH["sigma"], rtol=0.2)  # 150 samples of each


def test_likelihoods_of_responses_add_up():
    posterior = CASES["coupled, all apart"]
    values = posterior.table.draw(300, np.random.default_rng(0))
    both, whole = posterior.log_likelihoods(values), posterior.log_likelihood(values)
    assert_allclose(both.sum(axis=0), whole, rtol=1e-12)
    other = values.copy()
    own = [k for k in range(len(posterior.table.rows)) if posterior.table.acting_on(k) == (1,)]
    other[:, own] = values[::-1][:, own]
    changed = posterior.log_likelihoods(other)
    assert_allclose(changed[0], both[0], rtol=1e-12)
    assert_allclose(changed[1], both[1][::-1], rtol=1e-12)
