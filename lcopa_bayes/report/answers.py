"""What stands first on the page of a verb: a reader's questions, each answered in a sentence from the result,
with the section that has more."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from math import log10
from typing import Any, NamedTuple, TypeAlias, final

from lcopa_bayes.core.units import measured
from lcopa_bayes.core.wording import joined, listed
from lcopa_bayes.report.formatting import (
    ends,
    figures,
    percent,
    probability,
    spread,
    stopped,
    to_spread,
    with_error,
)
from lcopa_bayes.results.summary import grouped

Values: TypeAlias = Mapping[str, Any]


@final
class Answer(NamedTuple):
    """A question, its answer in a sentence, and the title of the section that has more."""

    question: str
    answer: str
    section: str = ""


_Answers: TypeAlias = Iterable[tuple[str, str, str]]


def answers(verb: str, values: Values) -> list[Answer]:
    """The answers of a verb's result, those that have nothing to say left out; none for other verbs.

    KeyError where the values lack an entry.
    """
    given = _ANSWERS[verb](values) if verb in _ANSWERS else ()
    return [Answer(*one) for one in given if one[1]]


def _audit(v: Values) -> _Answers:
    rows, others = v["parameters"], dict[str, list[str]]()
    for row in rows:
        others.setdefault(row["verdict"], []).append(row["name"])
    sure = others.pop("identified", [])
    yield "What do the records determine?", f"{_of(sure, rows, 'parameter')}.", "Verdicts"
    rest = joined(f"{verdict}: {listed(names)}" for verdict, names in others.items())
    yield "What do they leave open?", rest, "Verdicts"
    for best in v["functions"][:1]:
        known = f"Best is {best['name']}, {measured(ends(best), best['unit'])} with 90 % probability"
        said = f"{known}; the draws behind it are {v['grade']}."
        yield "Which numbers can be trusted?", said, "Best-determined functions"
    limits = [one["reason"] for one in v["limitations"]]
    limits += [one["sentence"] for one in v["symmetries"] if one["kind"] != "exchange"]
    seen = "Nothing that the checks of the model against its records could see."
    yield "What is missing?", joined(limits) or seen, "Symmetries"
    advice = v["next_measurement"]
    if advice is None:
        remedies = [one["remedy"] for one in v["limitations"] if one["remedy"]]
        said = joined(remedies) or "Nothing for these parameters: all are identified."
    elif advice.get("words"):
        said = f"A record of {advice['time']:g} {advice['time_unit']} with the drive {advice['words']}."
    else:
        said = joined([advice["reason"]])
    yield "What next?", said, "What to measure next"


def _compare(v: Values) -> _Answers:
    rows, name = {row["name"]: row for row in v["models"]}, v["preferred"]
    best, flagged = rows.get(name), {one["model"]: one["sentence"] for one in v["flags"]}
    said = f"{name} of {len(rows)} candidates: {best['about']}." if best else stopped(v["why"])
    yield "Which model?", said, "Scores"
    weighed = [row for row in rows.values() if row["usable"] and row["log_evidence"] is not None]
    if best is not None and best in weighed:
        gaps = [(row["log_evidence"] - best["log_evidence"], row["name"]) for row in weighed if row != best]
        said = _stopped([f"{other} gains {gap:+.1f} nat" for gap, other in sorted(gaps, reverse=True)[:3]])
        yield "How do others compare in log evidence?", said, "Scores"
    free, said = v["fractional"], v["fractional"]["sentence"]
    word = {"warranted": "Yes", "not warranted": "No", "not shown": "Not shown"}.get(free["verdict"])
    if word:
        gain = with_error(free["log_bayes_factor"], free["log_bayes_factor_sd"])
        said = f"{word}: {free['fractional']} gains {gain} nat of log evidence over {free['integer']}."
    yield "Are fractional orders needed?", said, "Scores"
    yield "Does it predict?", _unseen(best["held_out"] if best else ()), "Prediction"
    yield "Which numbers can be trusted?", _graded(v["averaged"]), "Numbers over all models"
    worst = sorted(flagged, key=lambda other: other != name)
    lacking = [f"{other}: {flagged[other]}" for other in worst]
    lacking += [f"{one['name']} is not ranked: {one['reason']}" for one in v["unranked"]]
    white = "The residuals of every candidate are compatible with its noise model."
    yield "What is missing?", _stopped(lacking[:2]) or white, "Warnings"
    if best is None:
        said = "Sample the candidates longer, or change their priors."
    elif name in flagged:
        said = f"`loop` looks for what {name} leaves out."
    elif not best["held_out"]:
        said = "Hold out a record (--held-out), so that prediction can decide too."
    else:
        said = f"Fit and audit {name} by itself."
    yield "What next?", said, ""


_UNNAMED = {"clean": "Nothing that these records could show", "unexplained": "Something without a name"}
"""What a model lacks by a verdict without effects."""


def _loop(v: Values) -> _Answers:
    names = [one["name"] for one in v["effects"]]
    unnamed = _UNNAMED.get(v["verdict"], v["verdict"].capitalize())
    said = f"{listed(names) or unnamed} ({v['confidence']})."
    yield "What does the model lack?", said, "What was missing"
    scores = zip(v["before"]["scores"], v["after"]["scores"], strict=True)
    held = [(before, after) for before, after in scores if after["held_out"]]
    if held:
        before, after = max(held, key=lambda pair: pair[1]["rmse_over_noise"] or 0.0)
        error = f"{measured(figures(after['rmse']), after['unit'])} rms"
        change = f"goes from {figures(before['rmse'])} to {error}" if names else f"errs by {error}"
        if after["rmse_over_noise"] is not None:
            change += f", {figures(after['rmse_over_noise'])} times the noise"
            # an error far above the noise is no contradiction where the model leaves as much open
            change += f"; the 90 % band holds {percent(after['coverage_90'])} of its samples"
        said = f"The worst held-out response, {after['record']}/{after['axis']}, {change}."
        yield f"How good is it{' with that' * bool(names)}?", said, "Errors before and after"
    found = [row for one in v["effects"] for row in one["parameters"]]
    yield "Which numbers can be trusted?", _graded(found), "What was missing"
    moved = [f"{row['name']} by {figures(abs(row['shift_in_sd']), 2)} sd" for row in v["moved"]]
    said = f"Biased without it: {listed(moved, 4)}." if moved else "Without it no parameter was biased."
    yield "What was wrong before?", said * bool(names), "Bias of the parameters without the effect"
    groups = [(one["name"], one["group"][1:]) for one in v["effects"] if one["group"][1:]]
    doubts = [f"{name} may as well be {listed(others)}" for name, others in groups]
    first = [one.partition(". ")[0] for one in v["cautions"][:1]]
    more = [f"{len(v['cautions']) - 1} more below"] if len(v["cautions"]) > 1 else []
    yield "What stays uncertain?", _stopped([*doubts, *first, *more]), "What was missing"
    done = "Fit explained.toml, the study with what was found." if names else "Nothing: the model suffices."
    yield "What next?", v["next_measurement"] or done, "What was missing"


def _design(v: Values) -> _Answers:
    best, gain = v["winner"], v["factor_over_step"]
    if best is None:
        yield "What to measure next?", "No drive tried determines any parameter.", "Drives"
    else:
        said = f"{best['drive']} for {v['time']:g} {v['time_unit']}: {best['words']}."
        yield "What to measure next?", said, "Recommended drive" if v["template"] else "Drives"
        times = f"{figures(gain['value'], 2)} times ({ends(gain)} over draws)"
        said = f"{gain['parameter']}, the worst, gets {times} more precise than by a step of equal time."
        if gain["value"] is None:
            said = f"At most draws a step of equal time leaves open what it determines, {gain['parameter']} "
            said += "worst."
        elif gain["value"] == 1:
            said = f"Nothing: for {gain['parameter']}, the worst, no drive tried is better than a step."
        yield "How much does it gain?", said, "Drives"
    held = [one["confirmed"] for one in v["confirmed"]["trials"]]
    if held:
        said = f"Simulation confirms the gain at {sum(held)} of {len(held)} true values"
        said += f"; linear bounds hold at {percent(v['linear_share'])} of the draws, which are {v['grade']}."
        yield "Can that be trusted?", said, "Confirmation"
    lost = [row["name"] for row in v["parameters"] if row["time_for_10_percent"] is None]
    said = f"No drive tried brings {listed(lost)} to 10 %." if lost else "Nothing: all can reach 10 %."
    yield "What stays open?", said, "Gain of each parameter"
    if v["template"]:
        yield "What next?", f"Play the drive of {v['template']} and fill in its responses.", "Drives"


def _calibrate(v: Values) -> _Answers:
    rows, outside = v["coverage"], [row for row in v["coverage"] if not row["within"]]
    said = f"{v['replicas']} simulated studies, each fitted like {v['study']}."
    yield "What was tested?", said, "Replicas"
    missed = [
        f"{row['parameter']} at {percent(row['level'])} covers {percent(row['observed'])}" for row in outside
    ]
    said = f"As often as stated, within chance, in all {len(rows)} cases."
    if outside:
        said = f"{len(outside)} of {len(rows)} do not as stated: {listed(missed, 3)}."
    yield "Do the intervals hold the truth?", said, "Coverage"
    worst = min(v["ranks"], key=lambda row: row["p_value"])
    least = f"least so those of {worst['parameter']}, {probability(worst['p_value'])} by itself"
    yield "Are the ranks uniform?", f"Overall {probability(v['p_value'])}; {least}.", "Ranks"
    counted = [f"{n} {name}" for name, n in v["grades"].items() if n]
    yield "Which replicas can be trusted?", f"{', '.join(counted)}.", "Replicas"
    widest = max(row["upper"] - row["lower"] for row in rows)
    yield "How sharp is the test?", f"Chance bands are up to {percent(widest)} wide.", "Coverage"
    said = "Use the intervals as stated; more replicas (--replicas) narrow the bands of chance."
    if outside:
        narrow = sorted({row["parameter"] for row in outside if row["observed"] < row["level"]})
        said = f"Do not rely on intervals of {listed(narrow)}: they are too narrow."
        said = said if narrow else "Intervals that miss are too wide: safe, but not sharp."
    yield "What next?", said, ""


def _predict(v: Values) -> _Answers:
    for row in v["axes"]:
        value = measured(to_spread(row["value_at_end"], spread(row)), row["unit"])
        at = f"{row['end']:.4g} {v['time_unit']}"
        said = f"To {value} at {at}, {ends(row)} with 90 % probability."
        yield f"Where does {row['axis']} go?", said, "Predicted response"
    widths = [
        (row["axis"], measured(figures(row["half_width_simultaneous"], 2), row["unit"])) for row in v["axes"]
    ]
    widest = ", ".join(f"{axis} ±{width}" for axis, width in widths)
    yield "How sure is that?", f"90 % bands of whole curves are at most {widest}.", "Predicted response"
    yield "Does it match?", _unseen(v["scores"]), "Scores"
    said = f"In {len(v['outside'])} respects it leaves" if v["outside"] else "It stays within"
    said = f"{said} the range of the fit records; the draws are {v['grade']}."
    yield "Can the drive be predicted?", said, "Fitted range"
    said = "Record a response to such a drive before relying on it." if v["outside"] else ""
    yield "What next?", said, "Fitted range"


def scatter_at_rest(record: Values) -> list[tuple[float, str]]:
    """Scatter at rest over the range of each response of a checked record [-], with its axis."""
    return [
        (one["scatter"] / (one["highest"] - one["lowest"]), one["axis"])
        for one in record["responses"]
        if one["samples"] and one["scatter"] is not None and one["highest"] > one["lowest"]
    ]


def _check(v: Values) -> _Answers:
    yield "What is the plant?", v["sentences"][0], "Plant"
    fitted = [row for row in v["records"] if not row["held_out"]]
    axes = [(one, row) for row in fitted for one in row["responses"] if one["samples"]]
    noisy = [
        (share, f"{row['record']}/{axis}", row) for row in fitted for share, axis in scatter_at_rest(row)
    ]
    if noisy:
        share, name, row = max(noisy, key=lambda each: each[0])
        scatter = f"{figures(100 * share, 2)} % of the range of the response ({name})"
        said = f"At rest samples scatter by up to {scatter}."
        yield "How good are the records?", said, f"Record {row['record']}"
    else:
        yield "How good are the records?", "No record has samples at rest that show the noise.", ""
    seen = [(one["onset"], one["axis"], row) for one, row in axes if one["onset"] is not None]
    if seen:
        onset, axis, row = min(seen, key=lambda each: each[0])
        said = f"{axis} of {row['record']} moves first, {figures(onset)} {v['time_unit']} after a drive."
        yield "Is there a delay?", said, f"Record {row['record']}"
    default = [row["name"] for row in v["parameters"] if row.get("from") == "default"]
    said = f"{len(default)} of {len(v['parameters'])} priors come from the records by rule."
    yield "What is assumed?", said, "Priors"
    lacking = [one.rstrip(".") for one in (*v["problems"], *v["disagreements"])]
    place = "Remarks" if lacking else "Plant"
    if len(fitted) == len(v["records"]):
        lacking.append("no record is held out to test the prediction")
    yield "What is missing?", joined(lacking), place
    ready = f"`fit` samples the {len(v['parameters'])} parameters of {v['study']}."
    yield "What next?", "Mend what is missing, then check again." if v["problems"] else ready, ""


def _claims(v: Values) -> _Answers:
    rows, questions = v["claims"], ("Which claims hold?", "Which do not?", "Which are undecided?")
    for question, verdict in zip(questions, ("supported", "contradicted", "undecided"), strict=True):
        ids = [row["id"] for row in rows if row["verdict"] == verdict]
        yield question, f"{_of(ids, rows, 'claim', len(rows))}.", "Verdicts"
    said = f"Audits and comparisons (--audit, --compare) for {listed(ids, len(ids))}."
    yield "What is missing?", said if ids else "Nothing: every claim is decided.", "Verdicts"


def _identify(v: Values) -> _Answers:
    odd = list[str]()
    for path in v["paths"]:
        models = sorted(path["models"], key=lambda one: one["output_rmse"])
        best, whole = models[0], next((one for one in models if "integer" in one["method"]), None)
        orders = ", ".join(map(figures, best["orders"]))
        error = f"{measured(figures(best['output_rmse']), path['response_unit'])} rms"
        delay = f"{figures(best['delay'])} {v['time_unit']}"
        said = f"Orders {orders}, delay {delay} ({best['method']}) leave {error}"
        said += f"; integer orders {figures(whole['output_rmse'])}" if whole not in (None, best) else ""
        yield f"What is the path {path['path']}?", f"{said}.", "Identified models"
        odd += [f"{path['path']}, {one['method']}" for one in models if not one["physical"]]
    held = [(row["curves"][0], row) for row in v["records"] if row["held_out"]]
    said = "Untested: no record was held out."
    if held:
        one, row = max(held, key=lambda each: each[0]["rmse"])
        error = f"{one['model']} misses by {measured(figures(one['rmse']), row['unit'])} rms"
        said = f"On {row['record']}/{row['axis']}, the worst held out, {error}."
    yield "Does it predict?", said, "Records and models"
    said = (
        f"Not physical, a viscosity or k is negative: {listed(odd)}." if odd else "All models are physical."
    )
    yield "Which numbers can be trusted?", said, "Identified models"
    rows = v["step_metrics"]
    late = [f"{row['metric']} of {row['path']}" for row in rows if None in row["values"].values()]
    said = f"Not reached within a record by some model: {listed(late)}." if late else ""
    yield "What is missing?", said, "Step metrics"
    credible = any(row["posterior"] for row in rows)
    said = "" if credible else "`fit` gives intervals, --posterior shows them here."
    yield "What next?", said, "Step metrics"


def _optics(v: Values) -> _Answers:
    array, steering = v["array"], "Far field along one axis"
    apart = figures(array["pitch_m"] / array["wavelength_m"])
    said = f"{array['elements']} elements, {apart} wavelengths apart."
    yield "What is the array?", said, steering
    off = max(abs(row["main_lobe_deg"] - row["target_deg"]) for row in v["steering"])
    sides = [row["side_lobe"] for row in v["steering"] if row["side_lobe"]]
    said = f"Main lobes are up to {figures(off, 2)} deg off" if off > 1e-6 else "Main lobes hit their targets"
    said += f"; side lobes are at most {figures(10 * log10(max(sides)))} dB" if sides else ""
    yield "Does it steer?", f"{said}.", steering
    others = [row for row in v["grating_lobes"] if row["order"]]
    if others:
        worst = max(others, key=lambda row: row["with_element"])
        where = f"at {figures(worst['angle_deg'])} deg when steered to {figures(worst['target_deg'])} deg"
        said = f"A lobe {where} has {percent(worst['with_element'])} of the main lobe."
        yield "Where else does light go?", said, steering
    law, low = v["tilt_law"][0], v["threshold_voltage"]
    printed, best = (figures(law[key]["r_squared"]) for key in ("printed", "best"))
    said = f"The director tilts above {figures(low['value'])} {low['unit']}; up to {figures(law['to_V'])} V "
    said += f"Eq. 24 as printed has R² = {printed}, its best form {best}."
    yield "Does the tilt law hold?", said, "Director"
    last = v["chain"][-1]
    error = abs(last["angle_linearised_rad"] - last["angle_rad"])
    angle = f"{figures(error, 2)} rad of {figures(last['angle_rad'])} rad"
    said = f"At {figures(last['voltage_V'])} V Eq. 26 is off by {angle}."
    yield "How far is the chain linear?", said, "From volts to angle"


def _fleet(v: Values) -> _Answers:
    devices, counts = v["devices"], v["counts"]
    ended = ", ".join(f"{count} {grade}" for grade, count in counts.items() if count)
    yield "How did the devices end?", f"{len(devices)} by `{v['of']}`: {ended}.", "Devices"
    rows = [row for group in v["groups"][:1] for row in group["parameters"]]
    each = [
        f"{row['name']} {measured(figures(row['mean']['value']), row['unit'])}, "
        f"spread {figures(row['spread']['value'], 2)}"
        for row in rows
    ]
    yield "What are they like?", _stopped(each[:4]), "Population"
    odd = [f"{row['device']} ({row['differs_in']})" for row in devices if row["differs_in"]]
    yield "Which differ?", f"{listed(odd) or 'None stands out'}." * bool(rows), "Devices that differ"
    yield "Which numbers can be trusted?", _graded(rows), "Population"
    failed = [row["device"] for row in devices if row["grade"] == "failed"]
    yield "What is missing?", f"Without a result: {listed(failed)}." * bool(failed), "Devices"
    said = 'The population is a prior for the next study: [priors] from = "fleet.json".' * bool(rows)
    if failed:
        said = "Mend what failed and run `fleet` again: finished devices are kept."
    elif odd:
        said = f"Measure {odd[0].partition(' ')[0]} again: what differs may be the device or its record."
    yield "What next?", said, "Devices"


_ANSWERS: Mapping[str, Callable[[Values], _Answers]] = {
    "audit": _audit,
    "compare": _compare,
    "loop": _loop,
    "design": _design,
    "calibrate": _calibrate,
    "predict": _predict,
    "check": _check,
    "claims": _claims,
    "identify": _identify,
    "optics": _optics,
    "fleet": _fleet,
}


def _graded(rows: Iterable[Values]) -> str:
    return grouped((row["name"], row["grade"]) for row in rows)


def _unseen(scores: Iterable[Values]) -> str:
    """How well the worst of responses that were not fitted is predicted; empty without any."""
    worst = min(scores, key=lambda row: row["coverage_90"], default=None)
    if worst is None:
        return ""
    name = "/".join(str(worst[key]) for key in ("record", "axis") if key in worst)
    share, error = percent(worst["coverage_90"]), f"{measured(figures(worst['rmse']), worst['unit'])} rms"
    return (
        f"The worst unseen response, {name}, has {share} of its samples in the 90 % band and errs by {error}."
    )


def _of(names: Sequence[str], rows: Sequence[Values], noun: str, most: int = 8) -> str:
    return f"{len(names) or 'None'} of {len(rows)} {noun}s{': ' * bool(names)}{listed(names, most)}"


def _stopped(clauses: Sequence[str]) -> str:
    """Clauses that may begin with names, as a sentence; empty without any."""
    return f"{'; '.join(one.rstrip('.') for one in clauses)}." if clauses else ""
