"""A design as plain values, and what an audit advises to measure next; open numbers have a reason."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.estimate import Estimate, plain, quantile
from lcopa_bayes.experiments.design import Design, Promise, design
from lcopa_bayes.results.predictive import Predictive


def as_json(result: Design) -> dict[str, Any]:
    """Every number of a design; what is infinite or undefined is None and has a reason in words."""
    study, table = result.fit.study, result.fit.draws.table
    determined = bool(result.determined.any())
    return plain(
        {
            "study": study.name,
            "verdict": result.sentence,
            "grade": result.fit.draws.grade.level,
            "grade_reason": result.fit.draws.grade.reason,
            "time": result.time,
            "time_unit": study.time_unit,
            "repeats": result.repeats,
            "draws": result.draws.shape[0],
            "refresh": result.limits.refresh,
            "period": result.limits.period,
            "range": [
                {"axis": axis.name, "unit": axis.unit, "rest": rest, "low": low, "high": high}
                for axis, rest, low, high in zip(
                    study.drive_axes, result.limits.rest, result.limits.low, result.limits.high, strict=True
                )
            ],
            "winner": _row(result, result.winner) if determined else None,
            "d_optimal": result.overall.candidate.name if determined else None,
            "factor_over_step": result.factor.as_json() | {"parameter": result.worst} if determined else None,
            "linear_share": result.linear if determined else None,
            "parameters": [
                _parameter(result, name, table.rows[table.names.index(name)].unit) for name in result.names
            ],
            "table": [_row(result, one) for one in result.here],
            "curve": _curve(result),
            "structure": [one.as_json() for one in result.structure.symmetries],
        }
    )


def _row(result: Design, promise: Promise) -> dict[str, Any]:
    """One drive at one bench time."""
    among = result.determined
    return {
        "drive": promise.candidate.name,
        "family": promise.candidate.family,
        "words": promise.candidate.words if promise.excites else "excites nothing that could be seen",
        "changes": promise.candidate.command.times.size,
        "time": promise.time,
        "worst": result.over_draws("worst", promise.worst(among)).as_json() if among.any() else None,
        "factor_over_step": quantile(result.factors(promise), 0.5) if among.any() else None,
        "typical": promise.typical(among) if among.any() else None,
        "relative_sd": [
            result.estimate(promise, name).as_json() if result.determined[k] else None
            for k, name in enumerate(result.names)
        ],
    }


def _parameter(result: Design, name: str, unit: str) -> dict[str, Any]:
    """What becomes of one parameter."""
    at, needed, reason = result.names.index(name), result.time_needed(name), result.reason(name)
    best = result.best(name, result.here)
    sizes = np.abs(result.draws[:, result.fit.draws.table.names.index(name)])
    spread: Vector = best.relative[:, at] * sizes
    estimates = (
        {}
        if reason
        else {
            "relative_sd": result.estimate(best, name),
            "sd": Estimate.of(name, unit, spread, ess=float(spread.size), grade=result.fit.draws.grade.level),
            "relative_sd_step": result.estimate(result.step, name),
            "relative_sd_winner": result.estimate(result.winner, name),
        }
    )
    needed_words = "not by any drive tried"
    if needed is not None:
        needed_words = f"{'at most ' * needed[1]}{needed[0]:.3g} {result.fit.study.time_unit}"
    return {
        "name": name,
        "unit": unit,
        "reason": reason,
        "best_drive": None if reason else best.candidate.name,
        **dict.fromkeys(("relative_sd", "sd", "relative_sd_step", "relative_sd_winner")),
        **{key: one.as_json() for key, one in estimates.items()},
        "time_for_10_percent": None if needed is None else needed[0],
        "time_is_upper_bound": needed is not None and needed[1],
        "time_words": needed_words,
    }


def _curve(result: Design) -> list[dict[str, Any]]:
    """Per bench time, the best drive and the plain step for every parameter."""
    out = []
    for row in result.tried:
        best = {name: result.best(name, row) for name in result.names if name not in result.structure.blind}
        out.append(
            {
                "time": row[0].time,
                "best": {name: one.expected[result.names.index(name)] for name, one in best.items()},
                "drive": {
                    name: one.candidate.name
                    for name, one in best.items()
                    if np.isfinite(one.expected[result.names.index(name)])
                },
                "step": {name: row[0].expected[result.names.index(name)] for name in best},
            }
        )
    return out


_DRAWS = 8
"""Draws averaged over: enough to rank drives."""
_EFFECT_SPANS, _EFFECT_DRAWS = 4, 2
"""Length of the record with effects, whose simulation takes long [spans of the records], and draws."""


def next_measurement(fit: Predictive, parameters: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    """The drive to play next and, per parameter that is not identified, the best drive for it.

    `parameters`: rows of an audit with `name` and `verdict`. None when every one is identified, no drive when
    only parameters of the noise are not. Bounds are those of one new record of 40 spans alone, at 8 draws,
    with effects of 4 spans, at 2; the verb `design` tries more and confirms.
    """
    left = [row["name"] for row in parameters if row["verdict"] != "identified"]
    if not left:
        return None
    table = fit.draws.table
    if all(table.rows[table.names.index(name)].noise for name in left):
        reason = "no parameter of the plant is left open, and no drive tells more of the noise"
        return {"drive": None, "reason": reason, "parameters": []}
    long, draws = None, _DRAWS
    if fit.problem.ranges is not None:
        long, draws = _EFFECT_SPANS * fit.problem.scales.span, _EFFECT_DRAWS
    try:
        result = design(fit, time=long, draws=draws, ladder=False)
    except InputError as error:
        return {"drive": None, "reason": "; ".join(error.problems), "parameters": []}
    rows = []
    for name in left:
        if name not in result.names:
            rows.append({"name": name, "drive": None, "reason": "no parameter of the plant"})
            continue
        best, reason = result.best(name, result.here), result.reason(name)
        rows.append(
            {
                "name": name,
                "drive": None if reason else best.candidate.name,
                "reason": reason,
                "expected_relative_sd": None if reason else result.estimate(best, name).as_json(),
                "expected_relative_sd_step": None if reason else result.estimate(result.step, name).as_json(),
            }
        )
    return plain(
        {
            "drive": result.winner.candidate.name if result.determined.any() else None,
            "words": result.winner.candidate.words if result.determined.any() else "",
            "reason": result.sentence,
            "time": result.time,
            "time_unit": fit.study.time_unit,
            "parameters": rows,
        }
    )
