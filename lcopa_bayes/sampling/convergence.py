"""Convergence of draws: diagnostics, grades and their reasons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import Any, Literal, final

import numpy as np
from arviz_stats.base import array_stats  # type: ignore[attr-defined]
from scipy.stats import chi2, norm, rankdata, spearmanr

from lcopa_bayes.core.arrays import Array, Index, Vector
from lcopa_bayes.core.estimate import attributes
from lcopa_bayes.core.wording import listed
from lcopa_bayes.sampling.modes import Modes

Level = Literal["reliable", "tentative", "unusable"]

RELIABLE_RHAT = 1.02
"""Nested R-hat of independent ensembles [-] (Margossian et al. 2024, Bayesian Analysis 19)."""
_ALSO = 3
"""Parameters that a reason names beside the worst."""
TENTATIVE_RHAT = 1.1
"""Above it the estimates of the ensembles differ."""
RELIABLE_MEMORY = 0.5
"""Walkers are nearly independent of their start [-]."""
TENTATIVE_MEMORY = 0.7
"""Above it walkers hardly move [-]."""
TENTATIVE_ESS = 100.0
"""Below it not even a mean is accurate [draws]."""
RELIABLE_SCATTER = 0.3
"""Error of one ensemble's mean that is excluded at `_CONFIDENCE` [posterior standard deviations]: four
ensembles, each with this error, give the mean to 0.15 of them, as 44 independent draws do."""
_CONFIDENCE = 0.9
"""Of the upper bound on the scatter between ensembles [-]. Two ensembles with errors of 0.3 pass once in ten
times, where R-hat lets every other pair pass; the price is that to pass nine times in ten two ensembles
without an error need 3 800 effective draws, three 800 and four 500."""
CERTAIN = 3.0
"""Standard errors from which a drift is certain [-]."""
RELIABLE_SHARES = 0.05
"""Difference of a mode's share between ensembles, beyond Monte Carlo error, that has little influence [-]."""
TENTATIVE_SHARES = 0.2
"""Above it the posterior mass of the modes is not known."""
_RANK: dict[Level, int] = {"reliable": 0, "tentative": 1, "unusable": 2}


