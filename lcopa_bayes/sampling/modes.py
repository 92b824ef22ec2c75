"""Modes of the marginal of a parameter, and how differently the ensembles weigh them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from math import sqrt
from typing import Any, final

import numpy as np
from arviz_stats.base import array_stats  # type: ignore[attr-defined]
from scipy.ndimage import gaussian_filter1d

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector, frozen
from lcopa_bayes.core.estimate import attributes, plain

DEPTH = 0.5
"""The minimum between two modes is below this share of the lower of both [-] ..."""
CERTAINTY = 3.0
"""... by this many Monte Carlo errors [-]."""
LEAST_SHARE = 0.02
"""Smallest share of all draws in a mode [-]: less changes no number by what a grade allows."""
_CELLS = 1024
"""Cells of the grid on which the density is smoothed."""
_TAIL = 0.002
"""Share of the draws beyond each end of the grid [-]."""
_SMOOTHED_AS = (200.0, 2000.0)
"""Effective draws [draws] that the width of smoothing is chosen for, at least and at most: ensembles in
different modes have few, although every mode holds many draws."""
_NARROW = 0.6
"""Width of smoothing over Silverman's [-], which merges modes four standard deviations apart; additional
minima due to noise do not matter, as each has to be certain."""
_COUNT = {2: "two", 3: "three", 4: "four"}


@final
@dataclass(frozen=True, eq=False)
class Modes:
    """Modes of one parameter's marginal, in increasing order; a single mode without boundaries."""

    parameter: str
    unit: str
    boundaries: tuple[float, ...]
    """Minima of the density between them, increasing, in `unit`."""
    shares: Matrix
    """Share of each ensemble's draws in each mode, (ensembles, modes) [-]."""
    errors: Matrix
    """Monte Carlo standard errors of the shares, (ensembles, modes) [-]."""

    def __post_init__(self) -> None:
        for key in ("shares", "errors"):
            object.__setattr__(self, key, frozen(getattr(self, key), name=key, ndim=2))
        modes = len(self.boundaries) + 1
        if self.shares.shape != self.errors.shape or self.shares.shape[1] != modes:
            raise ValueError(f"need a share and an error of {modes} modes; got {self.shares.shape}")

    @property
    def pooled(self) -> Vector:
        """Share of all draws in each mode, (modes,) [-]."""
        return np.asarray(self.shares.mean(axis=0))

    @property
    def pooled_errors(self) -> Vector:
        """Their Monte Carlo standard errors, (modes,) [-]: the errors within ensembles, or the scatter
        between ensembles where that is larger."""
        ensembles = self.shares.shape[0]
        within = np.sqrt(np.sum(self.errors**2, axis=0)) / ensembles
        between = self.shares.std(axis=0, ddof=1) / np.sqrt(ensembles) if ensembles > 1 else 0.0
        return np.asarray(np.maximum(within, between))

    @property
    def ess(self) -> float:
        """Number of independent draws that give a share with the same error, of the least certain mode
        [draws]."""
        share = self.pooled
        return float(np.min(share * (1 - share) / self.pooled_errors**2)) if self.boundaries else np.inf

    @property
    def spread(self) -> float:
        """Largest difference of a mode's share between two ensembles beyond Monte Carlo error [-]: of those
        above `CERTAINTY` standard errors; 0 when there is none."""
        worst = 0.0
        for first, second in combinations(range(self.shares.shape[0]), 2):
            apart = np.abs(self.shares[first] - self.shares[second])
            error = np.hypot(self.errors[first], self.errors[second])
            worst = max([worst, *apart[apart > CERTAINTY * error]])
        return float(worst)

    def as_json(self) -> dict[str, Any]:
        """Plain values; shares by ensemble and mode."""
        return plain(
            {
                **attributes(self, "parameter", "unit", "boundaries", "shares"),
                "shares_mcse": self.errors,
                "pooled": self.pooled,
                "pooled_mcse": self.pooled_errors,
                "spread": self.spread,
                "sentence": self.sentence(),
            }
        )

    def sentence(self) -> str:
        """Number, position and shares of the modes, and the remedy when the ensembles weigh them
        differently."""
        if not self.boundaries:
            return f"one mode of {self.parameter}"
        modes = len(self.boundaries) + 1
        where = " and ".join(f"{boundary:.3g}" for boundary in self.boundaries)
        split = f"below and above {where}" if modes == 2 else f"separated at {where}"
        counted = f"{_COUNT.get(modes, str(modes))} modes of {self.parameter} ({split})"
        if self.spread == 0.0:
            shares = " and ".join(f"{share:.2f}" for share in self.pooled)
            return f"{counted}, shares {shares}, equal in all sets of draws within Monte Carlo error"
        k = int(np.argmax(np.ptp(self.shares, axis=0)))
        which = ("the lower mode" if k == 0 else "the upper mode") if modes == 2 else f"mode {k + 1}"
        low, high = self.shares[:, k].min(), self.shares[:, k].max()
        share = f"share of {which} {low:.2f} to {high:.2f} over independent sets of draws"
        return f"{counted}, {share}: run longer"


