"""The answers on top of each page follow the result: another number, verdict or grade is another sentence."""

# ruff: noqa: E501, RUF001

from __future__ import annotations

from copy import deepcopy
from typing import Any

import numpy as np
import pytest
from small import TWO, problem, record

from lcopa_bayes.report import write_page
from lcopa_bayes.report.answers import _ANSWERS, Answer, answers
from lcopa_bayes.report.pages import _PAGES
from lcopa_bayes.results.summary import plant


def row(name: str, grade: str = "reliable", **more: Any) -> dict[str, Any]:
    return {"name": name, "grade": grade, **more}


def score(record: str, coverage: float, rmse: float = 2e-4, **more: Any) -> dict[str, Any]:
    return {"record": record, "axis": "x", "unit": "rad", "rmse": rmse, "coverage_90": coverage, **more}


def model(name: str, evidence: float, **more: Any) -> dict[str, Any]:
    given = {"about": f"about {name}", "usable": True, "log_evidence": evidence, "held_out": []}
    return row(name, **given | more)


STEP = {"held_out": True, "rmse_over_noise": 1.02}
BEST = {"lower": 0.017, "upper": 0.018, "unit": "rad/V"}
AT_REST = {"axis": "x", "samples": 9, "scatter": 0.01, "lowest": 0.0, "highest": 1.0, "onset": 3.0}
FREE = {"fractional": "a", "integer": "b", "log_bayes_factor": 44.84, "log_bayes_factor_sd": 0.01}
LAW = {"to_V": 5.0, "printed": {"r_squared": 0.745}, "best": {"r_squared": 0.94}}

VALUES: dict[str, dict[str, Any]] = {
    "audit": {
        "grade": "reliable",
        "parameters": [row("gain", verdict="identified"), row("time", verdict="one-sided")],
        "functions": [row("rise[x]", **BEST)],
        "limitations": [],
        "symmetries": [{"kind": "exchange", "sentence": "two terms are interchangeable"}],
        "next_measurement": {"words": "on and off", "time": 90.0, "time_unit": "ms", "reason": "why"},
    },
    "compare": {
        "preferred": "a",
        "why": "no evidence",
        "models": [model("a", 10.0), model("b", 7.5), model("c", 9.0)],
        "flags": [],
        "unranked": [],
        "fractional": FREE | {"verdict": "warranted", "sentence": "s"},
        "averaged": [row("delay"), row("rise", "tentative")],
    },
    "fleet": {
        "of": "fit",
        "counts": {"reliable": 2, "tentative": 0, "failed": 1},
        "devices": [
            {"device": "d3", "grade": "failed", "differs_in": ""},
            {"device": "d1", "grade": "reliable", "differs_in": "gain"},
            {"device": "d2", "grade": "reliable", "differs_in": ""},
        ],
        "groups": [
            {"parameters": [row("gain", unit="rad/V", mean={"value": 2.0}, spread={"value": 0.034})]},
        ],
    },
    "loop": {
        "verdict": "explained",
        "confidence": "firm",
        "effects": [{"name": "creep", "parameters": [row("creep.a")], "group": ["creep"]}],
        "before": {"scores": [score("r", 0.7, 3e-4, **STEP)]},
        "after": {"scores": [score("r", 0.9, **STEP)]},
        "moved": [row("gain", shift_in_sd=-15.2)],
        "cautions": [],
        "next_measurement": "",
    },
    "design": {
        "grade": "reliable",
        "time": 90.0,
        "time_unit": "ms",
        "winner": {"drive": "binary, 4 ms", "words": "low or high"},
        "factor_over_step": {"parameter": "time", "value": 4.58, "lower": 1.9, "upper": 14.0},
        "template": "next.csv",
        "confirmed": {"trials": [{"confirmed": True}, {"confirmed": False}]},
        "linear_share": 0.25,
        "parameters": [row("time", time_for_10_percent=None), row("gain", time_for_10_percent=9.0)],
    },
    "calibrate": {
        "study": "s",
        "replicas": 200,
        "coverage": [
            {"parameter": "gain", "level": 0.9, "observed": 0.88, "lower": 0.8, "upper": 0.97, "within": True}
        ],
        "ranks": [{"parameter": "gain", "p_value": 0.39}],
        "p_value": 0.72,
        "grades": {"reliable": 199, "failed": 1},
    },
    "predict": {
        "grade": "reliable",
        "time_unit": "ms",
        "axes": [BEST | {"axis": "x", "value_at_end": 0.0175, "end": 25.0, "half_width_simultaneous": 3e-4}],
        "scores": [],
        "outside": [],
    },
    "check": {
        "study": "s",
        "time_unit": "ms",
        "sentences": ["1 path."],
        "records": [
            {"record": "on", "held_out": False, "responses": [AT_REST]},
            {"record": "off", "held_out": True, "responses": []},
            {"record": "b", "held_out": False, "responses": [AT_REST | {"scatter": 0.002, "onset": 4.0}]},
        ],
        "parameters": [row("gain", **{"from": "default"}), row("order")],
        "problems": [],
        "disagreements": [],
    },
    "claims": {"claims": [{"id": "I1", "verdict": "supported"}, {"id": "M2", "verdict": "contradicted"}]},
    "identify": {
        "time_unit": "ms",
        "paths": [
            {
                "path": "x_x",
                "response_unit": "rad",
                "models": [
                    {"method": m, "orders": [1.8], "delay": 3.0, "output_rmse": e, "physical": True}
                    for m, e in (("scan", 2e-4), ("output error", 1e-4), ("scan, integer orders", 3e-4))
                ],
            }
        ],
        "records": [],
        "step_metrics": [{"metric": "rise", "path": "x_x", "values": {"scan": 4.0}, "posterior": None}],
    },
    "optics": {
        "array": {"elements": 32, "pitch_m": 1.2e-6, "wavelength_m": 1e-6},
        "steering": [{"target_deg": 5.0, "main_lobe_deg": 5.0, "side_lobe": 0.05}],
        "grating_lobes": [{"order": 1, "target_deg": 5.0, "angle_deg": -48.0, "with_element": 0.2}],
        "threshold_voltage": {"value": 0.96, "unit": "V"},
        "tilt_law": [LAW],
        "chain": [{"voltage_V": 3.0, "angle_linearised_rad": 0.5, "angle_rad": 0.52}],
    },
}

