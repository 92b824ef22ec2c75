"""The verb `fit`: posterior, bands, held-out scores and step metrics of a study."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any, final

import numpy as np
from xarray import DataTree

from lcopa_bayes.core.arrays import Matrix, Vector, digest_of
from lcopa_bayes.core.errors import refuse_if
from lcopa_bayes.core.estimate import Estimate
from lcopa_bayes.core.files import save_json, save_table, writable_folder, write_text, write_whole
from lcopa_bayes.core.parallel import meanwhile
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.declared import obstacles
from lcopa_bayes.inference.optimum import Optimum
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.results.adequacy import limitations
from lcopa_bayes.results.datatree import POSTERIOR, posterior_tree, save_tree
from lcopa_bayes.results.discretisation import Discretisation, discretisation, optima_of, resolved_optima
from lcopa_bayes.results.frequency import FrequencyResponse
from lcopa_bayes.results.nearby import surrogate_about
from lcopa_bayes.results.prediction import Band, study_bands
from lcopa_bayes.results.predictive import Predictive
from lcopa_bayes.results.residuals import Residual, residuals
from lcopa_bayes.results.resonances import is_disturbance
from lcopa_bayes.results.result import PAGE, write_fit_page
from lcopa_bayes.results.runfolder import add_origin, fingerprint, opened, provenance
from lcopa_bayes.results.savedfit import NAME as SAVED
from lcopa_bayes.results.savedfit import fit_to_json
from lcopa_bayes.results.sensitivity import Sensitivity, sensitivity
from lcopa_bayes.results.stepcurves import StepCurves, step_curves
from lcopa_bayes.results.steps import step_metrics, too_fast
from lcopa_bayes.results.summary import results, verdict
from lcopa_bayes.results.tables import tables
from lcopa_bayes.sampling.crosscheck import CrossCheck
from lcopa_bayes.sampling.draws import Draws, draws_of
from lcopa_bayes.sampling.evidence import Evidence, evidence_of
from lcopa_bayes.sampling.nested import NestedPlan, nested
from lcopa_bayes.sampling.run import Run, SamplePlan
from lcopa_bayes.sampling.sampler import sample
from lcopa_bayes.sampling.weighted import Weighted
from lcopa_bayes.sampling.weightedrun import QUICK_STARTS, STARTS, weighted_run

if TYPE_CHECKING:
    from lcopa_bayes.results.alternatives import Alternatives
    from lcopa_bayes.results.integerrival import Rival
    from lcopa_bayes.results.structure import Structure

_QUICK = 4
"""How many times fewer steps a quick fit takes."""
HOPELESS = 30.0
"""Time for draws where no number will be usable, because records contradict each other grossly or the plant
at its optimum is a periodic disturbance, and the study states none [s]."""


@final
@dataclass(frozen=True, eq=False)
class Fit(Predictive):
    """A fitted study: draws of its posterior, what it predicts, and how far both can be trusted."""

    problem: Problem
    """The study prepared for inference, with blocks as narrow as its records need."""
    run: Run
    """Ensembles or weighted draws, as sampled."""
    draws: Draws
    """Posterior draws, (ensembles, draws, parameters) in the unit of each, with their grade."""
    bands: tuple[Band, ...]
    """50 and 90 % bands of every response axis of every record, fitted ones first [response unit]."""
    residuals: tuple[Residual, ...]
    """What the median prediction leaves of each of these [response unit], tested for whiteness."""
    curves: StepCurves
    """Unit step responses of every path over the longest record, at each draw."""
    metrics: tuple[Estimate, ...]
    """Rise, delay, settling [time unit], overshoot [-] and levels [response unit] of every path."""
    evidence: Evidence | None
    """None for a single ensemble, which cannot tell its error."""
    discretisation: Discretisation
    """How far the width of the blocks moves the posterior."""
    cross_check: CrossCheck | None = None
    """How a second, independent sampling method agrees; None without one."""
    rival: Rival | None = None
    """The same study with integer orders, and how it predicts; None when none was fitted."""
    structure: Structure | None = None
    """What other structures the records allow; None where the study states its terms."""
    alternatives: Alternatives | None = None
    """Sums of lags and integer orders that follow the records too, and numbers over all; None likewise."""

    @property
    def near(self) -> Posterior:
        """The posterior, with effects by what the draws were made with: a response costs a hundredth."""
        return replace(self.problem.posterior, surrogate=self.run.surrogate)

    @property
    def best(self) -> Vector:
        """Table values of the most probable draw, linear parameters at their conditional mean, (rows,)."""
        posterior = self.problem.posterior
        best = self.draws.flat[[int(self.draws.log_density.argmax())]]
        values: Vector = posterior.complete(posterior.coordinates(best), None)[0]
        return values

    @property
    def by_name(self) -> dict[str, Matrix]:
        """Draws of every free parameter, (ensembles, draws) [its unit]."""
        rows = self.draws.table.rows
        return {row.name: self.draws.values[..., k] for k, row in enumerate(rows) if row.free}

    @cached_property
    def sensitivity(self) -> tuple[Sensitivity, ...]:
        """How far each parameter's median moves with the power of prior or likelihood [posterior sd]."""
        return sensitivity(self.draws, self.near)

    @cached_property
    def frequency(self) -> FrequencyResponse:
        """Over the frequencies that the fit records resolve."""
        return self.frequency_response()

    @property
    def verdict(self) -> str:
        """What was learned, how far it can be trusted, what is wrong with it."""
        return verdict(self)

    def to_json(self) -> dict[str, Any]:
        """Every number of the fit as plain values; see `summary.results`."""
        return dict(self._values)

    @cached_property
    def _values(self) -> dict[str, Any]:
        """Asked for when a fit is saved, and by whoever looks at it then."""
        return results(self)

    def to_datatree(self) -> DataTree:
        """Draws, data and prior in the ArviZ groups; see `datatree`."""
        return posterior_tree(self)

    def save(self, folder: Path | str, *, compact: bool = False, jobs: int = 1, page: bool = False) -> Path:
        """Write draws, numbers and tables into a run folder, which `load_result` reads; returns the folder.

        Where it shall be `compact`, what has one number for each sample is kept for fewer draws, and nothing
        of the prior (`posterior_tree`). With `page` that is drawn too; draws, tables and page at the same
        time where there are several `jobs`. InputError naming a file that cannot be written, and as
        `Result.save`.
        """
        origin = provenance(self.study, self.verb)
        with opened(folder, origin) as path:
            writable_folder(path / "tables")
            with meanwhile(_write_draws, (self, path, compact), lambda _: None, jobs=jobs):
                values = self.to_json()
                for name, table in tables(self).items():
                    save_table(table, path / "tables" / f"{name}.csv")
                text = json.dumps(fit_to_json(self.problem, self.draws), allow_nan=False)
                write_text(path / SAVED, f"{text}\n")
                add_origin(path, self.verb, origin)
                if page:
                    write_fit_page(path, (values, self.by_name), jobs=jobs)
            if not page and (path / PAGE).is_file() and not self.is_in(path):
                (path / PAGE).unlink()  # of another fit
            save_json(values, path / self.file)
        return path