def modes_of(parameter: str, unit: str, values: Array, *, log_scale: bool = False) -> Modes:
    """Modes of a parameter's marginal from draws (ensembles, walkers, draws) [unit], as by `boundaries`.

    Errors come from the scatter between walkers; an ensemble that stays in one mode gets that of one
    walker, 1 / walkers. ValueError unless draws are finite, and positive with `log_scale`.
    """
    if values.ndim != 3 or not np.isfinite(values).all() or (log_scale and values.min() <= 0):
        raise ValueError(f"{parameter}: draws must be finite, (ensembles, walkers, draws), positive for logs")
    chains = values.reshape(-1, values.shape[-1])
    ess = float(array_stats.ess(chains, method="bulk")) if np.ptp(chains) > 0 else np.nan  # type: ignore[no-untyped-call]
    edges = boundaries(
        values.ravel(),
        np.full(values.size, 1 / values.size),
        ess,
        lambda each: _batch_error(each.reshape(chains.shape)),
        log_scale=log_scale,
    )
    mode = np.searchsorted(edges, values)
    on = np.stack([mode == k for k in range(len(edges) + 1)]).astype(float)
    shares = on.mean(axis=(2, 3)).T
    errors = np.array([[_error(visits) for visits in ensemble] for ensemble in on.swapaxes(0, 1)])
    return Modes(parameter, unit, edges, shares, errors)


def boundaries(
    values: Vector,
    weights: Vector,
    ess: float,
    error: Callable[[Vector], float],
    *,
    log_scale: bool = False,
) -> tuple[float, ...]:
    """Minima between the modes of a marginal, increasing, from draws with normalised weights, (draws,).

    The draws, by their logarithm with `log_scale`, are smoothed with a Gaussian narrower than Silverman's
    (1986, Density Estimation, Eq. 3.31) for the effective sample size `ess` [draws]. From all minima of that
    density those are removed that cut off less than `LEAST_SHARE` and then, the least certain first, those
    not below `DEPTH` times the lower mode beside them by `CERTAINTY` Monte Carlo errors of that difference.
    `error` gives the Monte Carlo error of the mean of anything known at the draws, (draws,).
    """
    order = np.argsort(values, kind="stable")
    x = np.log(values[order]) if log_scale else values[order]
    cumulative = np.concatenate([[0.0], np.cumsum(weights[order])])
    low, quarter, three_quarters, high = x[
        np.minimum(np.searchsorted(cumulative[1:], [_TAIL, 0.25, 0.75, 1 - _TAIL]), x.size - 1)
    ]
    sd = float(np.sqrt(weights[order] @ (x - weights[order] @ x) ** 2))
    scale = min(sd, float(three_quarters - quarter) / 1.34) or sd
    effective = float(np.clip(ess, *_SMOOTHED_AS)) if ess > 0 else _SMOOTHED_AS[0]
    width = _NARROW * 0.9 * scale * float(effective**-0.2)
    if not (high - low > _CELLS * np.spacing(max(abs(low), abs(high))) and width > 0):
        return ()  # draws that rounding alone tells apart
    counts, edges = np.histogram(x, bins=_CELLS, range=(low, high), weights=weights[order])
    cell = (high - low) / _CELLS
    density = gaussian_filter1d(counts, width / cell, mode="reflect", truncate=5.0)
    centre = 0.5 * (edges[1:] + edges[:-1])
    as_given = np.log(values) if log_scale else values
    bottoms = _bottoms(density)
    while bottoms.size:
        tops = _tops(density, bottoms)
        shares = np.diff(cumulative[np.searchsorted(x, [-np.inf, *centre[bottoms], np.inf])])
        lower = [min(pair, key=lambda at: density[at]) for pair in pairwise(tops)]
        slight = np.flatnonzero(np.minimum(shares[:-1], shares[1:]) < LEAST_SHARE)
        if slight.size:  # the shallowest first: parts of one mode are merged before two modes
            bottoms = np.delete(bottoms, slight[np.argmax((density[bottoms] / density[lower])[slight])])
            continue
        certain = []
        for top, bottom in zip(lower, bottoms, strict=True):
            # ``DEPTH f(top) - f(bottom)`` of the smoothed density over its Monte Carlo error
            kernel = DEPTH * np.exp(-0.5 * ((as_given - centre[top]) / width) ** 2)
            kernel -= np.exp(-0.5 * ((as_given - centre[bottom]) / width) ** 2)
            uncertain = error(kernel)
            # no draw is near either: nothing is certain
            certain.append(float(weights @ kernel) / uncertain if uncertain > 0 else 0.0)
        if min(certain) >= CERTAINTY:
            break
        bottoms = np.delete(bottoms, int(np.argmin(certain)))
    return tuple(float(at) for at in (np.exp(centre[bottoms]) if log_scale else centre[bottoms]))


def _error(visits: Matrix) -> float:
    """Monte Carlo error of a share from visits (walkers, draws), at least that of independent draws."""
    share = float(visits.mean())
    if share in (0.0, 1.0):
        return 1.0 / len(visits)
    return max(_batch_error(visits), sqrt(share * (1 - share) / visits.size))


def _batch_error(chains: Matrix) -> float:
    """Monte Carlo error of the mean from chains (walkers, draws) that differ by chance alone; exact however
    slowly a walker moves, which effective sample sizes of split chains are not."""
    return float(chains.mean(axis=1).std(ddof=1) / np.sqrt(chains.shape[0]))


def _bottoms(density: Vector) -> Index:
    """Positions of the minima between modes, the middle of those that are wide."""
    steps = np.flatnonzero(np.diff(density))
    falls = np.diff(density)[steps] < 0
    turns = [(a, b) for (a, down), (b, up) in pairwise(zip(steps, falls, strict=True)) if down and not up]
    return np.array([(a + 1 + b) // 2 for a, b in turns], dtype=np.intp)


def _tops(density: Vector, bottoms: Sequence[int] | Index) -> list[int]:
    """Positions of the highest points between the bottoms."""
    ends = [0, *(int(b) for b in bottoms), density.size]
    return [a + int(np.argmax(density[a:b])) for a, b in pairwise(ends)]
