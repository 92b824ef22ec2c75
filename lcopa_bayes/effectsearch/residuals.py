"""The residual of a fit from every side: where it is large, and what it goes with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from scipy import signal, stats

from lcopa_bayes.core.arrays import Flags, Vector
from lcopa_bayes.effectsearch.bandwidening import since_command
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.whitening import Part, parts

_BINS = 12
_LAGS = 60
_SEEN = 1e-3
"""p-value below which a dependence is reported [-]."""
_BANDS = 24


@final
@dataclass(frozen=True, eq=False)
class View:
    """One axis' residual against one thing."""

    name: str
    axis: str
    across: str
    """What is on the horizontal axis, with its unit."""
    along: str
    """What is on the vertical axis, with its unit."""
    x: Vector
    """[unit in `across`]."""
    y: Vector
    """[unit in `along`]."""
    error: Vector
    """Standard error of `y` if the residual were noise [unit in `along`]."""
    sentence: str

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return dict(vars(self))


@final
@dataclass(frozen=True, eq=False)
class _Axis:
    """Samples of one axis."""

    name: str
    parts: tuple[Part, ...]
    white: Vector
    since: Vector
    predicted: Vector
    growing: Flags

    @classmethod
    def of(cls, state: State, axis: int) -> _Axis:
        """Of all records."""
        own, columns = parts(state.whitening.samples, axis), []
        for part in own:
            predicted = state.fitted[part.rows] - state.fitted[part.rows][0]
            growing = np.gradient(np.abs(predicted)) > 0 if predicted.size > 1 else np.array([False])
            since = since_command(part.samples)[part.observed.index]
            columns.append((state.optimum.settled[part.rows], since, predicted, growing))
        name = own[0].samples.record.response_axes[axis].name
        return cls(name, own, *(np.concatenate(each) for each in zip(*columns, strict=True)))


def views(state: State, time_unit: str) -> list[View]:
    """All views of every axis' whitened residual."""
    out: list[View] = []
    for axis, response in enumerate(state.whitening.samples[0].record.response_axes):
        pooled = _Axis.of(state, axis)
        out.append(_by_record(pooled, [state.optimum.settled[part.rows] for part in pooled.parts]))
        out.append(_by_time(pooled, time_unit))
        out += _by_amplitude(pooled, response.unit)
        out.append(_by_direction(pooled))
        out.append(_spectrum(state, pooled, time_unit))
        out.append(_drive(state, pooled))
    return out


def _binned(x: Vector, y: Vector, statistic: Callable[[Vector], float]) -> tuple[Vector, Vector, Vector]:
    """Centres of bins of equal counts, a statistic in each, and the counts."""
    order = np.argsort(x, kind="stable")
    chunks = [c for c in np.array_split(order, _BINS) if c.size > 1]
    return (
        np.array([x[c].mean() for c in chunks]),
        np.array([statistic(y[c]) for c in chunks]),
        np.array([float(c.size) for c in chunks]),
    )


def _power(values: Vector) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _by_record(pooled: _Axis, white: list[Vector]) -> View:
    rms, names = np.array([_power(one) for one in white]), [part.samples.record.name for part in pooled.parts]
    worst = int(np.argmax(rms))
    said = (
        f"largest on record {names[worst]}, {rms[worst]:.2f} times the noise, smallest {rms.min():.2f} times"
    )
    error = np.sqrt(0.5 / np.array([one.size for one in white]))
    across = "record: " + ", ".join(f"{k} {name}" for k, name in enumerate(names))
    x = np.arange(len(names), dtype=float)
    return View("by record", pooled.name, across, "rms over noise [-]", x, rms, error, said)


def _by_time(pooled: _Axis, unit: str) -> View:
    known = np.isfinite(pooled.since)
    x, y, count = _binned(pooled.since[known], pooled.white[known], _power)
    said = "no sample follows a command"
    if y.size:
        top = int(np.argmax(y))
        said = f"largest {x[top]:.3g} {unit} after a command, {y[top]:.2f} times the noise; last {y[-1]:.2f}"
    across = f"time since the last command [{unit}]"
    return View(
        "by time since command", pooled.name, across, "rms over noise [-]", x, y, np.sqrt(0.5 / count), said
    )