def _write_draws(wanted: tuple[Fit, Path, bool]) -> None:
    """Write the draws of a fit into its run folder, as a task of a process of its own."""
    fitted, path, compact = wanted
    write_whole(path / POSTERIOR, lambda beside: save_tree(posterior_tree(fitted, compact=compact), beside))


def fit(
    study: Study,
    *,
    jobs: int = 1,
    folder: Path | None = None,
    resume: bool = False,
    quick: bool = False,
    cross_check: bool = False,
    quiet: bool = True,
    starts: Matrix | None = None,
    searched: tuple[Problem, tuple[Optimum, ...]] | None = None,
    around_optima: bool = False,
    budget: float | None = None,
) -> Fit:
    """Sample the posterior of a study and derive what it predicts.

    `starts`, table values (starts, rows), are modes known from elsewhere that sampling proposes too. A plant
    with effects where the method is "auto", and any `around_optima`, is sampled by importance around its
    optima (`weightedrun`), which searches for no other modes, where its weights hold. The study prepared and
    its optima, where it has been `searched` (`firstlook`) or its structure chosen, spare that search. A
    `budget` is the time for draws where the study states none [s]; by default it is not limited, unless
    nothing that is drawn will be usable (`HOPELESS`).

    With `folder`, sampling is stored there in `chain.h5` and `resume` goes on from it; the result is
    the same as without interruption. With `cross_check` the posterior is also sampled by nested sampling,
    always from the start, and where the two disagree every grade is lowered. Blocks are narrowed until their
    width does not move the optimum; how far it moves the posterior is measured and, where too far, lowers the
    grade. So does what speaks against the model itself (`adequacy`). InputError when the study does not fit
    its records, these do not meet the requirements of a fit (`requirements`), or the folder cannot be written
    to; then nothing is written.
    """
    if study.model.terms == "auto":
        raise ValueError("the number of terms is not settled yet")
    if searched is None:
        refuse_if(obstacles(study))
    problem = searched[0] if searched else problem_of(study)
    if folder:
        writable_folder(folder)
    weighted_result, optima = None, tuple[Optimum, ...]()
    plan = plan_of(problem, quick=quick, budget=budget)
    if around_optima or (problem.posterior.simulation is not None and plan.method == "auto"):
        problem, begun = weighted_start(problem, quick=quick)
        begin = monotonic()
        weighted_result = weighted_run(problem.posterior, plan, jobs=jobs, quick=quick, optima=begun)
        if weighted_result is None and plan.seconds is not None:  # ensembles have what is left
            plan = replace(plan, seconds=max(begin + plan.seconds - monotonic(), 0.0))
    else:
        problem, optima = resolved_optima(problem, searched[1] if searched else optima_of(problem))
        if study.sampler.seconds is None and optima and is_disturbance(problem, optima[0]):
            plan = replace(plan, seconds=HOPELESS if budget is None else min(HOPELESS, budget))
    if weighted_result is not None:
        run, draws = weighted_result
    else:
        run = sample(
            problem.posterior,
            plan,
            jobs=jobs,
            chain_file=folder / "chain.h5" if folder else None,
            fingerprint=fingerprint(study, plan) + ("" if starts is None else digest_of(starts)),
            resume=resume,
            quiet=quiet,
            starts=starts,
            optima=optima,
            rough=problem.rough,
        )
        draws = draws_of(problem.posterior, run)
    check = None
    weighed = evidence_of(problem.posterior, run, draws.ess)
    if cross_check:
        wanted = NestedPlan.of(problem.posterior.dimension, seed=plan.seed, quick=quick)
        check = CrossCheck.of(
            draws,
            nested(problem.posterior, wanted, jobs=jobs, quiet=quiet),
            log_evidence=weighed.value if weighed else None,
            log_evidence_sd=weighed.sd if weighed else None,
        )
        draws = draws.limited(check.limitations(draws.grade))
    width = discretisation(problem, draws, surrogate=run.surrogate, jobs=jobs)
    draws = draws.limited(width.limitations)
    return _derived(problem, run, draws, weighed, width, check, judged=False)


