"""The verb `fit`, end to end on one tiny record whose truth is known."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from small import TRUTH, record, study

from lcopa_bayes.bench.command import on_off
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.files import commanded
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.results.fit import HOPELESS, Fit, fit, plan_of
from lcopa_bayes.results.runfolder import fingerprint, provenance
from lcopa_bayes.results.summary import residual_rms, results, verdict
from lcopa_bayes.sampling.run import SamplePlan

fits = sys.modules[fit.__module__]

TINY = {"target_ess": 200}
BRIEF = {"ensembles": 2, "walkers": 8, "steps": 40, "thin": 1, "target_ess": 200}
KNOWN = {
    "delay": TRUTH["delay"],
    "order_1": TRUTH["order_1"],
    "time_1": ("uniform", {"loc": 1.3, "scale": 0.4}),
    "sigma": ("uniform", {"loc": 0.01, "scale": 0.02}),
}
"""Two parameters are left, close about the truth: tempering from such a prior is short."""
HELD = record(2, command=on_off(-0.7, hold=4.0, at=1.3), name="held")
STUDY = study(record(), held_out=(HELD,), sampler=TINY)


@pytest.fixture(scope="module")
def fitted() -> Fit:
    return fit(STUDY)


def test_recovers_the_truth(fitted):
    for name, exact in TRUTH.items():
        low, high = np.quantile(fitted.draws.column(name), (0.005, 0.995))
        assert low < exact < high, name
        assert high - low < 0.5 * abs(exact), name  # and says something about it


def test_predicts_the_record_it_never_saw(fitted):
    (seen,), (unseen,) = ([b for b in fitted.bands if b.held_out == flag] for flag in (False, True))
    assert (seen.record, unseen.record) == ("step", "held")
    for band in (seen, unseen):
        n = band.observed.size
        assert abs(band.coverage(0.9) - 0.9) < 4 * np.sqrt(0.9 * 0.1 / n)
        assert band.rmse == pytest.approx(TRUTH["sigma"], rel=4 / np.sqrt(2 * n))
    assert seen.offset_from == "fitted"
    assert unseen.offset_from == "samples before the drive acts"
    assert residual_rms(fitted) == {"y": pytest.approx(seen.rmse)}
    assert all(left.p_white > 1e-3 for left in fitted.residuals)


def test_scores_say_what_kind_of_band_and_from_how_many_samples_the_offset_comes(fitted):
    (reported,) = results(fitted)["held_out"]
    assert (reported["bands"], reported["offset_samples"]) == (
        "pointwise",
        10,
    )  # one per 0.2 until 1.3 and the delay
    assert "pointwise 90 % band" in verdict(fitted)
    assert "constant error" not in verdict(fitted)
    alone = [replace(b, offset_samples=b.time.size) if b.held_out else b for b in fitted.bands]
    said = verdict(replace(fitted, bands=tuple(alone)))
    assert "(offset from these samples)" in said
    assert "A constant error of a record whose offset comes from its scored samples cannot show." in said


def test_results_have_the_keys_that_other_tools_rely_on(fitted):
    reported = results(fitted)
    assert {
        "grade",
        "grade_reason",
        "parameters",
        "log_evidence",
        "log_evidence_sd",
        "residual_rms",
        "step_metrics",
    } <= reported.keys()
    assert [row["name"] for row in reported["parameters"]] == list(TRUTH)
    for row in reported["parameters"]:
        assert {"name", "unit", "mean", "sd", "lower", "upper", "level", "ess", "rhat"} <= row.keys()
        assert row["lower"] < row["value"] < row["upper"]
        assert row["lower"] < row["mean"] < row["upper"]
    for metric in reported["step_metrics"]:
        assert {"value", "unit", "lower", "upper", "level", "interval", "grade"} <= metric.keys()
    assert {metric["name"] for metric in reported["step_metrics"]} >= {
        "rise_10_90[y]",
        "settling_2[y]",
        "delay[y]",
    }
    assert reported["grade"] in ("reliable", "tentative", "unusable")
    assert reported["sampler"]["method"] == "importance draws"
    assert json.loads(json.dumps(reported, allow_nan=False)) == reported


def test_the_verdict_names_grade_residual_and_held_out_record(fitted):
    said = verdict(fitted)
    assert said.startswith(f"Grade {fitted.draws.grade.level}: ")
    assert "The residual is compatible with the noise model" in said
    assert "Held out: held/y RMSE 0.0" in said
    assert "untested" in verdict(replace(fitted, bands=fitted.bands[:1]))


def test_correlated_noise_under_a_white_model_is_said_to_be_unexplained():
    """Alternating noise: smooth correlation would partly be fitted by the plant."""
    noisy = record(3, camera=0.1, correlation=-0.6)
    said = verdict(fit(study(noisy, sampler={"target_ess": 50})))
    assert "intervals hold only if" in said
    assert "step, axis y, is not white" in said
    assert said.startswith("Grade tentative") or said.startswith("Grade unusable")


@pytest.fixture(scope="module")
def kept(tmp_path_factory) -> tuple[Fit, Path]:
    """By ensembles, and the folder of their chain."""
    folder = tmp_path_factory.mktemp("chain")
    brief = study(record(camera=0.6), held_out=(HELD,), sampler=BRIEF, priors=KNOWN)
    return fit(brief, folder=folder), folder


def test_the_same_study_gives_the_same_fit_and_resumes_to_it(kept):
    again, folder = kept
    first = fit(again.study)
    assert_array_equal(again.draws.values, first.draws.values)
    resumed = fit(again.study, folder=folder, resume=True)
    reported = results(first)
    assert results(resumed) == reported
    assert reported["sampler"]["steps"] <= reported["sampler"]["most_steps"] == 40


def test_a_chain_of_another_study_is_not_taken_up(kept):
    own, folder = kept
    with pytest.raises(InputError, match="written with other records, settings or seed"):
        fit(replace(own.study, fit=(record(6),)), folder=folder, resume=True)


def test_the_fingerprint_knows_all_that_the_draws_depend_on():
    plan = plan_of(problem_of(STUDY), quick=False)
    seen = {fingerprint(STUDY, plan)}
    changed = np.array(STUDY.fit[0].response)
    changed[5] += 1e-12
    others = [
        study(replace(STUDY.fit[0], response=changed), held_out=(HELD,), sampler=TINY),
        study(replace(STUDY.fit[0], time=STUDY.fit[0].time + 1e-9), held_out=(HELD,), sampler=TINY),
        replace(STUDY, seed=6),
        study(*STUDY.fit, held_out=(HELD,), sampler=TINY, priors={"delay": 0.7}),
        study(*STUDY.fit, held_out=(HELD,), sampler=TINY, noise="ar1"),
        study(*STUDY.fit, held_out=(HELD,), sampler=TINY, terms=2),
        replace(STUDY, inputs={"a.csv": "0"}),
    ]
    seen |= {fingerprint(other, plan) for other in others}
    seen |= {fingerprint(STUDY, replace(plan, **{name: 7})) for name in ("seed", "thin", "steps", "walkers")}
    assert len(seen) == 1 + len(others) + 4
    assert fingerprint(study(record(), held_out=(HELD,), sampler=TINY), plan) == fingerprint(STUDY, plan)


def test_provenance_is_plain_and_complete():
    assert provenance(STUDY, "fit")["command"] == ["lcopa_bayes.fit"]
    with commanded(["lcopa-bayes", "fit", "small"]):
        reported = provenance(STUDY, "fit")
    assert reported["command"] == ["lcopa-bayes", "fit", "small"]
    assert reported["study"] == "small"
    assert reported["seed"] == 5
    assert {"lcopa-bayes", "numpy", "scipy", "emcee"} <= reported["versions"].keys()
    assert reported["settings"]["held_out"] == ["held"]
    assert json.loads(json.dumps(reported, allow_nan=False)) == reported


def test_a_quick_fit_takes_a_quarter_of_the_steps():
    problem = problem_of(study(record(), sampler={"steps": 300}))
    assert (plan_of(problem, quick=False).steps, plan_of(problem, quick=True).steps) == (300, 75)


def test_records_that_no_plant_follows_are_sampled_for_half_a_minute():
    """Unless the study says for how long: their numbers are not usable, however long that takes."""
    on = record(1, name="on")
    wrong = replace(on, response=on.response * 1e3, name="wrong")
    agreeing, contrary = study(on, record(2, name="again")), study(on, wrong)
    assert plan_of(problem_of(agreeing), quick=False).seconds is None
    assert plan_of(problem_of(contrary), quick=False).seconds == 30.0
    stated = study(on, wrong, sampler={"seconds": 900.0})
    assert plan_of(problem_of(stated), quick=False).seconds == 900.0


@pytest.mark.parametrize(
    ("disturbance", "stated", "budget", "seconds"),
    [
        (False, {}, None, None),
        (False, {}, 240.0, 240.0),
        (True, {}, None, HOPELESS),
        (True, {}, 240.0, HOPELESS),
        (True, {}, 7.0, 7.0),
        (True, {"seconds": 900.0}, 240.0, 900.0),
    ],
)
def test_a_disturbance_has_little_time_for_draws(monkeypatch, disturbance, stated, budget, seconds):
    """None of its numbers is usable, however long they are sampled."""
    plans: list[SamplePlan] = []

    def noted(posterior: object, plan: SamplePlan, **_: object) -> None:
        plans.append(plan)
        raise InputError("enough is known")

    monkeypatch.setattr(fits, "is_disturbance", lambda *_: disturbance)
    monkeypatch.setattr(fits, "sample", noted)
    with pytest.raises(InputError, match="enough is known"):
        fit(study(record(), sampler=stated), budget=budget)
    assert [plan.seconds for plan in plans] == [seconds]


def test_too_few_samples_and_nothing_to_sample_are_refused():
    few = record(camera=3.0)
    with pytest.raises(InputError, match="4 samples cannot determine 6 free parameters"):
        fit(study(few))
    known = {name: TRUTH[name] for name in ("time_1", "order_1", "delay", "sigma")}
    with pytest.raises(InputError, match="leave at least one free"):
        fit(study(record(), priors=known))
