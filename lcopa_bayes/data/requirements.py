"""What records must offer before a posterior is sampled from them, in words where they do not.

Whether a record begins at rest: does a response move before a change of drive can move it?

Before its first row the plant is taken as resting under the drive of that row. Where it did not, for
instance because the drive was switched on as the record began, the response relaxes from the start, and a
model that is at rest there puts this into its offset and its other parameters. A record is recognised when,
before its drives have changed,

- a relaxation ``exp(-t / T)`` of any onset and time constant explains a response better than a constant does,
  under first-order autoregressive noise of any correlation up to that of a random walk. The ratio of the
  largest likelihoods is held against `_THRESHOLD`, for the samples and for means of neighbours: white noise
  on top of a slow disturbance hides in the samples how correlated that is; and
- the response moves by `_SHARE` of its range, so that slight drifts stay what they are.

An early row without a response states what the plant rested under; such a record is not examined. Where no
drive moves in a record and a straight line follows its response as well as a relaxation does, the movement
may be a drift, which effects describe.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple, final

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.units import measured
from lcopa_bayes.data.drive import moved_with_drive
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.study import Study

_THRESHOLD = 25.0
"""Twice the log ratio of the largest likelihoods above which a relaxation is no noise [-]. Of 1000 simulated
stretches each of 8 to 400 samples, none exceeds it with a correlation up to 0.5, 0.1 % with 0.9, 0.4 % with
0.99 and 0.7 % as a random walk, with or without white noise on top."""
_SHARE = 0.1
"""Least movement that counts, over the range of the response in the records [-]."""
_UNMOVED = 0.01
"""Deviation of a drive from its first row that counts as no change, over its range in the records [-]."""
FEWEST = 8
"""Fewer samples cannot distinguish a relaxation from noise [-]."""
_MEANS = 24
"""Means of neighbours that a long stretch is reduced to, at most twice as many [-]."""
_RHO = 1.0 - np.concatenate(([1.0], np.geomspace(0.7, 1e-4, 20)))
"""Correlations of the noise one sampling period apart that are tried [-]."""
_MOST = 1000
"""Means that a very long stretch is reduced to in place of its samples, at most twice as many [-]."""
_TIMES = 8
"""Time constants that are tried [-]."""
_ONSETS = np.arange(24) / 25
"""Onsets of a relaxation that are tried, over the stretch [-]."""
_LONGEST = 4.0
"""Longest time constant, over the stretch [-]: as straight as a line there."""
_EXACT = 1e-6
"""Noise below this share of a response's range is rounding [-]."""


@final
class Movement(NamedTuple):
    """A response that moves before a drive can move it."""

    record: Record
    axis: int
    """Position of the response."""
    size: float
    """[response unit]."""
    range: float
    """Of the response in the records to fit [response unit]."""
    until: int
    """Rows up to and with the one at which a drive first changes."""
    straight: bool
    """Whether no drive changes and a line follows it as well as a relaxation does."""

    def __str__(self) -> str:
        """What was seen and what to do."""
        drift = f"{_STRAIGHT}; `loop` traces one, and {_DECLARED} declares it. " if self.straight else ""
        return (
            f"{self._seen}: the plant was not at rest there, as the model assumes. {drift}{self._advice}; if "
            "it is not known, leave the responses empty until they have come to rest. A row before the first "
            "with the same drive states that the plant was at rest and the response drifts"
        )

    @property
    def as_drift(self) -> str:
        """What was seen of one that is `straight`, and what it may be instead of a drift."""
        return f"{self._seen}. {_STRAIGHT}, and is taken for one. {self._advice}"

    @property
    def _seen(self) -> str:
        record, axis = self.record, self.record.response_axes[self.axis]
        drives = zip(record.drive_axes, record.drive[0], strict=True)
        rest = ", ".join(f"{drive.name} = {measured(value, drive.unit, '.6g')}" for drive, value in drives)
        last = f"{record.time[self.until - 1]:.6g} {record.time_unit}"
        until_then = "throughout" if self.until == record.time.size else f"until {last}"
        return (
            f"record {record.name!r}: response {axis.name!r} moves by {measured(self.size, axis.unit)} "
            f"({100 * abs(self.size) / self.range:.0f} % of its range) while the drive stays as in the first "
            f"row ({rest}) {until_then}"
        )

    @property
    def _advice(self) -> str:
        return f"If the drive was another one before the record, {self.record.early_row}"


_STRAIGHT = "It moves along a straight line, as a drift does"
_DECLARED = 'use = ["pointing_drift"] in [effects]'


def not_at_rest(fit: Sequence[Record], held_out: Sequence[Record] = ()) -> list[Movement]:
    """Every response of a record that moves before a drive does; all records have equal axes."""
    if not fit:
        return []
    responses = np.concatenate([record.response for record in fit])
    spans = np.nanmax(responses, axis=0) - np.nanmin(responses, axis=0)
    reach = np.ptp(np.concatenate([record.drive for record in fit]), axis=0)
    found = []
    for record in (*fit, *held_out):
        if np.isnan(record.response[0]).all():
            continue
        until = _still(record, reach)
        for axis, span in enumerate(spans):
            late = moved_with_drive(record, axis) != 0.0  # `agreement` says so
            seen = np.flatnonzero(np.isfinite(record.response[: until - late, axis]))
            if seen.size < FEWEST or not span > 0.0:
                continue
            times, values = record.time[seen], record.response[seen, axis]
            moved = unrest(times, values, float(span))
            if moved is not None:
                still = until == record.time.size and straight(times, values, float(span))
                found.append(Movement(record, axis, moved, float(span), until, still))
    return found