SAID = [
    ("audit", (), None, "What do the records determine?", "1 of 2 parameters: gain."),
    ("audit", (), None, "What do they leave open?", "One-sided: time."),
    ("audit", ("parameters", 1, "verdict"), "identified", "What do they leave open?", None),
    ("audit", ("parameters", 0, "verdict"), "one-sided", "What do the records", "None of 2 parameters."),
    ("audit", ("grade",), "unusable", "Which numbers", "Best is rise[x], 0.01700 to 0.01800 rad/V with 90 % "
     "probability; the draws behind it are unusable."),
    ("audit", (), None, "What is missing?", "Nothing that the checks of the model against its records could see."),
    ("audit", ("symmetries", 0, "kind"), "sum", "What is missing?", "Two terms are interchangeable."),
    ("audit", ("limitations",), [{"reason": "it drifts", "remedy": "hold"}], "What is missing?", "It drifts."),
    ("audit", (), None, "What next?", "A record of 90 ms with the drive on and off."),
    ("audit", ("next_measurement",), None, "What next?", "Nothing for these parameters: all are identified."),
    ("compare", (), None, "Which model?", "a of 3 candidates: about a."),
    ("compare", ("preferred",), None, "Which model?", "no evidence."),
    ("compare", (), None, "How do others", "c gains -1.0 nat; b gains -2.5 nat."),
    ("compare", ("models", 1, "usable"), False, "How do others", "c gains -1.0 nat."),
    ("compare", (), None, "Are fractional", "Yes: a gains 44.84 ± 0.01 nat of log evidence over b."),
    ("compare", ("fractional", "verdict"), "not warranted", "Are fractional", "No: a gains 44.84 ± 0.01 nat of "
     "log evidence over b."),
    ("compare", ("fractional", "verdict"), "undecided", "Are fractional", "s"),
    ("compare", (), None, "Which numbers", "Reliable: delay; tentative: rise."),
    ("compare", ("models", 0, "held_out"), [score("q", 0.9), score("r", 0.5)], "Does it predict?",
     "The worst unseen response, r/x, has 50 % of its samples in the 90 % band and errs by 2.00×10⁻⁴ rad rms."),
    ("compare", (), None, "What next?", "Hold out a record (--held-out), so that prediction can decide too."),
    ("compare", ("flags",), [{"model": "a", "sentence": "odd"}], "What is missing?", "a: odd."),
    ("compare", ("flags",), [{"model": "a", "sentence": "odd"}], "What next?", "`loop` looks for what a leaves out."),
    ("loop", (), None, "What does the model lack?", "creep (firm)."),
    ("loop", (), {"effects": [], "verdict": "clean"}, "What does the model lack?",
     "Nothing that these records could show (firm)."),
    ("loop", (), {"effects": [], "verdict": "unexplained"}, "What does the model lack?",
     "Something without a name (firm)."),
    ("loop", (), None, "How good", "The worst held-out response, r/x, goes from 3.00×10⁻⁴ to 2.00×10⁻⁴ rad "
     "rms, 1.02 times the noise; the 90 % band holds 90 % of its samples."),
    ("loop", (), {"effects": [], "verdict": "clean"}, "How good is it?",
     "The worst held-out response, r/x, errs by 2.00×10⁻⁴ rad rms, 1.02 times the noise; the 90 % band holds 90 % of its samples."),
    ("loop", ("after", "scores", 0, "unit"), "1", "How good is it with that?", "The worst held-out response, r/x, "
     "goes from 3.00×10⁻⁴ to 2.00×10⁻⁴ rms, 1.02 times the noise; the 90 % band holds 90 % of its samples."),
    ("loop", (), None, "What was wrong", "Biased without it: gain by 15 sd."),
    ("loop", ("moved",), [], "What was wrong", "Without it no parameter was biased."),
    ("loop", ("effects", 0, "group"), ["creep", "drift"], "What stays uncertain?", "creep may as well be drift."),
    ("loop", ("cautions",), ["x: few samples. Repeat.", "b.", "c"], "What stays uncertain?", "x: few samples; 2 more "
     "below."),
    ("loop", ("next_measurement",), "Repeat.", "What next?", "Repeat."),
    ("design", (), None, "What to measure", "binary, 4 ms for 90 ms: low or high."),
    ("design", ("winner",), None, "What to measure", "No drive tried determines any parameter."),
    ("design", (), None, "How much", "time, the worst, gets 4.6 times (1.9 to 14.0 over draws) more precise than by "
     "a step of equal time."),
    ("design", ("factor_over_step", "value"), None, "How much", "At most draws a step of equal time leaves open what "
     "it determines, time worst."),
    ("design", ("factor_over_step", "value"), 1.0, "How much", "Nothing: for time, the worst, no drive tried is "
     "better than a step."),
    ("design", (), None, "Can that be", "Simulation confirms the gain at 1 of 2 true values; linear bounds hold at "
     "25 % of the draws, which are reliable."),
    ("design", (), None, "What stays open?", "No drive tried brings time to 10 %."),
    ("calibrate", (), None, "Do the intervals", "As often as stated, within chance, in all 1 cases."),
    ("calibrate", ("coverage", 0, "within"), False, "Do the intervals", "1 of 1 do not as stated: gain at 90 % "
     "covers 88 %."),
    ("calibrate", ("coverage", 0, "within"), False, "What next?", "Do not rely on intervals of gain: they are too "
     "narrow."),
    ("calibrate", ("grades", "failed"), 0, "Which replicas", "199 reliable."),
    ("predict", (), None, "Where does x go?", "To 0.01750 rad/V at 25 ms, 0.01700 to 0.01800 with 90 % probability."),
    ("predict", ("axes", 0, "unit"), "1", "Where does x go?", "To 0.01750 at 25 ms, 0.01700 to 0.01800 with 90 % "
     "probability."),
    ("predict", ("axes", 0, "unit"), "1", "How sure", "90 % bands of whole curves are at most x ±3.0×10⁻⁴."),
    ("predict", (), None, "Can the drive", "It stays within the range of the fit records; the draws are reliable."),
    ("predict", ("outside",), [1, 2], "Can the drive", "In 2 respects it leaves the range of the fit records; the "
     "draws are reliable."),
    ("predict", ("outside",), [1, 2], "What next?", "Record a response to such a drive before relying on it."),
    ("check", (), None, "How good", "At rest samples scatter by up to 1.0 % of the range of the response (on/x)."),
    ("check", ("records", 0, "responses", 0, "scatter"), None, "How good", "At rest samples scatter by up to 0.20 % of the "
     "range of the response (b/x)."),
    ("check", (), None, "Is there a delay?", "x of on moves first, 3.00 ms after a drive."),
    ("check", (), None, "What is assumed?", "1 of 2 priors come from the records by rule."),
    ("check", ("records", 1, "held_out"), False, "What is missing?", "No record is held out to test the prediction."),
    ("check", ("problems",), ["one axis is idle."], "What is missing?", "One axis is idle."),
    ("check", ("problems",), ["one axis is idle."], "What next?", "Mend what is missing, then check again."),
    ("claims", (), None, "Which claims hold?", "1 of 2 claims: I1."),
    ("claims", ("claims", 0, "verdict"), "undecided", "Which claims hold?", "None of 2 claims."),
    ("claims", ("claims", 0, "verdict"), "undecided", "What is missing?", "Audits and comparisons (--audit, "
     "--compare) for I1."),
    ("identify", (), None, "What is the path x_x?", "Orders 1.80, delay 3.00 ms (output error) leave 1.00×10⁻⁴ rad "
     "rms; integer orders 3.00×10⁻⁴."),
    ("identify", ("paths", 0, "models", 0, "physical"), False, "Which numbers", "Not physical, a viscosity or k is "
     "negative: x_x, scan."),
    ("identify", ("step_metrics", 0, "values", "scan"), None, "What is missing?", "Not reached within a record by "
     "some model: rise of x_x."),
    ("fleet", (), None, "How did", "3 by `fit`: 2 reliable, 1 failed."),
    ("fleet", (), None, "What are they", "gain 2.00 rad/V, spread 0.034."),
    ("fleet", (), None, "Which differ", "d1 (gain)."),
    ("fleet", ("devices", 1, "differs_in"), "", "Which differ", "None stands out."),
    ("fleet", ("groups",), [], "Which differ", None),
    ("fleet", (), None, "What is missing", "Without a result: d3."),
    ("fleet", ("devices", 0, "grade"), "reliable", "What next", "Measure d1 again: what differs may be the device "
     "or its record."),
    ("fleet", (), None, "What next", "Mend what failed and run `fleet` again: finished devices are kept."),
    ("optics", (), None, "Does it steer?", "Main lobes hit their targets; side lobes are at most −13.0 dB."),
    ("optics", ("steering", 0, "main_lobe_deg"), 5.2, "Does it steer?", "Main lobes are up to 0.20 deg off; side "
     "lobes are at most −13.0 dB."),
    ("optics", (), None, "Where else", "A lobe at −48.0 deg when steered to 5.00 deg has 20 % of the main lobe."),
    ("optics", (), None, "How far", "At 3.00 V Eq. 26 is off by 0.020 rad of 0.520 rad."),
]  # fmt: skip


