"""A fitted plant with the orders of some elements at integers, as likely as the one with free orders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.integerorders import (
    Orders,
    most_likely,
    nearest,
    problem_with,
    said_of,
    starts,
    weight_of,
)
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.results.fit import Fit, fit

FOLDER = "integer"
"""In the run folder of a fit, what is kept of them while they are sampled."""
_PART = 0.02
"""Share of the draws below which integer orders have no part: they would move an end of a 90 % interval by no
more than that share of the draws."""


@final
@dataclass(frozen=True, eq=False)
class IntegerFit:
    """A plant with integer orders beside a fit, under the noise of that."""

    orders: Orders
    problem: Problem
    """The study with these orders."""
    values: Vector
    """Table values at its optimum, (rows,)."""
    gained: float
    """Log likelihood over that of the fitted plant, both at their optima [nat]."""
    log_odds: float
    """By the Bayesian information criterion, against the fitted plant [nat]."""
    sampled: Fit | None = None
    """Its posterior; None before it is sampled."""

    @property
    def weight(self) -> float:
        """Its part beside the fitted plant [-]."""
        return weight_of(self.log_odds, self.gained)

    @property
    def draws(self) -> Fit:
        """Its posterior, once it is sampled."""
        assert self.sampled is not None
        return self.sampled

    @property
    def sentence(self) -> str:
        """What it is and what part it has."""
        return (
            f"A plant with integer orders ({said_of(self.orders)}; {self.log_odds:+.1f} nat by BIC) follows "
            f"the records as well and has {100 * self.weight:.0f} % of the draws of both."
        )

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "orders": {name: list(own) for name, own in self.orders.items()},
            "weight": self.weight,
            "log_odds": self.log_odds,
            "log_likelihood_gained": self.gained,
            "ess": self.draws.draws.ess,
            "grade": self.draws.draws.grade.level,
        }


def integer_fit(
    fitted: Fit,
    *,
    jobs: int = 1,
    folder: Path | None = None,
    resume: bool = False,
    quick: bool = False,
    quiet: bool = True,
) -> IntegerFit | None:
    """The plant of a fit with integer orders of all elements that the records let have them, sampled as that
    was; None without any, where the plant has effects, or where its own draws are unusable: beside these no
    others mean anything.

    With `folder`, the run folder of the fit, `resume` goes on from what was sampled in its `integer`.
    """
    posterior = fitted.problem.posterior
    if posterior.simulation is not None or fitted.draws.sampling_grade.level == "unusable":
        return None
    level, values = _optimum(posterior, [fitted.best])
    orders = dict(nearest(posterior.table, values))
    found = most_likely(orders, lambda own: _held(fitted, level, values, own))
    if found is None or found.weight < _PART:
        return None
    sampled = fit(
        found.problem.study,
        jobs=jobs,
        folder=folder / FOLDER if folder else None,
        resume=resume,
        quick=quick,
        quiet=quiet,
    )
    return replace(found, sampled=sampled)


def _held(fitted: Fit, level: float, values: Vector, orders: Orders) -> IntegerFit | None:
    """The plant with these elements at integer orders beside the fitted one at its optimum, of log likelihood
    `level`; None where it cannot follow the records."""
    posterior = fitted.problem.posterior
    try:
        problem = problem_with(fitted.problem, posterior.table, orders)
        own = problem.posterior
        begun = starts(posterior.table, values, own.table, orders)
        reached, optimum = _optimum(own, [own.table.canonical(one[None])[0] for one in begun])
    except (ArithmeticError, InputError):
        return None
    fewer = len(LeastSquares(posterior).columns) - len(LeastSquares(own).columns)
    gained = reached - level
    saved = 0.5 * fewer * float(np.log(posterior.size))
    return IntegerFit(orders, problem, optimum, gained, gained + saved)


def _optimum(posterior: Posterior, begun: Sequence[Vector]) -> tuple[float, Vector]:
    """The highest log likelihood of descents from some table values under their noise, and the values there,
    (rows,)."""
    found = np.array([LeastSquares(posterior).solve(one)[0] for one in begun])
    levels = posterior.joint_log_likelihood(found)
    return float(levels.max()), found[int(levels.argmax())]
