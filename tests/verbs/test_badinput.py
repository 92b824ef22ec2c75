"""What cannot be computed or is not computed long enough is reported, whatever leads there."""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from dataclasses import replace
from importlib.metadata import version

import numpy as np
import pytest
from small import problem, record, study

from lcopa_bayes import cli
from lcopa_bayes.cli import main
from lcopa_bayes.core import parallel
from lcopa_bayes.data.record import save_record
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.model.forward import Dynamics, ForwardModel
from lcopa_bayes.results.fit import Fit, fit
from lcopa_bayes.results.summary import results
from lcopa_bayes.sampling import marginal, sampler
from lcopa_bayes.sampling.draws import shortfall
from lcopa_bayes.sampling.run import SamplePlan
from lcopa_bayes.sampling.sampler import sample
from lcopa_bayes.sampling.tempering import temper

PLAN = SamplePlan(2, 12, 200, 1, 100.0, 1)
SLOW = 3.0
"""Time constant above which the broken model has no response [ms]."""


class Broken:
    """A forward model that gives NaN for slow plants, from its `sound`-th evaluation on."""

    effects = None

    def __init__(self, inner: ForwardModel, sound: int) -> None:
        self.inner, self.sound = inner, sound
        self.layout, self.experiments = inner.layout, inner.experiments

    def unit_responses(self, dynamics: Dynamics) -> list[np.ndarray]:
        self.sound -= 1
        out = self.inner.unit_responses(dynamics)
        if self.sound < 0:
            out[0][:, dynamics.times[0][:, 0] > SLOW] = np.nan
        return out


def broken(sound: int) -> Posterior:
    posterior = problem(record(camera=0.6)).posterior
    return replace(posterior, model=Broken(posterior.model, sound))


@pytest.mark.parametrize(
    ("sound", "jobs"), [(0, 1), pytest.param(0, 2, marks=pytest.mark.slow), (3, 1), (40, 1)]
)
def test_a_likelihood_that_is_nan_stops_sampling_and_says_where(sound, jobs, capfd):
    """At the prior draws, in this process or another, and early and late on the way from them."""
    posterior = broken(sound)
    with pytest.raises(FloatingPointError) as caught:
        sample(posterior, PLAN, jobs=jobs)
    reported = re.fullmatch(r"the log density is NaN at (.*)", str(caught.value))
    assert reported is not None
    values = {name: float(value) for name, value in (pair.split(" = ") for pair in reported[1].split(", "))}
    assert tuple(values) == posterior.table.names
    assert values["time_1"] > SLOW
    assert jobs > 1 or posterior.model.sound < 0
    assert capfd.readouterr() == ("", "")  # the caller tells, once


def test_the_command_line_says_where_a_likelihood_is_nan(tmp_path, capfd, monkeypatch):
    sound = ForwardModel.unit_responses

    def unit_responses(self: ForwardModel, dynamics: Dynamics) -> list[np.ndarray]:
        out = sound(self, dynamics)
        out[0][:, dynamics.times[0][:, 0] > SLOW] = np.nan
        return out

    monkeypatch.setattr(ForwardModel, "unit_responses", unit_responses)
    path, out = tmp_path / "step.csv", tmp_path / "run"
    save_record(record(camera=0.6), path)
    code = main(["fit", str(path), "--out", str(out), "--jobs", "1", "--quiet", "--quick"])
    printed, reported = capfd.readouterr()
    assert code == 2
    assert printed == ""
    assert reported.count("\n") == 1
    assert reported.startswith("error: the log density is NaN at gain = ")
    assert "time_1 = " in reported
    assert "narrow the priors" in reported
    assert not (out / "results.json").exists()
    assert not (out / "chain.h5").exists()


@pytest.fixture(scope="module")
def hasty() -> Fit:
    """As few walkers and steps as there may be, asked for more than they can give."""
    reported = {"ensembles": 2, "walkers": 4, "steps": 1, "thin": 1, "target_ess": 5000}
    return fit(study(record(camera=0.6), sampler=reported))


