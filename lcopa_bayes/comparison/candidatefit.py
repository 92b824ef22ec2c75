"""One candidate fitted and scored, as plain values that its folder keeps."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import log
from pathlib import Path
from typing import Any, final

import numpy as np
import pandas as pd
from scipy.special import logsumexp

from lcopa_bayes.comparison.averaging import quantiles
from lcopa_bayes.comparison.candidates import Candidate
from lcopa_bayes.comparison.integerorder import integer_orders
from lcopa_bayes.comparison.predictivedensity import Predicted, predictions
from lcopa_bayes.comparison.priorwidth import widths
from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.estimate import attributes, plain
from lcopa_bayes.core.files import save_json, save_table, writable_folder
from lcopa_bayes.data.settings import SamplerSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.likelihood import Landscape, Peak
from lcopa_bayes.results.alternatives import alternatives_of
from lcopa_bayes.results.bands import POINTWISE
from lcopa_bayes.results.discretisation import optima_of
from lcopa_bayes.results.fit import Fit, fit, plan_of, whole
from lcopa_bayes.results.runfolder import digest, fingerprint, settings_of
from lcopa_bayes.results.summary import residual_rms, scores
from lcopa_bayes.sampling.convergence import Grade, Limitation

_CLIMBED = 4
"""Draws the maximum is sought from."""


@final
@dataclass(frozen=True, eq=False)
class Criteria:
    """AIC and BIC, for those who want them: they ignore priors and confounded parameters."""

    values: Vector
    """Table values at the maximum, (rows,)."""
    log_likelihood: float
    """Maximum [nat]."""
    parameters: int
    """Free parameters, noise and offsets included [-]."""
    samples: int
    """Observed samples [-]."""

    @property
    def aic(self) -> float:
        """``2 k - 2 log L`` (Akaike 1974) [-]."""
        return 2 * self.parameters - 2 * self.log_likelihood

    @property
    def bic(self) -> float:
        """``k log n - 2 log L`` (Schwarz 1978) [-]; n counts samples as if they were independent."""
        return self.parameters * log(self.samples) - 2 * self.log_likelihood

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return plain(
            {
                "max_log_likelihood": self.log_likelihood,
                **attributes(self, "parameters", "samples", "aic", "bic"),
            }
        )


def criteria(fit: Fit, also: Sequence[Peak] = ()) -> Criteria:
    """From a search that starts at the highest of a few draws, and maxima `also` known."""
    landscape = Landscape.about(fit.near, fit.draws.flat)
    own = highest(landscape, fit.draws.thinned(200))
    if landscape.precision is not None:
        own = Peak(own.values, float(landscape.exact(own.values[None])[0]))
    peak = max([own, *also], key=lambda one: one.log_likelihood)
    return Criteria(peak.values, peak.log_likelihood, len(landscape.free), fit.problem.posterior.size)


def highest(landscape: Landscape, values: Matrix) -> Peak:
    """The highest maximum of the likelihood reached from the best few of some table values (n, rows), or from
    the best where effects are simulated."""
    heights = landscape.log_likelihood(values)
    cheap = landscape.posterior.simulation is None or landscape.posterior.surrogate is not None
    best = np.argsort(-heights)[: _CLIMBED if cheap else 1]
    peaks = [landscape.maximise(values[k]) for k in best]
    return max([Peak(values[best[0]], float(heights[best[0]])), *peaks], key=lambda one: one.log_likelihood)


CARD = "candidate.json"
"""File of a candidate's scores inside its folder."""
WALKERS = 32
"""Walkers of a comparison where the study leaves their number open, if the dimension does not ask for more
[-]. Ensembles and effective draws are those of a fit, so that a grade means the same."""
BUDGET = 240.0
"""Time for the draws of a candidate, where the study states none [s]. Ensembles of a lightly damped plant of
four paths took 500 s each of its candidates, twice, and none was usable."""
_STARTS = 64
"""Draws kept as starts of richer models [-]."""
_VERSION = 5
"""Raised when what a card holds changes."""
REJECTED = 100.0
"""Log evidence that the optima of a candidate may lack of another's before it is sampled around these alone
[nat]: Laplace's approximation errs by a few."""
_REJECTED_ESS = 100
"""Effective draws of such a candidate: its evidence is then known to a tenth of a nat [-]."""


