"""Parameters that a prior far from the data pulls towards itself are named, with their size without it."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small import draws_of, problem

from lcopa_bayes.data.settings import EffectsSettings, PriorSettings
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.optimum import find_optima
from lcopa_bayes.results.adequacy import conflicts
from lcopa_bayes.sampling.convergence import Limitation
from lcopa_bayes.sampling.draws import Draws

sys.path.insert(0, str(Path(__file__).parents[1] / "effectsearch"))
from test_loop_priors import CURVATURE, bent

WIDTH = 0.03
"""Standard deviation of a prior about 0 [unit of the gain]."""
COUNT = 4000


def normal(data: float, sd: float, prior: float = WIDTH, seed: int = 0) -> Draws:
    """Draws of a gain with a normal prior about 0 that data alone give as `data` with that `sd`."""
    priors = {"gain": ("norm", {"loc": 0.0, "scale": prior})}
    table = problem(priors=priors).posterior.table
    values = np.tile([row.value for row in table.rows], (COUNT, 1))
    rng = np.random.default_rng(seed)
    for k, row in enumerate(table.rows):
        if row.free:
            values[:, k] = row.draw(COUNT, rng)
    precision = 1 / sd**2 + 1 / prior**2
    mean = data / sd**2 / precision
    at = table.names.index("gain")
    values[:, at] = mean + rng.standard_normal(COUNT) / np.sqrt(precision)
    return draws_of(table, values)


def reported(draws: Draws) -> list[Limitation]:
    return [one for one in conflicts(draws) if one.parameters == ("gain",)]


def numbers(one: Limitation) -> tuple[float, float]:
    """Shift [posterior sd] and value without the prior."""
    found = re.search(r"shifts it by ([0-9.]+) posterior sd: .* about ([-0-9.e]+)", one.reason)
    assert found is not None
    return float(found[1]), float(found[2])


def test_a_normal_posterior_gives_the_closed_form():
    """Data at 0.29 +- 0.01 under a prior of sd 0.03: the posterior is at 0.261 +- 0.0095."""
    (one,) = reported(normal(0.29, 0.01))
    shift, alone = numbers(one)
    assert one.level == "tentative"
    assert "widen the prior of gain" in one.remedy
    assert shift == pytest.approx((0.29 - 0.261) / 0.0094868, rel=0.05)
    assert alone == pytest.approx(0.29, abs=0.003)


def test_it_agrees_with_draws_weighted_by_the_inverse_prior():
    """Another method to the estimate without the prior."""
    draws = normal(0.1, 0.01)
    (one,) = reported(draws)
    x = draws.column("gain")
    weights = np.exp(0.5 * (x / WIDTH) ** 2 - 0.5 * (x.max() / WIDTH) ** 2)
    alone = float(np.average(x, weights=weights))
    assert numbers(one)[1] == pytest.approx(alone, abs=0.001)
    assert numbers(one)[0] == pytest.approx((alone - x.mean()) / x.std(), abs=0.1)


@pytest.mark.parametrize(
    ("data", "sd"),
    [(0.06, 0.01), (0.29, 1e-4), (0.05, 0.03), (0.1, 0.2)],
    ids=["within", "not pulled", "as wide as the data", "weak data"],
)
def test_what_the_prior_may_well_give_or_does_not_move_is_no_conflict(data, sd):
    assert reported(normal(data, sd)) == []


def test_truths_of_the_prior_are_rarely_in_conflict():
    """Of 150 no more than four errors above one in 370."""
    rng = np.random.default_rng(1)
    alarms = 0
    for seed in range(150):
        truth = WIDTH * rng.standard_normal()
        alarms += bool(reported(normal(truth + 0.02 * rng.standard_normal(), 0.02, seed=seed)))
    assert alarms <= 150 * 2.7e-3 + 4 * np.sqrt(150 * 2.7e-3)


def test_flat_priors_are_never_in_conflict():
    priors = {"gain": ("uniform", {"loc": 0.0, "scale": 0.3})}
    table = problem(priors=priors).posterior.table
    draws = normal(0.29, 0.01)
    at = table.names.index("gain")
    values = draws.flat.copy()
    values[:, at] = 0.3 - 0.01 * np.random.default_rng(2).random(len(values))
    assert [one for one in conflicts(draws_of(table, values)) if "gain" in one.parameters] == []


def about_optimum(wide: float) -> Draws:
    """Normal draws about the optimum of a study whose effect is far beyond its default prior."""
    made = bent(1)
    name = "odd_curvature.c"
    priors = {}
    if wide != 1.0:
        priors = {name: PriorSettings(name, dist="norm", parameters={"loc": 0.0, "scale": wide * 0.03})}
    declared = replace(made, effects=EffectsSettings(use=("odd_curvature",)), priors=priors)
    posterior = problem_of(declared).posterior
    best = find_optima(posterior, np.random.default_rng(0), starts=2)[0]
    rng = np.random.default_rng(1)
    centre = posterior.coordinates(best.values[None])[0]
    drawn = centre + rng.multivariate_normal(np.zeros(centre.size), best.covariance, COUNT)
    drawn = drawn[np.isfinite(posterior.log_prior(drawn))]
    values = np.tile(best.values, (len(drawn), 1))
    sampled = posterior.values(drawn)
    free = ~np.isnan(sampled)
    values[free] = sampled[free]
    return draws_of(posterior.table, values)


def test_an_effect_beyond_its_default_prior_is_named_with_its_size():
    """And not once that prior is wide enough."""
    found = [one for one in conflicts(about_optimum(1.0)) if one.parameters == ("odd_curvature.c",)]
    assert len(found) == 1
    assert numbers(found[0])[1] == pytest.approx(CURVATURE * 1.03**2, abs=0.03)
    assert [one for one in conflicts(about_optimum(10.0)) if "odd_curvature.c" in one.parameters] == []


def test_a_usual_problem_has_none():
    table = problem().posterior.table
    drawn = table.draw(COUNT, np.random.default_rng(3))
    assert list(conflicts(draws_of(table, drawn))) == []
