"""The public names: the lines that must work, the manners of every result, and a docstring for each."""

import ast
import dataclasses
import inspect
import json
import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import arviz_stats
import numpy as np
import pandas as pd
import pytest
from small import record

import lcopa_bayes as lb
from lcopa_bayes.bench.command import on_off
from lcopa_bayes.cli import main
from lcopa_bayes.data.record import save_record
from lcopa_bayes.results.runfolder import LOCK, opened, provenance
from lcopa_bayes.verbs.commandline import RUNS

README = Path(__file__).parents[1] / "README.md"
TINY = {"target_ess": 50}
"""Too short for numbers that hold, long enough for every table."""
ON = record(1, camera=0.5, name="on")
OFF = record(2, command=on_off(-0.7, hold=4.0, at=1.3), camera=0.5, name="off")
FIXED = {"delay": 0.73, "order_1": 0.8, "offset": 0.3}
NOISE = {"kind": "white"}


def small(**more) -> lb.Study:
    return lb.Study(
        "small", fit=[ON], held_out=[OFF], terms=1, noise=NOISE, sampler=TINY, priors=FIXED, seed=5, **more
    )


@pytest.fixture(scope="module")
def fit() -> lb.Fit:
    return lb.fit(small(), jobs=2)


@pytest.fixture(scope="module")
def folder(fit, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("runs") / "small"
    fit.save(path)
    return path


@pytest.fixture(scope="module")
def audit(fit) -> lb.AuditResult:
    return lb.audit(fit, quick=True)


@pytest.fixture(scope="module")
def comparison() -> lb.Comparison:
    return lb.compare(small(), ["study", "first-order"], quick=True)


@pytest.fixture(scope="module")
def design(fit, short_benches) -> lb.DesignResult:
    return lb.design(fit, bench_time=30.0, quick=True)


@pytest.fixture(scope="module")
def loop() -> lb.LoopResult:
    return lb.loop(small(), quick=True, as_stated=True)


@pytest.fixture(scope="module")
def calibration() -> lb.CalibrationResult:
    return lb.calibrate(small(), replicas=2, quick=True)


@pytest.fixture(scope="module")
def fleet() -> lb.FleetResult:
    one = {"terms": 1, "noise": NOISE, "priors": FIXED, "seed": 5}
    return lb.fleet([lb.Study("a", fit=[ON], **one), lb.Study("b", fit=[OFF], **one)])


@pytest.fixture(scope="module")
def prediction(fit) -> lb.Prediction:
    return fit.predict(lb.Drive.steps(u=[(0, 1.0), (5, 0.0)]))


OTHERS = ("audit", "comparison", "design", "loop", "prediction", "fleet")
RESULTS = (
    ("fit", True),
    *((name, False) for name in OTHERS),
    *(pytest.param(name, True, marks=pytest.mark.slow) for name in (*OTHERS, "calibration")),
)
"""Results, and whether their figures are drawn: the short form draws those of a fit, and makes the others."""


# ---- the lines


def test_a_study_is_made_of_records_files_frames_and_arrays(tmp_path):
    save_record(ON, tmp_path / "on.csv")
    columns = {
        f"time_{OFF.time_unit}": OFF.time,
        f"drive_u_{OFF.drive_axes[0].unit}": OFF.drive[:, 0],
        f"response_y_{OFF.response_axes[0].unit}": OFF.response[:, 0],
    }
    frame = pd.DataFrame(columns)
    frame.attrs["name"] = "frame"
    made = lb.Study(fit=[tmp_path / "on.csv", frame], held_out=columns, terms=2, priors={"delay": 0.7})
    assert made.name == "on-frame"
    assert [one.name for one in (*made.fit, *made.held_out)] == ["on", "frame", "held-out-1"]
    assert (made.model.terms, made.time_unit, made.priors["delay"].fixed) == (2, "ms", 0.7)
    for own, wanted in zip((*made.fit, *made.held_out), (ON, OFF, OFF), strict=True):
        np.testing.assert_array_equal(own.time, wanted.time)
        np.testing.assert_array_equal(own.drive, wanted.drive)
        np.testing.assert_array_equal(own.response, wanted.response)
    same = lb.load_study([tmp_path / "on.csv"])
    assert same.name == lb.Study(fit=tmp_path / "on.csv").name == "on"


def test_times_of_files_are_converted_to_one_unit_and_those_of_records_refused(tmp_path):
    save_record(ON, tmp_path / "on.csv")
    made = lb.Study(fit=tmp_path / "on.csv", time_unit="s")
    np.testing.assert_allclose(made.fit[0].time, ON.time / 1000)
    with pytest.raises(lb.InputError, match="record 'on' is in ms"):
        lb.Study(fit=ON, time_unit="s")


def test_all_that_is_wrong_with_a_study_is_reported_at_once(tmp_path):
    with pytest.raises(lb.InputError) as refused:
        lb.Study(
            fit=[ON, tmp_path / "nowhere.csv"],
            held_out=[{"time_ms": [0.0, 1.0], "drve_u_V": [0.0, 1.0]}],
            noise={"kind": "pink"},
            sampler={"walker": 16},
            priors={"delay": {"dist": "nrm"}},
        )
    said = "\n".join(refused.value.problems)
    for word in ("nowhere.csv", "held-out-1", "'drve'", "pink", "'walkers'", "nrm"):
        assert word in said, word


SHORTER = {
    "lb.audit(fit)": "lb.audit(fit, quick=True)",
    "bench_time=1000": "bench_time=20, quick=True",
    "fractional-2": "fractional-1",
    "second-order": "first-order",
}
"""What the README's lines ask for, and what takes seconds in its place."""


def bent_lag(height: float, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """A first-order lag of 2 ms under a step, read by a sensor that adds a part of the cube."""
    time_ms = np.arange(-6.0, 9.0, 0.25)
    lag = height * -np.expm1(-np.maximum(time_ms, 0) / 2)
    reading = lag + 0.04 * lag**3 + 0.003 * rng.normal(size=time_ms.size)
    return {"time_ms": time_ms, "drive_x_rad": height * (time_ms >= 0), "response_x_rad": reading}


@pytest.mark.usefixtures("undrawn")
def test_the_lines_that_must_work(tmp_path, monkeypatch):
    """The README's Python section, line by line, on a small study with small candidates."""
    (text,) = re.findall(r"^```python\n(.*?)^```$", README.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    rng = np.random.default_rng(1)
    study = lb.Study(
        "bench",
        fit=[bent_lag(height, rng) for height in (1.0, -1.0, 0.5)],
        model={"orders": [1], "offset": "none"},
        noise=NOISE,
        sampler=TINY,
        priors={"delay": 0.0},
        seed=1,
    )
    for stated, small in SHORTER.items():
        assert stated in text
        text = text.replace(stated, small)
    monkeypatch.setattr(lb, "load_study", lambda folder: study)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    results = {}
    for line in ast.parse(text).body:
        source = ast.unparse(line)
        if isinstance(line, ast.Expr):
            results[source] = eval(source, names)
        else:
            exec(source, names)
    fit, better = names["fit"], names["better"]
    assert fit.study is study
    summary = results["fit.summary()"]
    assert {"value", "lower", "upper", "unit", "ess", "rhat", "grade"} <= set(summary.columns)
    assert ((summary["lower"] <= summary["value"]) & (summary["value"] <= summary["upper"])).all()
    assert arviz_stats.summary(results["fit.to_datatree()"], var_names=["gain"]).shape[0] == 1
    (predicted,) = (one for one in results.values() if isinstance(one, lb.Prediction))
    assert (predicted.table()["plant_pointwise_05"] <= predicted.table()["plant_pointwise_95"]).all()
    assert results["fit.frequency_response([0.01, 0.1])"].table().shape[0] == 2
    verdicts = results["lb.audit(fit, quick=True).summary()"]
    assert set(verdicts["parameter"]) == {"gain", "time_1", "sigma"}
    tables = [one for source, one in results.items() if source.startswith("lb.compare")]
    assert [list(one["name"]) for one in tables] == [
        ["fractional-1", "first-order"],
        ["bench", "bench-explained"],
    ]
    # the effect that the records hold is named, and with it the time constant is that of the lag
    assert names["search"].study.effects.use == better.study.effects.use == ("odd_curvature",)
    assert tables[1]["log_evidence"].diff().iloc[1] > 100
    times = {one: names[one].summary().set_index("parameter").loc["time_1"] for one in ("fit", "better")}
    assert times["fit"]["lower"] > 2.03
    assert times["better"]["lower"] < 2.01
    drive = next(one for one in results.values() if isinstance(one, lb.Drive))
    assert drive.axes == ("x",)
    assert len(list((tmp_path / "runs").rglob("*.html"))) == 1
    again = next(one for source, one in results.items() if source.startswith("lb.load_result"))
    pd.testing.assert_frame_equal(again.summary(), better.summary())


def test_a_fit_does_not_depend_on_processes(fit):
    again = lb.fit(small())
    np.testing.assert_array_equal(again.draws.values, fit.draws.values)


def test_an_audit_of_a_fit_a_folder_and_a_study_are_one(fit, folder, audit):
    assert set(audit.summary()["parameter"]) == set(fit.summary()["parameter"])
    assert lb.audit(folder, quick=True).to_json() == audit.to_json()
    assert lb.audit(small(), quick=True).to_json() == audit.to_json()


def test_candidates_by_name_and_studies_side_by_side(fit, comparison):
    assert list(comparison.summary()["name"]) == ["study", "first-order"]
    pair = lb.compare(
        [
            fit,
            lb.Study(
                "whole",
                fit=[ON],
                held_out=[OFF],
                model={"orders": (1.0,)},
                noise=NOISE,
                sampler=TINY,
                priors={"delay": 0.73, "offset": 0.3},
                seed=5,
            ),
        ],
        quick=True,
    )
    assert list(pair.summary()["name"]) == ["small", "whole"]
    assert pair.summary()["preferred"].sum() <= 1
    with pytest.raises(lb.InputError, match="different data"):
        lb.compare([small(), lb.Study("other", fit=[OFF], noise=NOISE)])


def test_the_drive_of_a_design_can_be_played_and_predicted(fit, design):
    assert design.drive is not None
    assert design.drive.axes == ("u",)
    assert fit.predict(design.drive).bands[0].time.size == 61  # 30 at 0.5, and one before


def test_what_a_loop_found_is_a_study(loop):
    assert loop.study is not None
    assert loop.study.name == "small-explained"
    assert set(loop.summary()["effect"]) == set(loop.study.effects.use)


def test_a_campaign_is_simulated(tmp_path):
    campaign = Path(__file__).parents[1] / "studies"
    files = sorted(campaign.glob("*/campaign.toml"))
    assert files
    made = lb.simulate(files[0], seed=3)
    paths = made.save(tmp_path / "out")
    read = lb.load_study(tmp_path / "out")
    assert len(paths) == len(made.records) + 1 == len(made.summary()) + 1
    assert [one.name for one in read.fit] == [one.name for one in made.study.fit]
    np.testing.assert_array_equal(read.fit[0].response, made.study.fit[0].response)


# ---- the manners


@pytest.mark.parametrize(("name", "drawn"), RESULTS)
def test_a_result_is_the_same_when_read_back(name, drawn, request, tmp_path):
    result = request.getfixturevalue(name)
    if not drawn:
        request.getfixturevalue("undrawn")
    assert isinstance(result.summary(), pd.DataFrame)
    assert result.summary().shape[1] > 3
    values = result.to_json()
    assert json.loads(json.dumps(values, allow_nan=False)) == values
    cells = re.findall(r"<td[^>]*>(.*?)</td>", html := result._repr_html_())
    assert len(cells) == result.summary().size
    assert html.count("<p>") == 1
    numbers = [cell for cell in cells if re.fullmatch(r"-?\d*\.\d+", cell)]
    assert all(len(cell.replace(".", "").lstrip("-0")) <= 4 or cell[-3] == "." for cell in numbers)
    assert result.verdict in str(result) or name == "loop"
    page = result.report(tmp_path / "run")
    assert page.is_file()
    assert result.is_in(tmp_path / "run")
    read = lb.load_result(tmp_path / "run")
    assert read.to_json() == values
    assert read.verdict == result.verdict
    pd.testing.assert_frame_equal(read.summary(), result.summary(), check_dtype=False)
    before = page.read_bytes()
    read.save(tmp_path / "copy")
    assert lb.load_result(tmp_path / "copy").to_json() == values
    page.unlink()
    assert read.report(tmp_path / "run").read_bytes() == before


def test_a_design_and_a_loop_read_back_hold_drive_and_study(design, loop, tmp_path):
    design.save(tmp_path / "design")
    drive = lb.load_result(tmp_path / "design").drive
    np.testing.assert_array_equal(drive.values, design.drive.values)
    np.testing.assert_array_equal(drive.time, design.drive.time)
    loop.save(tmp_path / "loop")
    found = lb.load_result(tmp_path / "loop").study
    assert found.name == loop.study.name
    assert found.effects == loop.study.effects
    np.testing.assert_array_equal(found.fit[0].response, loop.study.fit[0].response)


def test_a_study_its_records_and_a_drive_show_what_they_hold_and_not_their_numbers():
    assert repr(ON) == "Record('on', drive u [V], response y [rad], 26 rows from -0.5 to 11.5 ms)"
    assert repr(small()) == f"Study('small', fit=[{ON!r}], held_out=[{OFF!r}])"
    assert repr(lb.Drive.steps(u=[(0, 1.57), (20, 0)])) == "Drive('drive', u, 2 rows from 0 to 20)"


# ---- run folders


@pytest.mark.usefixtures("undrawn")
def test_verbs_in_one_folder_keep_their_own_provenance(folder, tmp_path, capsys):
    run, alone = tmp_path / "run", ("--jobs", "1")  # other processes would draw figures
    lb.load_result(folder).save(run)
    draws = (run / "posterior.nc").read_bytes()
    assert main(["audit", str(run), "--quick", "--quiet", *alone]) == 0
    drawn = (run / "report.html").stat().st_mtime_ns
    assert main(["loop", str(run), "--quick", "--as-stated", "--quiet", *alone]) == 0
    assert (run / "posterior.nc").read_bytes() == draws  # not fitted again
    assert (run / "report.html").stat().st_mtime_ns == drawn  # nor drawn again
    origins = json.loads((run / "provenance.json").read_text())
    assert list(origins) == ["fit", "audit", "loop"]
    assert origins["audit"]["command"] == ["lcopa-bayes", "audit", str(run), "--quick", "--quiet", *alone]
    assert origins["loop"]["command"][:2] == ["lcopa-bayes", "loop"]
    assert origins["fit"]["records_sha256"].keys() == {"on"}
    assert lb.load_result(run).verb == "loop"
    assert lb.load_result(run, "audit").verb == "audit"
    pages = ("report.html", "audit.html", "loop.html")
    before = [(run / page).read_bytes() for page in pages]
    for page in pages:
        (run / page).unlink()
    assert main(["report", str(run)]) == 0
    assert [(run / page).read_bytes() for page in pages] == before
    assert "audit.html" in capsys.readouterr().out
    # of another fit than the one beside it
    other = lb.fit(small().with_seed(6))
    other.save(run)
    assert not (run / "report.html").exists()
    with pytest.raises(lb.InputError, match="rests on another fit"):
        lb.load_result(run, "audit")
    # cut short, and published without its draws
    (run / "fit.json").unlink()
    with pytest.raises(lb.InputError, match=r"fit\.json: this file of the run folder is missing"):
        lb.load_result(run, "audit")
    (run / "posterior.nc").unlink()
    published = lb.load_result(run, "audit")
    assert published.fit is None
    with pytest.raises(lb.InputError, match=r"posterior\.nc: this file of the run folder is missing"):
        published.report(run)


def test_a_folder_of_another_study_is_refused(folder, tmp_path):
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with pytest.raises(lb.InputError, match="for the study 'small', not for 'other'"):
        lb.fit(lb.Study("other", fit=[ON], sampler=TINY), folder=folder)
    with pytest.raises(lb.InputError, match="for other records of the study 'small'"):
        lb.loop(lb.Study("small", fit=[OFF], sampler=TINY), folder=folder)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    with pytest.raises(lb.InputError, match="no result"):
        lb.load_result(tmp_path)
    with pytest.raises(lb.InputError, match="no such run folder"):
        lb.load_result(tmp_path / "nowhere")
    with pytest.raises(lb.InputError, match="no result of 'ft'; did you mean 'fit'"):
        lb.load_result(folder, "ft")


HOLDER = """
import sys, time
from small import study, record
from lcopa_bayes.results.runfolder import provenance
from lcopa_bayes.results.runfolder import opened
with opened(sys.argv[1], provenance(study(record()), "fit")):
    print("held", flush=True)
    time.sleep(120)
"""


def test_two_runs_do_not_write_into_one_folder(fit, tmp_path):
    paths = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLDER, tmp_path / "run"],
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": paths},
        text=True,
    )
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(lb.InputError, match=rf"another run is writing there \(process {holder.pid}\)"):
            fit.save(tmp_path / "run")
    finally:
        holder.kill()
        holder.communicate()
    fit.save(tmp_path / "run")  # the lock ends with its process
    assert not (tmp_path / "run" / LOCK).exists()


def test_a_lock_is_given_up_and_may_be_taken_again_by_its_holder(tmp_path):
    origin = provenance(small(), "fit")
    with opened(tmp_path / "run", origin), opened(tmp_path / "run", origin):
        assert (tmp_path / "run" / LOCK).exists()
    assert not (tmp_path / "run" / LOCK).exists()
    with pytest.raises(ZeroDivisionError), opened(tmp_path / "a" / "b", origin):
        raise ZeroDivisionError
    assert not (tmp_path / "a").exists()  # what came to nothing leaves nothing


# ---- scripts


SCRIPT = """
import lcopa_bayes as lb
print("begun")
fit = lb.fit(lb.Study(fit="on.csv", noise={noise}, sampler={sampler}, priors={priors}, seed=5), jobs=2)
print(fit.draws.sha256)
"""
"""Without a main guard."""


@pytest.mark.slow
def test_a_script_without_a_main_guard_fits(tmp_path):
    save_record(ON, tmp_path / "on.csv")
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(noise=NOISE, sampler=TINY, priors=FIXED))
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, cwd=tmp_path, timeout=120, check=False
    )
    assert done.stderr == ""
    alone = lb.fit(lb.Study(fit=tmp_path / "on.csv", noise=NOISE, sampler=TINY, priors=FIXED, seed=5))
    assert done.stdout.split() == ["begun", alone.draws.sha256]


