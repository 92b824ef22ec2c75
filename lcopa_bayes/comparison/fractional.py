"""Whether fractional orders are warranted: the best fractional candidate against the best integer one."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot
from typing import Any

from lcopa_bayes.comparison.gains import ERRORS, STRONG, TIE, Gain, Row, by_evidence, by_prediction, simplest


def fractional(usable: Sequence[Row]) -> dict[str, Any]:
    """Whether the best fractional candidate is warranted against the best integer one.

    The best is the simplest that none of its kind beats beyond chance.
    """
    weighed = [row for row in usable if row["log_evidence"] is not None]
    kinds = [[row for row in weighed if row["integer"] is kind] for kind in (False, True)]
    if not all(kinds):
        return undecided("a fractional and an integer candidate with evidence are needed")
    free, whole = (simplest(rows, by_evidence, "log_evidence") for rows in kinds)
    assert free is not None
    assert whole is not None
    gain, predicted = by_evidence(free, whole), by_prediction(free, whole)
    assert gain is not None
    gains = [gain, *_other_widths(free, whole)]
    least = min(gains, key=lambda one: one.nats - ERRORS * one.sd)
    most = max(gains, key=lambda one: one.nats + ERRORS * one.sd)
    told = {
        "fractional": free["name"],
        "integer": whole["name"],
        "log_bayes_factor": gain.nats,
        "log_bayes_factor_sd": gain.sd,
        "least_over_priors": least.nats,
        "most_over_priors": most.nats,
        "elpd_difference": None if predicted is None else predicted.nats,
        "elpd_difference_sd": None if predicted is None else predicted.sd,
    }
    said = f"{free['name']} against {whole['name']}: log evidence {gain}"
    if predicted is not None:
        said += f", log predictive density {predicted}"
    strong = least.nats - ERRORS * least.sd > STRONG
    denied = predicted is not None and -predicted.nats > max(TIE, ERRORS * predicted.sd)
    shown = predicted is None or predicted.nats > predicted.sd  # the evidence is strong by itself
    if strong and shown:
        return told | {"verdict": "warranted", "sentence": f"Fractional orders are warranted. {said}."}
    if denied or most.nats + ERRORS * most.sd < 0:
        return told | {
            "verdict": "not warranted",
            "sentence": f"Fractional orders are not warranted. {said}.",
        }
    lacking = "the evidence, or its prior's part, does not suffice" if not strong else ""
    lacking = lacking or "what was left out is predicted no better by more than a standard error"
    return told | {
        "verdict": "not shown",
        "sentence": f"No win of fractional orders is claimed: {lacking}. {said}.",
    }


def _other_widths(free: Row, whole: Row) -> list[Gain]:
    """The difference of log evidence under other prior widths, where both have one."""
    out = []
    for one in free["prior_widths"]:
        for other in whole["prior_widths"]:
            alike = one["factor"] == other["factor"]
            if alike and one["log_evidence"] is not None and other["log_evidence"] is not None:
                out.append(Gain(one["log_evidence"] - other["log_evidence"], hypot(one["sd"], other["sd"])))
    return out


def undecided(why: str) -> dict[str, Any]:
    """A verdict that waits."""
    return {"verdict": "undecided", "sentence": f"Undecided: {why}."}
