"""Profile likelihood: how far one parameter may move while all others compensate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, final

import numpy as np
from scipy.stats import chi2, t

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.estimate import LEVEL, attributes, plain
from lcopa_bayes.inference.likelihood import Landscape, Peak
from lcopa_bayes.inference.posterior import Posterior

LEVELS = (0.68, LEVEL, 0.95)
"""Two-sided levels at which intervals are read [-]."""
_BEYOND = 1.3
"""Fall at which a sequence of points ends, relative to that of the largest level [-]."""
_STRIDE = 0.4
"""Wanted change of the root of the fall per step [-]."""
_MOST_POINTS = 30
"""Most steps in one direction."""
_LONGEST = 1 / 8
"""Longest step, relative to the search [-]."""
_GAP = 1 / 12
"""Widest gap between points inside, relative to the search [-]."""
_HALVINGS = 3
_AT_TOP = 0.01
"""A point within this fall is not optimised again [nat]."""
_AGAIN = 25
"""Evaluations of a second attempt at a point."""
_MOVED = 0.1
"""Movement of another parameter along the profile, relative to its search, that is reported [-]."""
_FAR = 3
"""Draws beyond the last point from which another mode is sought."""


@final
@dataclass(frozen=True)
class Freedom:
    """Numbers of samples and of fitted parameters."""

    samples: int
    fitted: int
    """Parameters of the plant."""
    scale_known: bool
    """Whether the noise scale is fixed."""

    @classmethod
    def of(cls, posterior: Posterior) -> Freedom:
        """Of a posterior's likelihood; samples of all axes count as one."""
        free = [row for row in posterior.table.rows if row.free]
        plant = sum(not row.noise for row in free)
        return cls(posterior.size, plant, not any(row.declared.noise == "scale" for row in free))

    def fall_at(self, level: float) -> float:
        """Fall of twice the log likelihood at the ends of a two-sided interval of one parameter [nat].

        With n samples, nu = n - fitted and Student's t, ``n log(1 + t_nu^2 / nu)``: exact for responses
        linear in the parameters and white noise of one unknown scale, where the likelihood ratio is a
        function of Student's t. The quantile of chi^2 is its limit for many samples; with 20 samples and 5
        parameters an interval of 90 % that is read at the quantile holds the truth in 83 %.
        """
        degrees = self.samples - self.fitted
        if self.scale_known or degrees < 1:
            return float(chi2.ppf(level, 1))
        return self.samples * float(np.log1p(t.ppf((1 + level) / 2, degrees) ** 2 / degrees))


