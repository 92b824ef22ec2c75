"""The verb `fit`: posterior, bands, held-out scores and step metrics of a study."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from lcopa_bayes.estimate import Estimate, plain
from lcopa_bayes.files import writable_folder
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.draws import Draws, gather
from lcopa_bayes.inference.sampler import Run, SamplePlan, sample
from lcopa_bayes.predict import Band, bands
from lcopa_bayes.provenance import fingerprint
from lcopa_bayes.residuals import WHITE_P, Residual, residuals
from lcopa_bayes.stepmetrics import StepCurves, share_unsettled, step_curves, step_metrics
from lcopa_bayes.study import Study

_QUICK = 4
"""How many times fewer steps a quick fit takes."""


@final
@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted study."""

    problem: Problem
    run: Run
    draws: Draws
    bands: tuple[Band, ...]
    residuals: tuple[Residual, ...]
    curves: StepCurves
    metrics: tuple[Estimate, ...]

    @property
    def study(self) -> Study:
        """The study that was fitted."""
        return self.problem.study


def fit(
    study: Study,
    *,
    jobs: int = 1,
    folder: Path | None = None,
    resume: bool = False,
    quick: bool = False,
    quiet: bool = True,
) -> Fit:
    """Sample the posterior of a study and derive what it predicts.

    With `folder`, sampling is stored there in `chain.h5` and `resume` goes on from it; the result is
    the same as without interruption. InputError when the study does not fit its records or the folder
    cannot be written to; then nothing is written.
    """
    problem = problem_of(study)
    if folder:
        writable_folder(folder)
    plan = plan_of(problem, quick=quick)
    run = sample(
        problem.posterior,
        plan,
        jobs=jobs,
        chain_file=folder / "chain.h5" if folder else None,
        fingerprint=fingerprint(study, plan),
        resume=resume,
        quiet=quiet,
    )
    draws = gather(problem.posterior, run)
    noise, rng = problem.posterior.noise, np.random.default_rng([plan.seed, 2])
    shown = bands(draws, problem.posterior.model, problem.posterior.samples, noise, held_out=False, rng=rng)
    if study.held_out:
        samples, model = problem.simulated(study.held_out)
        shown += bands(draws, model, samples, noise, held_out=True, rng=rng)
    curves = step_curves(draws, problem.scales.span)
    metrics = step_metrics(draws, curves, time_unit=study.time_unit)
    left = residuals(draws, shown, noise, problem.scales.period)
    return Fit(problem, run, draws, tuple(shown), tuple(left), curves, tuple(metrics))


def plan_of(problem: Problem, *, quick: bool) -> SamplePlan:
    """How a study asks to be sampled."""
    wanted, study = problem.study.sampler, problem.study
    plan = SamplePlan.of(
        problem.posterior.dimension,
        seed=study.seed,
        ensembles=wanted.ensembles,
        walkers=wanted.walkers,
        steps=wanted.steps,
        thin=wanted.thin,
        target_ess=wanted.target_ess,
    )
    if not quick:
        return plan
    steps = max(plan.thin, plan.steps // _QUICK)
    return SamplePlan(plan.ensembles, plan.walkers, steps, plan.thin, plan.target_ess, plan.seed)


def verdict(fit: Fit) -> str:
    """One sentence: what was learned, how far it can be trusted, what is wrong with it."""
    grade = fit.draws.grade
    parts = [f"Grade {grade.level}: {grade.reason}."]
    worst = min((r for r in fit.residuals if not r.held_out), key=lambda r: r.p_white, default=None)
    if worst is not None and worst.p_white < WHITE_P:
        parts.append(
            f"The model does not explain everything: on {worst.record}, axis {worst.axis}, what the noise "
            f"model leaves is not white (p = {worst.p_white:.1g}), so intervals may be too narrow."
        )
    elif worst is not None:
        parts.append(f"What is left looks like the noise model (smallest p = {worst.p_white:.2g}).")
    parts.extend(_held_out_sentence(fit))
    slow = max(share_unsettled(curve) for curve in fit.curves.normalised)
    if slow > 0.05:
        parts.append(
            f"At least one step response has not reached its steady state within the longest record "
            f"({100 * slow:.0f} % of draws are more than 2 % away): algebraic tails are slow."
        )
    return " ".join(parts)


def _held_out_sentence(fit: Fit) -> list[str]:
    outside = [band for band in fit.bands if band.held_out]
    if not outside:
        return ["No record was held out, so prediction is untested."]
    said = ", ".join(
        f"{band.record}/{band.axis} RMSE {band.rmse:.3g} {band.unit} with {100 * band.coverage(0.9):.0f} % "
        "of samples in the 90 % band"
        for band in outside
    )
    return [f"Held out: {said}."]


def results(fit: Fit) -> dict[str, Any]:
    """Every number of the fit as plain JSON values; `None` is an open side or undefined."""
    grade = fit.draws.grade
    quality = {q.name: q for q in fit.draws.qualities}
    parameters = [
        estimate.as_json() | {"rhat": quality[estimate.name].rhat} for estimate in fit.draws.estimates()
    ]
    told: dict[str, Any] = plain(
        {
            "study": fit.study.name,
            "verdict": verdict(fit),
            "grade": grade.level,
            "grade_reason": grade.reason,
            "time_unit": fit.study.time_unit,
            "parameters": parameters,
            "fixed": [
                {"name": row.name, "value": row.value, "unit": row.unit}
                for row in fit.problem.posterior.table.rows
                if not row.free
            ],
            "log_evidence": None,
            "log_evidence_sd": None,
            "residual_rms": residual_rms(fit),
            "held_out": [_score(band) for band in fit.bands if band.held_out],
            "fit_scores": [_score(band) for band in fit.bands if not band.held_out],
            "step_metrics": [metric.as_json() for metric in fit.metrics],
            "residual_tests": [
                {
                    "record": r.record,
                    "axis": r.axis,
                    "held_out": r.held_out,
                    "p_white": r.p_white,
                    "rms": r.rms,
                }
                for r in fit.residuals
            ],
            "sampler": _sampler(fit),
        }
    )
    return told


def residual_rms(fit: Fit) -> dict[str, float]:
    """Root mean square residual of each response axis over the fit records [response unit]."""
    pooled: dict[str, list[float]] = {}
    for band in fit.bands:
        if not band.held_out:
            pooled.setdefault(band.axis, []).extend((band.observed - band.plant[2]) ** 2)
    return {axis: float(np.sqrt(np.mean(squares))) for axis, squares in pooled.items()}


def _score(band: Band) -> dict[str, Any]:
    return {
        "record": band.record,
        "axis": band.axis,
        "unit": band.unit,
        "rmse": band.rmse,
        "coverage_50": band.coverage(0.5),
        "coverage_90": band.coverage(0.9),
        "samples": band.time.size,
        "offset_from": band.offset_from,
        "draws": band.draws,
    }


def _sampler(fit: Fit) -> Mapping[str, Any]:
    plan, ensembles = fit.run.plan, fit.run.ensembles
    return {
        "ensembles": plan.ensembles,
        "walkers": plan.walkers,
        "steps": ensembles[0].steps,
        "most_steps": plan.steps,
        "thin": plan.thin,
        "acceptance": float(np.mean([ensemble.acceptance for ensemble in ensembles])),
        "smallest_ess": fit.draws.ess,
        "largest_rhat": max(q.rhat for q in fit.draws.qualities),
        "target_ess": plan.target_ess,
        "seed": plan.seed,
    }
