"""What a bench can play, and candidate drives of a given length, all within these limits and on its refresh
grid."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import isfinite
from typing import final

import numpy as np

from lcopa_bayes.bench.command import Command
from lcopa_bayes.core.arrays import Flags, Matrix, Vector
from lcopa_bayes.core.errors import InputError, refuse_if
from lcopa_bayes.data.study import Study
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
        return np.where(self._upwards, self.high, self.low)

    @property
    def near(self) -> Vector:
        """The other end [drive unit]."""
        return np.where(self._upwards, self.low, self.high)

    @property
    def _upwards(self) -> Flags:
        return np.asarray(self.high - self.rest >= self.rest - self.low)


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


PLAIN = "step"
"""Name of the drive all others are compared with."""
_LINES = 24
"""Most frequencies of a multisine."""
_LEVELS = 4
"""Levels of a staircase and of an amplitude series."""


@final
@dataclass(frozen=True, eq=False)
class Candidate:
    """A drive that may be played."""

    name: str
    family: str
    words: str
    command: Command


Shape = Callable[[int, float, np.random.Generator], Vector]
"""Position on so many refreshes, from the near end (0) to the far end (1) of a range in which the drive rests
at a given position [-]."""


def candidates(limits: Limits, time: float, rng: np.random.Generator, *, unit: str) -> tuple[Candidate, ...]:
    """Every drive worth trying for `time` [time unit], the plain step first.

    With several drive axes the plain step moves one axis after the other, each for an equal part of the
    time; every other shape moves all axes at once with shapes of their own (random ones are drawn for each,
    periodic ones are shifted), and two of them one axis alone.
    """
    ticks, axes = max(2, round(time / limits.refresh)), limits.rest.size
    drives: list[Candidate] = []
    resting = _resting(limits)
    for name, family, words, shape in _shapes(ticks, limits.refresh, unit):
        shares = _stacked(name, shape, ticks, resting, rng)
        drives.append(Candidate(name, family, words, _command(limits, shares)))
    for axis in range(axes if axes > 1 else 0):
        for name, shape in ((PLAIN, _step), ("binary, every refresh", _binary(1))):
            alone = np.tile(resting, (ticks, 1))
            alone[:, axis] = shape(ticks, resting[axis], rng)
            drives.append(
                Candidate(
                    f"{name}, axis {axis + 1} alone",
                    "one axis",
                    "the other axes rest",
                    _command(limits, alone),
                )
            )
    return tuple(drives)


def _resting(limits: Limits) -> Vector:
    """Position of rest in each range, (axes,) [-]."""
    return np.asarray((limits.rest - limits.near) / (limits.far - limits.near))


def _stacked(name: str, shape: Shape, ticks: int, resting: Vector, rng: np.random.Generator) -> Matrix:
    """Positions of all axes, (ticks, axes)."""
    axes = resting.size
    out = np.tile(resting, (ticks, 1))
    for axis in range(axes):
        begin = axis * ticks // axes if name == PLAIN else axis * ticks // (3 * axes)
        out[begin:, axis] = shape(ticks - begin, resting[axis], rng)
    return out


def _command(limits: Limits, shares: Matrix) -> Command:
    """Positions in each range as a command; only refreshes at which some axis changes are kept."""
    levels = limits.near + shares * (limits.far - limits.near)
    levels = np.where(shares == _resting(limits), limits.rest, levels)  # to the last bit
    moved = (np.diff(levels, axis=0, prepend=limits.rest[None]) != 0).any(axis=1)
    times = np.round(limits.refresh * np.arange(shares.shape[0]), 9)
    return Command(times[moved], levels[moved], limits.rest)


def _shapes(ticks: int, refresh: float, unit: str) -> Iterator[tuple[str, str, str, Shape]]:
    """Name, family, words and shape of every kind of drive that has room in `ticks`."""
    whole = f"{ticks * refresh:.4g} {unit}"
    yield PLAIN, "step", f"on at 0 and held for {whole}", _step
    holds = sorted({max(1, ticks // k) for k in (2, 8, 32, 128)})
    for hold in reversed(holds):
        dwell = f"{hold * refresh:.4g} {unit}"
        yield f"on/off, {dwell}", "on/off", f"on for {dwell}, off for as long, repeated", _square(hold)
    if ticks >= 2 * _LEVELS:
        words = f"1/{_LEVELS}, 2/{_LEVELS}, ... of the step from rest, each followed by as long a rest"
        yield "amplitude series", "amplitude series", words, _series
        words = f"up and down in {_LEVELS} steps over the whole time"
        yield "staircase", "staircase", words, _staircase
    for hold in (1, 4, 16):
        if ticks >= 4 * hold:
            dwell = f"{hold * refresh:.4g} {unit}"
            name = "binary, every refresh" if hold == 1 else f"binary, {dwell}"
            yield name, "pseudo-random binary", f"low or high, drawn anew every {dwell}", _binary(hold)
    if ticks >= 16:
        words = f"low and high by turns, dwells log-uniform from {refresh:.4g} {unit} to a quarter of {whole}"
        yield "telegraph", "random telegraph", words, _telegraph
        words = f"sines from 1/{whole} to a quarter of the refresh rate, log-spaced, Schroeder phases"
        yield "multisine", "multisine", words, _multisine


def _step(ticks: int, rest: float, rng: np.random.Generator) -> Vector:
    return np.ones(ticks)


def _square(hold: int) -> Shape:
    def shape(ticks: int, rest: float, rng: np.random.Generator) -> Vector:
        return np.where(np.arange(ticks) // hold % 2 == 0, 1.0, rest)

    return shape


def _series(ticks: int, rest: float, rng: np.random.Generator) -> Vector:
    part = np.arange(ticks) * 2 * _LEVELS // ticks
    return np.where(part % 2 == 0, rest + (1 - rest) * (part // 2 + 1) / _LEVELS, rest)


def _staircase(ticks: int, rest: float, rng: np.random.Generator) -> Vector:
    part = np.arange(ticks) * 2 * _LEVELS // ticks
    return np.asarray(rest + (1 - rest) * np.minimum(part + 1, 2 * _LEVELS - 1 - part) / _LEVELS)


def _binary(hold: int) -> Shape:
    def shape(ticks: int, rest: float, rng: np.random.Generator) -> Vector:
        bits = rng.integers(0, 2, -(-ticks // hold)).astype(float)
        bits[0] = 1.0  # nothing is learnt before the first change
        return np.repeat(bits, hold)[:ticks]

    return shape


def _telegraph(ticks: int, rest: float, rng: np.random.Generator) -> Vector:
    """Dwells log-uniform between one refresh and a quarter of the time."""
    out, at, level = np.empty(ticks), 0, 1.0
    while at < ticks:
        dwell = max(1, round(float(np.exp(rng.uniform(0.0, np.log(ticks / 4))))))
        out[at : at + dwell] = level
        at, level = at + dwell, 1.0 - level
    return out


def _multisine(ticks: int, rest: float, rng: np.random.Generator) -> Vector:
    """Equal lines at log-spaced harmonics (Schroeder 1970, IEEE Trans. Inf. Theory 16), filling 0 to 1."""
    harmonics = np.unique(np.round(np.geomspace(1, ticks / 4, _LINES)))
    k = np.arange(harmonics.size)
    turn = 2 * np.pi * np.arange(ticks)[:, None] / ticks * harmonics
    wave = np.cos(turn - np.pi * k * (k + 1) / harmonics.size + rng.uniform(0, 2 * np.pi)).sum(axis=1)
    return np.asarray((wave - wave.min()) / np.ptp(wave))


def template(study: Study, limits: Limits, command: Command, time: float) -> str:
    """A record table (CSV) of a drive for `time` [time unit] with empty responses.

    One row a camera period before time 0 under the resting drive, then one per camera sample; drives change
    only at rows. Filled in, the file is a record of the study.
    """
    ticks = np.arange(-1, max(2, round(time / limits.period)))
    at = np.round(limits.period * ticks, 9)
    drive = command.at(at + 1e-6 * limits.period)
    heads = [f"time_{study.time_unit}"]
    heads += [f"drive_{axis.name}_{axis.unit}" for axis in study.drive_axes]
    heads += [f"response_{axis.name}_{axis.unit}" for axis in study.response_axes]
    empty = "," * len(study.response_axes)
    rows = [
        ",".join(repr(float(value)) for value in (moment, *levels)) + empty
        for moment, levels in zip(at, drive, strict=True)
    ]
    return "\n".join([",".join(heads), *rows]) + "\n"
