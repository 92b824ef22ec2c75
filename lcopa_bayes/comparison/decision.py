"""Which candidate is preferred, why, and whether fractional orders are warranted."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot
from typing import Any

from lcopa_bayes.comparison.averaging import (
    ERRORS,
    STRONG,
    TIE,
    Gain,
    Row,
    by_evidence,
    by_prediction,
    simplest,
)
from lcopa_bayes.comparison.priorwidth import FACTORS
from lcopa_bayes.core.units import measured
from lcopa_bayes.core.wording import joined
from lcopa_bayes.results.residuals import WHITE_P


def fractional(usable: Sequence[Row]) -> dict[str, Any]:
    """Whether the best fractional candidate is warranted against the best integer one, and against sums of
    lags (`results.sumsoflags`), which are integer models too.

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
    values = {
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
    lags = [one for one in free["sums_of_lags"] if one["support"] != "plant"]
    rivals = f"{whole['name']} and sums of lags" if free["sums_of_lags"] else whole["name"]
    strong = least.nats - ERRORS * least.sd > STRONG
    denied = predicted is not None and -predicted.nats > max(TIE, ERRORS * predicted.sd)
    shown = predicted is None or predicted.nats > predicted.sd  # the evidence is strong by itself
    if strong and shown and not unknown and not lags:
        return values | {
            "verdict": "warranted",
            "sentence": (
                f"Fractional orders are warranted, against {rivals}. {said}; least over priors half and "
                f"twice as wide {least}."
            ),
        }
    preferred = [one for one in lags if one["support"] == "lags"]
    if denied or preferred or most.nats + ERRORS * most.sd < 0:
        if preferred:
            better = _lags(free, preferred)
            said = f"{better[0].upper()}{better[1:]} better. {said}"
        return values | {
            "verdict": "not warranted",
            "sentence": f"Fractional orders are not warranted. {said}.",
        }
    lacking = (
        "the evidence, or its prior's part, does not suffice"
        if not strong
        else f"{_lags(free, lags)} as well"
        if lags
        else "what was left out is predicted no better by more than a standard error"
        if not shown
        else f"whether the evidence hangs on the width of the priors is not known: {'; '.join(unknown)}"
    )
    return values | {
        "verdict": "not shown",
        "sentence": f"No win of fractional orders is claimed: {lacking}. {said}.",
    }


def _lags(free: Row, lags: Sequence[Row]) -> str:
    """Which sums of lags follow the records, without how well."""
    parts = [
        f"{one['said']} for {', '.join(one['paths'])} (AIC "
        f"{'lower' if one['aic_advantage'] > 0 else 'higher'} by {abs(one['aic_advantage']):.1f})"
        for one in lags
    ]
    return f"beside {free['name']}, {' and '.join(parts)} follow the records"


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


RESONANT = 1.5
"""Order from which a single term overshoots visibly [-]."""


def decided(rows: Sequence[Row]) -> dict[str, Any]:
    """Preferred candidate with the reason, the flag of disagreement, and the verdict on fractional orders."""
    unranked = [
        {"name": row["name"], "reason": f"its posterior is unusable: {row['grade_reason']}"}
        for row in rows
        if not row["usable"]
    ]
    undefined = [
        {"name": row["name"], "reason": f"its evidence is undefined: {row['evidence_undefined']}"}
        for row in rows
        if row["usable"] and row["log_evidence"] is None
    ]
    usable = [row for row in rows if row["usable"]]
    weighed = [row for row in usable if row["log_evidence"] is not None]
    values = {"unranked": unranked, "evidence_undefined": undefined, "flags": flags(rows)}
    if len(usable) < 2:
        why = "fewer than two candidates have a usable posterior: nothing can be compared"
        return values | {
            "preferred": None,
            "why": joined([why]),
            "agreement": {"agree": None, "sentence": joined([why])},
            "fractional": undecided(why),
            "by_evidence": None,
            "by_prediction": None,
        }
    evident = simplest(weighed, by_evidence, "log_evidence") if weighed else None
    predictive = simplest([row for row in usable if row["elpd"] is not None], by_prediction, "elpd")
    agree, sentence = _agreement(evident, predictive, usable)
    preferred = evident or predictive
    unseen = any(row["held_out"] for row in usable)
    if agree is False and unseen and predictive is not None:
        preferred = predictive
    why = _why(preferred, evident, usable, agree, sentence, unseen)
    why += "".join(
        f" {row['name']} is not ranked: it has not met a mode of a model that it contains."
        for row in rows
        if not row["containment"]["met"]
    )
    return values | {
        "preferred": None if preferred is None else preferred["name"],
        "why": why,
        "agreement": {"agree": agree, "sentence": sentence},
        "fractional": fractional(usable),
        "by_evidence": None if evident is None else evident["name"],
        "by_prediction": None if predictive is None else predictive["name"],
    }


def _agreement(evident: Row | None, predictive: Row | None, usable: Sequence[Row]) -> tuple[bool | None, str]:
    """Whether the records left out contradict the evidence, in words."""
    if evident is None or predictive is None or evident["elpd"] is None:
        return None, "Either evidence or prediction is missing; only one of them decides."
    best = max((row for row in usable if row["elpd"] is not None), key=lambda row: row["elpd"])
    if best is evident:
        return True, f"Evidence and prediction agree: {evident['name']} also predicts best."
    lost = by_prediction(best, evident)
    assert lost is not None
    if not lost.counts:
        return True, (
            f"Evidence and prediction agree: no candidate predicts better than {evident['name']} beyond "
            f"chance (best: {best['name']}, {lost})."
        )
    last = min((row for row in usable if row["elpd"] is not None), key=lambda row: row["elpd"])
    worst = " and predicts worst of all" if last is evident else ""
    rivals = [row for row in usable if row["log_evidence"] is not None]
    highest = max(rivals, key=lambda row: row["log_evidence"]) is evident
    stands = "has the highest evidence" if highest else "is the simplest that no evidence speaks against"
    return False, (
        f"Fit and prediction disagree: {evident['name']} {stands}{worst}, but {best['name']} "
        f"predicts what was left out better by {lost}. The models leave something out that both notice "
        "differently."
    )


def _why(
    preferred: Row | None,
    evident: Row | None,
    usable: Sequence[Row],
    agree: bool | None,
    sentence: str,
    unseen: bool,
) -> str:
    """The decision with its reason."""
    if preferred is None:
        return "No candidate has a score to be ranked by."
    name = preferred["name"]
    if evident is None:
        return f"{name} is preferred by prediction alone: no candidate has an evidence."
    if preferred is not evident or agree is False:
        reason = "records that were not fitted decide" if unseen else "no whole record was held out to decide"
        return f"{name} is preferred, with a warning: {sentence} Here {reason}."
    richer = [row for row in usable if row["parameters"] > preferred["parameters"]]
    others = [row for row in usable if row is not preferred and row not in richer]
    parts = [f"{row['name']}, with more parameters, gains {gain}" for row, gain in _gains(richer, preferred)]
    parts += [f"{row['name']} differs by {gain}" for row, gain in _gains(others, preferred)]
    word = "suffices" if richer else "is preferred"
    return f"{name} {word}: in log evidence {'; '.join(parts)}. {sentence}"


def _gains(rows: Sequence[Row], against: Row) -> list[tuple[Row, Gain]]:
    """Rows with what they gain over another, the best first; those without evidence are left out."""
    gains = [(row, by_evidence(row, against)) for row in rows]
    return sorted(((row, gain) for row, gain in gains if gain is not None), key=lambda pair: -pair[1].nats)


def flags(rows: Sequence[Row]) -> list[dict[str, str]]:
    """What a reader must not overlook, per candidate."""
    out: list[dict[str, str]] = []
    for row in rows:
        out += missed_modes(row)
        if not row["usable"]:
            continue
        left = [one for one in row["residual_tests"] if not one["held_out"]]
        worst = min(left, key=lambda one: one["p_white"], default=None)
        if worst is None or len(left) * worst["p_white"] >= WHITE_P:  # corrected for all that are tested
            continue
        high = [one["estimate"] for one in row["order_is_integer"] if one["estimate"]["lower"] > RESONANT]
        said = (
            f"on {worst['record']}, axis {worst['axis']}, what it leaves is not white "
            f"(p = {worst['p_white']:.1g})"
        )
        if high:
            names = ", ".join(f"{one['name']} = {one['value']:.3g}" for one in high)
            said = (
                f"{names} makes it overshoot, and {said}: the high order may imitate an overshoot of another "
                "origin, such as a pulse of the drive that is not in the record"
            )
        out.append({"model": row["name"], "kind": "imitation" if high else "residual", "sentence": said})
    ranked = [row for row in rows if row["usable"] and row["held_out"]]
    for axis, unit in {one["axis"]: one["unit"] for row in ranked for one in row["fit_scores"]}.items():
        fitted = min(ranked, key=lambda row: row["residual_rms"][axis])
        error = {row["name"]: row["held_out_rmse"].get(axis) for row in ranked}
        if None in error.values() or len(ranked) < 2:
            continue
        if max(error, key=lambda name: error[name]) == fitted["name"]:
            least = min(error, key=lambda name: error[name])
            out.append(
                {
                    "model": fitted["name"],
                    "kind": "overfit",
                    "sentence": (
                        f"it fits axis {axis} best (RMSE {measured(fitted['residual_rms'][axis], unit)}) and "
                        f"predicts it worst (RMSE {measured(error[fitted['name']], unit)}; {least}: "
                        f"{measured(error[least], unit)})"
                    ),
                }
            )
    return out


def missed_modes(row: Row) -> list[dict[str, str]]:
    """That a candidate was sampled again because a model it contains had found a mode it had missed."""
    held = row["containment"]
    missed = [one for one in held["contains"] if one["missed"]]
    if not missed:
        return []
    best = max(missed, key=lambda one: one["reached"])
    said = (
        f"its first sampling missed a mode that {best['model']}, which it contains, had found (best log "
        f"likelihood {best['own']:.1f} against {best['reached']:.1f} there); it was sampled again with that "
        "mode among the proposals"
    )
    if not held["met"]:
        said += ", and still has not met it: it is ranked nowhere"
    return [{"model": row["name"], "kind": "missed mode", "sentence": said}]