HEAVY = ("numpy", "scipy", "pandas", "matplotlib", "arviz", "emcee")
"""Libraries that take a tenth of a second or more to load."""
SHOWN = (
    f"import atexit, sys\natexit.register(lambda: print([name for name in {HEAVY} if name in sys.modules]))\n"
)


@pytest.mark.parametrize(
    ("code", "loaded"),
    [
        ("import lcopa_bayes", []),
        ("from lcopa_bayes.cli import main\nmain(['--help'])", []),
        ("import lcopa_bayes.core.arrays", ["numpy"]),
    ],
)
def test_import_and_help_come_at_once(code, loaded):
    done = subprocess.run([sys.executable, "-c", SHOWN + code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == str(loaded)


# ---- the names


def public() -> dict[str, object]:
    return {name: getattr(lb, name) for name in lb.__all__}


def test_the_names_are_those_that_were_promised():
    promised = {"load_study", "Study", "Record", "Drive", "fit", "audit", "compare", "loop", "design"}
    promised |= {"calibrate", "fleet", "simulate", "load_result"}
    assert promised <= set(lb.__all__)
    assert set(lb.__all__) <= set(dir(lb))
    with pytest.raises(AttributeError, match="no attribute 'fitt'"):
        lb.fitt  # noqa: B018


def members(kind: type) -> dict[str, object]:
    """Public functions and properties of a class of the package, its own and inherited ones."""
    out = {}
    for base in kind.__mro__:
        if base.__module__.startswith("lcopa_bayes"):
            out |= {
                name: one for name, one in vars(base).items() if not name.startswith("_") and name not in out
            }
    wanted = (property, classmethod, staticmethod)
    return {name: one for name, one in out.items() if inspect.isfunction(one) or isinstance(one, wanted)}


def field_words(kind: type) -> set[str]:
    """Fields of a dataclass that a docstring follows, in the class or one it inherits from."""
    out = set()
    for base in kind.__mro__:
        if not base.__module__.startswith("lcopa_bayes"):
            continue
        (body,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        assert isinstance(body, ast.ClassDef)
        for one, after in zip(body.body, body.body[1:], strict=False):
            if isinstance(one, ast.AnnAssign) and isinstance(after, ast.Expr):
                out.add(one.target.id)  # type: ignore[union-attr]
    return out


def test_every_public_name_has_a_docstring_that_says_what_it_takes_gives_and_refuses():
    lacking = []
    for name, one in public().items():
        words = inspect.getdoc(one) or ""
        if len(words) < 30:
            lacking.append(f"{name}: no docstring")
        if inspect.isfunction(one):
            lacking += [
                f"{name}: says nothing of `{key}`"
                for key in inspect.signature(one).parameters
                if f"`{key}`" not in words and len(inspect.signature(one).parameters) > 1
            ]
            if "InputError" not in words:
                lacking.append(f"{name}: says nothing of errors")
        elif inspect.isclass(one):
            lacking += [
                f"{name}.{key}: no docstring"
                for key, each in members(one).items()
                if len(inspect.getdoc(each) or "") < 15
            ]
            if dataclasses.is_dataclass(one):
                reported = field_words(one)
                lacking += [
                    f"{name}.{each.name}: no docstring"
                    for each in dataclasses.fields(one)
                    if each.name not in reported
                ]
    assert lacking == []


def test_runs_leave_what_is_published_alone():
    """Run folders are made where version control does not look."""
    ignored = (Path(__file__).parents[1] / ".gitignore").read_text().splitlines()
    assert f"{RUNS}/" in ignored
    published = Path(__file__).parents[1] / "reports"
    for verb in ("audit", "compare"):
        assert lb.load_result(published / "paper-step", verb).verb == verb
    assert "coverage" in lb.load_result(published / "calibration" / "one-term").to_json()
