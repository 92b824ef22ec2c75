"""What a loop found, as plain JSON values and in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lcopa_bayes.core.estimate import EQUAL_TAILED, attributes, plain
from lcopa_bayes.core.wording import listed
from lcopa_bayes.effectsearch.findings import Side
from lcopa_bayes.effectsearch.lags import ess_with_lags
from lcopa_bayes.effectsearch.leavingout import in_turn
from lcopa_bayes.effectsearch.loopresult import Loop
from lcopa_bayes.effectsearch.residuals import View, views
from lcopa_bayes.effectsearch.rounds import Round
from lcopa_bayes.effectsearch.scores import Score, pooled_coverage, pooled_rmse
from lcopa_bayes.effectsearch.trace import SEEN
from lcopa_bayes.model.effects.effect import Card, Effect
from lcopa_bayes.results.sumsoflags import sentence_of

FAR = 2.0
"""Shifts beyond so many standard deviations are listed [-]."""

SHOWN = 0.1
"""Weight beside that of the final model from which an effect that is open is listed [-]."""
_NEAREST = 4
"""Rivals that are listed for each named effect, and that a further record is to separate it from [-]."""


def results(result: Loop) -> dict[str, Any]:
    """Every number of the loop; `None` is open or undefined."""
    trace, unit = result.trace, result.problem.study.time_unit
    chances = trace.probabilities if trace else {}
    numbers: dict[str, Any] = {
        "study": result.problem.study.name,
        "verdict": result.verdict.kind,
        **attributes(result.verdict, "confidence", "sentence"),
        "cautions": result.cautions,
        "base_failed": result.base.failed,
        "base_enlarged": result.enlarged,
        "time_unit": unit,
        "grade": result.grade.level,
        "grade_reason": result.grade.reason,
        "noise": [
            {
                "axis": axis.name,
                "unit": axis.unit,
                **attributes(one.law, "sigma", "sigma_ar", "rho", "sd"),
                **attributes(one, "samples", "source", "sentence"),
            }
            for axis, one in zip(result.problem.study.response_axes, result.base.noise, strict=True)
        ],
        "effects": _effects(result, chances),
        "open": _open(result),
        "alternatives": {
            "sums_of_lags": [one.as_json() for one in result.lags],
            "sentence": sentence_of(result.lags),
            "plants": result.plants.sentence,
        },
        "outliers": result.outliers
        and attributes(result.outliers, "count", "share", "width", "log_bayes_factor", "sentence"),
        "before": side(result.before, result),
        "after": side(result.after, result),
        "unseen_by": in_turn(len(result.problem.study.fit)) if result.left_out else "held-out records",
        "survival": {one.name: one.survival for one in trace.traced} if trace else {},
        "invisible": [one.name for one in trace.traced if one.survival < SEEN] if trace else [],
        "evidence": _evidence(result),
        "rounds": [_round(one) for one in result.rounds],
        "moved": moved(result),
        "next_measurement": next_measurement(result),
        "parameters": [result.estimate(k) for k in range(result.after.state.model.plant_size)],
        "figures": _figures(result),
        "residual": {
            when: [{"name": view.name, "axis": view.axis, "sentence": view.sentence} for view in shown]
            for when, shown in _views(result).items()
        },
        "seed": result.problem.study.seed,
    }
    return plain(numbers)


def drawn(result: Loop) -> dict[str, Any]:
    """What the figures need beyond `results`: residual views and residuals before and after."""
    shown = {when: [view.as_json() for view in each] for when, each in _views(result).items()}
    return plain({"views": shown, "curves": _curves(result)})


def _views(result: Loop) -> dict[str, list[View]]:
    unit = result.problem.study.time_unit
    return {"before": views(result.before.state, unit), "after": views(result.after.state, unit)}


def side(one: Side, result: Loop) -> dict[str, Any]:
    """Errors before or after, pooled per axis and for each record."""
    axes = [axis.name for axis in result.problem.study.response_axes]
    noise = {score.axis: score.noise_sd for score in one.fit}
    fit = {axis: pooled_rmse(one.fit, axis) for axis in axes}
    unseen = {axis: pooled_rmse(one.unseen, axis) for axis in axes}
    return {
        "fit_rmse": fit,
        "held_out_rmse": unseen,
        "fit_rmse_over_noise": {axis: fit[axis] / noise[axis] for axis in axes if axis in noise},
        "held_out_rmse_over_noise": {axis: unseen[axis] / noise[axis] for axis in axes if axis in noise},
        "fit_coverage_90": pooled_coverage(one.fit),
        "held_out_coverage_90": pooled_coverage(one.unseen),
        "held_out_level_from": sorted({score.level_from for score in one.unseen}),
        "log_evidence": one.state.log_evidence,
        "scores": [score.as_json() for score in (*one.fit, *one.unseen)],
    }


def _effects(result: Loop, chances: dict[str, float]) -> list[dict[str, Any]]:
    model, optimum = result.after.state.model, result.after.state.optimum
    first, out = model.plant_size, []
    for number, effect in enumerate(result.effects):
        if effect.card.dynamics:
            continue
        own = [(k, one) for k, one in enumerate(model.effected.coefficients) if one.effect == number]
        out.append(
            {
                "name": effect.name,
                **attributes(effect.card, "place", "formula", "source"),
                "group": list(result.groups[number]),
                "nearest": _nearest(result, effect.name),
                "probability": chances.get(effect.name),
                "constants": _constants(result, effect),
                "parameters": [
                    result.estimate(first + k)
                    | {"prior_sd": float(model.scale[k]), "one_signed": one.coefficient.one_signed}
                    for k, one in own
                ],
                "disturbance": effect.card.disturbance,
                "significance": float(np.abs(optimum.x[first + own[0][0]] / optimum.sd[first + own[0][0]])),
            }
        )
    return out


def _constants(result: Loop, effect: Effect) -> list[dict[str, Any]]:
    """Internal constants of an effect."""
    ranges, time = result.after.state.model.effected.ranges, result.problem.study.time_unit
    units = {"time": time, "1/time": f"1/{time}"}
    known = {one.name: units.get(one.unit, one.unit) for one in effect.internal(ranges)}
    return [{"name": key, "value": value, "unit": known[key]} for key, value in effect.constants.items()]


def _figures(result: Loop) -> list[dict[str, Any]]:
    """Figures of the step responses; delays and steady values are among the parameters."""
    draws = result.draws
    ess, interval = np.nan, "Laplace"
    if draws is not None:
        ess, interval = ess_with_lags(draws.ess, result.lags), EQUAL_TAILED
    out = []
    for one in result.figures:
        if one.name.startswith(("delay[", "steady_state[")):
            continue
        said, grade = result.extrapolated.figure(one.name), result.grade.level
        shown = replace(one, note=f"{one.note}. {said}" if one.note else said) if said else one
        out.append(shown.as_json(ess=ess, grade="unusable" if said else grade, interval=interval))
    return out


def _open(result: Loop) -> list[dict[str, Any]]:
    """Effects that are open, with the weight of all their instances beside 1 of the final model, by it."""
    weights: dict[tuple[str, str], float] = {}
    for one in result.open:
        key = one.name, one.instead
        weights[key] = weights.get(key, 0.0) + one.weight
    return [
        {"name": name, "instead": bool(instead), "weight": weight}
        | {"said": f"{name}{f' in place of {instead}' if instead else ''} (weight {weight:.3g} beside 1)"}
        for (name, instead), weight in sorted(weights.items(), key=lambda one: -one[1])
        if weight > SHOWN
    ]


def _nearest(result: Loop, name: str) -> list[dict[str, Any]]:
    """Effects whose signatures lie closest to a named one, as what the base model cannot imitate of them."""
    assert result.trace is not None
    own = result.trace.of(name)
    others = [one for one in result.trace.traced if one.signatures and one.name != name]
    angles = {one.name: own.signature.cosine(one.signature) for one in others}
    ranked = sorted(angles, key=lambda other: -angles[other])[:_NEAREST]
    return [{"name": other, "cosine": angles[other]} for other in ranked]


def _evidence(result: Loop) -> dict[str, Any]:
    trace = result.trace
    if trace is None:
        empty = dict.fromkeys(("threshold", "threshold_between", "p_value", "least_p_value"))
        return {**empty, "draws": 0, "classes": []}
    chances = trace.probabilities
    return {
        "threshold": trace.threshold,
        "threshold_between": trace.between,
        "p_value": trace.p_value,
        "least_p_value": 1 / (trace.draws + 1),
        "draws": trace.draws,
        "none": chances["none"],
        "classes": [
            {
                **attributes(one, "name", "log_bayes_factor", "survival", "failed"),
                **attributes(one.card, "place", "reveals", "mistaken_for"),
                "probability": chances[one.name],
                "instances": len(one.signatures),
            }
            for one in trace.traced
        ],
    }


def _round(one: Round) -> dict[str, Any]:
    return {
        **attributes(one.trace, "largest", "threshold", "p_value"),
        "leading": [attributes(each, "name", "log_bayes_factor") for each in one.trace.traced[:6]],
        "refits": [
            {
                **attributes(candidate, "added", "log_bayes_factor", "significant"),
                "left_out_gain": candidate.left_out,
                "converged": candidate.optimum.converged,
                "ended": not candidate.glances,
            }
            for candidate in one.refits
        ],
        "failures": list(one.failures),
        "chosen": list(one.chosen.added) if one.chosen else [],
    }


def _curves(result: Loop) -> list[dict[str, Any]]:
    """Residuals before and after, thinned for drawing."""
    pairs = [*zip(result.before.fit, result.after.fit, strict=True)]
    if not result.left_out:
        pairs += [*zip(result.before.unseen, result.after.unseen, strict=True)]
    return [_curve(before, after) for before, after in pairs]


def _curve(before: Score, after: Score, most: int = 1500) -> dict[str, Any]:
    step = max(1, -(-before.time.size // most))
    return {
        **attributes(before, "record", "axis", "unit", "held_out"),
        "time": before.time[::step],
        "observed": before.observed[::step],
        "noise_sd": before.noise_sd,
        "before": (before.observed - before.predicted)[::step],
        "after": (after.observed - after.predicted)[::step],
        "half_width_before": before.half_width[::step],
        "half_width_after": after.half_width[::step],
    }


def words(numbers: dict[str, Any]) -> Sequence[str]:
    """Lines for a reader."""
    out = [f"{numbers['verdict']} ({numbers['confidence']}): {numbers['sentence']}"]
    out += [one for one in (numbers["base_enlarged"], *(f"caution: {c}" for c in numbers["cautions"])) if one]
    for effect in numbers["effects"]:
        group = f" (confounded with {', '.join(effect['group'][1:])})" if len(effect["group"]) > 1 else ""
        out.append(f"effect {effect['name']}, acts on the {effect['place']}{group}")
        out += [
            f"  {p['name']} = {p['value']:.4g} [{p['lower']:.4g}, {p['upper']:.4g}] {p['unit']}, {p['grade']}"
            for p in effect["parameters"][:6]
        ]
    before, after = numbers["before"], numbers["after"]
    for axis, value in before["fit_rmse"].items():
        said = f"axis {axis}: fit RMSE {value:.4g} -> {after['fit_rmse'][axis]:.4g}"
        unseen = before["held_out_rmse"][axis], after["held_out_rmse"][axis]
        if None not in unseen:  # no held-out record may have a sample of this axis
            said += f", unseen {unseen[0]:.4g} -> {unseen[1]:.4g} ({numbers['unseen_by']})"
        out.append(said)
    coverage = [numbers[side]["held_out_coverage_90"] for side in ("before", "after")]
    if None not in coverage:
        first, last = (f"{100 * share:.0f} %" for share in coverage)
        out.append(f"pointwise 90 % bands hold {first} of unseen samples before, {last} after")
    out += [f"next measurement: {numbers['next_measurement']}"] if numbers["next_measurement"] else []
    return out


def moved(result: Loop) -> list[dict[str, Any]]:
    """Plant parameters that the effects moved by more than two standard deviations of the fit with them."""
    if not result.effects:
        return []
    before, after = result.before.state, result.after.state
    base, n = result.base.model, after.model.plant_size
    first, last = base.values(before.optimum.x), after.model.values(after.optimum.x)
    sds = np.sqrt(np.diag(after.covariance))[:n]
    out = []
    rows = base.plant.table.rows
    for position, k in enumerate(base.columns):
        shift = (after.optimum.x[position] - before.optimum.x[position]) / sds[position]
        if abs(shift) > FAR:
            out.append(
                attributes(rows[k], "name", "unit")
                | {"before": first[k], "after": last[k], "shift_in_sd": shift}
            )
    return sorted(out, key=lambda row: -abs(row["shift_in_sd"]))


def next_measurement(result: Loop) -> str:
    """In words: what excitation splits a group, finds what is unexplained, or shows what stayed invisible."""
    trace = result.trace
    if any(one.gross for one in result.contrary):
        return "Correct the records that disagree first."
    if trace is None:
        return "Mend the base fit first: give it records in which it can follow the response."
    if not result.base.noise_known:
        quiet = (
            "a stretch before the first command, or a repeat, so that the noise is known apart from the fit"
        )
        return f"Record {quiet}."
    cards = {one.name: one.card for one in trace.traced}
    for group in result.groups:
        if len(group) > 1:
            wanted = _wanted([cards[name] for name in group[: _NEAREST + 1] if name in cards])
            return f"To separate {group[0]} from {listed(group[1:], _NEAREST)}, record {wanted}."
    if result.verdict.kind == "unexplained":
        if result.lags:
            return "Record until the responses settle, and sample their onset: sums of lags leave both open."
        alone = [one.remedy for one in result.contrary if len(one.records) == 1]
        if alone:
            return f"{alone[0][0].upper()}{alone[0][1:]}."
        near = [one for one in trace.traced if one.card.place != "generic"][:2]
        return f"To find what is missing, record {_wanted([one.card for one in near])}." if near else ""
    hidden = [one for one in trace.traced if one.survival < SEEN and one.card.place != "generic"]
    if hidden:
        names = ", ".join(one.name for one in hidden[:3])
        return f"These records could not show {names}; {_wanted([one.card for one in hidden[:3]])} would."
    return ""


def _wanted(cards: Sequence[Card]) -> str:
    """What reveals these effects, each excitation once."""
    excitations = (part.strip() for card in cards for part in card.reveals.split(";")[0].split(","))
    several = [one for one in dict.fromkeys(excitations) if one != "any record"]
    return ", ".join(several) or "a further record"
