"""Decisions whose right answer is known, over 100 draws each: how often they are right, and how often wrong.

Orders with a normal likelihood and a uniform prior: evidence, posterior and predictions are known in closed
form, so that what is tested is the rule and not the sampling.
"""

from __future__ import annotations

from math import log

import numpy as np
import pytest
from scipy.stats import binom, norm
from small import path, record, study
from test_comparison import card, outcome, prior_widths

from lcopa_bayes.bench.device import Device
from lcopa_bayes.comparison.averaging import STRONG, Gain, by_prediction
from lcopa_bayes.comparison.candidates import candidates_of
from lcopa_bayes.comparison.compare import compare
from lcopa_bayes.comparison.integerorder import DECISIVE, savage_dickey
from lcopa_bayes.comparison.sequentialdensity import log_densities
from lcopa_bayes.core.estimate import Estimate
from lcopa_bayes.inference.noise import AR1

DRAWS = 100
RARE = 0.01
"""Probability with which a correct rule fails a test here."""


def at_most(rate: float) -> int:
    """Largest count of `DRAWS` that a rate allows."""
    return int(binom.ppf(1 - RARE, DRAWS, rate))


def at_least(rate: float, draws: int = DRAWS) -> int:
    return int(binom.ppf(RARE, draws, rate))


# -- is this order an integer? ---------------------------------------------------------------------


def answers(orders, sd: float, rng) -> list[tuple[str, float]]:
    """Answer for each true order after one measurement of it, and the exact log Bayes factor."""
    prior, out = rng.uniform(0, 2, 200_000), []
    for order in orders:
        seen = rng.normal(order, sd)
        draws = rng.normal(seen, sd, 2_000)
        reported = savage_dickey(
            draws, prior, Estimate.of("order_1", "-", draws, ess=2_000, grade="reliable")
        )
        out.append((reported.answer, float(norm.logpdf(1.0, seen, sd)) - log(0.5)))
    return out


@pytest.mark.parametrize("sd", [0.0008, 0.01, 0.05])
def test_an_integer_order_is_called_one(sd):
    found = answers(np.ones(DRAWS), sd, np.random.default_rng(1))
    wrong = sum(answer == "not an integer" for answer, _ in found)
    # a Bayes factor below a third has at most a third of the probability under the integer, here 2 % and less
    limit = np.sqrt(2 * (log(2 / np.sqrt(2 * np.pi) / sd) + log(DECISIVE)))
    assert wrong <= at_most(2 * norm.sf(limit))
    assert sum(answer == "integer" for answer, _ in found) >= at_least(2 * norm.cdf(1.8) - 1)
    for answer, exact in found:
        if answer != "undecided":
            assert (answer == "integer") == (exact > 0)


@pytest.mark.parametrize("sd", [0.0008, 0.01, 0.05])
@pytest.mark.parametrize("apart", [6.0, 10.0])
def test_an_order_well_off_an_integer_is_never_called_one(sd, apart):
    found = answers(np.full(DRAWS, 1 + apart * sd), sd, np.random.default_rng(2))
    assert not any(answer == "integer" for answer, exact in found if exact < -log(DECISIVE))
    limit = np.sqrt(2 * (log(2 / np.sqrt(2 * np.pi) / sd) + log(DECISIVE) + 0.5))
    right = sum(answer == "not an integer" for answer, _ in found)
    assert right >= at_least(norm.cdf(apart - limit) - 0.05)


# -- ranking by prediction -------------------------------------------------------------------------


def forecasts(rng, *, rho: float = 0.9, samples: int = 200) -> tuple[Gain, float]:
    """Gain of a forecaster that knows how noise correlates over one that takes it for white, of one record,
    and the expected one."""
    noise = AR1().draw(np.array([[1.0, rho]]), np.ones(samples), rng)
    rows = []
    for correlation in (rho, 0.0):
        reported = log_densities(
            AR1(), noise, np.array([[1.0, correlation]]), np.ones(samples), np.zeros(1), 1
        )[0]
        pointwise = {
            "part": ["a"] * reported.size,
            "axis": ["y"] * reported.size,
            "log_density": reported.tolist(),
        }
        rows.append({"elpd": float(reported.sum()), "elpd_monte_carlo_sd": 0.0, "pointwise": pointwise})
    gain = by_prediction(*rows)
    assert gain is not None
    return gain, -0.5 * (samples - 1) * log(1 - rho**2)


def test_a_forecast_in_nats_is_that_of_the_joint_density():
    """The forecaster that knows the correlation gains what information theory says; densities that forget
    the samples before would rank both alike."""
    found = [forecasts(np.random.default_rng(seed)) for seed in range(DRAWS)]
    gains = np.array([gain.nats for gain, _ in found])
    error = gains.std(ddof=1) / np.sqrt(DRAWS)
    assert abs(gains.mean() - found[0][1]) < 4 * error
    assert error < 0.05 * found[0][1]
    assert sum(gain.counts for gain, _ in found) == DRAWS
    spread = np.mean([gain.sd for gain, _ in found]) / gains.std(ddof=1)
    assert 0.6 < spread < 1.6  # neighbours err together, and the error knows it


