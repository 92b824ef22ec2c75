"""What a bench can play: the range of every drive, its refresh, the camera, and how long it may take."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.errors import InputError, refuse_if
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.observations import sampling_period
from lcopa_bayes.model.literature import PAPER

MOST_SAMPLES = 100_000
"""Samples of the longest bench time tried: 10 s at 10 kHz."""
SPANS = (1, 2, 4, 10, 40, 100, 400)
"""Bench times that are tried, in spans of the study's records [-]: 25 ms to 10 s for those of the paper."""
PREFERRED = 40
"""The one of them that is designed for when none is asked for [-]."""
_PER_REFRESH = round(PAPER.records.camera_rate / PAPER.records.refresh_rate)
"""Camera samples per refresh of the drive on the paper's bench, taken over for other time scales."""


@final
@dataclass(frozen=True, eq=False)
class Limits:
    """Drives stay between `low` and `high`, start at `rest` and change at multiples of `refresh`."""

    rest: Vector
    """Drive before time 0 [drive unit], one per drive axis."""
    low: Vector
    """Smallest value [drive unit], one per drive axis; not above `rest`."""
    high: Vector
    """Largest value [drive unit], one per drive axis; not below `rest`."""
    refresh: float
    """Time between changes [time unit], a whole number of camera periods."""
    period: float
    """Camera period [time unit]."""

    @property
    def far(self) -> Vector:
        """The end of each range that is farther from rest [drive unit], where a plain step goes."""
        return np.where(self.high - self.rest >= self.rest - self.low, self.high, self.low)


def limits_of(problem: Problem, *, amplitude: float | None = None, refresh: float | None = None) -> Limits:
    """Ranges that the study's records have used, or with `amplitude` scaled to reach so far from rest.

    A drive that never moved takes the range of a drive of the same unit that did. `refresh` is ten camera
    periods when it is not given, as on the bench of Ta et al. 2026. InputError when the amplitude is not
    positive, no range is known for some drive, or the refresh is shorter than a camera period.
    """
    records, axes = problem.study.fit, problem.study.drive_axes
    period, unit = float(f"{sampling_period(records):.9g}"), problem.study.time_unit  # 0.1, not 0.0999...6
    problems = []
    if amplitude is not None and not (isfinite(amplitude) and amplitude > 0):
        problems.append(
            f"no candidate drive lies inside an amplitude limit of {amplitude:g}: it must be positive; give "
            "the largest deviation from rest in the unit of the drives"
        )
    if refresh is not None and not (isfinite(refresh) and refresh >= 0.999 * period):
        problems.append(
            f"a refresh of {refresh:g} {unit} is shorter than the camera period {period:g} {unit}; give a "
            "longer one"
        )
    rest = records[0].drive[0]
    low = np.minimum(np.min([r.drive.min(axis=0) for r in records], axis=0) - rest, 0.0)
    high = np.maximum(np.max([r.drive.max(axis=0) for r in records], axis=0) - rest, 0.0)
    moved = high > low
    for j, axis in enumerate(axes):
        like = [k for k, other in enumerate(axes) if moved[k] and other.unit == axis.unit]
        if moved[j]:
            continue
        if like:
            low[j], high[j] = low[like].min(), high[like].max()
        else:
            problems.append(
                f"drive {axis.name!r} moves in no record and no other drive is in {axis.unit}: its range is "
                "not known; add a record in which it moves"
            )
    refuse_if(problems)
    if amplitude is not None:
        factor = amplitude / np.maximum(-low, high)
        low, high = low * factor, high * factor
    ticks = _PER_REFRESH if refresh is None else max(1, round(refresh / period))
    return Limits(rest, rest + low, rest + high, float(f"{ticks * period:.9g}"), period)


def bench_times(problem: Problem, limits: Limits, wanted: float | None) -> tuple[tuple[float, ...], float]:
    """Bench times to try [time unit], increasing, and the one to design for, which is among them.

    InputError when the wanted time holds fewer than four refreshes or more than `MOST_SAMPLES` samples.
    """
    unit, least, most = problem.study.time_unit, 4 * limits.refresh, MOST_SAMPLES * limits.period
    if wanted is not None and not (least <= wanted <= most * (1 + 1e-9)):
        raise InputError(
            f"a bench time of {wanted:g} {unit} cannot be designed for: it must hold four refreshes "
            f"({least:g} {unit}) or more and at most {MOST_SAMPLES} samples ({most:g} {unit})"
        )
    span = round(problem.scales.span / limits.refresh) * limits.refresh or limits.refresh
    ladder = {float(f"{k * span:.9g}") for k in SPANS if least <= k * span <= most * (1 + 1e-9)}
    chosen = wanted or max([t for t in ladder if t <= PREFERRED * span * (1 + 1e-9)], default=least)
    return tuple(sorted({*ladder, chosen})), chosen
