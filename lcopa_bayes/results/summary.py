"""The verdict of a fit in a few sentences, and every number as plain JSON values.

What a reader asks a fit first: the plant, how well it follows the records, what to trust, what to do.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.estimate import plain
from lcopa_bayes.core.units import measured, per
from lcopa_bayes.core.wording import joined, listed
from lcopa_bayes.inference.kinds import COEFFICIENTS, CONSTANTS
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.results.residuals import WHITE_P
from lcopa_bayes.results.steps import share_unsettled
from lcopa_bayes.sampling.convergence import Grade, shares_grade

if TYPE_CHECKING:
    from lcopa_bayes.results.firstlook import FirstLook
    from lcopa_bayes.results.fit import Fit

_AT_REST = 8
"""Samples at rest without which their scatter is not shown [-]."""


def overview(fit: Fit) -> dict[str, Any]:
    """The equation of the plant at the draw of highest density, line by line, and the answer to each
    question, with the section of the page that has more.

    Medians of a posterior with several modes make a plant that no record supports.
    """
    draws = fit.draws
    graded = [(one.name, one.grade) for one in draws.estimates()]
    return _overview(
        plant(draws.table, draws.flat[int(draws.log_density.argmax())]),
        ("How good is the fit?", _fitted(fit), "Residuals"),
        ("Does it predict?", _predicted(fit), "Data and bands"),
        ("Which numbers can be trusted?", grouped(graded), "Parameters"),
        ("What is missing?", _missing(fit), "Residuals"),
        ("What next?", _next(fit), ""),
    )


def overview_of_look(look: FirstLook) -> dict[str, Any]:
    """The same of a first look, with the plant at its best optimum."""
    rough = f"Roughly, all: {look.reason}."
    lacking = [one for one in (look.whiteness, *(limit.reason for limit in look.before)) if one]
    return {"at": "best optimum"} | _overview(
        plant(look.draws.table, look.optimum.values),
        ("How good is the fit?", _fitted(look), "Residuals"),
        ("Does it predict?", _predicted(look), "Data and bands"),
        ("Which numbers can be trusted?", rough, "Parameters"),
        ("What is missing?", joined(lacking), "Residuals"),
        ("What next?", joined([*(one.remedy for one in look.before), "`fit` samples the posterior"]), ""),
    )


def _overview(lines: list[str], *answers: tuple[str, str, str]) -> dict[str, Any]:
    keys = ("question", "answer", "section")
    return {"plant": lines, "answers": [dict(zip(keys, one, strict=True)) for one in answers if one[1]]}


def plant(table: ParameterTable, values: Vector) -> list[str]:
    """Transfer functions of all paths at table values (rows,), and the elements that they share."""
    layout = table.layout
    shared = {e for e, count in Counter(chain(*layout.element_of)).items() if count > 1}
    named = shared if len(layout.elements) > 1 else set()
    lines = []
    elements = {}
    for e, slot in enumerate(layout.elements):
        terms = [
            f"({values[table.at('time', e, k)]:.4g} s)^{values[table.at('order', e, k)]:.4g}"
            for k in range(slot.terms)
        ]
        elements[e] = " + ".join(["1", *terms])
    for i, response in enumerate(layout.responses):
        for j, drive in enumerate(layout.drives):
            e = layout.element_of[i][j]
            gain = values[table.at("gain", i, j)]
            delay = values[table.at("delay", layout.delay_of[i][j])]
            size = measured(gain, per(response.unit, drive.unit), ".4g")
            below = layout.elements[e].name if e in named else f"({elements[e]})"
            lines.append(f"{response.name} / {drive.name} = {size} exp(-{delay:.4g} s) / {below}")
    lines += [f"{slot.name} = {elements[e]}" for e, slot in enumerate(layout.elements) if e in named]
    if table.effects is not None:
        lines += [
            f"with {row.name} = {measured(value, row.unit, '.4g')}"
            for row, value in zip(table.rows, values, strict=True)
            if row.kind in (*COEFFICIENTS, *CONSTANTS)
        ]
    return lines


def _fitted(fit: Fit | FirstLook) -> str:
    parts = []
    for axis, response in enumerate(fit.draws.table.layout.responses):
        own = [band for band in fit.bands if band.axis == response.name and not band.held_out]
        residual = np.concatenate([band.observed - band.plant[2] for band in own])
        rms = measured(float(np.sqrt(np.mean(residual**2))), response.unit)
        said = f"The residual of {response.name} is {rms} rms"
        still = [one.quiet(axis).values for one in fit.problem.posterior.samples]
        free = sum(max(0, values.size - 1) for values in still)
        if free >= _AT_REST:
            squares = sum(float(np.sum((values - values.mean()) ** 2)) for values in still if values.size)
            scatter = measured(float(np.sqrt(squares / free)), response.unit)
            said += f", where samples at rest scatter by {scatter}"
        parts.append(said)
    return ". ".join(parts) + "."


def _predicted(fit: Fit | FirstLook) -> str:
    held = [band for band in fit.bands if band.held_out]
    if not held:
        return "Untested: no record was held out."
    worst = min(held, key=lambda band: band.coverage(0.9))
    several = "s" * (len(held) != 1)
    return (
        f"Of {len(held)} held-out response{several} the worst, {worst.record}/{worst.axis}, has "
        f"{100 * worst.coverage(0.9):.0f} % of its samples in the 90 % band and an error of "
        f"{measured(worst.rmse, worst.unit)} rms."
    )


def grouped(graded: Iterable[tuple[str, str]]) -> str:
    """Names by their grade, the best first, as a sentence; empty without any."""
    by_grade: dict[str, list[str]] = {"reliable": [], "tentative": [], "unusable": []}
    for name, grade in graded:
        by_grade[grade].append(name)
    shown = {grade: names for grade, names in by_grade.items() if names}
    if len(shown) == 1:
        ((grade, names),) = shown.items()
        return f"All {len(names)} are {grade}." if len(names) > 1 else f"{names[0]} is {grade}."
    return joined([f"{grade}: {listed(names)}" for grade, names in shown.items()])


def _missing(fit: Fit) -> str:
    reasons = [one.reason for one in fit.draws.limitations if one.level != "reliable"]
    if fit.draws.modes:
        names = listed([one.parameter for one in fit.draws.modes])
        reasons.append(f"the posterior has several modes, which differ in {names}")
    if not reasons:
        return "Nothing that the checks of the model against its records could see."
    return joined(reasons)


def _next(fit: Fit) -> str:
    remedies = [one.remedy for one in fit.draws.limitations if one.level != "reliable" and one.remedy]
    if not fit.study.held_out:
        remedies.append("hold out a record (--held-out) to test the prediction")
    remedies.append("`audit` says what the records determine, `loop` what the model lacks")
    return joined(remedies)


IMPORTANCE = "importance draws"
"""Method of a fit whose draws are not those of ensembles."""


def verdict(fit: Fit) -> str:
    """One sentence: what was learned, how far it can be trusted, what is wrong with it."""
    grade = fit.draws.grade
    parts = [f"Grade {grade.level}: {grade.reason}."]
    if fit.cross_check is not None and fit.cross_check.agrees:  # a disagreement is part of the grade
        said = fit.cross_check.sentence
        parts.append(f"{said[0].upper()}{said[1:]}.")
    worst = min((r for r in fit.residuals if not r.held_out), key=lambda r: r.p_white, default=None)
    flags = [one.held_out for one in fit.residuals] + [one.held_out for one in fit.bands]
    tried = flags.count(False)  # as many tests as `adequacy` corrects for
    if worst is not None and tried * worst.p_white >= WHITE_P:  # what is not white is part of the grade
        parts.append(f"The residual is compatible with the noise model (smallest p = {worst.p_white:.2g}).")
    parts.extend(_held_out_sentence(fit))
    slow = max(share_unsettled(curve) for curve in fit.curves.normalised)
    if slow > 0.05:
        parts.append(
            f"At least one step response has not reached its steady state within the longest record "
            f"({100 * slow:.0f} % of draws are more than 2 % away): algebraic tails are slow."
        )
    parts += [one.sentence for one in (fit.structure, fit.alternatives, fit.rival) if one is not None]
    return " ".join([*parts, f"{fit.discretisation.sentence}."])


def _held_out_sentence(fit: Fit) -> list[str]:
    outside = [band for band in fit.bands if band.held_out]
    if not outside:
        return ["No record was held out, so prediction is untested."]
    said = ", ".join(
        f"{band.record}/{band.axis} RMSE {measured(band.rmse, band.unit)} with "
        f"{100 * band.coverage(0.9):.0f} % of samples in the pointwise 90 % band"
        f"{' (offset from these samples)' if band.own_offset else ''}"
        for band in outside
    )
    own = "A constant error of a record whose offset comes from its scored samples cannot show."
    return [f"Held out: {said}.", *([own] if any(band.own_offset for band in outside) else [])]


def results(fit: Fit) -> dict[str, Any]:
    """Every number of the fit as plain JSON values; `None` is an open side or undefined."""
    grade = fit.draws.grade
    quality = {q.name: q for q in fit.draws.qualities}
    parameters = [
        estimate.as_json()
        | {"rhat": quality[estimate.name].rhat, "ess_between": quality[estimate.name].ess_between}
        for estimate in fit.draws.estimates()
    ]
    return plain(
        {
            "study": fit.study.name,
            "verdict": verdict(fit),
            "overview": overview(fit),
            "grade": grade.level,
            "grade_reason": grade.reason,
            "limitations": [one.as_json() for one in fit.draws.limitations],
            "time_unit": fit.study.time_unit,
            "parameters": parameters,
            "fixed": fixed_values(fit.problem.posterior.table),
            "log_evidence": fit.evidence.value if fit.evidence else None,
            "log_evidence_sd": fit.evidence.sd if fit.evidence else None,
            "log_evidence_by_ensemble": fit.evidence.by_ensemble if fit.evidence else (),
            "log_evidence_grade": Grade.worst([fit.evidence.grade, grade]).level if fit.evidence else None,
            "cross_check": None if fit.cross_check is None else fit.cross_check.as_json(),
            "discretisation": fit.discretisation.as_json(),
            "residual_rms": residual_rms(fit),
            "held_out": scores(fit, held_out=True),
            "rival": fit.rival.as_json() if fit.rival else None,
            "structure": fit.structure.as_json() if fit.structure else None,
            "alternatives": fit.alternatives.as_json() if fit.alternatives else None,
            "fit_scores": scores(fit, held_out=False),
            "modes": [
                r.as_json() | {"grade": fit.draws.level(r.parameter, shares_grade(r))}
                for r in fit.draws.modes
            ],
            "sensitivity": [moved.as_json() for moved in fit.sensitivity],
            "step_metrics": [metric.as_json() for metric in fit.metrics],
            "residual_tests": [one.test() for one in fit.residuals],
            "sampler": _sampler(fit),
        }
    )


def residual_rms(fit: Fit) -> dict[str, float]:
    """Root mean square residual of each response axis over the fit records [response unit]."""
    pooled: dict[str, list[float]] = {}
    for band in fit.bands:
        if not band.held_out:
            pooled.setdefault(band.axis, []).extend((band.observed - band.plant[2]) ** 2)
    return {axis: float(np.sqrt(np.mean(squares))) for axis, squares in pooled.items()}


def fixed_values(table: ParameterTable) -> list[dict[str, Any]]:
    """Parameters that are not estimated."""
    return [{"name": row.name, "value": row.value, "unit": row.unit} for row in table.rows if not row.free]


def scores(fit: Fit | FirstLook, *, held_out: bool) -> list[dict[str, Any]]:
    """Error and coverage of every axis of the records that were held out, or of those fitted."""
    return [band.score() for band in fit.bands if band.held_out == held_out]


def _sampler(fit: Fit) -> Mapping[str, Any]:
    plan, ensembles, weighted = fit.run.plan, fit.run.ensembles, fit.run.weighted
    common = {
        "smallest_ess": fit.draws.ess,
        "largest_rhat": max(q.rhat for q in fit.draws.qualities),
        "target_ess": plan.target_ess,
        "seed": plan.seed,
    }
    if weighted is not None:
        return {
            "method": IMPORTANCE,
            "batches": len(weighted.parts),
            "draws": weighted.count,
            "pareto_k": weighted.pareto_k,
            "weights_ess": weighted.ess,
            **common,
        }
    return {
        "method": "ensembles",
        "ensembles": plan.ensembles,
        "walkers": plan.walkers,
        "steps": ensembles[0].steps,
        "most_steps": plan.steps,
        "thin": plan.thin,
        "acceptance": float(np.mean([ensemble.acceptance for ensemble in ensembles])),
        **common,
    }
