"""Ranks of truths among posterior draws, and whether they are uniform.

When a truth is drawn from the prior, a record simulated from it and L independent posterior draws made of
that record, the rank of the truth among the draws is uniform on 0 to L (Talts et al. 2018,
arXiv:1804.06788). The number of ranks below each value is then binomial; the test looks at the least
likely of these numbers, and the corridor holds them all with one probability (Säilynoja, Bürkner and
Vehtari 2022, Statistics and Computing 32). Both are computed exactly, not by simulation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, final

import numpy as np
from scipy import stats
from scipy.special import bdtr, bdtrc, gammaln, xlog1py, xlogy

from lcopa_bayes.core.arrays import Array, Index, Vector
from lcopa_bayes.core.estimate import attributes

SIMULTANEOUS = 0.95
"""Probability that all that one band is drawn for lies inside it [-]."""
_ALIKE = 1e-9
"""Tail probabilities closer than this, relatively, are equal: they are mirror images of each other [-]."""
_HALVINGS = 14
"""Bisections of the logarithm of a pointwise tail probability."""


@final
class Limits(NamedTuple):
    """Smallest and largest number that lies inside, one per rank value or per bin."""

    lower: Index
    upper: Index


def rank_of(truth: float, draws: Vector, rng: np.random.Generator) -> int:
    """Number of draws below the truth, 0 to draws.size; among equal ones the place is drawn at random."""
    equal = int(np.count_nonzero(draws == truth))
    return int(np.count_nonzero(draws < truth)) + int(rng.integers(equal + 1))


def p_uniform(counts: Index) -> float:
    """p-value that ranks with these counts, one per rank value, are uniform [-].

    Of the numbers of ranks below each value, the one with the smallest binomial tail is the statistic;
    its distribution under uniform ranks is exact. 1 when there are no ranks at all.
    """
    replicas, values = int(counts.sum()), counts.size
    if replicas == 0 or values < 2:
        return 1.0
    tails = _tails(replicas, values)
    below = np.cumsum(counts)[:-1]
    return _leaving(replicas, values, _inside(tails, float(tails[np.arange(values - 1), below].min())))


def corridor(replicas: int, values: int, level: float = SIMULTANEOUS) -> Limits:
    """Limits on how many of `replicas` uniform ranks lie below 1, 2, ..., values - 1.

    All of them lie inside with a probability of at least `level`, each tail being cut at one and the
    same pointwise probability, the largest for which this is so.
    """
    tails = _tails(replicas, values)
    low, high = np.log((1 - level) / (2 * values)), np.log(0.5)  # Bonferroni's is never too large
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        if _leaving(replicas, values, _inside(tails, float(np.exp(middle)))) <= 1 - level:
            low = middle
        else:
            high = middle
    return _inside(tails, float(np.exp(low)))


def bin_limits(replicas: int, bins: int) -> tuple[int, int]:
    """Limits on the counts of `bins` equal bins of uniform ranks, by Bonferroni's inequality."""
    tail = (1 - SIMULTANEOUS) / (2 * bins)
    ends = stats.binom(replicas, 1 / bins)
    return int(ends.ppf(tail)), int(ends.ppf(1 - tail))


def _tails(replicas: int, values: int) -> Array:
    """Smaller binomial tail of c ranks below i + 1, (values - 1, replicas + 1); both tails include c."""
    share = np.arange(1, values)[:, None] / values
    count = np.arange(replicas + 1)
    return np.minimum(stats.binom.cdf(count, replicas, share), stats.binom.sf(count - 1, replicas, share))


def _inside(tails: Array, tail: float) -> Limits:
    """Numbers whose smaller tail is above `tail`."""
    kept = tails > tail * (1 + _ALIKE)
    none = ~kept.any(axis=1)
    last = tails.shape[1] - 1
    return Limits(
        np.where(none, 1, kept.argmax(axis=1)), np.where(none, 0, last - kept[:, ::-1].argmax(axis=1))
    )


def _leaving(replicas: int, values: int, inside: Limits) -> float:
    """Probability that uniform ranks leave the limits anywhere.

    The numbers of ranks below 1, 2, ... are a Markov chain: of the ranks not yet counted, each falls to the
    next value with probability 1 / (values left). What leaves is summed, so that small probabilities keep
    their digits.
    """
    if (inside.lower > inside.upper).any():
        return 1.0
    at, mass, left = np.zeros(1, dtype=int), np.ones(1), 0.0
    factorial = gammaln(np.arange(replicas + 1) + 1.0)
    for i, (low, high) in enumerate(zip(inside.lower, inside.upper, strict=True)):
        share, rest = 1 / (values - i), replicas - at
        left += float(mass @ (_fewer(low - at, rest, share) + _more(high - at, rest, share)))
        then = np.arange(low, high + 1)
        falling = then - at[:, None]
        count = np.maximum(falling, 0)
        log_mass = factorial[rest][:, None] - factorial[count] - factorial[replicas - then]
        log_mass += xlogy(count, share) + xlog1py(replicas - then, -share)
        mass = mass @ np.where(falling < 0, 0.0, np.exp(log_mass))
        at = then
    return min(1.0, left)


def _fewer(count: Index, of: Index, share: float) -> Vector:
    """Binomial probability of fewer than `count`; that of `scipy.stats`, without its checks of every call."""
    return np.where(count <= 0, 0.0, bdtr(np.clip(count - 1, 0, of), of, share))


def _more(count: Index, of: Index, share: float) -> Vector:
    """Binomial probability of more than `count`."""
    return np.where(count < 0, 1.0, bdtrc(np.clip(count, 0, of), of, share))


BAND = "Clopper-Pearson"
"""Clopper and Pearson 1934, Biometrika 26: an exact binomial confidence interval."""
LEVELS = (0.5, 0.9)
"""Probabilities inside the central intervals that are checked [-]."""


@final
@dataclass(frozen=True)
class Coverage:
    """Coverage of the central interval of one quantity at one level."""

    parameter: str
    """Name of the parameter, or of the step response and its time."""
    kind: str
    level: float
    """Probability inside the interval, as stated [-]."""
    hits: int
    """Replicas whose interval held the truth."""
    replicas: int
    confidence: float
    """Confidence of the band [-]."""

    @property
    def observed(self) -> float:
        """Share of replicas whose interval held the truth [-]."""
        return self.hits / self.replicas

    @property
    def lower(self) -> float:
        """Lower end of the band of the true coverage [-]."""
        tail = (1 - self.confidence) / 2
        return float(stats.beta.ppf(tail, self.hits, self.replicas - self.hits + 1)) if self.hits else 0.0

    @property
    def upper(self) -> float:
        """Upper end of the band of the true coverage [-]."""
        tail, missed = (1 - self.confidence) / 2, self.replicas - self.hits
        return float(stats.beta.ppf(1 - tail, self.hits + 1, missed)) if missed else 1.0

    @property
    def holds(self) -> bool:
        """Whether the stated level lies within the band."""
        return self.lower <= self.level <= self.upper

    @property
    def p_value(self) -> float:
        """Of the exact binomial test that the coverage is as stated [-]."""
        return float(stats.binomtest(self.hits, self.replicas, self.level).pvalue)

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            **attributes(self, "parameter", "kind", "level", "observed", "lower", "upper"),
            "band": BAND,
            "confidence": self.confidence,
            "within": self.holds,
            "p_value": self.p_value,
            "replicas": self.replicas,
        }
