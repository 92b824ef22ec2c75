"""Noise at rest: closed forms against dense densities, limits against simulation, priors in a fit."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import linalg, signal, stats
from scipy.optimize import minimize
from small import problem, record

from lcopa_bayes.bench.command import step
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.noise import NOISES, WhiteAR1
from lcopa_bayes.inference.noisefit import NoiseFit
from lcopa_bayes.inference.observations import FEWEST, Observed, _about_own_level, quiet_noise
from lcopa_bayes.inference.optimum import find_optima
from lcopa_bayes.inference.parameter import Parameter, Place
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.inference.priors import Prior

CORRELATIONS = (np.exp(-1.0), 0.95)
LATE = step(1.0, at=4.0)


def piece(values: np.ndarray, gaps: np.ndarray | None = None) -> Observed:
    n = values.size
    return Observed(np.arange(n), values, np.ones(n) if gaps is None else gaps)


def at_rest(n: int, sigma: float, sigma_ar: float, rho: float, seed: int) -> list[Observed]:
    """Two pieces at different levels."""
    rng = np.random.default_rng(seed)
    drawn = WhiteAR1().draw(np.tile([sigma, sigma_ar, rho], (2, 1)), np.ones(n // 2), rng)
    return [piece(level + values) for level, values in zip((3.0, -20.0), drawn, strict=True)]


def test_the_level_of_a_piece_is_integrated_out_as_by_a_dense_covariance():
    """With a flat prior on the level: the density of any basis of the differences."""
    gaps = np.random.default_rng(0).uniform(0.5, 4.0, 9)
    seen = np.random.default_rng(1).normal(5.0, 2.0, 9)
    at = np.concatenate(([0.0], np.cumsum(gaps[1:])))
    basis = linalg.null_space(np.ones((1, 9)))
    totals, exact = [], []
    for share, rho in ((0.5, 0.9), (0.1, 0.5), (0.9, 0.2)):
        parameters = np.array([[np.sqrt(1 - share), np.sqrt(share), rho]])
        level, squares = _about_own_level(piece(seen, gaps), parameters)
        totals.append(float((level - 0.5 * squares)[0]))
        covariance = (1 - share) * np.eye(9) + share * rho ** np.abs(at[:, None] - at)
        exact.append(
            stats.multivariate_normal(np.zeros(8), basis.T @ covariance @ basis).logpdf(basis.T @ seen)
        )
    assert_allclose(np.diff(totals), np.diff(exact), rtol=1e-9)


@pytest.mark.parametrize(
    ("kind", "parameters"),
    [("white+ar1", [[0.7, 0.5, 0.9], [1.1, 0.2, 0.4]]), ("student", [[0.7, 4.0], [1.1, 9.0]])],
)
def test_residuals_of_records_sampled_alike_count_as_one_by_one(kind: str, parameters: list[list[float]]):
    rng, noise, values = np.random.default_rng(2), NOISES[kind](), np.array(parameters)
    even, uneven = np.ones(30), rng.uniform(0.5, 4.0, 30)
    gaps = [even, uneven, even.copy(), even[:20], uneven.copy(), even]
    residuals = [rng.standard_normal(one.size) for one in gaps]
    alone = [NoiseFit(noise, (), [residual], [own]) for residual, own in zip(residuals, gaps, strict=True)]
    one_by_one = sum(one.log_likelihood(values) for one in alone)
    assert_allclose(NoiseFit(noise, (), residuals, gaps).log_likelihood(values), one_by_one, rtol=1e-12)


def test_estimates_at_rest_are_calibrated():
    """Over 300 truths from the priors of the estimate; its scale is free, so that one scale serves."""
    rng, inside, standard = np.random.default_rng(4), [], []
    for seed in range(300):
        share, rho = rng.uniform(), rng.uniform(*CORRELATIONS)
        sigma, sigma_ar = np.sqrt(1 - share), np.sqrt(share)
        found = quiet_noise(at_rest(60, sigma, sigma_ar, rho, seed), CORRELATIONS)
        assert found.samples == 58
        inside.append(found.correlated > sigma_ar)
        standard.append(np.log(found.sigma / sigma) / found.log_sd)
    assert np.mean(inside) == pytest.approx(0.975, abs=4 * np.sqrt(0.975 * 0.025 / 300))
    assert np.mean(np.array(standard) > 0) == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(300))
    assert np.std(standard) == pytest.approx(1.0, abs=0.25)  # not Gaussian: its median and sd stand for it


def test_more_samples_at_rest_know_more():
    few, many = (quiet_noise(at_rest(n, 0.3, 0.05, 0.8, 1), CORRELATIONS) for n in (16, 1600))
    assert many.log_sd < 0.3 * few.log_sd
    assert many.correlated < 0.5 * few.correlated


def test_nothing_is_derived_from_too_few_samples_or_from_the_resolution_of_the_instrument():
    rng = np.random.default_rng(0)
    enough = rng.normal(size=FEWEST + 1)
    assert quiet_noise([piece(enough)], CORRELATIONS) is not None
    assert quiet_noise([piece(enough[:-1])], CORRELATIONS) is None
    assert quiet_noise([], CORRELATIONS) is None
    assert quiet_noise([piece(np.round(rng.normal(size=400) * 0.8))], CORRELATIONS) is not None
    assert quiet_noise([piece(np.round(rng.normal(size=400) * 0.3))], CORRELATIONS) is None
    assert quiet_noise([piece(np.full(400, 21.3))], CORRELATIONS) is None


def default_priors(*fit: Record) -> dict[str, Prior | None]:
    rows = problem(*fit, noise="white+ar1").posterior.table.rows
    return {row.name: row.prior for row in rows if row.noise}


def test_default_priors_come_from_the_samples_at_rest_where_there_are_some():
    reported = default_priors(record(camera=0.05, command=LATE))
    assert [prior.dist for prior in reported.values()] == ["lognorm", "uniform", "uniform"]
    assert reported["sigma"].frozen.median() == pytest.approx(0.02, rel=0.25)  # 80 samples: an sd of 0.08
    assert reported["sigma"].parameters["s"] > np.log(2)
    assert 0.01 < reported["sigma_ar"].support[1] < 0.06
    assert reported["rho"].support == pytest.approx((np.exp(-1), np.exp(-20 * 0.05 / 8.0)), rel=1e-3)
    none = default_priors(record(camera=0.05))
    assert [prior.dist for prior in none.values()] == ["loguniform", "loguniform", "uniform"]


def test_a_short_record_keeps_a_correlation_to_infer():
    assert default_priors(record(camera=0.6))["rho"].support == pytest.approx((np.exp(-1), np.exp(-0.5)))


def test_priors_of_a_study_come_before_those_from_rest():
    reported = {"sigma": 0.02, "sigma_ar": ("halfnorm", {"scale": 0.5}), "rho": 0.0}
    table = problem(record(camera=0.05, command=LATE), noise="white+ar1", priors=reported).posterior.table
    rows = {row.name: row for row in table.rows}
    assert (rows["sigma"].value, rows["rho"].value) == (0.02, 0.0)
    assert rows["sigma_ar"].prior == Prior("halfnorm", {"scale": 0.5})


def three_lags(n: int = 900, rest: int = 90, sd: float = 0.05) -> Record:
    """A heater of three lags that one term cannot follow, on, lower, higher, off."""
    time, drive = np.arange(float(n)), np.zeros(n)
    for number, level in enumerate((50.0, 20.0, 70.0, 0.0)):
        drive[rest + 200 * number :] = level
    lag = np.array([45.0, 1.0])
    numerator, denominator, _ = signal.cont2discrete(
        ([0.8], np.polymul(np.polymul(lag, lag), lag)), 1.0, "zoh"
    )
    response = 21.0 + signal.lfilter(np.ravel(numerator), denominator, drive)
    response += sd * np.random.default_rng(0).normal(size=n)
    axes = (Axis("heater", "pct"),), (Axis("plate", "degC"),)
    return Record("heater", time, drive[:, None], response[:, None], *axes, "s")


def misfit(posterior: Posterior) -> tuple[float, dict[str, float], float]:
    """At the optimum: root mean square of the residual [degC], values, root mean square when standardised."""
    values = find_optima(posterior, np.random.default_rng(0), starts=3)[0].values
    (fit,) = LeastSquares(posterior).noise_fits(values)
    parameters = posterior.noise_parameters(values[None], 0)
    standard = posterior.noise.standard(fit.residuals[0][None], parameters, fit.gaps[0])
    root = [float(np.sqrt(np.mean(each**2))) for each in (fit.residuals[0], standard)]
    return root[0], dict(zip(posterior.table.names, values, strict=True)), root[1]


def test_noise_does_not_take_for_its_own_what_the_plant_lacks():
    """The defaults stay by the least squares residual, end at the limit from rest, and show the misfit."""
    seen = three_lags()
    least, _, _ = misfit(problem(seen, noise="white").posterior)
    posterior = problem(seen, noise="white+ar1").posterior
    found, values, standard = misfit(posterior)
    assert least > 5 * 0.05
    assert found < 1.1 * least
    (row,) = (row for row in posterior.table.rows if row.name == "sigma_ar")
    assert values["sigma_ar"] > 0.99 * row.prior.support[1]
    assert standard > 1.1
    wide = {
        "sigma_ar": ("loguniform", {"a": 1e-3, "b": 100.0}),
        "rho": ("uniform", {"loc": 0.3, "scale": 0.7}),
    }
    swallowed, values, standard = misfit(problem(seen, noise="white+ar1", priors=wide).posterior)
    assert swallowed > 1.2 * least
    assert values["rho"] > 0.99
    assert standard == pytest.approx(1.0, abs=0.05)


def fit_of(noise: str, *values: float, n: int = 4000, **priors: Prior | None) -> NoiseFit:
    """Of a record drawn from a noise; parameters without a prior are fixed."""
    model = NOISES[noise]()
    drawn = model.draw(np.array([values]), np.ones(n), np.random.default_rng(0))[0]
    rows = [Parameter(name, "-", name, Place(0, 0), priors[name]) for name in model.names]
    return NoiseFit(
        model, tuple(rows), [drawn[: n // 3], drawn[n // 3 :]], [np.ones(n // 3), np.ones(n - n // 3)]
    )


BROAD = Prior("loguniform", {"a": 1e-4, "b": 1e3})
FLAT = Prior("uniform", {"loc": 0.0, "scale": 1.0})


def test_fitted_noise_and_its_curvature_have_the_asymptotics_of_an_autoregression():
    """Box and Jenkins 1970: n var(rho) = 1 - rho^2, n var(log sd) = (1 + rho^2) / (1 - rho^2) / 2."""
    rho, n = 0.8, 4000
    fit = fit_of("ar1", 0.5, rho, sigma=BROAD, rho=FLAT)
    best, covariance = fit.best(np.array([np.nan, np.nan])), fit.covariance(fit.best(np.full(2, np.nan)))
    exact = np.array([(1 + rho**2) / (1 - rho**2) / 2 / n, (1 - rho**2) / n / (rho * (1 - rho)) ** 2])
    assert_allclose(np.diagonal(covariance), exact, rtol=0.15)
    away = np.array([np.log(best[0] / 0.5), np.log(best[1] / (1 - best[1])) - np.log(rho / (1 - rho))])
    assert np.all(np.abs(away) < 4 * np.sqrt(exact))


def test_fitted_noise_is_where_the_density_is_highest():
    fit = fit_of("white+ar1", 0.3, 0.4, 0.9, sigma=BROAD, sigma_ar=BROAD, rho=FLAT)
    template = np.full(3, np.nan)
    best = fit.best(template)
    assert_allclose(best, (0.3, 0.4, 0.9), rtol=0.15)
    x = np.array([np.log(best[0]), np.log(best[1]), np.log(best[2] / (1 - best[2]))])
    around = x + 0.01 * np.concatenate([np.eye(3), -np.eye(3)])
    top = fit.log_density(x[None], template)[0]
    assert np.all(fit.log_density(around, template) < top)
    width = np.sqrt(np.diagonal(fit.covariance(best)))
    assert np.all(np.abs(x - np.log([0.3, 0.4, 9.0])) < 4 * width)


def test_fixed_noise_stays_and_an_empty_residual_changes_nothing():
    fit = fit_of("white+ar1", 0.3, 0.4, 0.9, sigma=None, sigma_ar=BROAD, rho=None)
    best = fit.best(np.array([0.3, np.nan, 0.9]))
    assert (best[0], best[2]) == (0.3, 0.9)
    assert best[1] == pytest.approx(0.4, rel=0.15)
    still = NoiseFit(fit.noise, fit.rows, [np.zeros(20)], [np.ones(20)])
    assert_allclose(still.best(np.array([0.3, 0.1, 0.9])), (0.3, 0.1, 0.9))


@pytest.mark.parametrize("noise", ["ar1", "white+ar1"])
def test_the_likeliest_noise_is_that_of_a_search_without_slopes(noise):
    """The prior counts for nothing, and what is held stays."""
    values = {"ar1": (0.5, 0.8), "white+ar1": (0.3, 0.4, 0.9)}[noise]
    narrow = Prior("lognorm", {"s": 0.01, "scale": 2.0})
    rows = dict.fromkeys(("sigma", "sigma_ar"), narrow) | {"rho": FLAT}
    fit = fit_of(noise, *values, n=600, **rows)
    moving, start = fit.free[1:], np.array(values)
    ends = np.full(len(moving), -6.0), np.full(len(moving), 6.0)
    best = fit.likeliest(start, moving, ends)
    assert best[0] == values[0]

    def cost(x):
        at = fit.values(x[None], start, moving)
        pairs = zip(fit.residuals, fit.gaps, strict=True)
        return -sum(fit.noise.pointwise(part[None], at, gaps).sum() for part, gaps in pairs)

    x = [fit.rows[k].coordinate(start[k]) for k in moving]
    other = minimize(cost, x, method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-9}).x
    assert_allclose([fit.rows[k].coordinate(best[k]) for k in moving], other, atol=2e-4)
    still = fit.likeliest(start, moving, (np.array(x) - 0.01, np.array(x) + 0.01))
    assert (np.abs([fit.rows[k].coordinate(still[k]) for k in moving] - np.array(x)) <= 0.01 + 1e-12).all()


@pytest.mark.parametrize("noise", NOISES)
def test_every_noise_has_a_curvature_that_is_positive_where_it_is_not_seen(noise):
    posterior = problem(record(camera=0.1, noise_sd=0.02, command=LATE), noise=noise).posterior
    optimum = find_optima(posterior, np.random.default_rng(0), starts=2)[0]
    assert np.isfinite(optimum.covariance).all()
    assert np.linalg.eigvalsh(optimum.covariance).min() > 0