@pytest.mark.parametrize("apart", [0.05, 0.5])
def test_equal_forecasters_are_seldom_ranked(apart):
    """Means off by as much to either side predict equally well: 2 errors of 10 stretches are a probability of
    7.7 % by Student's law, both sides together."""
    counted = 0
    for seed in range(DRAWS):
        y = np.random.default_rng(seed).normal(size=400)
        rows = [
            {
                "elpd": float(norm.logpdf(y, side * apart).sum()),
                "elpd_monte_carlo_sd": 0.0,
                "pointwise": {
                    "part": ["a"] * y.size,
                    "axis": ["y"] * y.size,
                    "log_density": norm.logpdf(y, side * apart).tolist(),
                },
            }
            for side in (1, -1)
        ]
        gain = by_prediction(*rows)
        assert gain is not None
        counted += gain.counts or Gain(-gain.nats, gain.sd).counts
    assert counted <= at_most(0.077)


# -- fractional orders warranted -------------------------------------------------------------------

SEEN = 40


def verdict(order: float, sd: float, rng) -> str:
    """A record of `SEEN` measurements of an order decides between 1 and any order in (0, 2); another is
    predicted."""
    seen, unseen = rng.normal(order, sd, SEEN), rng.normal(order, sd, SEEN)
    mean, known = seen.mean(), sd / np.sqrt(SEEN)
    level = norm.logpdf(seen, mean, sd).sum() - norm.logpdf(mean, mean, known)
    evidence = level - log(2.0), level + norm.logpdf(mean, 1.0, known)
    spread = np.hypot(sd, known)
    lpd = norm.logpdf(unseen, mean, spread), norm.logpdf(unseen, 1.0, sd)
    rows = []
    for name, value, reported, count in (
        ("free", evidence[0], lpd[0], 6),
        ("first-order", evidence[1], lpd[1], 5),
    ):
        row = card(name, float(value), 0.0, parameters=count)
        row["pointwise"] |= {"log_density": reported.tolist()}
        rows.append(row | {"prior_widths": prior_widths(float(value), float(value))})
    return str(outcome(*rows)["fractional"]["verdict"])


@pytest.mark.slow
def test_fractional_orders_are_not_warranted_by_chance():
    """A Bayes factor of 20 against the truth has a probability of 1/20 at most; with prediction far less."""
    found = [verdict(1.0, 0.05, np.random.default_rng(seed)) for seed in range(DRAWS)]
    assert found.count("warranted") <= at_most(0.005)


@pytest.mark.parametrize("draws", [30, pytest.param(DRAWS, marks=pytest.mark.slow)])
def test_fractional_orders_are_warranted_where_the_record_shows_them(draws):
    """0.8 is known to 6.3 standard deviations from 1 by the record that is fitted and by the other."""
    found = [verdict(0.8, 0.2, np.random.default_rng(seed)) for seed in range(draws)]
    assert found.count("warranted") >= at_least(0.9, draws)
    assert "not warranted" not in found


@pytest.mark.slow
@pytest.mark.parametrize(("order", "most", "least"), [(1.0, 1, 0), (0.8, 10, 8)])
def test_compared_records_of_known_order(order, most, least):
    """The verb on ten pairs of simulated records: first order against one free order."""
    from small import TWO

    device = Device(
        ((path(2.0, 0.73, (1.5,), (order,)),),), TWO.drive_axes[:1], TWO.response_axes[:1], (0.3,)
    )
    priors = {
        "time_1": ("loguniform", {"a": 0.3, "b": 15.0}),
        "delay": 0.73,
        "gain": ("norm", {"loc": 0.0, "scale": 10.0}),
        "sigma": ("loguniform", {"a": 2e-3, "b": 0.2}),
    }
    sampler = {"ensembles": 2, "walkers": 16, "target_ess": 100}
    found = []
    for seed in range(10):
        pair = [
            record(100 + 2 * seed + k, device=device, camera=0.4, name=name) for k, name in enumerate("ab")
        ]
        one = study(*pair, noise="white", priors=priors, sampler=sampler, seed=seed)
        reported = compare(candidates_of(one, (), ["fractional-1", "first-order"]))
        found.append(reported["fractional"])
    beaten = sum(one["least_over_priors"] > STRONG for one in found)
    assert least <= beaten <= most, found
    verdicts = [one["verdict"] for one in found]
    assert verdicts.count("warranted") <= beaten  # so few samples seldom tell an order of 0.8 from two lags
    assert order == 1.0 or "not warranted" not in verdicts