@final
@dataclass(frozen=True, eq=False)
class Profile:
    """Largest likelihood at each value of one parameter.

    Confidence intervals hold where ``2 (max L - L)`` is below `Freedom.fall_at` (Venzon and Moolgavkar 1988,
    Applied Statistics 37); a side is open when the fall does not reach it before the end of the search (Raue
    et al. 2009, Bioinformatics 25).
    """

    parameter: str
    unit: str
    coordinates: Vector
    """Points of the profile on the sampled scale, increasing, (n,)."""
    values: Vector
    """The same in `unit`, (n,)."""
    log_likelihood: Vector
    """Profile there, (n,) [nat]."""
    best: float
    """Largest log likelihood known [nat]."""
    at_bound: tuple[str, ...]
    """Other parameters that are at an end of their search within the widest interval."""
    ends: tuple[float, float]
    """Ends of the search, in `unit`."""
    moving: tuple[str, ...]
    """Other parameters that move within that interval to compensate the change, farthest first."""
    top: Vector
    """Table values of the highest point, (rows,)."""
    freedom: Freedom

    @property
    def fall(self) -> Vector:
        """``2 (max L - L)``, (n,) [nat]."""
        return np.maximum(2 * (self.best - self.log_likelihood), 0.0)

    def holding(self, peak: Peak, coordinate: float, value: float) -> Profile:
        """With a maximum at a value of the parameter as one of its points, where it is higher than all of
        them."""
        if peak.log_likelihood <= self.best:
            return self
        others = self.coordinates != coordinate
        at = np.append(self.coordinates[others], coordinate)
        order = np.argsort(at)
        return replace(
            self,
            coordinates=at[order],
            values=np.append(self.values[others], value)[order],
            log_likelihood=np.append(self.log_likelihood[others], peak.log_likelihood)[order],
            best=peak.log_likelihood,
            top=peak.values,
        )

    @cached_property
    def intervals(self) -> Mapping[float, tuple[float | None, float | None]]:
        """Lower and upper end by level, in `unit`; None is open."""
        return {level: (self._end(level, -1), self._end(level, 1)) for level in LEVELS}

    def _end(self, level: float, side: int) -> float | None:
        """Outermost crossing on a side, linear in the root of the fall; None when there is none."""
        u, root = self.coordinates[::side], np.sqrt(self.fall)[::side]
        wanted = np.sqrt(self.freedom.fall_at(level))
        inside = np.flatnonzero(root <= wanted)
        last = int(inside[-1])
        if last == u.size - 1:
            return None
        share = (wanted - root[last]) / (root[last + 1] - root[last])
        at = u[last] + share * (u[last + 1] - u[last])
        return float(np.interp(at, self.coordinates, self.values))

    @property
    def open_sides(self) -> tuple[str, ...]:
        """Which sides are open at `LEVEL`."""
        lower, upper = self.intervals[LEVEL]
        return tuple(side for side, end in (("below", lower), ("above", upper)) if end is None)

    def said_end(self, side: int) -> str:
        """An end of the search as the study states it, without the margin of 1e-6 that is kept from it."""
        linear = bool(np.all(self.coordinates == self.values))
        at = self.ends[side]
        return f"{0.0 if linear and abs(at) < 1e-5 * np.ptp(self.ends) else at:.4g}"

    @property
    def parts(self) -> int:
        """Number of separate stretches of the interval at `LEVEL`."""
        inside = self.fall <= self.freedom.fall_at(LEVEL)
        return int(inside[0]) + int(np.sum(inside[1:] & ~inside[:-1]))

    def as_json(self) -> dict[str, Any]:
        """Plain values; an open side is None."""
        lower, upper = self.intervals[LEVEL]
        return plain(
            {
                "lower": lower,
                "upper": upper,
                "level": LEVEL,
                "interval": "profile likelihood",
                "levels": [
                    {"level": level, "lower": ends[0], "upper": ends[1]}
                    for level, ends in self.intervals.items()
                ],
                "searched": self.ends,
                "nuisance_at_bound": self.at_bound,
                "nuisance_moving": self.moving,
                **attributes(self, "parts", "values", "fall"),
            }
        )


def profile(landscape: Landscape, k: int, peak: Peak, witnesses: Matrix, first_step: float) -> Profile:
    """Profile of the parameter at table position `k` from the maximum `peak`.

    Points to both sides with steps that follow the fall, each started from the previous point; then again,
    each from its outer neighbour; then each from the best of `witnesses` (draws, rows) near it. Where a
    draw beyond the last point is nearly as likely as the maximum, the sequence continues from there.
    """
    return _Path(landscape, k, peak, witnesses).run(first_step)