@final
@dataclass(frozen=True)
class Quality:
    """Convergence of one parameter's draws."""

    name: str
    ess_bulk: float
    """Effective sample size for the centre of the distribution [draws]."""
    ess_tail: float
    """Effective sample size for the 5 and 95 % quantiles [draws]."""
    rhat: float
    """Nested rank R-hat between ensembles [-]."""
    memory: float = 0.0
    """Rank correlation, over walkers, between their positions at the start and at the end of the draws [-];
    walkers that do not move have 1, and their number has no information about the posterior."""
    ess_between: float = np.inf
    """Number of independent draws whose mean scatters as the means of the ensembles do [draws]; also of the
    shares of modes where there are several. It includes errors common to all walkers of an ensemble."""
    ess_drift: float = np.inf
    """Number of independent draws whose mean is as uncertain as the draws drift from their first to their
    last third [draws]; infinite where no drift is certain. It includes errors common to all ensembles: a mode
    that none of them had filled at the start."""
    scatter: float = 0.0
    """Upper bound at 90 % confidence on the error of one ensemble's mean [posterior standard deviations]."""

    @property
    def ess(self) -> float:
        """The smallest of the effective sample sizes, NaN when any is [draws]."""
        return float(np.min([self.ess_bulk, self.ess_tail, self.ess_between, self.ess_drift]))

    def grade(self, target_ess: float) -> Grade:
        """Grade of this parameter against a wanted effective sample size."""
        # the scatter of a few means is too uncertain to condemn draws: R-hat does where it is large
        within = float(np.minimum(self.ess_bulk, self.ess_tail))
        known = self.rhat <= TENTATIVE_RHAT and within >= TENTATIVE_ESS and not np.isnan(self.ess)
        if not (known and self.memory <= TENTATIVE_MEMORY):
            level: Level = "unusable"
        elif (
            self.rhat <= RELIABLE_RHAT
            and self.ess >= target_ess
            and self.memory <= RELIABLE_MEMORY
            and self.scatter <= RELIABLE_SCATTER
        ):
            level = "reliable"
        else:
            level = "tentative"
        return Grade(
            level,
            f"{self.name}: R-hat {self.rhat:.3f}, effective sample size {self.ess:.0f}, "
            f"rank correlation with the start {self.memory:.2f}",
        )

    def remedy(self, target_ess: float) -> str:
        """Why this parameter is not reliable, and the remedy."""
        if np.isnan(self.rhat) or np.isnan(self.ess):
            return "its draws do not vary; sample more steps, and check its prior"
        reasons, steps = [], "sample more steps"
        if self.rhat > RELIABLE_RHAT:
            reasons.append(
                f"its estimates differ between independent sets of draws (R-hat {self.rhat:.3f}, at most "
                f"{RELIABLE_RHAT:g} when they agree): the posterior has several modes or a strong correlation"
            )
        if self.memory > RELIABLE_MEMORY:
            reasons.append(
                f"the walkers still depend on where they started (rank correlation {self.memory:.2f}, at "
                f"most {RELIABLE_MEMORY:g} is wanted)"
            )
        if self.rhat <= RELIABLE_RHAT and self.scatter > RELIABLE_SCATTER:
            reasons.append(
                f"the mean of each set of draws may have an error of {self.scatter:.2f} standard deviations "
                f"(at most {RELIABLE_SCATTER:g} when they agree closely enough)"
            )
            steps += ", or with more ensembles"
        if self.ess_drift < target_ess:
            reasons.append(
                "its draws still drift: a mode that is hard to reach is still filling in all ensembles"
            )
        if self.ess < target_ess:
            reasons.append(f"it has {self.ess:.0f} effective draws where {target_ess:.0f} are wanted")
            steps += f", about {max(2, ceil(target_ess / max(self.ess, 1.0)))} times as many"
        if self.rhat > RELIABLE_RHAT:
            steps += "; or fix parameters that the record does not determine, or narrow their priors"
        return f"{'; '.join(reasons)}; {steps}"


@final
@dataclass(frozen=True)
class Grade:
    """A grade with the reason for it."""

    level: Level
    reason: str

    @staticmethod
    def worst(grades: Sequence[Grade]) -> Grade:
        """The lowest of several grades."""
        return max(grades, key=lambda grade: _RANK[grade.level])


@final
@dataclass(frozen=True)
class Limitation:
    """A condition under which intervals hold and that the draws cannot check: no number it concerns is
    graded better than `level`."""

    level: Level
    """The best grade under this limitation."""
    reason: str
    """A clause without a full stop, such as "intervals hold only if the noise model explains the rest"."""
    remedy: str = ""
    """What to do about it, a clause without a full stop."""
    parameters: tuple[str, ...] = ()
    """The parameters it concerns; empty: every number."""

    def concerns(self, parameter: str) -> bool:
        """Whether the numbers of a parameter rest on it."""
        return not self.parameters or parameter in self.parameters

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {**attributes(self, "level", "reason", "remedy"), "parameters": list(self.parameters)}


def limited(grade: Grade, limitations: Sequence[Limitation]) -> Grade:
    """`grade`, or the lowest level of the limitations where that is lower.

    The reason names each limitation, the most severe first, then the remedies; the reason of the sampling
    comes first where it is as low, else last. What makes numbers unusable however well they are sampled comes
    before that: records that contradict each other are hard to sample too.
    """
    if not limitations:
        return grade
    ordered = sorted(limitations, key=lambda limitation: -_RANK[limitation.level])
    remedies = dict.fromkeys(
        limitation.remedy for limitation in ordered if limitation.remedy
    )  # a remedy of several limitations is given once
    reasons = "; ".join([*(limitation.reason for limitation in ordered), *remedies])
    if _RANK[grade.level] >= _RANK[ordered[0].level] and ordered[0].level != "unusable":
        joint = "but " if grade.level == "reliable" else "also, "
        return Grade(grade.level, f"{grade.reason}; {joint}{reasons}")
    return Grade(ordered[0].level, f"{reasons}; the sampling by itself is {grade.level}: {grade.reason}")


