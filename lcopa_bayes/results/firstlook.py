"""The first look: least squares and draws about the best optimum, within seconds and before any sampling.

It shows whether the model can follow the records at all, what the best of a few searches leaves of them, and
roughly how wide intervals will be. Draws are of a Gaussian about that optimum, weighted by the posterior; how
far the Gaussian is from it is measured by the weights. Other modes are not searched for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
import pandas as pd
from scipy.special import logsumexp

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.covariance import root_of
from lcopa_bayes.core.errors import InputError, refuse_if
from lcopa_bayes.core.estimate import Estimate, plain
from lcopa_bayes.core.units import measured
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.declared import obstacles
from lcopa_bayes.inference.nestedmodels import lifted
from lcopa_bayes.inference.optimum import Optimum
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.results.discretisation import optima_of
from lcopa_bayes.results.prediction import Band, study_bands
from lcopa_bayes.results.residuals import WHITE_P, Residual, residuals
from lcopa_bayes.results.restbefore import rest_before
from lcopa_bayes.results.summary import fixed_values, overview_of_look, scores
from lcopa_bayes.results.tables import data_tables
from lcopa_bayes.sampling.convergence import Limitation
from lcopa_bayes.sampling.draws import Draws
from lcopa_bayes.sampling.importanceweights import effective, smoothed

TABLES = ("bands", "drives", "residuals", "autocorrelation", "spectrum")
"""Tables of a first look."""
GRADE = "tentative"
"""No first look has a better grade."""
_DRAWS = 2_000
"""Draws of the Gaussian ..."""
_SIMULATED = 200
"""... where each takes a simulation with effects."""
_SHOWN = 400
"""Draws of equal weight behind bands and intervals."""
_FEWEST = 20
"""Effective draws below which the Gaussian is shown as it is; draws inside the priors below which it is
narrowed."""
_ADDED = 32
"""Ways in which what a smaller model lacks is added to its optimum [-]."""
_STREAM = 13
"""Marks the randomness of a first look."""
_CLOSE = 0.3
"""Effective share of the draws from which the Gaussian is close to the posterior near the optimum [-]."""
_TRIED = 20
"""Batches after which draws outside the prior are replaced no further."""


@final
@dataclass(frozen=True, eq=False)
class FirstLook:
    """Least squares of a study with a Gaussian about the best optimum."""

    problem: Problem
    optima: tuple[Optimum, ...]
    """Best first."""
    draws: Draws
    """Of the Gaussian, cut to the support of the priors and weighted by the posterior where enough of them
    count, (1, draws, rows)."""
    share: float
    """Effective share of draws of the Gaussian as importance draws of the posterior near the optimum [-]."""
    bands: tuple[Band, ...]
    """50 and 90 % bands of every response axis of every record, fitted ones first [response unit]."""
    residuals: tuple[Residual, ...]
    """What the optimum leaves of each of these [response unit], tested for whiteness."""
    before: tuple[Limitation, ...]
    """Whether another drive before a record explains its start better."""

    @property
    def optimum(self) -> Optimum:
        """The best one."""
        return self.optima[0]

    @property
    def reason(self) -> str:
        """What the numbers rest on."""
        near = "close to" if self.share >= _CLOSE else "far from"
        return (
            "a first look shows the best of a few least-squares searches, and draws about it of a Gaussian "
            f"that is {near} the posterior there ({100 * self.share:.0f} % effective); other modes are not "
            "searched for"
        )

    @property
    def whiteness(self) -> str:
        """Whether the noise model explains what the optimum leaves; empty where that is not tested."""
        tested = [one.p_white for one in self.residuals if not one.held_out]
        if not tested:
            return ""
        white = min(tested) * len(tested) >= WHITE_P
        found = "residual is compatible with the noise model", "noise model does not explain the residual"
        return f"The {found[not white]} (smallest p = {min(tested):.2g})"

    @property
    def verdict(self) -> str:
        """How well the best optimum follows the records, and what the numbers rest on."""
        study = self.problem.study
        parts = [one.sentence for one in study.disagreements]
        for held, name in ((False, "Fitted"), (True, "Held out")):
            shown = [band for band in self.bands if band.held_out == held]
            if shown:
                said = ", ".join(
                    f"{band.record}/{band.axis} RMSE {measured(band.rmse, band.unit)}" for band in shown
                )
                parts.append(f"{name}: {said}.")
        parts += [f"{self.whiteness}."] if self.whiteness else []
        parts += [f"{one.reason[0].upper()}{one.reason[1:]}; {one.remedy}." for one in self.before]
        return " ".join([f"Grade {GRADE}: {self.reason}.", *parts, "`fit` samples the posterior."])

    def to_json(self) -> dict[str, Any]:
        """Every number as plain values."""
        return plain(
            {
                "study": self.problem.study.name,
                "verdict": self.verdict,
                "grade": GRADE,
                "grade_reason": self.reason,
                "overview": overview_of_look(self),
                "time_unit": self.problem.study.time_unit,
                "log_density": self.optimum.log_density,
                "effective_share": self.share,
                "parameters": [one.as_json() for one in self._estimates()],
                "fixed": fixed_values(self.problem.posterior.table),
                "fit_scores": scores(self, held_out=False),
                "held_out": scores(self, held_out=True),
                "residual_tests": [one.test() for one in self.residuals],
            }
        )

    def tables(self) -> Mapping[str, pd.DataFrame]:
        """`TABLES` by name."""
        return data_tables(self.problem.study, self.bands, self.residuals)

    def _estimates(self) -> list[Estimate]:
        flat = self.draws.flat
        worth = min(_DRAWS * self.share, float(len(flat)))
        return [
            Estimate.of(row.name, row.unit, flat[:, k], ess=worth, grade=GRADE)
            for k, row in enumerate(self.problem.posterior.table.rows)
            if row.free
        ]


def first_look(study: Study) -> FirstLook:
    """Look at a study before it is sampled.

    InputError when the study does not fit its records, these do not meet the requirements of a fit, or no
    search leads to a plant inside the priors. With effects a look costs many simulations.
    """
    return look_at(*searched(study))


def searched(
    study: Study, others: Sequence[tuple[Posterior, Optimum]] = (), *, jobs: int = 1
) -> tuple[Problem, tuple[Optimum, ...]]:
    """A study prepared for inference and its least-squares optima, best first; InputError as `first_look`.

    Of `others`, posteriors with their optima, the first that the study's model contains is looked at too,
    with what it lacks added in a few ways: a richer model is no less likely.
    """
    refuse_if(obstacles(study))
    problem = problem_of(study)
    rng = np.random.default_rng([study.seed, _STREAM, 1])
    lifts = (
        lifted(np.tile(optimum.values, (_ADDED, 1)), source, problem.posterior, rng)
        for source, optimum in others
    )
    near = next((added for added in lifts if added is not None), ())
    optima = optima_of(problem, near=list(near), jobs=jobs)
    if not optima:
        raise InputError(
            f"{study.name}: no least-squares search leads to a plant inside the priors; widen them or "
            "check the units of the records"
        )
    return problem, optima


def look_at(problem: Problem, optima: tuple[Optimum, ...]) -> FirstLook:
    """The first look that follows from known optima, best first."""
    posterior, rng = problem.posterior, np.random.default_rng([problem.study.seed, _STREAM])
    draws, share = _near(posterior, optima[0], rng)
    shown = study_bands(problem, draws)
    same = np.tile(optima[0].values, (1, 4, 1))  # a simultaneous band needs four draws
    best = Draws(posterior.table, same, np.zeros((1, 4)), (), 1.0)
    remaining = residuals(best, study_bands(problem, best), posterior.noise, problem.scales.period)
    before = tuple(rest_before(problem, optima[0].values))
    return FirstLook(problem, optima, draws, share, tuple(shown), tuple(remaining), before)


def _near(posterior: Posterior, optimum: Optimum, rng: np.random.Generator) -> tuple[Draws, float]:
    """Draws of the posterior near an optimum inside the priors, by importance weights of a Gaussian about it
    where enough of its draws count, else draws of the Gaussian; and the effective share of these [-]."""
    count = _DRAWS if posterior.simulation is None else _SIMULATED
    centre = posterior.coordinates(optimum.values[None])[0]
    root = root_of(optimum.covariance)
    standard = _inside(posterior, centre, root, count, rng)
    while len(standard) < _FEWEST:  # an optimum in a corner of the priors, or at their end
        root = 0.5 * root
        standard = _inside(posterior, centre, root, count, rng)
    z = centre + standard @ root.T
    density = posterior.log_density(z)
    log_weights, _ = smoothed(density + 0.5 * (standard**2).sum(axis=1))
    worth, chosen = effective(log_weights), np.arange(len(z))
    if worth >= _FEWEST:
        chosen = rng.choice(len(z), min(_SHOWN, len(z)), p=np.exp(log_weights - logsumexp(log_weights)))
    chosen = chosen[:_SHOWN]
    completed = posterior.complete(z[chosen], rng)
    return Draws(posterior.table, completed[None], density[None, chosen], (), 1.0), worth / len(z)


def _inside(
    posterior: Posterior, centre: Vector, root: Matrix, count: int, rng: np.random.Generator
) -> Matrix:
    """The centre and standard normal draws that are inside the priors once scaled by `root`, `count` of them
    unless few are, (draws, dimension)."""
    kept = [np.zeros((1, centre.size))]
    for _ in range(_TRIED):
        standard = rng.standard_normal((count, centre.size))
        kept.append(standard[np.isfinite(posterior.log_prior(centre + standard @ root.T))])
        if sum(map(len, kept)) >= count:
            break
    return np.concatenate(kept)[:count]