def _still(record: Record, reach: Vector) -> int:
    """Number of rows up to and with the one at which a drive first changes: it has moved nothing yet."""
    away = (np.abs(record.drive - record.drive[0]) > _UNMOVED * reach).any(axis=1)
    return int(away.argmax()) + 1 if away.any() else record.time.size


def unrest(time: Vector, values: Vector, span: float) -> float | None:
    """Movement of samples (n,) that noise does not explain [response unit]; None when it does.

    `span` is the range of the response in the records, in the same unit.
    """
    n = values.size
    moved = float(values[-max(1, n // 6) :].mean() - values[: max(1, n // _MEANS)].mean())
    if abs(moved) < _SHARE * span:
        return None
    least = _EXACT * span
    over = (relaxation(*means, least) for means in _reduced(time, values))
    return moved if all(ratio >= _THRESHOLD for ratio in over) else None


def straight(time: Vector, values: Vector, span: float) -> bool:
    """Whether a line follows samples (n,) so well that noise explains what a relaxation explains better."""
    least = _EXACT * span
    return any(relaxation(*means, least, line=True) < _THRESHOLD for means in _reduced(time, values))


def drifts(time: Vector, values: Vector) -> bool:
    """Whether samples (n,) of a response that nothing drives move, of any size, and along a straight line."""
    span = float(np.ptp(values)) if values.size >= FEWEST else 0.0
    return span > 0.0 and unrest(time, values, span) is not None and straight(time, values, span)


def _reduced(time: Vector, values: Vector) -> Iterator[tuple[Vector, Vector]]:
    """Times and values of a stretch in means of neighbours, many to a mean and few."""
    for many in {max(1, values.size // most) for most in (_MEANS, _MOST)}:
        yield _means(time, many), _means(values, many)


def _means(values: Vector, many: int) -> Vector:
    """Means of `many` neighbours each, or a few more."""
    return np.array([part.mean() for part in np.array_split(values, values.size // many)])


def relaxation(time: Vector, values: Vector, exact: float, *, line: bool = False) -> float:
    """Twice the log ratio of the likelihood of the best relaxation of samples (n,) to that of a constant, or
    with `line` of a straight line beside a constant [-].

    `exact` is the least standard deviation of the noise [response unit].
    """
    at = time - time[0]
    gaps = np.diff(at)
    period = float(np.median(gaps))
    constants = np.geomspace(0.5 * period, _LONGEST * at[-1], _TIMES)
    late = [np.maximum(at - onset * at[-1], 0.0) for onset in _ONSETS]
    relaxed = np.exp(-np.concatenate([one / constants[:, None] for one in late]))
    plain = np.stack((at / at[-1], np.ones(at.size)))[0 if line else 1 :]
    curves = np.concatenate((relaxed, values[None], plain))
    best, constant = -np.inf, -np.inf
    for rho in _RHO:
        link = rho ** (gaps / period)
        scale = np.sqrt(1.0 - link**2)
        white = np.concatenate((curves[:, :1], (curves[:, 1:] - link * curves[:, :-1]) / scale), axis=1)
        level = -np.log(scale).sum()
        basis, _ = np.linalg.qr(white[-len(plain) :].T)
        beyond = white[: -len(plain)] - (white[: -len(plain)] @ basis) @ basis.T
        exps, seen = beyond[:-1], beyond[-1]
        least = values.size * exact**2
        power = float(seen @ seen) + least
        left = power - float(((exps @ seen) ** 2 / np.einsum("tn,tn->t", exps, exps)).max())
        constant = max(constant, level - 0.5 * values.size * np.log(power))
        best = max(best, level - 0.5 * values.size * np.log(max(left, least)))
    return 2.0 * float(best - constant) * (1.0 - 4.0 / values.size)


_ROUNDING = 1e-9
"""Movement of a drive over its largest value that is no more than rounding [-]."""
_TWINS = 1e-6
"""Closer than this share of the sampling period two samples of an axis are one sample read twice [-]."""
_SCALE = 1e100
"""Ranges beyond it, or below its inverse, overflow once squared and divided by each other [any unit]."""


def unmet(study: Study, *, described: bool = False) -> list[str]:
    """A problem for everything in the records that keeps a fit of them from meaning anything; `described` as
    `unmet_rest`."""
    return unmet_apart_from_rest(study) or unmet_rest(study, described=described)


def unmet_rest(study: Study, *, described: bool) -> list[str]:
    """A problem for every response that moves before a drive does; `described`, but for drifts where no drive
    moves, which an effect describes."""
    return [str(one) for one in not_at_rest(study.fit, study.held_out) if not (described and one.straight)]


def unmet_apart_from_rest(study: Study) -> list[str]:
    """The same without the question whether records begin at rest."""
    problems = [*_drives(study), *_responses(study)]
    for record in (*study.fit, *study.held_out):
        problems += _exposure(record, study.exposure) + _twins(record)
    if not any(record.sampled.size > 1 for record in study.fit):
        problems.append("no fit record has more than one response sample; give records with two or more")
    return problems


def _scaled(role: str, axis: Axis, span: float) -> list[str]:
    if span == 0.0 or 1 / _SCALE < span < _SCALE:
        return []
    return [
        f"{role} {axis.name!r} has a range of {measured(span, axis.unit)}; give it in a unit that suits its "
        "size"
    ]


def _drives(study: Study) -> list[str]:
    problems = []
    values = np.concatenate([record.drive for record in study.fit])
    moved = np.max([np.ptp(record.drive, axis=0) for record in study.fit], axis=0)
    for axis, span, largest in zip(study.drive_axes, moved, np.abs(values).max(axis=0), strict=True):
        problems += _scaled("drive", axis, float(span))
        if 0.0 < span <= _ROUNDING * largest:
            problems.append(
                f"drive {axis.name!r} changes by {measured(span, axis.unit)} at values of {largest:.6g} "
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
    times = record.sampled
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