def qualities(names: Sequence[str], values: Array) -> tuple[Quality, ...]:
    """Quality of each parameter from draws (ensembles, walkers, draws, parameters).

    A parameter that does not vary has no R-hat: its entries are NaN and it grades as unusable, so
    leave fixed parameters out.
    """
    ensembles, walkers = values.shape[:2]
    owner = np.repeat(np.arange(ensembles), walkers)
    out = []
    for k, name in enumerate(names):
        chains = values[..., k].reshape(ensembles * walkers, -1)
        out.append(
            Quality(
                name,
                float(array_stats.ess(chains, method="bulk")),  # type: ignore[no-untyped-call]
                float(array_stats.ess(chains, method="tail", prob=(0.05, 0.95))),  # type: ignore[no-untyped-call]
                nested_rhat(chains, owner),
                rank_correlation(chains[:, 0], chains[:, -1]),
                *_shared(values[..., k]),
            )
        )
    return tuple(out)


def nested_rhat(chains: Array, owner: Index) -> float:
    """Nested rank R-hat of chains (chains, draws) of ensembles `owner`, (chains,) [-]; infinite or NaN where
    no chain varies."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(array_stats.rhat_nested(chains, owner))  # type: ignore[no-untyped-call]


def _shared(values: Array) -> tuple[float, float, float]:
    """Effective sample sizes by errors that walkers share: `between`, with `drift` second."""
    worth, scatter = between(values)
    return worth, drift(values), scatter


def drift(values: Array) -> float:
    """Effective sample size by the drifts of draws (ensembles, walkers, draws) that are certain [draws]:
    with variance v, a drift d of the mean corresponds to ``v / d^2`` draws; infinite where none is
    certain."""
    worth = [variance / moved**2 for moved, error, variance in drifts(values) if abs(moved) > CERTAIN * error]
    return min(worth, default=np.inf)


def drifts(values: Array) -> tuple[tuple[float, float, float], ...]:
    """Mean of the last third of draws (ensembles, walkers, draws) less that of the first, its standard error
    and the variance of the draws: of their normal scores, of the shares beyond the 5 and the 95 % quantile.

    All ensembles start from populations of one kind, so that they may agree while a mode that few walkers
    reached still fills (after Geweke 1992, Bayesian Statistics 4). The error is that of the scatter between
    walkers or between ensembles, whichever is larger. None for fewer than three draws and for draws that do
    not vary.
    """
    third, out = values.shape[2] // 3, []
    if third == 0 or np.ptp(values) == 0.0:
        return ()
    low, high = np.quantile(values, (0.05, 0.95))
    for scored in (_scores(values), (values <= low).astype(float), (values >= high).astype(float)):
        apart = scored[..., -third:].mean(axis=2) - scored[..., :third].mean(axis=2)
        error = float(apart.std(ddof=1) / np.sqrt(apart.size))
        if apart.shape[0] > 1:
            error = max(error, float(apart.mean(axis=1).std(ddof=1) / np.sqrt(apart.shape[0])))
        out.append((float(apart.mean()), error, float(scored.var())))
    return tuple(out)


def _scores(values: Array) -> Array:
    """Normal scores of the ranks of values, of their shape."""
    ranks = rankdata(values).reshape(values.shape)
    return np.asarray(norm.ppf((ranks - 0.375) / (values.size + 0.25)))


def between(values: Array) -> tuple[float, float]:
    """Effective sample size by the scatter between ensembles [draws], and an upper bound on the error of one
    ensemble's mean [standard deviations], of draws (ensembles, walkers, draws) on the normal scores of their
    ranks.

    With K ensembles, variance v of all draws and variance B of the ensembles' means, the mean of all has the
    variance B / K and corresponds to ``K v / B`` draws. As ``(K - 1) B / sigma^2`` has the chi-square law
    with K - 1 degrees of freedom, sigma is below ``sqrt((K - 1) B / chi2)`` at the lower quantile of that
    law. NaN for a single ensemble and for draws that do not vary.
    """
    ensembles = values.shape[0]
    if ensembles < 2 or np.ptp(values) == 0.0:
        return np.nan, np.nan
    scores = _scores(values)
    variance = float(scores.var())
    apart = float(scores.mean(axis=(1, 2)).var(ddof=1))
    least = float(chi2.ppf(1 - _CONFIDENCE, ensembles - 1))
    worth = ensembles * variance / apart if apart > 0 else np.inf
    return worth, float(np.sqrt((ensembles - 1) * apart / least / variance))


def with_shares(quality: Quality, modes: Sequence[Modes]) -> Quality:
    """The quality of a parameter with modes: exchange between them may be slower than what moves its mean."""
    shares = [mode.ess for mode in modes if mode.parameter == quality.name]
    return replace(quality, ess_between=float(np.min([quality.ess_between, *shares])))


def rank_correlation(before: Vector, after: Vector) -> float:
    """Spearman's correlation over walkers; 1 where either does not vary, as when nothing moved."""
    if np.ptp(before) == 0.0 or np.ptp(after) == 0.0:
        return 1.0
    return float(spearmanr(before, after).statistic)


