"""Records described by sums of lagged drives, before any plant is assumed.

The drives of a record behind first-order lags of fixed time constants, with one delay: a linear plant without
ringing is near such a sum whatever its structure, and the sum is linear in its coefficients.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple, final

import numpy as np
from scipy import signal
from scipy.optimize import minimize_scalar

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.core.covariance import covariance_of
from lcopa_bayes.data.drive import axis_drives
from lcopa_bayes.data.record import Record

FOLLOWED = 0.7
"""Share of a response's variance from which a description follows it [-]."""
_DELAYS = 12
"""Delays that are tried either way."""
_LONGEST = 0.3
"""Longest delay, over the span of the record [-]."""
_SAMPLES, _CHANGES = 1_500, 20_000
"""Samples of a record that are described, and changes of a drive that act on them, at most."""
_FEWEST = 20
"""Samples of an axis without which it is not described."""
_AT_REST = 8
"""Samples before the first change of a drive that show whether a response rests there, at least [-]."""
_NEAR = 1e-3
"""Accuracy of a delay, over the step between those that are tried [-]."""
_PRIOR = 30.0
"""Standard deviation of a coefficient, over the ranges of response and lagged drive [-]."""
_RHO = 0.99
"""Largest correlation of noise from sample to sample [-]."""
_EXACT = 1e-12
"""Least variance of noise, over the square of the response's range [-]."""


@final
class Followed(NamedTuple):
    """How a description follows a response axis."""

    delay: float
    """Of the least misfit, 0 where nothing is followed [time unit]."""
    misfit: float
    """Residual variance with it, over the variance of the response [-]."""
    other: float
    """The least one of delays of the other sign [-]."""
    rests: bool
    """Whether the response rests before a drive first changes, where an advance of that size moves it."""


