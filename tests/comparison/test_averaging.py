"""Averages over candidates: mixtures in closed form, the two parts of an error, and coverage of the truth."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import brentq
from scipy.stats import norm

from lcopa_bayes.comparison.averaging import _moved, averaged, mixture_quantiles
from lcopa_bayes.results.averages import parts_of_sd

AT = (np.arange(200) + 0.5) / 200


def gaussian(mean: float, sd: float) -> list[float]:
    return list(norm.ppf(AT, mean, sd))


def row(name: str, probability: float, values: list[Any], **more: Any) -> dict[str, Any]:
    known = {
        "name": name,
        "usable": True,
        "probability": probability,
        "parameters": 5,
        "max_log_likelihood": 0.0,
        "elpd": 0.0,
        "elpd_difference_sd": 1.0,
        "grade": "reliable",
        "grade_reason": "",
        "quantiles": {"gain": {"unit": "V", "values": values}},
    }
    return known | more


def test_quantiles_of_a_mixture_are_those_of_its_cumulative_probability():
    weights, means, sds = np.array([0.7, 0.3]), np.array([0.0, 2.0]), np.array([1.0, 0.5])
    values = np.array([gaussian(mean, sd) for mean, sd in zip(means, sds, strict=True)])
    for p in (0.05, 0.5, 0.95):
        exact = brentq(lambda x, p=p: weights @ norm.cdf(x, means, sds) - p, -10, 10)
        assert_allclose(mixture_quantiles(values, weights, np.array([p]))[0], exact, atol=0.03)


def test_a_mixture_is_open_where_more_than_its_tail_is_never_reached():
    values = np.array([gaussian(0, 1), [*gaussian(0, 1)[:150], *[np.inf] * 50]])
    ends = mixture_quantiles(values, np.array([0.5, 0.5]), np.array([0.05, 0.95]))
    assert np.isfinite(ends[0])
    assert np.isinf(ends[1])
    assert all(np.isnan(parts_of_sd(values, np.array([0.5, 0.5]))))


def test_the_parts_of_an_error_add_up_to_that_of_the_mixture():
    rng = np.random.default_rng(3)
    weights, means, sds = np.array([0.5, 0.3, 0.2]), np.array([0.0, 2.0, -1.0]), np.array([1.0, 0.5, 2.0])
    values = np.array([gaussian(mean, sd) for mean, sd in zip(means, sds, strict=True)])
    within, between = parts_of_sd(values, weights)
    which = rng.choice(3, 200_000, p=weights)
    drawn = rng.normal(means[which], sds[which])
    assert_allclose(np.hypot(within, between), drawn.std(), rtol=0.01)
    assert_allclose(between, np.sqrt(weights @ (means - weights @ means) ** 2), rtol=1e-6)


RICHER = {"parameters": 7}


@pytest.mark.parametrize(
    ("other", "weight"),
    [
        (row("rich", 0.01, gaussian(3, 1), **RICHER), 0.5),
        (row("rich", 0.01, gaussian(0.3, 1), **RICHER), 0.01),  # moves nothing
        (row("rich", 0.01, gaussian(3, 1)), 0.01),  # is no richer
        (row("rich", 0.01, gaussian(3, 1), elpd=-2.5, **RICHER), 0.01),  # predicts worse
        (row("rich", 0.01, gaussian(3, 1), max_log_likelihood=-3.0, **RICHER), 0.01),  # explains less
        (row("rich", 0.01, gaussian(3, 1), elpd=None, **RICHER), 0.5),  # nothing was predicted
        (row("rich", 0.01, [None] * 200, **RICHER), 0.5),  # never reaches it
    ],
)
def test_a_richer_candidate_weighs_where_it_is_not_rejected_and_moves_a_number(other, weight):
    (number,) = averaged([row("plain", 0.99, gaussian(0, 1)), other])
    assert_allclose(number["weights"].get("rich", 0.0), weight, atol=1e-12)
    assert number["raised"] == (["rich"] if weight == 0.5 else [])
    assert number["upper"] > 1.5


def test_the_grade_is_the_worst_of_those_that_weigh():
    rich = row("rich", 0.01, gaussian(3, 1), grade="tentative", **RICHER)
    assert averaged([row("plain", 0.99, gaussian(0, 1)), rich])[0]["grade"] == "tentative"
    light = rich | {"probability": 1e-6, "elpd": -9.0}
    assert averaged([row("plain", 1 - 1e-6, gaussian(0, 1)), light])[0]["grade"] == "reliable"


def test_nothing_is_averaged_over_one_candidate_or_over_a_number_that_one_lacks():
    plain = row("plain", 1.0, gaussian(0, 1))
    assert averaged([plain, row("bad", 0.0, [], usable=False)]) == []
    assert averaged([plain, row("no", 0.0, [], quantiles={})]) == []


def test_an_extrapolation_is_covered_although_the_evidence_is_against_the_term_that_moves_it():
    """A level and a slope that the evidence does not ask for, at three times the range of the samples: the
    truth is covered by the rule, and half as often by probabilities alone."""
    rng, n, far, wide, slope = np.random.default_rng(11), 20, 3.0, 20.0, 0.45
    x = np.linspace(-1, 1, n)
    design = np.column_stack([np.ones(n), x])
    covered = np.zeros(2)
    for _ in range(400):
        y = slope * x + rng.standard_normal(n)
        cards = []
        for name, columns in (("level", 1), ("line", 2)):
            precision = design[:, :columns].T @ design[:, :columns] + np.eye(columns) / wide**2
            mean = np.linalg.solve(precision, design[:, :columns].T @ y)
            at = np.array([1.0, far])[:columns]
            sd = float(np.sqrt(at @ np.linalg.solve(precision, at)))
            evidence = (
                0.5 * mean @ precision @ mean - 0.5 * np.linalg.slogdet(precision)[1] - columns * np.log(wide)
            )
            likelihood = -0.5 * np.sum((y - design[:, :columns] @ mean) ** 2)
            cards.append((name, columns, float(at @ mean), sd, evidence, likelihood))
        shares = np.exp([card[4] for card in cards] - np.logaddexp(cards[0][4], cards[1][4]))
        rows = [
            row(name, share, gaussian(mean, sd), parameters=columns, elpd=None, max_log_likelihood=likelihood)
            for (name, columns, mean, sd, _, likelihood), share in zip(cards, shares, strict=True)
        ]
        truth = slope * far
        (number,) = averaged(rows)
        covered[0] += number["lower"] <= truth <= number["upper"]
        values = np.array([one["quantiles"]["gain"]["values"] for one in rows])
        low, high = mixture_quantiles(values, shares, np.array([0.05, 0.95]))
        covered[1] += low <= truth <= high
    assert covered[0] / 400 > 0.85
    assert covered[1] / 400 < 0.7


def test_a_number_that_both_candidates_leave_open_has_not_moved():
    """A settling time that neither reaches; one that only one reaches has moved."""
    settled, never = gaussian(0, 1), np.full(200, np.inf)
    assert not _moved(never, never)
    assert _moved(never, settled)
    assert _moved(settled, never)