def test_too_small_a_budget_is_reported_with_a_remedy(hasty):
    reported = results(hasty)
    assert reported["grade"] in ("tentative", "unusable")
    assert "sample more steps, about" in reported["grade_reason"]
    assert "5000 are wanted" in reported["grade_reason"]
    worst = min(reported["parameters"], key=lambda one: one["ess"])
    assert worst["grade"] == reported["grade"]
    assert worst["name"] in reported["grade_reason"]


def test_what_is_derived_from_too_few_draws_is_graded_no_better(hasty):
    reported = results(hasty)
    graded = [*reported["parameters"], *reported["step_metrics"]]
    assert len(graded) > len(reported["parameters"]) > 0
    assert {one["grade"] for one in graded} <= {"tentative", "unusable"}


def test_a_budget_of_time_ends_sampling_and_says_what_more_would_give(tmp_path, monkeypatch):
    """Time is up after the fewest rounds there may be; resumed without a budget, all draws are the same."""
    settings = {"ensembles": 2, "walkers": 12, "steps": 80, "thin": 1, "target_ess": 5000, "seconds": 1e3}
    task = study(record(camera=0.6), sampler=settings, priors={"delay": 0.73, "order_1": 0.8})
    clock = iter([0.0, 1.0])  # begun, and tempering begins
    monkeypatch.setattr(sampler, "monotonic", lambda: next(clock, 2e3))
    short = fit(task, folder=tmp_path)
    assert short.run.stopped_after == 2e3
    assert short.run.ensembles[0].steps == 2 * 20
    reported = results(short)
    assert reported["grade"] in ("tentative", "unusable")
    assert "the budget of 1000 s ended sampling: the smallest effective" in reported["grade_reason"]
    assert "s more by [sampler] seconds" in reported["grade_reason"]
    unlimited = replace(task, sampler=replace(task.sampler, seconds=None))
    resumed, whole = fit(unlimited, folder=tmp_path, resume=True), fit(unlimited)
    assert resumed.run.stopped_after is None
    assert "budget" not in results(resumed)["grade_reason"]
    np.testing.assert_array_equal(resumed.draws.values, whole.draws.values)


def test_a_search_that_its_budget_ends_gives_the_draws_it_has(monkeypatch):
    """Time is up once the first draws are there, a tenth of those wanted."""
    task = study(record(camera=0.6), sampler={"target_ess": 3000, "seconds": 1.0})
    clock, draw = [0.0], marginal.Search._last

    def last(*given):
        clock.append(2.0)
        return draw(*given)

    for module in (sampler, marginal):  # by a clock that stands still a round takes no time
        monkeypatch.setattr(module, "monotonic", lambda: clock[-1])
    monkeypatch.setattr(marginal.Search, "_last", last)
    monkeypatch.setattr(marginal.Search, "_direct", lambda *given: None)
    monkeypatch.setattr(marginal, "_SPARE", 0.1)
    fitted = fit(task)
    assert fitted.run.weighted is not None
    assert fitted.run.stopped_after == 2.0
    assert fitted.draws.ess < 3000
    assert "the budget of 1 s ended sampling" in results(fitted)["grade_reason"]


def test_tempering_takes_the_fewest_moves_once_time_is_up():
    posterior = problem(record(camera=0.6)).posterior
    random = tuple(np.random.RandomState(1).get_state())
    moves = [
        temper(posterior, 16, 40, np.random.default_rng(1), random, seconds)[0].moves
        for seconds in (0.0, np.inf)
    ]
    assert 0 < 3 * moves[0] < moves[1]