@final
@dataclass(frozen=True, eq=False)
class Contender:
    """A candidate and how it is to be fitted."""

    candidate: Candidate
    """With the short plan of a comparison."""
    patient: SamplerSettings
    """The study's own plan, for when the short one leaves nothing usable."""
    folder: Path | None
    quick: bool
    resume: bool
    rejected: bool = False
    """Whether its optima lie so far below another candidate's that no more than these is sampled."""

    @property
    def rough(self) -> float | None:
        """Log evidence before any sampling: that of the finished fit, else by Laplace's approximation at the
        optima [nat]; None with effects, whose sampling hardly takes longer."""
        if self.candidate.fit is not None:
            value: float | None = self.candidate.fit.to_json()["log_evidence"]
            return value
        problem = problem_of(self.candidate.study)
        return None if problem.posterior.simulation is not None else laplace(problem)

    @property
    def fingerprint(self) -> str:
        """Hash of everything the scores depend on."""
        study = self.candidate.study
        entries = (
            fingerprint(study, plan_of(problem_of(study), quick=self.quick)),
            self.candidate.improper,
            _VERSION,
            self.rejected,
            "" if self.candidate.fit is None else self.candidate.fit.draws.sha256,
            [digest(record) for record in study.held_out],
        )
        return hashlib.sha256(json.dumps(entries).encode()).hexdigest()

    def stored(self) -> Mapping[str, Any] | None:
        """The card of an earlier run of the same candidate; None when there is none."""
        path = None if self.folder is None else self.folder / CARD
        if not self.resume or path is None or not path.is_file():
            return None
        try:
            entries: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            own = entries["fingerprint"] == self.fingerprint
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{path}: not a candidate this program wrote, or damaged ({error}); leave out --resume to "
                "start anew, or choose another --out"
            ) from None
        return entries if own else None

    def __call__(self) -> Mapping[str, Any]:
        """The card: from the folder where it is complete, else by fitting. Deterministic given the study."""
        result = self.stored()
        if result is not None:
            return result
        began = time.perf_counter()
        fitted = self._first()
        entries = self.scored(fitted) | {"seconds": time.perf_counter() - began}
        self.store(entries)
        return entries

    def _first(self) -> Fit:
        """The finished fit; else one by the short plan, or by the study's own where that leaves nothing
        usable and no budget of time ended it, as it would end the other."""
        if self.candidate.fit is not None:
            return whole(self.candidate.fit)
        if self.rejected:
            sampler = replace(self.candidate.study.sampler, target_ess=_REJECTED_ESS)
            study = replace(self.candidate.study, sampler=sampler)
            fitted = fit(study, quick=self.quick, around_optima=True, budget=BUDGET)
            return replace(fitted, draws=fitted.draws.limited((_ROUGHLY,)))
        fitted = self._fitted(self.candidate.study, self.folder)
        useless = fitted.draws.grade.level == "unusable" and fitted.run.stopped_after is None
        if useless and self.patient != self.candidate.study.sampler:
            longer = replace(self.candidate.study, sampler=self.patient)
            fitted = self._fitted(longer, None if self.folder is None else self.folder / "longer")
        return fitted

    def fitted_from(self, starts: Matrix) -> Fit:
        """The candidate fitted as its study asks, with modes known from elsewhere, table values
        (starts, rows), among the proposals."""
        study = replace(self.candidate.study, sampler=self.patient)
        return self._fitted(study, None if self.folder is None else self.folder / "again", starts)

    def scored(self, fitted: Fit, also: Sequence[Peak] = ()) -> dict[str, Any]:
        """The card of a fit; `also` are maxima of its likelihood known from elsewhere."""
        entries, predicted = card(self.candidate, fitted, also)
        return entries | {
            "fingerprint": self.fingerprint,
            "pointwise": _pointwise(predicted),
            "curves": _curves(fitted),
            "quantiles": quantiles(fitted) if entries["usable"] else {},
        }

    def store(self, entries: Mapping[str, Any]) -> None:
        """Keep a card and its tables in the folder, where there is one."""
        if self.folder is not None:
            tables = writable_folder(self.folder / "tables")
            save_table(pd.DataFrame(entries["curves"]), tables / "curves.csv")
            save_table(pd.DataFrame(entries["pointwise"]), tables / "pointwise.csv")
            save_json(entries, self.folder / CARD)

    def _fitted(self, study: Study, folder: Path | None, starts: Matrix | None = None) -> Fit:
        return fit(study, folder=folder, resume=self.resume, quick=self.quick, starts=starts, budget=BUDGET)


_ROUGHLY = Limitation(
    "tentative",
    f"its optima lie more than {REJECTED:.0f} nat of log evidence below another candidate, so that it was "
    f"sampled around them alone, {_REJECTED_ESS} effective draws or more: other modes were not sought",
    "fit it by itself and compare its run folder",
)