def shares_grade(modes: Modes) -> Grade:
    """Grade of how well the ensembles agree on the posterior mass of a parameter's modes."""
    level: Level = (
        "reliable"
        if modes.spread <= RELIABLE_SHARES
        else "tentative"
        if modes.spread <= TENTATIVE_SHARES
        else "unusable"
    )
    return Grade(level, modes.sentence())


def overall(qualities: Sequence[Quality], target_ess: float, modes: Sequence[Modes] = ()) -> Grade:
    """Grade of a run: the worst parameter's, lowered where ensembles weigh modes differently, with the reason
    and the remedy when it is not reliable."""
    by_quality = _by_quality(qualities, target_ess)
    graded = sorted(((mode.spread, shares_grade(mode)) for mode in modes), key=lambda pair: -pair[0])
    uneven = [grade for _, grade in graded if grade.level != "reliable"]
    if not uneven:
        return by_quality
    others = f" (and {len(uneven) - 1} more like this)" if len(uneven) > 1 else ""
    reason = uneven[0].reason + others + ("" if by_quality.level == "reliable" else f"; {by_quality.reason}")
    return Grade(Grade.worst([by_quality, uneven[0]]).level, reason)


def also_said(others: Sequence[str]) -> str:
    """The next few of parameters that share a fault, and how many more do; nothing without any."""
    return f" (also {listed(others, _ALSO)})" if others else ""


def _by_quality(qualities: Sequence[Quality], target_ess: float) -> Grade:
    """The worst parameter's grade, and why."""
    worst = max(qualities, key=lambda quality: (_RANK[quality.grade(target_ess).level], -quality.ess))
    grade = worst.grade(target_ess)
    weak = [quality.name for quality in qualities if quality.grade(target_ess).level == grade.level]
    if grade.level == "reliable":
        return Grade(
            "reliable",
            f"independent sets of draws agree (largest R-hat {max(q.rhat for q in qualities):.3f}) and the "
            f"smallest effective sample size is {min(q.ess for q in qualities):.0f} ({worst.name})",
        )
    others = also_said([name for name in weak if name != worst.name])
    return Grade(grade.level, f"{worst.name}{others}: {worst.remedy(target_ess)}")