def _derived(
    problem: Problem,
    run: Run,
    draws: Draws,
    weighed: Evidence | None,
    width: Discretisation,
    check: CrossCheck | None = None,
    *,
    judged: bool,
) -> Fit:
    """The fit of a run and its draws; unless these are `judged` already, what speaks against the model limits
    them."""
    study, curves = problem.study, step_curves(draws, problem.scales.span)
    if not judged:
        draws = draws.limited(too_fast(draws, curves, problem.scales.period))
    shown = study_bands(problem, draws)
    remaining = residuals(draws, shown, problem.posterior.noise, problem.scales.period)
    if not judged:
        rng = np.random.default_rng([run.plan.seed, 4])
        draws = draws.limited(limitations(problem, draws, shown, remaining, rng))
    metrics = step_metrics(draws, curves, time_unit=study.time_unit)
    return Fit(
        problem=problem,
        run=run,
        draws=draws,
        bands=tuple(shown),
        residuals=tuple(remaining),
        curves=curves,
        metrics=tuple(metrics),
        evidence=weighed,
        discretisation=width,
        cross_check=check,
    )


def whole(fit: Predictive) -> Fit:
    """A finished fit with all that follows from its draws, where it is read from its run folder; these stand
    for the run."""
    if isinstance(fit, Fit):
        return fit
    problem, draws, values = fit.problem, fit.draws, fit.to_json()
    posterior, plan = problem.posterior, plan_of(problem, quick=False)
    weighed = None
    if values["log_evidence"] is not None:
        by_ensemble = tuple(values["log_evidence_by_ensemble"])
        weighed = Evidence(values["log_evidence"], values["log_evidence_sd"], by_ensemble)
    level = (weighed.value, weighed.sd) if weighed else (np.nan, np.inf)
    z = posterior.coordinates(draws.flat)
    weighted = Weighted.equal(posterior, z, draws.log_density.ravel(), *level)
    near = None
    if posterior.simulation is not None:
        near = surrogate_about(posterior, draws, np.random.default_rng([plan.seed, 11]))
    run = Run((), plan, weighted, surrogate=near)
    width = Discretisation.of_json(values["discretisation"])
    return _derived(problem, run, draws, weighed, width, judged=True)


def weighted_start(problem: Problem, *, quick: bool) -> tuple[Problem, tuple[Optimum, ...]]:
    """A plant with effects on blocks as narrow as its records need, and the optima that weighted draws of it
    begin around."""
    return resolved_optima(problem, optima_of(problem, starts=QUICK_STARTS if quick else STARTS))


def plan_of(problem: Problem, *, quick: bool, budget: float | None = None) -> SamplePlan:
    """The sampling plan of a study, with a `budget` of time [s], unless it states any; a small one where no
    plant follows the records."""
    wanted, seconds = problem.study.sampler, problem.study.sampler.seconds
    if seconds is None:
        seconds = HOPELESS if problem.study.contradictory else budget
    plan = SamplePlan.of(
        problem.posterior.dimension,
        seed=problem.study.seed,
        ensembles=wanted.ensembles,
        walkers=wanted.walkers,
        steps=wanted.steps,
        thin=wanted.thin,
        target_ess=wanted.target_ess,
        seconds=seconds,
        method=wanted.method or ("auto" if wanted.steps is None and wanted.thin is None else "ensembles"),
    )
    return replace(plan, steps=max(plan.thin, plan.steps // _QUICK)) if quick else plan