@final
class Described:
    """A record as a sum of lagged drives."""

    def __init__(self, record: Record, lags: Vector) -> None:
        self.record = record
        self.lags = lags
        self.drives = axis_drives(record)
        self.moving = tuple(j for j, drive in enumerate(self.drives) if drive.moves)
        self._states = {j: self._after_changes(j) for j in self.moving}
        last = min(
            [np.inf, *(self._states[j][0][-1] for j in self.moving if self.drives[j].times.size > _CHANGES)]
        )
        rows = np.flatnonzero(np.isfinite(record.response).any(axis=1) & (record.time < last))
        self.rows = rows[:: max(1, -(-rows.size // _SAMPLES))]
        self.time = record.time[self.rows]
        self.response = record.response[self.rows]

    def _after_changes(self, j: int) -> tuple[Vector, Vector, Matrix]:
        """Times of changes, the drive after each, and the drive behind the lags at each, (changes, lags)."""
        drive = self.drives[j]
        times, values = drive.times[:_CHANGES], drive.values[:_CHANGES]
        kept = np.exp(-np.diff(times)[:, None] / self.lags)
        states = np.zeros((times.size, self.lags.size))
        for k in range(1, times.size):
            states[k] = values[k - 1] + (states[k - 1] - values[k - 1]) * kept[k - 1]
        return times, values, states

    @cached_property
    def delays(self) -> Vector:
        """Delays that are tried, increasing [time unit]: negative ones, by which a response runs ahead, none
        and positive ones; among them those at which a response correlates most with a drive."""
        span, period = float(np.ptp(self.time)), float(np.median(np.diff(self.time)))
        steps = np.geomspace(0.5 * period, _LONGEST * span, _DELAYS)
        tried = np.unique([*-steps, 0.0, *steps, *self._correlated(_LONGEST * span)])
        return np.asarray(tried[np.abs(tried) <= _LONGEST * span])

    def _correlated(self, longest: float) -> Iterator[float]:
        """Delays either way up to `longest` at which a response correlates most with a drive, as they are
        and less each lag, which the description adds again [time unit]."""
        grid = np.linspace(self.time[0], self.time[-1], _SAMPLES)
        lags = signal.correlation_lags(grid.size, grid.size) * (grid[1] - grid[0])
        for j in self.moving:
            times, values = self.drives[j].times, np.append(0.0, self.drives[j].values)
            drive = values[np.searchsorted(times, grid, side="right")]
            for axis in filter(self.sampled, range(self.response.shape[1])):
                seen = np.isfinite(self.response[:, axis])
                response = np.interp(grid, self.time[seen], self.response[seen, axis])
                power = np.abs(signal.correlate(response - response.mean(), drive - drive.mean()))
                for side in ((lags > 0) & (lags <= longest), (lags < 0) & (lags >= -longest)):
                    yield from lags[side][np.argmax(power[side])] - np.append(0.0, self.lags)

    def lagged(self, j: int, delay: float) -> Matrix:
        """The deviation of a drive behind every lag, later by a delay, (samples, lags) [drive unit]."""
        out = np.zeros((self.time.size, self.lags.size))
        if j not in self._states:
            return out
        times, values, states = self._states[j]
        at = np.searchsorted(times, self.time - delay, side="right") - 1
        on = at >= 0
        past = (self.time[on] - delay - times[at[on]])[:, None]
        level = values[at[on]][:, None]
        out[on] = level + (states[at[on]] - level) * np.exp(-past / self.lags)
        return out

    def columns(self, delay: float) -> Array:
        """All drives behind every lag, (samples, drives, lags) [drive unit]."""
        return np.stack([self.lagged(j, delay) for j in range(len(self.drives))], axis=1)

    def sampled(self, axis: int) -> bool:
        """Whether an axis has samples enough, which move."""
        seen = self.response[np.isfinite(self.response[:, axis]), axis]
        return bool(seen.size >= _FEWEST and np.ptp(seen) > 0.0)

    def misfit(self, axis: int, delay: float) -> float:
        """Residual variance of the description of an axis over that of the response [-], of the samples whose
        drive is known; 1 where these do not move."""
        known = (self.time - delay <= self.record.time[-1]) & np.isfinite(self.response[:, axis])
        if known.sum() < _FEWEST or not np.ptp(self.response[known, axis]) > 0.0:
            return 1.0
        columns = self.columns(delay).reshape(self.time.size, -1)
        return LaggedSum.of(columns[known], self.response[known, axis]).misfit

    @cached_property
    def best(self) -> tuple[Followed, ...]:
        """Of every sampled axis."""
        return tuple(self._best(axis) for axis in range(self.response.shape[1]) if self.sampled(axis))

    def _best(self, axis: int) -> Followed:
        late, early = (self._nearby(axis, self.delays[side]) for side in (self.delays >= 0, self.delays < 0))
        (delay, misfit), (_, other) = sorted((late, early), key=lambda one: one[1])
        followed = misfit <= 1 - FOLLOWED
        rests = followed and delay < 0.0 and self._rests(axis, -delay)
        return Followed(delay if followed else 0.0, misfit, other, rests)

    def _rests(self, axis: int, lead: float) -> bool:
        """Whether the samples of an axis within a `lead` [time unit] before the first change of a drive, of
        which there are enough, are closer to their mean than to the description with that advance."""
        first = min(self.drives[j].times[0] for j in self.moving)
        seen = np.isfinite(self.response[:, axis])
        before = seen & (first - lead <= self.time) & (self.time < first)
        if np.count_nonzero(before) < _AT_REST:
            return False
        columns, response = self.columns(-lead).reshape(self.time.size, -1), self.response[:, axis]
        left = response - columns @ LaggedSum.of(columns, response).coefficients
        return bool(np.var(response[before]) < np.mean((left[before] - left[seen].mean()) ** 2))

    def _nearby(self, axis: int, delays: Vector) -> tuple[float, float]:
        """The delay of the least misfit among some and between its neighbours [time unit]; that misfit."""
        tried = [self.misfit(axis, delay) for delay in delays]
        k = int(np.argmin(tried))
        ends = float(delays[max(0, k - 1)]), float(delays[min(k + 1, delays.size - 1)])
        refined = minimize_scalar(
            partial(self.misfit, axis),
            bounds=ends,
            method="bounded",
            options={"xatol": _NEAR * (ends[1] - ends[0])},
        )
        return min(
            (float(refined.x), float(refined.fun)), (float(delays[k]), tried[k]), key=lambda one: one[1]
        )


@final
@dataclass(frozen=True, eq=False)
class LaggedSum:
    """Coefficients of a response in columns and a level, under noise correlated from sample to sample."""

    coefficients: Vector
    """(columns,) without the level."""
    covariance: Matrix
    """(columns, columns)."""
    misfit: float
    """Residual variance over that of the response [-]."""
    span: float
    """Range of the response."""

    @classmethod
    def of(cls, columns: Matrix, response: Vector) -> LaggedSum:
        """Of columns (n, k) and samples (n,), NaN where not taken: least squares, then under that noise."""
        seen = np.isfinite(response)
        x, y = columns[seen], response[seen] - response[seen].mean()
        reach = np.ptp(x, axis=0)
        used = np.flatnonzero(reach > 0.0)
        scale = np.append(np.ptp(y) / reach[used], 1.0)
        full = scale * np.column_stack([x[:, used], np.ones(y.size)])
        precision = np.append(np.full(used.size, _PRIOR**-2), 0.0)
        rho, variance = 0.0, float(y @ y) / y.size
        for _ in range(2):
            white, target = _whitened(full, rho), _whitened(y, rho)
            inverse = covariance_of(white.T @ white / variance + np.diag(precision))
            solved = inverse @ (white.T @ target) / variance
            residual = y - full @ solved
            power = float(residual @ residual)
            rho = float(residual[1:] @ residual[:-1]) / power if power > 0.0 else 0.0
            rho = min(max(rho, 0.0), _RHO)
            variance = max(float(np.mean(_whitened(residual, rho) ** 2)), _EXACT * float(np.ptp(y)) ** 2)
        coefficients, covariance = np.zeros(reach.size), np.zeros((reach.size, reach.size))
        coefficients[used] = (scale * solved)[:-1]
        covariance[np.ix_(used, used)] = (np.outer(scale, scale) * inverse)[:-1, :-1]
        return cls(coefficients, covariance, power / float(y @ y), float(np.ptp(y)))


def _whitened(values: Array, rho: float) -> Array:
    """Innovations of columns or samples (n, ...), of the variance of the last ones."""
    first = np.sqrt(1 - rho**2) * values[:1]
    return np.concatenate((first, values[1:] - rho * values[:-1]))
