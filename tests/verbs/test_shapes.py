"""Every verb on campaigns of every shape: a result with finite numbers or a message, never an exception."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from shapes import SHAPES, Shape

import lcopa_bayes as lb
from lcopa_bayes.cli import main
from lcopa_bayes.data.record import save_record
from lcopa_bayes.data.study import Study
from lcopa_bayes.data.studywriter import write_study

pytestmark = pytest.mark.usefixtures("short_benches")
PLAIN = {"model": {"terms": 1}, "noise": {"kind": "white"}, "sampler": {"target_ess": 40}}
"""Settings with which a verb takes seconds."""
SEARCHED = {
    "one record, hours, eight bits": Shape(
        samples=30, records=1, unit="s", second=9_000.0, step=1 / 128, settings=PLAIN
    ),
    "1x2, dark record": Shape(samples=30, drives=2, dark=True, settings=PLAIN),
    "2x1, missing cells": Shape(samples=20, responses=2, missing=0.3, settings=PLAIN),
    "2x2": Shape(samples=30, responses=2, drives=2, settings=PLAIN),
    "no sample at rest, hours": Shape(
        samples=30, unit="s", second=9_000.0, early=True, records=3, jitter=0.5, settings=PLAIN
    ),
    "microseconds": Shape(samples=30, unit="s", second=2e-6, records=3, drift=0.1, settings=PLAIN),
}
SHORT = ("2x1, missing cells", "no sample at rest, hours")
"""Of them those that the short form searches."""
LOOKED_AT = ("1x2", "2x1, jittered clock", "no sample at rest", "few samples", "eight bits")
LOOKED_AT += ("microseconds, dark record",)
"""Shapes that the short form looks at, with no more than 30 samples."""
PAIR = ("--pick", "first-order", "fractional-1")
SEARCHES = ("compare", "loop")
"""Verbs that fit many models."""


def written(study: Study, folder: Path) -> Path:
    """The folder with the study, and a drive that steps once in each of its axes."""
    write_study(study, folder / "study.toml")
    first = study.fit[0]
    time = np.linspace(0.0, float(np.ptp(first.time)), 30)
    columns = {f"time_{first.time_unit}": time}
    columns |= {f"drive_{axis.name}_{axis.unit}": 1.0 * (time > time[4]) for axis in first.drive_axes}
    pd.DataFrame(columns).to_csv(folder / "drive.csv", index=False)
    return folder


def answer(capsys: pytest.CaptureFixture[str], *words: object) -> dict:
    """What a verb prints as JSON: it ends with 0, or with 2 and a clear message for each problem."""
    code = main([*map(str, words), "--json"])
    out, err = capsys.readouterr()
    assert "Traceback" not in err
    values = json.loads(out, parse_constant=lambda name: pytest.fail(f"{name} in {words[0]}"))
    assert code in (0, 2), values
    if code == 2:
        assert values["errors"]
        assert all(len(said) > 20 for said in values["errors"])
    return values


def verbs(folder: Path, *, pick: tuple[str, ...] = ()) -> dict[str, tuple[object, ...]]:
    """Every verb that takes a study or a fit, in an order in which each finds what it needs."""
    run, quick = folder / "run", ("--quick", "--jobs", "1")
    return {
        "check": (folder,),
        "look": (folder,),
        "fit": (folder, *quick),
        "predict": (run, folder / "drive.csv"),
        "audit": (run, *quick),
        "design": (run, *quick),
        "compare": (folder, *pick, *quick),
        "loop": (folder, *quick),
    }


def answers(
    capsys: pytest.CaptureFixture[str],
    folder: Path,
    *,
    pick: tuple[str, ...] = (),
    leaving: tuple[str, ...] = (),
) -> dict[str, dict]:
    """Of verbs, each in a folder of its own but for those of the fit, whose page is drawn once."""
    of_fit = ("fit", "predict", "audit", "design")
    return {
        verb: answer(capsys, verb, *words, "--out", folder / ("run" if verb in of_fit else verb))
        for verb, words in verbs(folder, pick=pick).items()
        if verb not in leaving
    }


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name not in LOOKED_AT)) for name in SHAPES]
)
def test_a_look_at_any_shape(name, tmp_path):
    shape = SHAPES[name]
    study = (replace(shape, samples=min(shape.samples, 30)) if name in LOOKED_AT else shape).study()
    understood, seen = lb.check(study), lb.look(study)
    assert "can be fitted" in understood.verdict
    assert np.isfinite(seen.summary()["value"].astype(float)).all()
    for result in (understood, seen):
        assert result.report(tmp_path).read_text("utf-8").count("<svg")


def test_units_of_time_change_only_times():
    """The same numbers on clocks of milliseconds and of hours: what has no unit of time is equal.

    Rounding may exchange a few of the 400 draws behind the quantiles, which moves these by no more than
    their Monte Carlo error (0.03 of the interval at its ends). What is not drawn agrees as closely as
    descents end; the density of the delay, the one time without a logarithm, is per unit of time.
    """
    looks = [lb.look(SHAPES[name].study()) for name in ("repeats", "repeats, hours")]
    here, there = (look.summary() for look in looks)
    timed = here["unit"] == "ms"
    assert 0 < timed.sum() < len(timed)
    factor = np.where(timed, 9_000.0, 1.0)
    width = factor * (here["upper"] - here["lower"])
    for end in ("value", "lower", "upper"):
        assert np.all(np.abs(there[end] - factor * here[end]) < 0.06 * width)
    density, share = ([look.values[name] for look in looks] for name in ("log_density", "effective_share"))
    assert density[1] - density[0] == pytest.approx(-np.log(9_000.0), abs=1e-3)
    assert share[1] == pytest.approx(share[0], rel=2e-3)


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("leaving", [SEARCHES, pytest.param((), marks=pytest.mark.slow)])
def test_every_verb_answers(leaving, tmp_path, capsys):
    known = {"priors": {"delay": 0.1, "order_1": 1.0}} if leaving else {}
    study = Shape(samples=24, records=1, dark=True, settings=PLAIN | known).study()
    said = answers(capsys, written(study, tmp_path), pick=PAIR, leaving=leaving)
    assert not [verb for verb, values in said.items() if "errors" in values]
    assert "loop" in leaving or (tmp_path / "loop" / "explained.toml").exists()


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name not in SHORT)) for name in SEARCHED]
)
@pytest.mark.usefixtures("undrawn")
def test_a_loop_on_any_shape(name, tmp_path, capsys):
    folder = written(SEARCHED[name].study(), tmp_path)
    values = answer(
        capsys, "loop", folder, "--quick", "--jobs", "1", "--as-stated", "--out", tmp_path / "loop"
    )
    assert values["verdict"] in ("clean", "explained", "partly explained", "disturbance", "unexplained")


@pytest.mark.usefixtures("undrawn")
def test_a_loop_on_few_samples_adds_no_term_that_they_cannot_determine(tmp_path, capsys):
    """8 samples determine the 6 parameters of one term, not the 10 of two with coloured noise."""
    study = Shape(samples=9, records=1, settings=PLAIN).study()
    values = answer(capsys, "loop", written(study, tmp_path), "--quick", "--out", tmp_path / "loop")
    assert values["verdict"] == "unexplained"


def test_a_record_of_one_sample_is_drawn(tmp_path):
    study = Shape(samples=30, settings=PLAIN).study()
    first, second = study.fit
    response = np.where(np.arange(second.time.size)[:, None] == 20, second.response, np.nan)
    study = replace(study, fit=(first, replace(second, response=response)))
    assert lb.look(study).report(tmp_path).exists()


def test_no_verb_takes_records_whose_drive_never_moves(tmp_path, capsys):
    study = Shape(samples=30, records=1, dark=True).study()
    dark = tmp_path / "dark.csv"
    save_record(study.fit[1], dark)
    for verb in ("check", "look", "fit", "audit", "compare", "design", "loop"):
        values = answer(capsys, verb, dark, "--out", tmp_path / verb)
        (said,) = values["errors"]
        assert "the drive is constant throughout the fit records" in said
        assert not (tmp_path / verb).exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", SHAPES)
def test_every_verb_on_any_shape(name, tmp_path, capsys):
    said = answers(capsys, written(SHAPES[name].study(), tmp_path))
    assert "errors" not in said["fit"]
    assert said["loop"]["verdict"]