@final
class _Path:
    """Points of one profile under construction."""

    def __init__(self, landscape: Landscape, k: int, peak: Peak, witnesses: Matrix) -> None:
        self.landscape, self.k, self.peak = landscape, k, peak
        self.low, self.high = landscape.search(k)
        self.freedom = Freedom.of(landscape.posterior)
        self.beyond = _BEYOND * self.freedom.fall_at(max(LEVELS))
        at = min(max(landscape.coordinate(k, peak.values[k]), self.low), self.high)
        self.points: dict[float, Peak] = {at: peak}
        self.begun: dict[float, list[Peak]] = {}  # neighbours that a point was searched from
        self.start = at
        self.witnesses = witnesses
        self.where = landscape.column(k, witnesses) if witnesses.size else np.empty(0)
        self.likely = landscape.log_likelihood(witnesses) if witnesses.size else np.empty(0)

    def run(self, first_step: float) -> Profile:
        """Both directions, each point again from its neighbours, then from the draws."""
        for side in (-1, 1):
            self.extend(self.start, side, first_step)
            self.seek(side)
        self.refine()
        if self.landscape.precision is None:  # else of one mode, and from the posterior itself at the end
            self.from_neighbours()
            self.from_draws()
            self.extend_ends()
            self.refine()
        else:
            points = list(self.points.values())
            levels = self.landscape.exact(np.array([point.values for point in points])).tolist()
            renewed = [Peak(point.values, level) for point, level in zip(points, levels, strict=True)]
            self.points = dict(zip(self.points, renewed, strict=True))
        return self.profile()

    def solve(self, u: float, start: Vector, *, most: int = 60) -> Peak:
        """Maximum with the parameter held at coordinate `u`."""
        begin = start.copy()
        begin[self.k] = self.landscape.value(self.k, u)
        return self.landscape.maximise(begin, held=self.k, most=most)

    def improve(self, u: float, start: Vector) -> None:
        """Keep the optimum from another start at a point where it is better; points near the top are
        skipped."""
        if self.fall(self.points[u]) < _AT_TOP:
            return
        solved = self.solve(u, start, most=_AGAIN)
        if solved.log_likelihood > self.points[u].log_likelihood:
            self.points[u] = solved

    def fall(self, point: Peak) -> float:
        """Fall of twice the log likelihood below the best point [nat]."""
        best = max(known.log_likelihood for known in self.points.values())
        return max(2 * (best - point.log_likelihood), 0.0)

    def extend(self, start: float, side: int, step: float) -> None:
        """From a point outwards until the likelihood has fallen or the search ends."""
        u, here = start, self.points[start]
        end, width = (self.low if side < 0 else self.high), self.high - self.low
        step = min(max(step, 1e-9 * width), _LONGEST * width)
        before: tuple[float, Peak] | None = None
        for _ in range(_MOST_POINTS):
            if u == end or self.fall(here) > self.beyond:
                return
            ahead = u + side * step
            if side * (end - ahead) < 0.2 * step:
                ahead = end
            solved = self.solve(ahead, self._ahead(here, u, before, ahead))
            self.begun[ahead] = [here]
            moved = abs(np.sqrt(self.fall(solved)) - np.sqrt(self.fall(here)))
            if moved > 3 * _STRIDE and abs(ahead - u) > 1e-7 * width:
                step = 0.4 * abs(ahead - u)
                self.points[ahead] = solved  # kept: it may already bracket a level
                continue
            before, u, here = (u, here), ahead, solved
            self.points[u] = here
            step = min(step * float(np.clip(_STRIDE / max(moved, 1e-9), 0.4, 2.5)), _LONGEST * width)
        self.points.setdefault(end, self.solve(end, here.values))

    def refine(self) -> None:
        """Points in between where the profile changes much or neighbours are far apart."""
        for _ in range(_HALVINGS):
            at = sorted(self.points)
            for a, b in pairwise(at):
                falls = [self.fall(self.points[u]) for u in (a, b)]
                step = abs(np.sqrt(falls[0]) - np.sqrt(falls[1]))
                steep = step > 1.5 * _STRIDE and min(falls) < self.beyond
                far = b - a > _GAP * (self.high - self.low) and max(falls) < self.beyond
                if (steep or far) and b - a > 1e-6 * (self.high - self.low):
                    middle = 0.5 * (a + b)
                    self.begun[middle] = [self.points[u] for u in (a, b)]
                    tried = [self.solve(middle, start.values) for start in self.begun[middle]]
                    self.points[middle] = max(tried, key=lambda peak: peak.log_likelihood)

    def _ahead(self, here: Peak, u: float, before: tuple[float, Peak] | None, ahead: float) -> Vector:
        """Start for the next point: the other parameters extrapolated linearly."""
        if before is None or before[0] == u:
            return here.values
        share = float(np.clip((ahead - u) / (u - before[0]), 0.0, 2.0))
        out = here.values.copy()
        for k in self.landscape.least.columns:
            if k == self.k:
                continue
            low, high = self.landscape.search(k)
            x, old = (self.landscape.coordinate(k, values[k]) for values in (here.values, before[1].values))
            out[k] = self.landscape.value(k, min(max(x + share * (x - old), low), high))
        return out

    def seek(self, side: int) -> None:
        """Another mode beyond the last point, where draws indicate one."""
        last = max(self.points) if side > 0 else min(self.points)
        best = max(point.log_likelihood for point in self.points.values())
        far = (side * (self.where - last) > 0) & (2 * (best - self.likely) < 4 * self.beyond)
        far &= (self.where > self.low) & (self.where < self.high)
        ranked = np.flatnonzero(far)[np.argsort(-self.likely[far])][:_FAR]
        extreme = np.flatnonzero(far)[np.argsort(-side * self.where[far])][:1]
        for index in dict.fromkeys([*ranked, *extreme]):
            u = float(self.where[index])
            if side * (u - last) <= 0:
                continue
            solved = self.solve(u, self.witnesses[index])
            self.points[u] = solved
            if self.fall(solved) < self.beyond:
                step = abs(u - last) / 4
                self.extend(u, -side, step) if abs(u - last) > 0 else None
                self.extend(u, side, step)
                last = max(self.points) if side > 0 else min(self.points)

    def from_neighbours(self) -> None:
        """Every point once more from its neighbour, from either end through to the other; not from what it
        was searched from before."""
        for at in (sorted(self.points), sorted(self.points, reverse=True)):
            for near, far in pairwise(at):
                if self.points[near] not in self.begun.get(far, ()):
                    self.improve(far, self.points[near].values)

    def from_draws(self) -> None:
        """Every point once more from the most likely draw near it."""
        if not self.where.size:
            return
        at = np.array(sorted(self.points))
        edges = np.concatenate(([-np.inf], 0.5 * (at[1:] + at[:-1]), [np.inf]))
        for u, a, b in zip(at, edges[:-1], edges[1:], strict=True):
            near = np.flatnonzero((self.where >= a) & (self.where < b))
            if near.size:
                self.improve(float(u), self.witnesses[near[np.argmax(self.likely[near])]])

    def extend_ends(self) -> None:
        """Further outwards where the outermost point has improved and is now inside."""
        for side, end in ((-1, self.low), (1, self.high)):
            last, before = sorted(self.points, key=lambda u: -side * u)[:2]
            if last != end and self.fall(self.points[last]) < self.beyond:
                self.extend(last, side, abs(last - before) / 2)

    def profile(self) -> Profile:
        """The profile through the points."""
        row = self.landscape.posterior.table.rows[self.k]
        at = np.array(sorted(self.points))
        peaks = [self.points[u] for u in at]
        best = max(point.log_likelihood for point in peaks)
        widest = self.freedom.fall_at(max(LEVELS))
        inside = [point for point in peaks if 2 * (best - point.log_likelihood) < widest]
        flagged = dict.fromkeys(
            name for point in inside for name in self.landscape.at_bound(point.values, but=self.k)
        )
        range_of = {
            self.landscape.posterior.table.names[k]: np.ptp(
                self.landscape.column(k, np.array([point.values for point in inside]))
            )
            / np.subtract(*self.landscape.search(k)[::-1])
            for k in self.landscape.free
            if k != self.k
        }
        moving = sorted((n for n in range_of if range_of[n] > _MOVED), key=lambda n: -range_of[n])
        ends = (self.landscape.value(self.k, self.low), self.landscape.value(self.k, self.high))
        return Profile(
            row.name,
            row.unit,
            at,
            np.array([self.landscape.value(self.k, u) for u in at]),
            np.array([point.log_likelihood for point in peaks]),
            best,
            tuple(flagged),
            ends,
            tuple(moving),
            max(peaks, key=lambda point: point.log_likelihood).values,
            self.freedom,
        )
