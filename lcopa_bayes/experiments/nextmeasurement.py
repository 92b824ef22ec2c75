"""What an audit advises to measure next, for the parameters its records leave open."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.estimate import plain
from lcopa_bayes.experiments.design import design
from lcopa_bayes.results.predictive import Predictive

_DRAWS = 8
"""Draws averaged over: enough to rank drives."""


def next_measurement(fit: Predictive, parameters: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    """The drive to play next and, per parameter that is not identified, the best drive for it.

    `parameters`: rows of an audit with `name` and `verdict`. None when every one is identified. Bounds are
    those of one new record of 40 spans alone, at 8 draws; the verb `design` tries more and confirms.
    """
    left = [row["name"] for row in parameters if row["verdict"] != "identified"]
    if not left:
        return None
    try:
        made = design(fit, draws=_DRAWS, ladder=False)
    except InputError as error:
        return {"drive": None, "reason": "; ".join(error.problems), "parameters": []}
    rows = []
    for name in left:
        if name not in made.names:
            rows.append({"name": name, "drive": None, "reason": "no parameter of the plant"})
            continue
        best, reason = made.best(name, made.here), made.reason(name)
        rows.append(
            {
                "name": name,
                "drive": None if reason else best.candidate.name,
                "reason": reason,
                "expected_relative_sd": None if reason else made.estimate(best, name).as_json(),
                "expected_relative_sd_step": None if reason else made.estimate(made.step, name).as_json(),
            }
        )
    return plain(
        {
            "drive": made.winner.candidate.name if made.determined.any() else None,
            "words": made.winner.candidate.words if made.determined.any() else "",
            "reason": made.sentence,
            "time": made.time,
            "time_unit": fit.study.time_unit,
            "parameters": rows,
        }
    )