@pytest.mark.parametrize(("ess", "more"), [(100.0, 180.0), (399.0, 30.0)])
def test_more_time_is_asked_for_in_proportion_to_what_is_missing(ess, more, hasty):
    """Effective draws grow like the time: 100 of 400 in 60 s take 180 s more; half as long again at least."""
    quality = replace(hasty.draws.qualities[0], ess_bulk=ess, ess_tail=900.0, rhat=1.5)
    quality = replace(quality, ess_between=np.inf, ess_drift=np.inf)
    plan = replace(hasty.run.plan, target_ess=400.0, seconds=60.0)
    run = replace(hasty.run, plan=plan, stopped_after=60.0)
    (said,) = shortfall(run, replace(hasty.draws, qualities=(quality,), target_ess=400.0))
    assert f"about {more:.0f} s more" in said.remedy
    assert shortfall(replace(run, stopped_after=None), hasty.draws) == ()


def test_no_more_processes_than_cores(monkeypatch):
    for available, asked, used in ((1, 8, 1), (1, None, 1), (4, 10**6, 4), (4, 2, 2), (4, None, 4)):
        monkeypatch.setattr(parallel, "cores", lambda available=available: available)
        assert cli._jobs(argparse.Namespace(jobs=asked)) == used


@pytest.mark.slow
def test_the_advice_helps():
    """The same study with the default budget is reliable."""
    reported = results(
        fit(study(record(camera=0.6), sampler={"ensembles": 2, "walkers": 32, "target_ess": 200}))
    )
    assert reported["grade"] == "reliable", reported["grade_reason"]


BROKEN = """
[noize]
kind = "white"
[sampler]
ensembles = 1
walker = 8
[model]
exposure_ms = 50
[effects]
use = ["cubic_stifness", "bilinear_crosstalk", "clipping", "clipping"]
[priors]
gain = { dist = "nrm" }
delya = 0.1
"ion_creep.k" = 0.1
"""
WRONG = (
    "unknown table [noize]; did you mean 'noise'?",
    "[sampler]: unknown key 'walker'; did you mean 'walkers'?",
    "[sampler]: `ensembles` must be a whole number of at least 2; got 1",
    "prior of 'gain': unknown distribution 'nrm'",
    "the exposure of 50 ms is longer than the 0.6 ms",
    "no effect is named 'cubic_stifness'; did you mean 'cubic_stiffness'?",
    "'bilinear_crosstalk' has no place in a plant of 1 drive and 1 response",
    "'clipping' is listed 2 times",
    "[priors] ion_creep.k: the effect 'ion_creep' is not used",
    "[priors] delya: this model has no such parameter; did you mean 'delay'?",
)


