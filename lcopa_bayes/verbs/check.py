"""`check`: what was understood of a study, in words and pictures, without fitting it.

What a study holds, before anything is fitted: axes, drives, sampling, noise at rest, onsets and priors.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
import pandas as pd

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.estimate import plain
from lcopa_bayes.core.files import csv_of
from lcopa_bayes.core.units import measured
from lcopa_bayes.data.drive import axis_drives, first_change
from lcopa_bayes.data.record import Record
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.declared import obstacles
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.inference.parameter import Parameter
from lcopa_bayes.inference.priors import Prior
from lcopa_bayes.results.runfolder import provenance
from lcopa_bayes.results.stored import StoredResult
from lcopa_bayes.results.structure import with_least_terms
from lcopa_bayes.verbs.sources import StudyLike, study_of

_EVEN = 0.01
"""Spread of the gaps between samples over their median from which sampling is irregular [-]."""
_STILL = 5
"""Samples at rest without which no onset is looked for [-]."""
_AWAY = 5.0
"""Deviation from rest that is a response, over the scatter at rest [-] ..."""
_IN_TURN = 3
"""... in so many samples in turn."""
_ENDS = (0.05, 0.95)
_LEVEL = {"uniform": "", "loguniform": ", every decade alike"}
"""Densities that are level between two ends, and on which scale."""
_MANY = 50_000
"""Samples of the fit records from which means of them are advised [-]: a fit then takes many minutes."""


def inventory(study: Study) -> dict[str, Any]:
    """What was understood of a study, as plain values with sentences.

    InputError where its settings do not fit its records.
    """
    problem, problems = problem_of(with_least_terms(study)), obstacles(study)
    contradicted = study.disagreements
    disagree = [str(one) for one in contradicted]
    rows = problem.posterior.table.rows
    sentences = [*_of_plant(problem), *_of_model(problem)]
    if study.model.terms == "auto":
        sentences.append("A fit lets the records choose more terms, and what paths share.")
    if problem.posterior.size > _MANY:
        sentences.append(
            f"A fit takes time in proportion to the {problem.posterior.size} samples; `lcopa-bayes new "
            "--average` puts means in their place and states what that loses."
        )
    verdict = f"To mend before a fit: {'; '.join(problems)}." if problems else "The records can be fitted."
    verdict = " ".join([verdict, *(one.sentence for one in contradicted)])

    def remarked(record: Record) -> dict[str, Any]:
        """What was read of a record, with the remarks that name it."""
        own = [one for one in problems if one.startswith(f"record {record.name!r}:")]
        own += [str(one) for one in contradicted if record.name in one.records]
        return _record(record, problem, held_out=record in study.held_out) | {"remarks": own}

    return plain(
        {
            "study": study.name,
            "time_unit": study.time_unit,
            "verdict": verdict,
            "grade": "unusable" if problems else "tentative" if disagree else "reliable",
            "grade_reason": verdict,
            "problems": problems,
            "disagreements": disagree,
            "sentences": sentences,
            "records": [remarked(one) for one in (*study.fit, *study.held_out)],
            "parameters": [_prior(row) for row in rows],
        }
    )


def _of_plant(problem: Problem) -> list[str]:
    study = problem.study
    drives, responses = (
        ", ".join(f"{axis.name} [{axis.unit}]" for axis in axes)
        for axes in (study.drive_axes, study.response_axes)
    )
    number = len(study.drive_axes) * len(study.response_axes)
    return [
        f"{_counted(number, 'path')} from {drives} to {responses}; times in {study.time_unit}.",
        f"{_counted(len(study.fit), 'record')} to fit, {len(study.held_out)} held out.",
    ]


def _of_model(problem: Problem) -> list[str]:
    table = problem.posterior.table
    terms = sorted({slot.terms for slot in table.layout.elements})
    elements, delays = len(table.layout.elements), len(table.of_kind("delay"))
    free = [row for row in table.rows if row.free]
    several = " or ".join(map(str, terms))
    return [
        "Every path is gain exp(-delay s) / (1 + sum of (time_i s)^order_i), s the Laplace variable, with "
        f"{several} term{'s' * (terms != [1])}; all paths together have {_counted(elements, 'element')} and "
        f"{_counted(delays, 'delay')}.",
        f"{_counted(len(free), 'free parameter')}, {len(table.rows) - len(free)} fixed; "
        f"{problem.posterior.dimension} are sampled, the others are integrated out.",
    ]


def _record(record: Record, problem: Problem, *, held_out: bool) -> dict[str, Any]:
    samples = Samples.of(record, problem.scales.period)
    gaps = np.diff(samples.times if samples.times.size > 1 else record.time)
    period = float(np.median(gaps))
    even = bool(np.ptp(gaps) <= _EVEN * period)
    began = first_change(record)
    out: dict[str, Any] = {
        "record": record.name,
        "held_out": held_out,
        "rows": record.time.size,
        "start": float(record.time[0]),
        "end": float(record.time[-1]),
        "period": period,
        "even": even,
        "longest_gap": float(gaps.max()),
        "drives": _driven(record),
        "responses": [_response(record, samples, axis, began) for axis in range(record.response.shape[1])],
    }
    return out | {"sentences": _sentences(out, record.time_unit)}


def _driven(record: Record) -> list[dict[str, Any]]:
    out = []
    for axis, drive, values in zip(record.drive_axes, axis_drives(record), record.drive.T, strict=True):
        holds = np.diff([*drive.times, record.time[-1]])
        out.append(
            {
                "axis": axis.name,
                "unit": axis.unit,
                "rest": float(values[0]),
                "lowest": float(values.min()),
                "highest": float(values.max()),
                "changes": drive.times.size,
                "first_change": float(drive.times[0]) if drive.moves else None,
                "longest_hold": float(holds.max()) if drive.moves else None,
            }
        )
    return out


def _response(record: Record, samples: Samples, axis: int, began: float) -> dict[str, Any]:
    observed, at_rest = samples.axes[axis], samples.quiet(axis)
    times = samples.times[observed.index]
    scatter = _rest(at_rest.values)[1] if at_rest.values.size > 1 else None
    name = record.response_axes[axis]
    return {
        "axis": name.name,
        "unit": name.unit,
        "samples": observed.values.size,
        "missing": record.time.size - observed.values.size,
        "lowest": float(observed.values.min()) if observed.values.size else None,
        "highest": float(observed.values.max()) if observed.values.size else None,
        "at_rest": at_rest.values.size,
        "scatter": scatter,
        "onset": _onset(times, observed.values, at_rest.values, began),
    }


def _rest(values: Vector) -> tuple[float, float]:
    """Mean and standard deviation; of equal values exactly these and 0, from which both may be rounded."""
    if np.ptp(values) == 0.0:
        return float(values[0]), 0.0
    return float(values.mean()), float(values.std(ddof=1))


def _onset(times: Vector, values: Vector, at_rest: Vector, began: float) -> float | None:
    """Time from the first change of a drive to the first clear deviation from rest; None without one."""
    if at_rest.size < _STILL or at_rest.size + _IN_TURN > values.size:
        return None
    level, scatter = _rest(at_rest)
    away = np.abs(values - level) > _AWAY * scatter
    away[: at_rest.size] = False
    in_turn = np.convolve(away, np.ones(_IN_TURN, dtype=int), mode="valid") == _IN_TURN
    return float(times[int(in_turn.argmax())] - began) if in_turn.any() else None


def _sentences(one: dict[str, Any], unit: str) -> list[str]:
    span = f"{one['rows']} rows from {one['start']:.6g} to {one['end']:.6g} {unit}"
    spaced = f"sampled every {one['period']:.4g} {unit}"
    gaps = f"gaps of {one['period']:.4g} {unit} in the median and up to {one['longest_gap']:.4g} {unit}"
    uneven = f"sampled irregularly, with {gaps}"
    out = [f"{span}, {spaced if one['even'] else uneven}."]
    for drive in one["drives"]:
        if drive["first_change"] is None:
            out.append(f"{drive['axis']} stays at {measured(format(drive['rest'], '.4g'), drive['unit'])}.")
        else:
            at = f"{drive['first_change']:.4g} {unit}"
            highest = measured(drive["highest"], drive["unit"], ".4g")
            many = drive["changes"] != 1
            often = f"{drive['changes']} times from {at} on" if many else f"once, at {at}"
            out.append(
                f"{drive['axis']} changes {often}, between "
                f"{drive['lowest']:.4g} and {highest}; longest hold "
                f"{drive['longest_hold']:.4g} {unit}."
            )
    for axis in one["responses"]:
        if not axis["samples"]:
            out.append(f"{axis['axis']} was not sampled.")
            continue
        said = (
            f"{axis['axis']} between {axis['lowest']:.4g} and "
            f"{measured(format(axis['highest'], '.4g'), axis['unit'])}, "
            f"{axis['samples']} samples"
        )
        said += f", {axis['missing']} missing" if axis["missing"] else ""
        if axis["scatter"] is not None:
            scatter = f"scatter by {measured(axis['scatter'], axis['unit'], '.2g')}"
            said += f"; {axis['at_rest']} at rest, which {scatter if axis['scatter'] else 'are all equal'}"
        if axis["onset"] is not None:
            said += f"; it moves clearly {axis['onset']:.3g} {unit} after the first change of a drive"
        out.append(f"{said}.")
    return out


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' * (number != 1)}"


def _prior(row: Parameter) -> dict[str, Any]:
    if row.prior is None:
        return {"name": row.name, "unit": row.unit, "value": row.value, "words": f"fixed at {row.value:.6g}"}
    low, high = row.quantiles(_ENDS).tolist()
    return {
        "name": row.name,
        "unit": row.unit,
        "lower": low,
        "upper": high,
        "prior": str(row.prior),
        "from": "default" if row.default else "study",
        "words": _words(row.prior, (low, high), row.domain),
    }


def _words(prior: Prior, ends: tuple[float, float], domain: tuple[float, float]) -> str:
    """What a prior says, in words: a density that is level has hard ends, and no other places to name."""
    if prior.dist in _LEVEL:
        low, high = domain
        return f"anywhere between {low:.4g} and {high:.4g}{_LEVEL[prior.dist]}"
    return f"between {ends[0]:.3g} and {ends[1]:.3g} with 90 % probability"


@final
@dataclass(frozen=True, eq=False)
class CheckResult(StoredResult):
    """Axes, drives, sampling, noise at rest, onsets and priors of a study."""

    verb, file, beside = "check", "check.json", ("tables/check_records.csv",)

    def summary(self) -> pd.DataFrame:
        """One row per parameter: ends of the central 90 % of its prior [`unit`], or its fixed value."""
        keys = ("name", "lower", "upper", "value", "unit", "from")
        rows = [{key: row.get(key) for key in keys} for row in self.values["parameters"]]
        return pd.DataFrame(rows).rename(columns={"name": "parameter"})

    def __str__(self) -> str:
        lines = list(self.values["sentences"])
        for one in self.values["records"]:
            role = "held out" if one["held_out"] else "fit"
            lines += ["", f"{one['record']} ({role})", *(f"  {said}" for said in one["sentences"])]
        priors = [f"  {row['name']} [{row['unit']}]: {row['words']}" for row in self.values["parameters"]]
        return "\n".join([*lines, "", "priors", *priors, "", self.verdict])


def check(study: StudyLike, *, folder: Path | str | None = None) -> CheckResult:
    """Say what was understood of a study, without fitting it.

    Parameters: `study`, or where it is described; `folder`, a run folder to write into. Obstacles to a fit
    are part of the result. InputError when the study cannot be read.
    """
    wanted = study_of(study)
    records = pd.concat(
        [
            *(_table(one, held_out=False) for one in wanted.fit),
            *(_table(one, held_out=True) for one in wanted.held_out),
        ],
        ignore_index=True,
    )
    texts = {"tables/check_records.csv": csv_of(records)}
    return CheckResult(inventory(wanted), provenance(wanted, "check"), texts).kept(folder)


def _table(record: Record, *, held_out: bool) -> pd.DataFrame:
    """One row per time and axis."""
    frames = [
        pd.DataFrame(
            {"role": role, "axis": axis.name, "unit": axis.unit, "time": record.time, "value": values}
        )
        for role, axes, columns in (
            ("drive", record.drive_axes, record.drive.T),
            ("response", record.response_axes, record.response.T),
        )
        for axis, values in zip(axes, columns, strict=True)
    ]
    whole = pd.concat(frames, ignore_index=True)
    whole.insert(0, "record", record.name)
    return whole.assign(held_out=held_out)
