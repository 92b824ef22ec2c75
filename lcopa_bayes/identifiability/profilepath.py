"""The way along a profile: an optimiser at every point, started from its neighbours and from draws."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.identifiability.profile import LEVELS, Freedom, Profile
from lcopa_bayes.inference.likelihood import Landscape, Peak

_BEYOND = 1.3
"""Fall at which a walk ends, relative to that of the largest level [-]."""
_STRIDE = 0.4
"""Wanted change of the root of the fall per step [-]."""
_MOST_POINTS = 30
"""Steps of a walk."""
_LONGEST = 1 / 8
"""Longest step, relative to the search [-]."""
_GAP = 1 / 12
"""Widest gap between points inside, relative to the search [-]."""
_HALVINGS = 3
_AT_TOP = 0.01
"""A point within this fall is as high as it need be [nat]."""
_AGAIN = 25
"""Evaluations of a second attempt at a point."""
_MOVED = 0.1
"""Way of another parameter along the profile, relative to its search, that is told [-]."""
_FAR = 3
"""Draws beyond the end of a walk from which another hill is sought."""


def profile(landscape: Landscape, k: int, peak: Peak, witnesses: Matrix, first_step: float) -> Profile:
    """Profile of the parameter at table position `k` from the maximum `peak`.

    Walks to both sides with steps that follow the fall, each point started from the one before; then back,
    each from its outer neighbour; then each from the best of `witnesses` (draws, rows) near it. Where a
    draw beyond the end of a walk is nearly as likely as the maximum the walk is taken up from there.
    """
    return _Walk(landscape, k, peak, witnesses).run(first_step)


class _Walk:
    """Points of one profile while it is made."""

    def __init__(self, landscape: Landscape, k: int, peak: Peak, witnesses: Matrix) -> None:
        self.landscape, self.k, self.peak = landscape, k, peak
        self.low, self.high = landscape.search(k)
        self.freedom = Freedom.of(landscape.posterior)
        self.beyond = _BEYOND * self.freedom.fall_at(max(LEVELS))
        at = min(max(landscape.coordinate(k, peak.values[k]), self.low), self.high)
        self.points: dict[float, Peak] = {at: peak}
        self.start = at
        self.witnesses = witnesses
        self.where = landscape.column(k, witnesses) if witnesses.size else np.empty(0)
        self.likely = landscape.log_likelihood(witnesses) if witnesses.size else np.empty(0)

    def run(self, first_step: float) -> Profile:
        """Both walks, the way back, the draws."""
        for side in (-1, 1):
            self.walk(self.start, side, first_step)
            self.seek(side)
        self.refine()
        for at in (sorted(self.points), sorted(self.points, reverse=True)):
            for near, far in pairwise(at):  # from either end through to the other
                self.improve(far, self.points[near].values)
        self.from_draws()
        self.carry_on()
        self.refine()
        return self.made()

    def solve(self, u: float, start: Vector, *, most: int = 60) -> Peak:
        """Maximum with the parameter held at coordinate `u`."""
        begin = start.copy()
        begin[self.k] = self.landscape.value(self.k, u)
        return self.landscape.climb(begin, held=self.k, most=most)

    def improve(self, u: float, start: Vector) -> None:
        """Keep what another start finds at a point, where it is better and there is better to be had."""
        if self.fall(self.points[u]) < _AT_TOP:
            return
        found = self.solve(u, start, most=_AGAIN)
        if found.log_likelihood > self.points[u].log_likelihood:
            self.points[u] = found

    def fall(self, point: Peak) -> float:
        """Below the best known."""
        best = max(known.log_likelihood for known in self.points.values())
        return max(2 * (best - point.log_likelihood), 0.0)

    def walk(self, start: float, side: int, step: float) -> None:
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
            found = self.solve(ahead, self._ahead(here, u, before, ahead))
            moved = abs(np.sqrt(self.fall(found)) - np.sqrt(self.fall(here)))
            if moved > 3 * _STRIDE and abs(ahead - u) > 1e-7 * width:
                step = 0.4 * abs(ahead - u)
                self.points[ahead] = found  # kept: it may already bracket a level
                continue
            before, u, here = (u, here), ahead, found
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
                    tried = [self.solve(middle, self.points[u].values) for u in (a, b)]
                    self.points[middle] = max(tried, key=lambda peak: peak.log_likelihood)

    def _ahead(self, here: Peak, u: float, before: tuple[float, Peak] | None, ahead: float) -> Vector:
        """Start for the next point: the others carried on along the way they moved."""
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
        """Another hill beyond the end of the walk, where draws say there is one."""
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
            found = self.solve(u, self.witnesses[index])
            self.points[u] = found
            if self.fall(found) < self.beyond:
                step = abs(u - last) / 4
                self.walk(u, -side, step) if abs(u - last) > 0 else None
                self.walk(u, side, step)
                last = max(self.points) if side > 0 else min(self.points)

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

    def carry_on(self) -> None:
        """Outwards again where the outermost point has been improved and is inside after all."""
        for side, end in ((-1, self.low), (1, self.high)):
            last, before = sorted(self.points, key=lambda u: -side * u)[:2]
            if last != end and self.fall(self.points[last]) < self.beyond:
                self.walk(last, side, abs(last - before) / 2)

    def made(self) -> Profile:
        """What the points say."""
        row = self.landscape.posterior.table.rows[self.k]
        at = np.array(sorted(self.points))
        peaks = [self.points[u] for u in at]
        best = max(point.log_likelihood for point in peaks)
        widest = self.freedom.fall_at(max(LEVELS))
        inside = [point for point in peaks if 2 * (best - point.log_likelihood) < widest]
        flagged = dict.fromkeys(
            name for point in inside for name in self.landscape.at_bound(point.values, but=self.k)
        )
        travelled = {
            self.landscape.posterior.table.names[k]: np.ptp(
                self.landscape.column(k, np.array([point.values for point in inside]))
            )
            / np.subtract(*self.landscape.search(k)[::-1])
            for k in self.landscape.free
            if k != self.k
        }
        moving = sorted((n for n in travelled if travelled[n] > _MOVED), key=lambda n: -travelled[n])
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
