"""What one candidate gains over another, and when a gain counts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import hypot, log
from typing import Any

import numpy as np

from lcopa_bayes.core.arrays import Index, Vector

BLOCKS = 10
"""Stretches of each axis of each predicted part whose sums give the error of a total [-]."""
Card = Mapping[str, Any]

TIE = log(3)
"""Difference of log evidence not worth more than a bare mention [nat] (Jeffreys 1961, App. B)."""
STRONG = log(20)
"""Difference of log evidence from which a fractional order is claimed [nat] (Kass and Raftery 1995)."""
ERRORS = 2.0
"""Standard errors that a difference must exceed to count [-]."""
Row = Mapping[str, Any]


@dataclass(frozen=True)
class Gain:
    """What one candidate gains over another."""

    nats: float
    """Difference of log evidence, or of log predictive density [nat]."""
    sd: float
    """Its standard error [nat]."""

    @property
    def counts(self) -> bool:
        """Whether it is beyond chance and worth more than a bare mention."""
        return self.nats > max(TIE, ERRORS * self.sd)

    def __str__(self) -> str:
        digits = 1 if self.sd >= 0.05 else 2
        return f"{self.nats:+.{digits}f} ± {self.sd:.{digits}f} nats"


def by_evidence(one: Row, other: Row) -> Gain | None:
    """Difference of log evidence; None where either has none."""
    if one["log_evidence"] is None or other["log_evidence"] is None:
        return None
    return Gain(
        one["log_evidence"] - other["log_evidence"], hypot(one["log_evidence_sd"], other["log_evidence_sd"])
    )


def by_prediction(one: Row, other: Row) -> Gain | None:
    """Difference of log predictive density; None where nothing was predicted."""
    if one["elpd"] is None or other["elpd"] is None:
        return None
    nats, sd = difference(one, other)
    return Gain(nats, hypot(sd, one["elpd_monte_carlo_sd"], other["elpd_monte_carlo_sd"]))


def simplest(rows: Sequence[Row], score: Callable[[Row, Row], Gain | None], key: str) -> Row | None:
    """The candidate of fewest parameters among those that the best one does not beat beyond chance."""
    if not rows:
        return None
    best = max(rows, key=lambda row: row[key])
    level = [row for row in rows if row is best or not _counts(score(best, row))]
    return min(level, key=lambda row: (row["parameters"], -row[key]))


def _counts(gain: Gain | None) -> bool:
    return gain is not None and gain.counts


def difference(one: Card, other: Card) -> tuple[float, float]:
    """Total of log predictive densities of one less another, with its standard error [nat]."""
    gap = np.array(one["pointwise"]["log_density"]) - np.array(other["pointwise"]["log_density"])
    where = stretches(one["pointwise"])
    return float(gap.sum()), total_sd(np.array([gap[where == block].sum() for block in np.unique(where)]))


def total_sd(sums: Vector) -> float:
    """Standard error of a total from the spread of the sums of its stretches [nat]."""
    return float(np.sqrt(sums.size) * np.std(sums, ddof=1)) if sums.size > 1 else float("nan")


def stretches(pointwise: Mapping[str, Sequence[Any]]) -> Index:
    """Number of the stretch each predicted sample belongs to: samples next to each other err together."""
    series = [f"{part}\0{axis}" for part, axis in zip(pointwise["part"], pointwise["axis"], strict=True)]
    out = np.zeros(len(series), dtype=np.intp)
    count = 0
    for name in dict.fromkeys(series):
        at = np.flatnonzero(np.array([one == name for one in series]))
        for piece in np.array_split(at, min(BLOCKS, at.size)):
            out[piece] = count
            count += 1
    return out
