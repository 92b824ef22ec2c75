"""Is this order an integer? Savage-Dickey ratios of the posterior's free orders."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from math import log, sqrt
from typing import Any, Literal, final

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.estimate import Estimate, plain
from lcopa_bayes.results.fit import Fit

DECISIVE = 3.0
"""Bayes factor from which it counts as more than worth a bare mention [-] (Jeffreys 1961, App. B)."""
_WIDEST = 0.1
"""Widest distance from the integer that counts as at it [-]: no record tells the two apart."""
_SHARE = 0.25
"""Half width of the window in posterior standard deviations [-]: 3 of them off, the mean density in it is
8 % above that at the integer."""
_PRIOR_NARROWEST = 0.005
"""Narrowest window in which prior draws are counted [-]: no prior of an order varies within it."""
_FEWEST = 10.0
"""Effective draws at the integer below which the tail is extrapolated [-]."""
_PRIOR_DRAWS = 200_000

Answer = Literal["integer", "not an integer", "undecided"]
Method = Literal["draws at the integer", "normal tail", "undefined"]


@final
@dataclass(frozen=True)
class IntegerOrder:
    """What the draws say of one order."""

    parameter: str
    nearest: int
    """Integer next to the median, 1 or 2."""
    log_bayes_factor: float
    """Of the integer against a free order [nat]; above 0 favours the integer."""
    log_sd: float
    """Its Monte Carlo standard error [nat]."""
    method: Method
    window: float
    """Distance from the integer within which draws are counted [-]."""
    estimate: Estimate

    @property
    def bayes_factor(self) -> float:
        """Of the integer against a free order [-]."""
        return float(np.exp(self.log_bayes_factor))

    @property
    def answer(self) -> Answer:
        """By two standard errors about a Bayes factor of 3, or of a third."""
        low, high = (self.log_bayes_factor + side * 2 * self.log_sd for side in (-1, 1))
        if self.estimate.grade == "unusable" or np.isnan(low):
            return "undecided"
        return (
            "integer" if low > log(DECISIVE) else "not an integer" if high < -log(DECISIVE) else "undecided"
        )

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return plain(
            {key: value for key, value in asdict(self).items() if key != "estimate"}
            | {
                "bayes_factor": self.bayes_factor,
                "answer": self.answer,
                "grade": self.estimate.grade,
                "estimate": self.estimate.as_json(),
            }
        )


def integer_orders(fit: Fit) -> tuple[IntegerOrder, ...]:
    """Every free order of a fit."""
    table, rng = fit.draws.table, np.random.default_rng([fit.run.plan.seed, 8])
    free = [k for k, row in enumerate(table.rows) if row.kind == "order" and row.free]
    if not free:
        return ()
    prior = table.draw(_PRIOR_DRAWS, rng)
    estimates = {one.name: one for one in fit.draws.estimates()}
    return tuple(savage_dickey(fit.draws.flat[:, k], prior[:, k], estimates[table.names[k]]) for k in free)


def savage_dickey(posterior: Vector, prior: Vector, estimate: Estimate) -> IntegerOrder:
    """Ratio of posterior to prior density at the integer nearest to the median.

    ``B = p(order | y) / p(order)`` there (Dickey 1971, Ann. Math. Statist. 42). Densities are shares of
    draws within a window per width of the window: a quarter of a posterior standard deviation, 0.1 at most,
    for the posterior, and 0.005 at least for the prior. Where fewer than ten effective draws lie in it, the
    posterior density is that of a normal distribution of the draws' mean and standard deviation: good
    enough to say that the integer lies far out, and its error grows with the distance as that of both
    moments does. `prior` draws are independent; those of the posterior are worth the effective sample size
    of `estimate`. Draws that do not vary leave the ratio undefined.
    """
    nearest = max(1, round(float(np.median(posterior))))
    mean, sd, ess = float(posterior.mean()), float(posterior.std()), max(float(estimate.ess), 2.0)
    window = min(_SHARE * sd, _WIDEST)
    wide = max(window, _PRIOR_NARROWEST)
    after = float(np.mean(np.abs(posterior - nearest) <= window))
    before = float(np.mean(np.abs(prior - nearest) <= wide))
    if before == 0.0 or sd == 0.0:
        return IntegerOrder(estimate.name, nearest, np.nan, np.nan, "undefined", window, estimate)
    prior_error = (1 - before) / (before * prior.size)
    log_prior = log(before / _width(nearest, wide))
    if after * ess >= _FEWEST:
        error = sqrt((1 - after) / (after * ess) + prior_error)
        value = log(after / _width(nearest, window)) - log_prior
        return IntegerOrder(estimate.name, nearest, value, error, "draws at the integer", window, estimate)
    beyond = (nearest - mean) / sd
    density = -0.5 * beyond**2 - log(sd * sqrt(2 * np.pi))
    error = sqrt(beyond**2 / ess + (beyond**2 - 1) ** 2 / (2 * ess) + prior_error)
    return IntegerOrder(estimate.name, nearest, density - log_prior, error, "normal tail", window, estimate)


def _width(nearest: int, window: float) -> float:
    """Width of a window about an integer, of which nothing lies beyond an order of 2 [-]."""
    return min(nearest + window, 2.0) - (nearest - window)
