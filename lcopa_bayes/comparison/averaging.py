"""Numbers that every candidate has, over all candidates: what noise leaves open and what structure does.

Candidates are weighed by their posterior probabilities (Hoeting, Madigan, Raftery and Volinsky 1999,
Statistical Science 14). The evidence counts a further term against a model even where the records cannot
reject it, and an extrapolation such as a static gain may move by several standard deviations with that term.
So a richer candidate that predicts as well as the most probable one, and moves a number by more than half of
its standard deviation, weighs as much as that one, and the number's interval holds its interval.

What one candidate gains over another, and when a gain counts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import hypot, log
from typing import Any, final

import numpy as np

from lcopa_bayes.core.arrays import Index, Matrix, Vector
from lcopa_bayes.core.estimate import EQUAL_TAILED, LEVEL
from lcopa_bayes.results.averages import parts_of_sd
from lcopa_bayes.results.fit import Fit
from lcopa_bayes.results.steps import metrics_of
from lcopa_bayes.sampling.convergence import Grade

_COUNT = 200
"""Quantiles that stand for the draws of a number."""
_MOVED = 0.5
"""Shift of a median over its standard deviation from which a richer candidate counts [-]."""
_WORSE = 2.0
"""Standard errors by which a candidate predicts worse before it is rejected [-]."""
_LESS_LIKELY = 2.0
"""Maximum log likelihood below that of the most probable candidate from which one is rejected [nat]."""
_SHOWN = 0.01
"""Weight from which a candidate is named [-]."""

Row = Mapping[str, Any]


def quantiles(fitted: Fit) -> dict[str, dict[str, Any]]:
    """Quantiles of every number of a fit that does not depend on its structure, by name; None where infinite.

    They are the figures of the step responses of all paths [unit of each].
    """
    at = (np.arange(_COUNT) + 0.5) / _COUNT
    out = {}
    for one in metrics_of(fitted.draws.table, fitted.curves, time_unit=fitted.study.time_unit):
        ordered = np.sort(one.values)[np.floor(at * one.values.size).astype(int)]
        values = [float(value) if np.isfinite(value) else None for value in ordered]
        out[one.name] = {"unit": one.unit, "values": values}
    return out


def averaged(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Median, interval and the two parts of the standard deviation of every number that all usable candidates
    with evidence have; empty for fewer than two of these. Open ends and undefined parts are None."""
    usable = [row for row in rows if row["usable"] and row["probability"] is not None]
    if len(usable) < 2:
        return []
    best = max(usable, key=lambda row: float(row["probability"]))
    kept = [best, *(row for row in usable if row is not best and not _rejected(row, best))]
    shared = [name for name in best["quantiles"] if all(name in row["quantiles"] for row in usable)]
    return [_number(name, usable, best, kept) for name in shared]


def _rejected(row: Row, best: Row) -> bool:
    """Whether the records speak against a candidate beside the most probable one, Occam's factor apart."""
    if row["max_log_likelihood"] < best["max_log_likelihood"] - _LESS_LIKELY:
        return True
    if row["elpd"] is None or best["elpd"] is None:
        return False
    behind = best["elpd"] - row["elpd"]
    return bool(behind > _WORSE * max(row["elpd_difference_sd"], best["elpd_difference_sd"], 1e-12))


def _number(name: str, usable: Sequence[Row], best: Row, kept: Sequence[Row]) -> dict[str, Any]:
    values = np.array([_values(row, name) for row in usable])
    weights = np.array([float(row["probability"]) for row in usable])
    own = usable.index(best)
    raised = []
    for k, row in enumerate(usable):
        richer = row["parameters"] > best["parameters"] and any(row is one for one in kept)
        if richer and _moved(values[k], values[own]) and weights[k] < weights[own]:
            weights[k] = weights[own]
            raised.append(k)
    weights /= weights.sum()
    tail = (1 - LEVEL) / 2
    at = np.array([tail, 0.5, 1 - tail])
    lower, middle, upper = mixture_quantiles(values, weights, at)
    for k in raised:
        alone = mixture_quantiles(values[[k]], np.ones(1), at)
        lower, upper = min(lower, alone[0]), max(upper, alone[2])
    noise, structure = parts_of_sd(list(values), weights)
    shown = [k for k in range(len(usable)) if weights[k] >= _SHOWN]
    return {
        "name": name,
        "unit": best["quantiles"][name]["unit"],
        "value": middle,
        "lower": lower,
        "upper": upper,
        "level": LEVEL,
        "interval": EQUAL_TAILED,
        "sd_noise": noise,
        "sd_structure": structure,
        "weights": {usable[k]["name"]: float(weights[k]) for k in shown},
        "raised": [usable[k]["name"] for k in raised],
        "grade": _worst([usable[k] for k in shown]),
    }


def _worst(rows: Sequence[Row]) -> str:
    return Grade.worst([Grade(row["grade"], row["grade_reason"]) for row in rows]).level


def _values(row: Row, name: str) -> Vector:
    return np.array([np.inf if one is None else one for one in row["quantiles"][name]["values"]])


def _moved(values: Vector, others: Vector) -> bool:
    """Whether a median lies more than half a standard deviation from the other's; not where both are open."""
    here, there = np.median(values), np.median(others)
    if here == there:
        return False
    sd = float(np.std(others)) if np.isfinite(others).all() else 0.0
    return bool(abs(here - there) > _MOVED * sd)


def mixture_quantiles(values: Matrix, weights: Vector, probabilities: Vector) -> Vector:
    """Quantiles of a mixture of components, each given by equally probable values (components, values).

    Infinite where the mixture is; accuracy half of the probability that one value stands for.
    """
    flat, each = values.ravel(), np.repeat(weights / values.shape[1], values.shape[1])
    order = np.argsort(flat, kind="stable")
    reached = np.cumsum(each[order]) - 0.5 * each[order]
    at = np.searchsorted(reached, probabilities * each.sum(), side="left")
    return np.asarray(flat[order][np.minimum(at, flat.size - 1)])


BLOCKS = 10
"""Stretches of each axis of each predicted part whose sums give the error of a total [-]."""
Card = Mapping[str, Any]

TIE = log(3)
"""Difference of log evidence not worth more than a bare mention [nat] (Jeffreys 1961, App. B)."""
STRONG = log(20)
"""Difference of log evidence from which a fractional order is claimed [nat] (Kass and Raftery 1995)."""
ERRORS = 2.0
"""Standard errors that a difference must exceed to count [-]."""


@final
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
