"""Expansions of the likelihood and the coordinates in which they hold, against differences and refits."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from small import TRUTH, TWO, problem, record

from lcopa_bayes.inference.conditional import Conditional
from lcopa_bayes.inference.expansion import expanded
from lcopa_bayes.inference.posterior import Posterior

GAIN = {"gain": ("loguniform", {"a": 0.5, "b": 5.0})}
POSTERIORS = {
    "white": lambda: problem(record(camera=0.6), terms=2).posterior,
    "a sampled gain": lambda: problem(record(camera=0.6), terms=2, priors=GAIN).posterior,
    "a fixed time": lambda: problem(record(camera=0.6), terms=2, priors=GAIN | {"time_2": 0.7}).posterior,
    "ar1": lambda: problem(record(camera=0.6), noise="ar1").posterior,
    "student": lambda: problem(record(camera=0.6), noise="student").posterior,
    "two axes": lambda: problem(record(device=TWO, camera=1.0), share="all", terms=2).posterior,
}


@pytest.fixture(params=POSTERIORS, scope="module")
def posterior(request) -> Posterior:
    return POSTERIORS[request.param]()


def drawn(posterior: Posterior, count: int, seed: int = 3) -> np.ndarray:
    values = posterior.table.draw(count, np.random.default_rng(seed))
    for axis in range(len(posterior.table.layout.responses)):  # a likelihood that is not all curvature
        values[:, posterior.table.at("sigma", axis)] = 0.05
    return values


def test_slopes_are_those_of_the_likelihood(posterior):
    values = drawn(posterior, 12)
    rows = posterior.table.rows
    conditional = Conditional(posterior, delays=True)
    found = expanded(posterior, values, conditional.columns)
    assert_allclose(found.log_likelihood, posterior.log_likelihood(values), rtol=1e-9)
    for column, k in enumerate(conditional.columns):
        up, down, step = values.copy(), values.copy(), 1e-5
        if rows[k].kind == "time":
            up[:, k] *= np.exp(step)
            down[:, k] *= np.exp(-step)
        else:
            step *= float(rows[k].prior.frozen.std())
            up[:, k] += step
            down[:, k] -= step
        slope = (posterior.log_likelihood(up) - posterior.log_likelihood(down)) / (2 * step)
        if posterior.linear:  # the slope of the normalisation is neglected: a nat over a prior width
            assert np.median(np.abs(found.gradient[:, column] - slope)) < 0.05 * np.abs(slope).max()
        else:
            assert_allclose(found.gradient[:, column], slope, rtol=2e-4, atol=1e-4 * np.abs(slope).max())
    assert (np.linalg.eigvalsh(found.information).min(axis=1) > -1e-6 * np.abs(found.information).max()).all()


def test_coordinates_and_their_slopes(posterior):
    values = drawn(posterior, 20)
    conditional = Conditional(posterior)
    x = conditional.x(values)
    back, exists = conditional.values(x, values)
    assert exists.all()
    assert_allclose(back[:, conditional.columns], values[:, conditional.columns], rtol=1e-9)
    steep, natural = conditional.steepness(values), conditional.natural(values)
    for column in range(x.shape[1]):
        step = 1e-6 * np.abs(x[:, column])
        up, down = x.copy(), x.copy()
        up[:, column] += step
        down[:, column] -= step
        ends = [conditional.natural(conditional.values(at, values)[0]) for at in (up, down)]
        slope = (ends[0] - ends[1]) / (2 * step)[:, None]
        assert_allclose(steep[:, :, column], slope, rtol=1e-4, atol=1e-4 * np.abs(slope).max() + 1e-8)
    assert np.isfinite(natural).all()


def test_a_descent_from_prior_draws_reaches_one_optimum():
    """At the true orders, delay and noise, from anywhere; and there the expansion predicts the likelihood."""
    made = problem(record(camera=0.2), priors={k: TRUTH[k] for k in ("delay", "sigma")} | GAIN).posterior
    conditional = Conditional(made)
    values = made.table.draw(30, np.random.default_rng(1))
    values[:, made.table.at("order", 0)] = TRUTH["order_1"]
    at, objective = conditional.descended(values, 12)
    assert_allclose(objective, conditional.descended(at.values, 12)[1], atol=0.02)
    reached = objective > objective.max() - 0.02
    assert reached.mean() > 0.9
    best = at.values[np.argmax(objective)]
    assert abs(np.log(best[made.table.at("time", 0)] / TRUTH["time_1"])) < 0.2
    one = int(np.argmax(objective))
    sd = np.sqrt(np.diag(np.linalg.inv(at.information[one])))
    for sign in (-1.0, 1.0):
        for column in range(len(sd)):
            away = at.x[[one]].copy()
            away[0, column] += sign * sd[column]
            predicted = at.log_likelihood[one] + (away - at.x[[one]])[0] @ at.gradient[one]
            predicted -= 0.5 * sd[column] ** 2 * at.information[one, column, column]
            exact = made.log_likelihood(conditional.values(away, at.values[[one]])[0])[0]
            assert abs(exact - predicted) < 0.05


def test_a_descent_that_cannot_come_near_the_best_of_its_batch_ends(monkeypatch):
    """The others are what they are alone, and that one stays as far below."""
    posterior, counts, expand = problem(record(camera=0.2)).posterior, [], Conditional.expanded
    monkeypatch.setattr(Conditional, "expanded", lambda of, at: counts.append(len(at)) or expand(of, at))
    conditional = Conditional(posterior, delays=True)
    values = drawn(posterior, 40)
    values[:, posterior.table.at("order", 0)] = np.linspace(0.3, 1.7, 40)
    values[:, posterior.table.at("sigma", 0)] = TRUTH["sigma"]
    _, together = conditional.descended(values.copy(), 12)
    used = sum(counts)
    alone = np.array([conditional.descended(one[None], 12)[1][0] for one in values])
    near = alone > alone.max() - 50.0
    assert 3 < near.sum() < 30
    assert_allclose(together[near], alone[near], rtol=1e-9)
    assert (together[~near] < together.max() - 50.0).all()
    assert used < 0.8 * (sum(counts) - used)


def test_times_whose_response_overflows_do_not_exist():
    posterior = problem(record(camera=0.6)).posterior
    conditional = Conditional(posterior, delays=True)
    values = drawn(posterior, 1)
    assert conditional.values(conditional.x(values), values)[1].all()
    x = conditional.x(values)
    x[:, conditional.elements[0].part] = 0.9
    values[:, posterior.table.at("order", 0, 0)] = 0.001  # 0.9 / 0.1 to the power of 1000
    assert not conditional.values(x, values)[1].any()


def test_slopes_exist_where_a_term_is_nearly_all_of_its_element():
    """Its share of D(s_0) rounds to 1, and 1 less it to 0."""
    posterior = problem(record(camera=0.6)).posterior
    conditional = Conditional(posterior)
    values = drawn(posterior, 3)
    values[:, posterior.table.at("order", 0, 0)] = 1.5
    values[:, posterior.table.at("time", 0, 0)] = [1e13, 1e15, 1e20]
    element = conditional.elements[0]
    level = (values[:, element.times] * conditional.frequency) ** 1.5
    assert_allclose(conditional.left(element, values), 1 / level[:, 0], rtol=1e-12)
    steep = conditional.steepness(values)
    assert np.isfinite(steep).all()
    assert_allclose(
        steep[:, element.first, element.first] * conditional.x(values)[:, element.first], level[:, 0] / 1.5
    )
