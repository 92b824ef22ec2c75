"""Searches for sums of lags that a response axis may be, of every kind that may follow the records best.

Delays are tabulated over all that is asked first and then where they are. A diffusion may stand in place of
the first lag of each path, where it follows the records as well (`inference.diffusion`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.diffusion import KINDS, Kind, diffused
from lcopa_bayes.inference.lagfits import MOST, LagFit, best_of, lag_fits
from lcopa_bayes.inference.lagsum import LagTable, lag_table

_COARSE, FINE = 17, 33
"""Delays tabulated over all that is asked, and where they are."""
_NEAR = 20.0
"""BIC above the least of a number of lags, or of a kind, which is still looked at [-]."""
_LIKELY = 10.0
"""BIC above the least of a kind up to which it has an equal part in the draws [-]."""
_REACH = 10.0
"""Standard deviations of a delay that are tabulated on either side [-]."""


@final
@dataclass(frozen=True, eq=False)
class LagSearch:
    """Least squares of sums of lags for some drives of a `lag_problem` on one response axis."""

    problem: Problem
    axis: int
    drives: tuple[int, ...]
    noise: Vector
    """Its parameters, (names,)."""
    delays: Matrix
    """Ends between which delays are uniform, (paths, 2) [time unit]."""
    near: Matrix
    """Those between which they are tabulated, (paths, 2) [time unit]."""
    kind: Kind = "lags"
    """What the first component of a path is."""
    open_to: tuple[Matrix, ...] = ()
    """Directions along which the samples of each record may lie anywhere, (directions, samples), or none."""

    @classmethod
    def over(
        cls,
        problem: Problem,
        axis: int,
        drives: Sequence[int],
        noise: Vector,
        delays: Matrix,
        kinds: Sequence[Kind] = KINDS,
        open_to: tuple[Matrix, ...] = (),
    ) -> tuple[LagSearch, ...]:
        """Searches over all delays between their ends (paths, 2) [time unit], and again where they are, of
        every kind that may follow the records best; that which does so far is first."""
        table = lag_table(problem, axis, drives, noise, _nodes(delays, _COARSE), open_to)
        fits = {kind: lag_fits(diffused(table, kind)) for kind in kinds}
        level = {kind: best_of(own).bic for kind, own in fits.items()}
        return tuple(
            cls(problem, axis, tuple(drives), noise, delays, _near(table, fits[kind], delays), kind, open_to)
            for kind in sorted(level, key=lambda kind: level[kind])
            if level[kind] < min(level.values()) + _NEAR
        )

    @cached_property
    def table(self) -> LagTable:
        """Responses of the delays that are tabulated."""
        nodes = _nodes(self.near, FINE)
        lags = lag_table(self.problem, self.axis, self.drives, self.noise, nodes, self.open_to)
        return diffused(lags, self.kind)

    @cached_property
    def fits(self) -> tuple[LagFit, ...]:
        """The best with each number of lags."""
        return lag_fits(self.table)

    @property
    def best(self) -> LagFit:
        """With the number of lags that is best by BIC."""
        return best_of(self.fits)

    @property
    def lags(self) -> tuple[int, ...]:
        """Numbers of lags of the draws: that of the best and one more, where there may be so many."""
        best = self.best.lags
        return (best, best + 1) if best < MOST else (best,)

    @property
    def aic(self) -> float:
        """The least Akaike's criterion of these numbers of lags [-]."""
        return min(self.fits[lags - 1].aic for lags in self.lags)

    @property
    def apart(self) -> int:
        """Components of a path that are no lags as all others [-]."""
        return int(self.kind != "lags")


def likely(searches: Sequence[LagSearch]) -> tuple[LagSearch, ...]:
    """Those that follow the records about as well as the best by BIC, which is first."""
    ranked = sorted(searches, key=lambda one: one.best.bic)
    return tuple(one for one in ranked if one.best.bic < ranked[0].best.bic + _LIKELY)


def _near(table: LagTable, fits: Sequence[LagFit], delays: Matrix) -> Matrix:
    """Ends between which delays are, (paths, 2): those of every likely number of lags and around."""
    best = best_of(fits)
    places = np.array([one.coordinates[-table.paths :] for one in fits if one.bic < best.bic + _NEAR])
    reach = (
        _REACH * np.sqrt(np.diag(best.covariance)[-table.paths :]) + table.delays[:, 1] - table.delays[:, 0]
    )
    low = np.maximum(places.min(axis=0) - reach, delays[:, 0])
    return np.stack([low, np.minimum(places.max(axis=0) + reach, delays[:, 1])], axis=1)


def _nodes(ends: Matrix, count: int) -> Matrix:
    """Equally spaced delays between ends (paths, 2), (paths, count)."""
    return np.asarray(ends[:, :1] + (ends[:, 1:] - ends[:, :1]) * np.linspace(0, 1, count))