def laplace(problem: Problem) -> float:
    """Log evidence by Laplace's approximation at the optima of a least-squares search [nat]; -inf without
    any."""
    levels = [
        one.log_density + 0.5 * float(np.linalg.slogdet(2 * np.pi * one.covariance)[1])
        for one in optima_of(problem)
    ]
    return float(logsumexp(levels)) + problem.posterior.table.log_permutations if levels else -np.inf


def contender(candidate: Candidate, folder: Path | None, *, quick: bool, resume: bool) -> Contender:
    """A candidate with fewer walkers than a fit has; what the study's ``[sampler]`` states is kept.

    Where the short plan leaves a posterior that is unusable, before its budget ends, it is sampled again as a
    fit would.
    """
    own = candidate.study.sampler
    sampler = replace(own, walkers=own.walkers or WALKERS)
    # the study file may name candidates that say nothing of this one
    study = replace(candidate.study, sampler=sampler, inputs={})
    return Contender(replace(candidate, study=study), own, folder, quick, resume)


def card(
    candidate: Candidate, fitted: Fit, also: Sequence[Peak] = ()
) -> tuple[dict[str, Any], tuple[Predicted, ...]]:
    """Everything a comparison needs of a fitted candidate, as plain values, and its predictions."""
    grade = fitted.draws.grade
    usable = grade.level != "unusable"
    weighed = None if candidate.improper else fitted.evidence
    parts = predictions(fitted) if usable else ()
    result = criteria(fitted, also)
    # a diffusion has memory as fractional orders have: it is no rival of integer order
    # where lags are no rival for all paths of a response, fractional orders are warranted in some
    rivals = usable and not candidate.integer
    lags = alternatives_of(fitted, ["lags"], single=False) if rivals else ()
    entries: dict[str, Any] = plain(
        {
            **attributes(candidate, "name", "about", "notes", "integer", "terms"),
            "settings": settings_of(candidate.study),
            "time_unit": fitted.study.time_unit,
            "grade": grade.level,
            "grade_reason": grade.reason,
            "usable": usable,
            "log_evidence": weighed.value if weighed else None,
            "log_evidence_sd": weighed.sd if weighed else None,
            "log_evidence_grade": Grade.worst([weighed.grade, grade]).level if weighed else None,
            "evidence_undefined": (
                f"improper prior of {', '.join(candidate.improper)}" if candidate.improper else ""
            ),
            "prior_widths": [one.as_json() for one in widths(fitted)] if usable and weighed else [],
            **result.as_json(),
            "starts": {"optimum": result.values, "draws": fitted.draws.thinned(_STARTS)},
            "refinement": fitted.problem.refinement,
            "residual_rms": residual_rms(fitted),
            "fit_scores": scores(fitted, held_out=False),
            "held_out": scores(fitted, held_out=True),
            "predictions": [one.as_json() | {"grade": one.grade(grade.level)} for one in parts],
            "order_is_integer": [one.as_json() for one in integer_orders(fitted)],
            "sums_of_lags": [one.as_json() for one in lags],
            "estimates": [one.as_json() for one in fitted.draws.estimates()],
            "step_metrics": [one.as_json() for one in fitted.metrics],
            "residual_tests": [
                one.test() | {"lag_1": float(one.autocorrelation[0]) if one.autocorrelation.size else None}
                for one in fitted.residuals
            ],
            "ess": fitted.draws.ess,
        }
    )
    return entries, parts


def _pointwise(parts: tuple[Predicted, ...]) -> dict[str, list[Any]]:
    """Log predictive density of every sample predicted, one list per column."""
    columns = ("part", "kind", "axis", "time", "log_density")
    rows = [
        (one.part.name, one.part.kind, *sample)
        for one in parts
        for sample in zip(one.axis, one.time.tolist(), one.log_density.tolist(), strict=True)
    ]
    return {name: [row[k] for row in rows] for k, name in enumerate(columns)}


def _curves(fitted: Fit) -> dict[str, list[Any]]:
    """Observed, median and 90 % band of every record, one list per column."""
    ends = {
        f"plant_{POINTWISE}_50": "middle",
        f"noisy_{POINTWISE}_05": "low",
        f"noisy_{POINTWISE}_95": "high",
    }
    table = pd.concat([band.table() for band in fitted.bands]).rename(columns=ends)
    kept = ["record", "axis", "unit", "held_out", "time", "observed", *ends.values()]
    return {str(name): values for name, values in table[kept].to_dict("list").items()}