def _by_amplitude(pooled: _Axis, unit: str) -> list[View]:
    """Odd and even part: the mean residual along and regardless of the sign of the deflection."""
    size, sign = np.abs(pooled.predicted), np.sign(pooled.predicted)
    out = []
    for name, values in (("odd part", pooled.white * sign), ("even part", pooled.white)):
        x, y, count = _binned(size, values, lambda v: float(np.mean(v)))
        error = 1.0 / np.sqrt(count)
        p = float(stats.chi2.sf(((y / error) ** 2).sum(), max(y.size, 1)))
        goes = "goes with the amplitude" if p < _SEEN else "does not go with the amplitude"
        chance = f"p = {p:.1g}" if p > 0 else "p < 1e-300"
        said = f"the {name} {goes} ({chance}, samples taken as independent)"
        across = f"size of the deflection [{unit}]"
        out.append(View(name, pooled.name, across, "mean over noise [-]", x, y, error, said))
    return out


def _by_direction(pooled: _Axis) -> View:
    growing, known = pooled.growing, np.isfinite(pooled.since)
    sets = [pooled.white[known & growing], pooled.white[known & ~growing]]
    rms = np.array([_power(one) if one.size else np.nan for one in sets])
    error = np.array([np.sqrt(0.5 / one.size) if one.size else np.nan for one in sets])
    said = f"{rms[0]:.2f} times the noise while the deflection grows, {rms[1]:.2f} while it falls"
    across = "0 deflection grows, 1 it falls"
    return View("by direction", pooled.name, across, "rms over noise [-]", np.arange(2.0), rms, error, said)


def _spectrum(state: State, pooled: _Axis, unit: str) -> View:
    """Mean periodogram of the records over that of white noise, in bands of equal logarithmic width."""
    frequencies, powers = [], []
    for part in pooled.parts:
        if part.times.size < 8:
            continue
        rate = 1.0 / float(np.median(np.diff(part.times)))
        f, p = signal.periodogram(state.optimum.settled[part.rows], fs=rate, detrend=False)
        frequencies.append(f[1:])
        powers.append(p[1:] * rate / 2)
    across = f"frequency [cycles per {unit}]"
    if not frequencies:
        empty = np.zeros(0)
        return View(
            "spectrum", pooled.name, across, "power over noise [-]", empty, empty, empty, "records too short"
        )
    f, p = np.concatenate(frequencies), np.concatenate(powers)
    edges = np.geomspace(f.min(), f.max() * (1 + 1e-12), _BANDS + 1)
    which = np.clip(np.searchsorted(edges, f, side="right") - 1, 0, _BANDS - 1)
    count = np.bincount(which, minlength=_BANDS)
    kept = count > 0
    mean = np.bincount(which, weights=p, minlength=_BANDS)[kept] / count[kept]
    centre = np.bincount(which, weights=f, minlength=_BANDS)[kept] / count[kept]
    top = int(np.argmax(mean))
    said = f"largest at {centre[top]:.3g} cycles per {unit}, {mean[top]:.2f} times white noise"
    return View(
        "spectrum", pooled.name, across, "power over noise [-]", centre, mean, 1 / np.sqrt(count[kept]), said
    )


def _drive(state: State, pooled: _Axis) -> View:
    """Largest correlation of the residual with commands up to `_LAGS` samples earlier, over all drives."""
    lags = np.arange(_LAGS + 1)
    total, norm = np.zeros(lags.size), 0.0
    for part in pooled.parts:
        record = part.samples.record
        held = np.searchsorted(record.time, part.times, side="right") - 1
        drive = np.abs(np.diff(record.drive[np.clip(held, 0, None)], axis=0, prepend=record.drive[:1]))
        jumps = drive.sum(axis=1)
        power = state.optimum.settled[part.rows] ** 2
        excess = power - power.mean()
        for k in lags[: jumps.size]:
            total[k] += jumps[: jumps.size - k] @ excess[k:]
        norm += float(power.var() * (jumps**2).sum())
    y = total / np.sqrt(norm) if norm > 0 else total
    p = float(min(1.0, lags.size * 2 * stats.norm.sf(np.abs(y).max())))
    said = (
        f"its power goes with the commands, most {lags[int(np.argmax(np.abs(y)))]} samples after them "
        f"(p = {p:.1g})"
        if p < _SEEN
        else f"its power does not go with the commands (p = {p:.2g})"
    )
    return View(
        "independence from the drive",
        pooled.name,
        "samples after a command [-]",
        "correlation of power over its sd [-]",
        lags.astype(float),
        y,
        np.ones(lags.size),
        said,
    )
