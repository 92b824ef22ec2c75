"""Long records made shorter: means of so many samples in turn, each a sample with an exposure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from lcopa_bayes.core.arrays import Flags
from lcopa_bayes.core.errors import InputError, gathered, refuse_if
from lcopa_bayes.core.units import in_time_unit
from lcopa_bayes.data.record import Record
from lcopa_bayes.data.study import Study

_EVEN = 0.01
"""Largest deviation of a sample from equidistance [sampling periods]: a mean of many moves by less."""
_ALIKE = 1e-6
"""Relative difference of sampling periods that rounding of times explains [-]."""


def averaged(study: Study, count: int) -> Study:
    """The study with means of `count` samples in turn in place of the samples.

    A mean of samples a period p apart is nearly that over `count` p, which a likelihood takes exactly
    (`ModelSettings.exposure_ms`); noise of a white and a correlated part stays noise of these parts where its
    correlation is not shorter than p (means of an AR(1) process are ARMA(1,1)). What is lost is what a
    response does within `count` p: `identifiability.averagingloss` measures it.

    Drive changes keep their times. A mean of which a sample is missing is missing; samples at the end that
    fill no mean are left out. InputError for samples that are not equidistant, records of several
    sampling periods, and fewer than two means in a record.
    """
    if count < 2:
        raise InputError(f"a mean needs 2 samples or more; got {count}")
    records, periods, problems = {}, {}, list[str]()
    for record in (*study.fit, *study.held_out):
        with gathered(problems):
            records[record.name], periods[record.name] = _averaged(record, count, study.exposure)
    refuse_if(problems or _unequal(periods, study.time_unit))
    exposure = in_time_unit(count * next(iter(periods.values())), study.time_unit, "ms")
    return replace(
        study,
        fit=tuple(records[record.name] for record in study.fit),
        held_out=tuple(records[record.name] for record in study.held_out),
        model=replace(study.model, exposure_ms=float(exposure)),
    )


def _unequal(periods: Mapping[str, float], unit: str) -> list[str]:
    low, high = min(periods, key=periods.__getitem__), max(periods, key=periods.__getitem__)
    if periods[high] - periods[low] <= _ALIKE * periods[high]:
        return []
    return [
        f"record {low!r} is sampled every {periods[low]:.6g} {unit}, {high!r} every {periods[high]:.6g} "
        f"{unit}; means of as many samples then differ in exposure: average records of one period only"
    ]


def _averaged(record: Record, count: int, exposure: float) -> tuple[Record, float]:
    """Means of samples taken over an `exposure` [time unit], each at the end of its own, and the period of
    the samples [time unit]."""
    sampled: Flags = np.any(np.isfinite(record.response), axis=1)
    times = record.time[sampled]
    if times.size < 2 * count:
        raise InputError(f"record {record.name!r}: {times.size} samples are no two means of {count}")
    reach = float(times[-1] - times[0])
    period = reach / round(reach / float(np.median(np.diff(times))))
    slots = (times - times[0]) / period
    places = np.round(slots).astype(int)
    if np.abs(slots - places).max() > _EVEN or (np.diff(places) == 0).any():
        raise InputError(
            f"record {record.name!r}: its samples are not equidistant (median gap {period:.6g} "
            f"{record.time_unit}), and only means of equidistant samples have an exposure"
        )
    size = (places[-1] + 1) // count
    each = np.full((size * count, record.response.shape[1]), np.nan)
    inside = places < len(each)
    each[places[inside]] = record.response[sampled][inside]
    means = each.reshape(size, count, -1).mean(axis=1)
    ends = times[0] + period * (count * (np.arange(size) + 1) - 0.5) - exposure / 2
    kept: Flags = np.ones(record.time.size, dtype=bool)
    kept[1:] = (np.diff(record.drive, axis=0) != 0).any(axis=1)
    # a first row without a sample states what the plant rested under; others do not
    kept[0] = not sampled[0] or bool((record.time[kept][1:2] <= ends[0]).any())
    time = np.union1d(record.time[kept], ends)
    held = np.searchsorted(record.time, time, side="right") - 1
    response = np.full((time.size, means.shape[1]), np.nan)
    response[np.searchsorted(time, ends)] = means
    return replace(record, time=time, drive=record.drive[held], response=response), period