@pytest.mark.parametrize(
    "verb", ["run", "fit", "audit", "design", "compare", "loop", "calibrate", "identify"]
)
def test_every_problem_of_a_study_is_named_at_once(verb, tmp_path, capsys):
    """Those of its file, of its records, of its effects and of its priors, whichever tables are wrong."""
    folder, out = tmp_path / "in", tmp_path / "out"
    folder.mkdir()
    save_record(record(camera=0.6), folder / "step.csv")
    (folder / "study.toml").write_text(BROKEN)
    assert main([verb, str(folder), "--out", str(out), "--jobs", "1", "--quiet"]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    lines = printed.err.splitlines()
    for words, line in zip(WRONG, lines, strict=True):
        assert words in line
    assert not out.exists()


def test_a_plant_that_cannot_be_read_is_not_judged_further(tmp_path, capsys):
    save_record(record(camera=0.6), tmp_path / "step.csv")
    (tmp_path / "study.toml").write_text('[model]\nterms = 9\n[priors]\ntime_4 = 1.0\n[noise]\nkind = "ar"\n')
    assert main(["fit", str(tmp_path), "--out", str(tmp_path / "out"), "--quiet"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2  # whether there is a fourth term depends on what `terms` should have been
    assert '`terms` must be a whole number from 1 to 6, or "auto"; got 9' in lines[0]
    assert "`kind` must be one of white, ar1, white+ar1, student; got 'ar'; did you mean 'ar1'?" in lines[1]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[model]\nterms = { dircet = 2 }", "[model] terms names 'dircet', but this plant has one element"),
        ("[priors]\ngian = 3", "[priors] gian: this model has no such parameter; did you mean 'gain'"),
        ("[model]\nterms = 1\n[priors]\norder_1 = 3", "[priors] order_1 = 3: must lie in (0, 2]"),
    ],
)
def test_what_does_not_fit_the_plant_names_the_study_file(text, said, tmp_path, capsys):
    file = tmp_path / "study.toml"
    save_record(record(camera=0.6), tmp_path / "step.csv")
    file.write_text(text)
    assert main(["check", str(tmp_path), "--out", str(tmp_path / "out"), "--quiet"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {file}, {said}")


@pytest.mark.parametrize(
    ("option", "least"), [("--jobs=0", 1), ("--jobs=-2", 1), ("--seed=-1", 0), ("--seed=1.5", 0)]
)
def test_numbers_of_the_command_line_that_cannot_be_used_are_named(option, least, tmp_path, capsys):
    """No cores were taken for all of them, and fewer for one."""
    name, _, text = option.partition("=")
    with pytest.raises(SystemExit) as end:
        main(["fit", str(tmp_path / "study"), "--out", str(tmp_path / "run"), option])
    assert end.value.code == 2
    printed = f"argument {name}: must be a whole number of at least {least}; got {text!r}"
    assert printed in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("as_json", [False, True])
def test_an_unforeseen_error_is_one_sentence_and_a_file_of_details(as_json, tmp_path, capsys, monkeypatch):
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("the floor is gone")

    save_record(record(camera=0.6), tmp_path / "step.csv")
    monkeypatch.setattr("lcopa_bayes.verbs.check.inventory", broken)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    words = ["check", str(tmp_path / "step.csv"), "--out", str(tmp_path / "out")]
    assert main([*words, *["--json"] * as_json]) == 1
    out, err = capsys.readouterr()
    (said,) = json.loads(out)["errors"] if as_json else err.splitlines()
    assert "unforeseen RuntimeError: the floor is gone" in said
    (details,) = tmp_path.glob("lcopa-bayes-*.txt")
    assert str(details) in said
    written = details.read_text("utf-8")
    assert written.startswith(f"lcopa-bayes check {tmp_path}")
    assert "in broken" in written
    assert version("lcopa-bayes") in written


def test_a_reader_who_has_seen_enough_ends_it_without_a_trace(tmp_path):
    save_record(record(camera=0.6), tmp_path / "step.csv")
    words = ["check", tmp_path / "step.csv", "--out", tmp_path / "out"]
    code = "import sys, time; from lcopa_bayes.cli import main; sys.exit(main(sys.argv[1:]))"
    with subprocess.Popen(
        [sys.executable, "-c", code, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as end:
        end.stdout.close()
        assert end.stderr.read() == b""
    assert end.returncode == 1


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (["fit", "LONG.csv"], "`name` must be text fit for a folder, of at most 100 letters"),
        (["new", "x", "LONG.csv"], "`record name` must be text fit for a folder, of at most 100 letters"),
        (["new", "x" * 300, "step.csv"], "at most 100 letters"),
        (["new", f"{'x' * 300}/oven", "step.csv"], "File name too long; give a shorter name"),
        (["fit", f"{'n' * 5000}.csv"], "nnn...: File name too long; give a shorter name"),
        (["new", "x", "."], ".: is a folder; name the tables in it"),
        (["--versoin"], "--versoin is not an option; did you mean '--version'?"),
    ],
)
def test_names_that_no_system_holds_and_folders_for_tables_are_refused(
    command, said, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    save_record(record(1), tmp_path / "step.csv")
    long = f"{'l' * 200}.csv"
    (tmp_path / long).write_bytes((tmp_path / "step.csv").read_bytes())
    try:
        code = main([one.replace("LONG.csv", long) for one in command])
    except SystemExit as end:
        code = end.code
    assert code == 2
    assert said in capsys.readouterr().err
    assert sorted(one.name for one in tmp_path.iterdir()) == [long, "step.csv"]
