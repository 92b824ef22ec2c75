"""Numbers that every candidate has, over all candidates: what noise leaves open and what structure does.

Candidates are weighed by their posterior probabilities (Hoeting, Madigan, Raftery and Volinsky 1999,
Statistical Science 14). The evidence counts a further term against a model even where the records cannot
reject it, and an extrapolation such as a static gain may move by several standard deviations with that term.
So a richer candidate that predicts as well as the most probable one, and moves a number by more than half of
its standard deviation, weighs as much as that one, and the number's interval holds its interval.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.estimate import EQUAL_TAILED, LEVEL
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
    noise, structure = parts_of_sd(values, weights)
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
    """Whether a median lies more than half a standard deviation from the other's."""
    apart = abs(np.median(values) - np.median(others))
    sd = float(np.std(others)) if np.isfinite(others).all() else 0.0
    return bool(not np.isfinite(apart) or apart > _MOVED * sd)


def mixture_quantiles(values: Matrix, weights: Vector, probabilities: Vector) -> Vector:
    """Quantiles of a mixture of components, each given by equally probable values (components, values).

    Infinite where the mixture is; accuracy half of the probability that one value stands for.
    """
    flat, each = values.ravel(), np.repeat(weights / values.shape[1], values.shape[1])
    order = np.argsort(flat, kind="stable")
    reached = np.cumsum(each[order]) - 0.5 * each[order]
    at = np.searchsorted(reached, probabilities * each.sum(), side="left")
    return np.asarray(flat[order][np.minimum(at, flat.size - 1)])


def parts_of_sd(values: Matrix, weights: Vector) -> tuple[float, float]:
    """Standard deviation within and between the components of a mixture; NaN where a component is open.

    Their squares add up to the variance of the mixture.
    """
    if not np.isfinite(values).all():
        return np.nan, np.nan
    means = values.mean(axis=1)
    within = float(weights @ values.var(axis=1))
    between = float(weights @ (means - weights @ means) ** 2)
    return float(np.sqrt(within)), float(np.sqrt(between))
