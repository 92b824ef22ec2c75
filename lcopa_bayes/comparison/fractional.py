"""Whether fractional orders are warranted: the best fractional candidate against the best integer one."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot
from typing import Any

from lcopa_bayes.comparison.gains import ERRORS, STRONG, TIE, Gain, Row, by_evidence, by_prediction, simplest
from lcopa_bayes.comparison.priorwidth import FACTORS


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
    others, unknown = _other_widths(free, whole)
    gains = [gain, *others]
    least = min(gains, key=lambda one: one.nats - ERRORS * one.sd)
    most = max(gains, key=lambda one: one.nats + ERRORS * one.sd)
    told = {
        "fractional": free["name"],
        "integer": whole["name"],
        "log_bayes_factor": gain.nats,
        "log_bayes_factor_sd": gain.sd,
        "least_over_priors": least.nats,
        "most_over_priors": most.nats,
        "prior_widths_unknown": unknown,
        "elpd_difference": None if predicted is None else predicted.nats,
        "elpd_difference_sd": None if predicted is None else predicted.sd,
    }
    said = f"{free['name']} against {whole['name']}: log evidence {gain}"
    if predicted is not None:
        said += f", log predictive density {predicted}"
    strong = least.nats - ERRORS * least.sd > STRONG
    denied = predicted is not None and -predicted.nats > max(TIE, ERRORS * predicted.sd)
    shown = predicted is None or predicted.nats > predicted.sd  # the evidence is strong by itself
    if strong and shown and not unknown:
        return told | {
            "verdict": "warranted",
            "sentence": (
                f"Fractional orders are warranted. {said}; least over priors half and twice as wide {least}."
            ),
        }
    if denied or most.nats + ERRORS * most.sd < 0:
        return told | {
            "verdict": "not warranted",
            "sentence": f"Fractional orders are not warranted. {said}.",
        }
    lacking = (
        "the evidence, or its prior's part, does not suffice"
        if not strong
        else "what was left out is predicted no better by more than a standard error"
        if not shown
        else f"whether the evidence hangs on the width of the priors is not known: {'; '.join(unknown)}"
    )
    return told | {
        "verdict": "not shown",
        "sentence": f"No win of fractional orders is claimed: {lacking}. {said}.",
    }


def _other_widths(free: Row, whole: Row) -> tuple[list[Gain], list[str]]:
    """Differences of log evidence under other prior widths, and in words those that could not be had."""
    out, unknown = [], []
    known = {one["factor"]: one for one in whole["prior_widths"]}
    for factor in FACTORS:
        pair = next((one for one in free["prior_widths"] if one["factor"] == factor), None), known.get(factor)
        missing = [
            row["name"]
            for row, one in zip((free, whole), pair, strict=True)
            if one is None or one["log_evidence"] is None
        ]
        if missing:
            names = " and ".join(missing)
            unknown.append(f"under priors {factor:g} times as wide {names} gave no evidence")
            continue
        one, other = pair
        assert one is not None
        assert other is not None
        out.append(Gain(one["log_evidence"] - other["log_evidence"], hypot(one["sd"], other["sd"])))
    return out, unknown


def undecided(why: str) -> dict[str, Any]:
    """A verdict that waits."""
    return {"verdict": "undecided", "sentence": f"Undecided: {why}."}
