"""What records must offer before a posterior is sampled from them, in words where they do not."""

from __future__ import annotations

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.rest import not_at_rest
from lcopa_bayes.data.study import Study

_ROUNDING = 1e-9
"""Movement of a drive over its largest value that is no more than rounding [-]."""
_TWINS = 1e-6
"""Closer than this share of the sampling period two samples of an axis are one sample read twice [-]."""
_SCALE = 1e100
"""Ranges beyond it, or below its inverse, overflow once squared and divided by each other [any unit]."""


def unmet(study: Study) -> list[str]:
    """A problem for everything in the records that keeps a fit of them from meaning anything."""
    return unmet_apart_from_rest(study) or not_at_rest(study.fit, study.held_out)


def unmet_apart_from_rest(study: Study) -> list[str]:
    """The same without the question whether records begin at rest."""
    problems = [*_drives(study), *_responses(study)]
    for record in (*study.fit, *study.held_out):
        problems += _exposure(record, study.exposure) + _twins(record)
    if not any(_sampled(record).size > 1 for record in study.fit):
        problems.append("no fit record has more than one response sample; give records with two or more")
    return problems


def _sampled(record: Record) -> Vector:
    """Times of rows in which some response was sampled, (n,) [time unit]."""
    return record.time[np.isfinite(record.response).any(axis=1)]


def _scaled(role: str, axis: Axis, span: float) -> list[str]:
    if span == 0.0 or 1 / _SCALE < span < _SCALE:
        return []
    return [
        f"{role} {axis.name!r} has a range of {span:.3g} {axis.unit}; give it in a unit that suits its size"
    ]


def _drives(study: Study) -> list[str]:
    problems = []
    values = np.concatenate([record.drive for record in study.fit])
    moved = np.max([np.ptp(record.drive, axis=0) for record in study.fit], axis=0)
    for axis, span, largest in zip(study.drive_axes, moved, np.abs(values).max(axis=0), strict=True):
        problems += _scaled("drive", axis, float(span))
        if 0.0 < span <= _ROUNDING * largest:
            problems.append(
                f"drive {axis.name!r} changes by {span:.3g} {axis.unit} at values of {largest:.6g} "
                f"{axis.unit}, which is rounding: write it as constant, or give its changes with more digits"
            )
    return problems


def _responses(study: Study) -> list[str]:
    problems = []
    values = np.concatenate([record.response for record in study.fit])
    for axis, span, level in zip(
        study.response_axes, np.nanmax(values, axis=0) - np.nanmin(values, axis=0), values.T, strict=True
    ):
        problems += _scaled("response", axis, float(span))
        if span == 0.0:
            problems.append(
                f"response {axis.name} is constant throughout the fit records ({np.nanmax(level):.6g} "
                f"{axis.unit}): it shows neither noise nor anything to explain; leave its column out, or "
                "give records in which it is read out finely enough to move"
            )
    return problems


def _exposure(record: Record, exposure: float) -> list[str]:
    """A sample cannot be a mean over a time in which the sample before it was still taken."""
    times = _sampled(record)
    if exposure == 0.0 or times.size < 2:
        return []
    period = float(np.median(np.diff(times)))
    if exposure <= period * (1 + _TWINS):
        return []
    unit = record.time_unit
    return [
        f"record {record.name!r}: the exposure of {exposure:.6g} {unit} is longer than the {period:.6g} "
        f"{unit} from one sample to the next, in which a sample cannot be taken; `exposure_ms` is in ms: "
        "give the exposure of one sample, or leave it out where a filter averages over several, which the "
        "plant then includes"
    ]


def _twins(record: Record) -> list[str]:
    problems = []
    for axis, values in zip(record.response_axes, record.response.T, strict=True):
        times = record.time[np.isfinite(values)]
        gaps = np.diff(times)
        if not gaps.size:
            continue
        k = int(gaps.argmin())
        if gaps[k] < _TWINS * np.median(gaps):
            problems.append(
                f"record {record.name!r}: response {axis.name!r} has samples at {float(times[k])!r} and "
                f"{float(times[k + 1])!r} {record.time_unit}, {gaps[k]:.2g} apart, as if one were read "
                "twice; keep one"
            )
    return problems
