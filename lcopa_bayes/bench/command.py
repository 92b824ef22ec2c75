"""Drive schedules: what an experimenter commands, and when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import ArrayLike

from lcopa_bayes.core.arrays import Array, Matrix, Vector, frozen
from lcopa_bayes.core.errors import InputError


@final
@dataclass(frozen=True, eq=False)
class Command:
    """Piecewise constant drive: `rest` before ``times[0]``, then ``values[i]`` from ``times[i]`` on."""

    times: Vector
    """Instants of change [ms], (n_changes,), increasing; may be empty."""
    values: Matrix
    """Drive from each instant on [drive unit], (n_changes, n_drives)."""
    rest: Vector
    """Drive before the first instant [drive unit], (n_drives,); the device rests under it."""

    def __post_init__(self) -> None:
        for name, ndim in (("times", 1), ("values", 2), ("rest", 1)):
            object.__setattr__(self, name, frozen(getattr(self, name), name=name, ndim=ndim))

    @property
    def jumps(self) -> Matrix:
        """Change of the drive at each instant [drive unit], (n_changes, n_drives)."""
        return np.diff(self.values, axis=0, prepend=self.rest[None, :])

    def at(self, time: ArrayLike) -> Matrix:
        """Drive at the times [ms], (n, n_drives) [drive unit]; a change counts from its own instant on."""
        levels = np.vstack([self.rest, self.values])
        return np.asarray(levels[np.searchsorted(self.times, np.asarray(time, dtype=float), side="right")])

    def refreshed(self, period: float) -> Command:
        """The command as a device obeys it that looks only at multiples of `period` [ms]; 0: at once.

        A change acts at the first multiple not before it; of several that fall to one multiple the
        last one acts. An instant within 1e-9 periods after a multiple counts as on it.
        """
        if period == 0:
            return self
        ticks = np.ceil(self.times / period - 1e-9)
        last = np.append(np.diff(ticks) > 0, True) if ticks.size else np.zeros(0, dtype=bool)
        return Command(period * ticks[last], self.values[last], self.rest)


def _levels(values: ArrayLike, *, name: str) -> Vector:
    return frozen(np.atleast_1d(np.asarray(values, dtype=float)), name=name)


def quiet(rest: ArrayLike = 0.0) -> Command:
    """No change at all: the drive stays at `rest` [drive unit], one number per axis."""
    level = _levels(rest, name="rest")
    return Command(np.empty(0), np.empty((0, level.size)), level)


def step(level: ArrayLike, *, at: float = 0.0, rest: ArrayLike = 0.0) -> Command:
    """From `rest` to `level` [drive unit, one number per axis] at the time `at` [ms]."""
    return staircase([level], hold=np.inf, start=at, rest=rest)


def on_off(level: ArrayLike, *, hold: float, at: float = 0.0, rest: ArrayLike = 0.0) -> Command:
    """From `rest` to `level` [drive unit, one number per axis] at `at` and back after `hold` [ms]."""
    back = np.broadcast_to(_levels(rest, name="rest"), _levels(level, name="level").shape)
    return staircase([level, back], hold=hold, start=at, rest=rest)


def staircase(
    levels: Sequence[ArrayLike], *, hold: float, start: float = 0.0, rest: ArrayLike = 0.0
) -> Command:
    """One level [drive unit, one number per axis] after another, each held for `hold` > 0 [ms].

    The first begins at `start` [ms], the last one stays. `rest` may be one number for all axes.
    """
    values = np.array([_levels(level, name="levels") for level in levels])
    if not (values.ndim == 2 and hold > 0):
        raise InputError(f"a staircase needs at least one level and a hold above 0; got {levels} and {hold}")
    times = start + np.append(0.0, hold * np.arange(1.0, len(values)))
    return Command(times, values, np.broadcast_to(_levels(rest, name="rest"), values.shape[1:]))


def prbs(
    low: ArrayLike,
    high: ArrayLike,
    *,
    hold: float,
    duration: float,
    rng: np.random.Generator,
    start: float = 0.0,
    rest: ArrayLike | None = None,
) -> Command:
    """Random binary drive: every `hold` [ms] each axis draws `low` or `high` [drive unit] anew, evenly.

    Axes are independent; only instants at which an axis changes are kept. The drive rests at `rest`
    (default `low`) before `start` [ms] and keeps its last level after ``start + duration`` [ms].
    """
    if not 0 < hold <= duration < np.inf:
        raise InputError(f"need 0 < hold <= duration; got hold {hold} and duration {duration}")
    a, b = np.broadcast_arrays(_levels(low, name="low"), _levels(high, name="high"))
    bits = rng.random((int(np.ceil(duration / hold - 1e-9)), a.size)) < 0.5
    values: Array = np.where(bits, b, a)
    before = np.broadcast_to(a if rest is None else _levels(rest, name="rest"), a.shape)
    moved = (np.diff(values, axis=0, prepend=before[None, :]) != 0).any(axis=1)
    return Command((start + hold * np.arange(len(values)))[moved], values[moved], before)


def joint(*commands: Command) -> Command:
    """All commands at once, the drives of the first before those of the next."""
    times = np.unique(np.concatenate([each.times for each in commands]))
    rest = np.hstack([each.rest for each in commands])
    return Command(times, np.hstack([each.at(times) for each in commands]), rest)