@pytest.mark.parametrize(("verb", "place", "value", "question", "said"), SAID)
def test_an_answer_follows_the_result(verb, place, value, question, said):
    values = deepcopy(VALUES[verb])
    if place:
        *path, last = place
        at: Any = values
        for key in path:
            at = at[key]
        at[last] = value
    elif value is not None:
        values |= value
    found = [one.answer for one in answers(verb, values) if one.question.startswith(question)]
    assert found == ([] if said is None else [said])


def test_every_page_but_those_of_a_fit_and_a_first_look_has_answers():
    assert _ANSWERS.keys() == _PAGES.keys() - {"look"} == VALUES.keys()
    assert all(one.answer.endswith((".", "s")) for verb in VALUES for one in answers(verb, VALUES[verb]))


def test_an_answer_links_to_a_section_of_its_page(tmp_path):
    template = tmp_path / "field.html"
    template.write_text('{% call section("Far field") %}{{ p("Text.") }}{% endcall %}', encoding="utf-8")
    shown = {"plant": ["y / u = 1"], "answers": [Answer("How far?", "To -3e-05 m^2.", "Far field")]}
    values = {"time_unit": "ms"}
    text = write_page(tmp_path, template, "t", values, {}, overview=shown).read_text(encoding="utf-8")
    assert "<strong>How far?</strong> To −3×10⁻⁵ m<sup>2</sup>." in text
    assert '<a href="#far-field">Far field</a>' in text
    assert text.index('id="summary"') < text.index('id="far-field"')
    shown["answers"] = [Answer("How far?", "There.", "Near field")]
    with pytest.raises(ValueError, match="near-field"):
        write_page(tmp_path, template, "t", values, {}, overview=shown)


@pytest.mark.parametrize(("share", "named"), [("none", 0), ("paper", 2), ("all", 0)])
def test_the_plant_names_only_elements_that_paths_share(share, named):
    """An element of one path stands in its line, where a reader looks for it."""
    table = problem(record(device=TWO, camera=0.5), share=share).posterior.table
    lines = plant(table, np.arange(1.0, 1.0 + len(table.rows)))
    paths = [line for line in lines if " / " in line and "exp(" in line]
    assert len(lines) == len(paths) + named
    assert sum(line.endswith(")") for line in paths) == (len(paths) if named == 0 else 0)
