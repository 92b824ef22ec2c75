"""What precision a drive promises: Cramer-Rao bounds at draws of the posterior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lcopa_bayes.core.arrays import Array, Flags, Matrix, Vector
from lcopa_bayes.core.estimate import quantile
from lcopa_bayes.experiments.candidates import Candidate
from lcopa_bayes.experiments.information import Bench
from lcopa_bayes.experiments.limits import Limits

_SINGULAR = 1e-13
"""Eigenvalues of the information between unit sensitivities below this are rounding [-]."""
_TOUCHED = 1e-6
"""Squared weight in a singular direction from which a parameter's variance is infinite [-]."""


@dataclass(frozen=True, eq=False)
class Promise:
    """Cramer-Rao covariances of the plant's parameters after one drive of one length."""

    candidate: Candidate
    time: float
    """[time unit]."""
    covariance: Array
    """Relative to the size of each parameter, (draws, parameters, parameters) [-]; infinite on the diagonal
    and NaN beside it where the information is singular."""

    @property
    def relative(self) -> Matrix:
        """Standard deviation over the size of the value, (draws, parameters) [-]."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)))

    @property
    def expected(self) -> Vector:
        """Medians of `relative` over the draws, (parameters,) [-]; infinite when half the draws are."""
        return quantile(self.relative, 0.5)

    @property
    def excites(self) -> bool:
        """Whether at any draw any parameter is determined."""
        return bool(np.isfinite(self.relative).any())

    def worst(self, among: Flags) -> Vector:
        """Largest relative standard deviation among some parameters at every draw, (draws,) [-]."""
        return np.asarray(self.relative[:, among].max(axis=1))

    def typical(self, among: Flags) -> float:
        """Median over draws of ``det(covariance)^(1 / 2p)`` among p parameters [-]: the geometric mean of
        the standard deviations along its axes, smallest for the D-optimal drive; infinite when singular."""
        chosen = self.covariance[:, among][:, :, among]
        open_ = ~np.asarray(np.isfinite(chosen).all(axis=(1, 2)))
        bare = np.where(open_[:, None, None], np.eye(int(among.sum())), chosen)
        sign, logs = np.linalg.slogdet(bare)
        sizes = np.where(open_ | (sign <= 0), np.inf, np.exp(logs / (2 * among.sum())))
        return float(quantile(sizes, 0.5))


def ratios(over: Vector, under: Vector) -> Vector:
    """Quotients of standard deviations that may be infinite; 1 where both are."""
    both = np.isinf(over) & np.isinf(under)
    quotient = np.where(both, 1.0, over) / np.where(both, 1.0, under)
    return np.asarray(quotient)


def promises(
    bench: Bench,
    drives: Sequence[Candidate],
    draws: Matrix,
    *,
    repeats: int = 1,
    prior: Vector | None = None,
) -> list[Promise]:
    """What each drive promises at draws (draws, rows) of table values.

    `prior`, (parameters,): standard deviations that count as information beforehand, in the coordinates of
    `Bench.slopes`; None: the measurement alone.
    """
    result: list[list[Matrix]] = [[] for _ in drives]
    for values in draws:
        elements, sizes = bench.elements(values), bench.sizes(values)
        for place, drive in enumerate(drives):
            gram = repeats * bench.gram(values, elements, drive.command)
            if prior is not None:
                gram[np.diag_indices_from(gram)] += prior**-2.0
            result[place].append(cramer_rao(gram * np.outer(sizes, sizes)))
    return [Promise(drive, bench.time, np.array(each)) for drive, each in zip(drives, result, strict=True)]


def cramer_rao(gram: Matrix) -> Matrix:
    """Covariance from Fisher information, (p, p): infinite variance where the information is singular.

    Singular is judged between sensitivities of unit length, so that it does not depend on units. Covariances
    with a parameter of infinite variance are NaN.
    """
    norms = np.sqrt(np.diag(gram))
    acting = norms > 0
    scale = np.where(acting, norms, 1.0)
    eigenvalues, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    blind = eigenvalues <= _SINGULAR * max(float(eigenvalues[-1]), 1e-300)
    kept = vectors[:, ~blind]
    covariance: Matrix = (kept / eigenvalues[~blind]) @ kept.T / np.outer(scale, scale)
    lost = ((vectors[:, blind] ** 2).sum(axis=1) > _TOUCHED) | ~acting
    covariance[lost] = np.nan
    covariance[:, lost] = np.nan
    covariance[lost, lost] = np.inf
    return covariance


def reached(times: Vector, spreads: Vector, wanted: float) -> tuple[float, bool] | None:
    """Bench time from which a spread is `wanted`, by straight lines between logarithms.

    Parameters: times increasing [time unit] and the spread at each, (times,) [-], perhaps infinite.
    Returns: the time and whether it is only an upper bound, because the shortest time tried (or the first
    at which the parameter is determined at all) is enough; None when no time tried is.
    """
    good = np.flatnonzero(spreads <= wanted)
    if good.size == 0:
        return None
    at = int(good[0])
    if at == 0 or not np.isfinite(spreads[at - 1]):
        return float(times[at]), True
    share = np.log(spreads[at - 1] / wanted) / np.log(spreads[at - 1] / spreads[at])
    return float(times[at - 1] * (times[at] / times[at - 1]) ** share), False


def within(drive: Candidate, limits: Limits) -> bool:
    """Whether a drive respects the limits, to rounding."""
    slack = 1e-9 * (limits.high - limits.low)
    levels = drive.command.values
    inside = (levels >= limits.low - slack) & (levels <= limits.high + slack)
    ticks = drive.command.times / limits.refresh
    return bool(inside.all() and np.allclose(ticks, np.round(ticks), atol=1e-6))
