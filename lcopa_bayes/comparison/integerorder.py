"""Is this order an integer? Savage-Dickey ratios of the posterior's free orders."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal, final

import numpy as np

from lcopa_bayes.arrays import Vector
from lcopa_bayes.estimate import Estimate, plain
from lcopa_bayes.fit import Fit
from lcopa_bayes.inference.grade import Level

DECISIVE = 3.0
"""Bayes factor from which it counts as more than worth a bare mention [-] (Jeffreys 1961, App. B)."""
_WIDEST = 0.1
"""Widest distance from the integer that counts as at it [-]: an order no audit tells from an integer."""
_NARROWEST = 0.01
_PRIOR_DRAWS = 200_000

Answer = Literal["integer", "not an integer", "undecided"]


@final
@dataclass(frozen=True)
class IntegerOrder:
    """What the draws say of one order."""

    parameter: str
    nearest: int
    """Integer next to the median, 1 or 2."""
    bayes_factor: float
    """Of the integer against a free order [-]; above 1 favours the integer. An upper bound when no draw
    is at the integer."""
    relative_sd: float
    """Monte Carlo standard error over the ratio [-]; infinite for a bound."""
    bound: bool
    """Whether `bayes_factor` is only an upper bound."""
    window: float
    """Distance from the integer within which draws are counted [-]."""
    estimate: Estimate
    answer: Answer

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        told: dict[str, Any] = plain(
            {key: value for key, value in asdict(self).items() if key != "estimate"}
            | {"grade": self.estimate.grade, "estimate": self.estimate.as_json()}
        )
        return told


def integer_orders(fit: Fit) -> tuple[IntegerOrder, ...]:
    """Every free order of a fit."""
    table, rng = fit.draws.table, np.random.default_rng([fit.run.plan.seed, 8])
    free = [k for k, row in enumerate(table.rows) if row.kind == "order" and row.free]
    if not free:
        return ()
    prior = table.draw(_PRIOR_DRAWS, rng)
    estimates = {one.name: one for one in fit.draws.estimates()}
    return tuple(
        savage_dickey(
            fit.draws.flat[:, k], prior[:, k], estimates[table.names[k]], terms=_independent(prior.shape[0])
        )
        for k in free
    )


def _independent(count: int) -> float:
    return float(count)


def savage_dickey(
    posterior: Vector, prior: Vector, estimate: Estimate, *, terms: float | None = None
) -> IntegerOrder:
    """Ratio of posterior to prior density at the integer nearest to the median.

    ``B = p(order | y) / p(order)`` there (Dickey 1971, Ann. Math. Statist. 42), both by the share of draws
    within a window of it: exact for the question whether the order lies in the window, and tending to the
    point's ratio with its width, half a posterior standard deviation within 0.01 to 0.1. The relative error
    is binomial, at the effective sample size of `estimate` and `terms` independent prior draws.
    """
    nearest = max(1, round(float(np.median(posterior))))
    window = float(np.clip(0.5 * posterior.std(), _NARROWEST, _WIDEST))
    after, before = (float(np.mean(np.abs(draws - nearest) <= window)) for draws in (posterior, prior))
    size = prior.size if terms is None else terms
    ess = max(estimate.ess, 1.0)
    if before == 0.0:
        return IntegerOrder(estimate.name, nearest, np.nan, np.inf, False, window, estimate, "undecided")
    if after == 0.0:
        # three in as many draws: the 95 % limit of a share of which none was seen
        ratio, relative, bound = 3.0 / ess / before, np.inf, True
    else:
        ratio, bound = after / before, False
        relative = float(np.sqrt((1 - after) / (after * ess) + (1 - before) / (before * size)))
    return IntegerOrder(
        estimate.name,
        nearest,
        ratio,
        relative,
        bound,
        window,
        estimate,
        _answer(ratio, relative, bound, estimate.grade),
    )


def _answer(ratio: float, relative: float, bound: bool, grade: str) -> Answer:
    level: Level | str = grade
    if level == "unusable":
        return "undecided"
    if bound:
        return "not an integer" if ratio < 1 / DECISIVE else "undecided"
    if ratio / (1 + 2 * relative) > DECISIVE:
        return "integer"
    return "not an integer" if ratio * (1 + 2 * relative) < 1 / DECISIVE else "undecided"
