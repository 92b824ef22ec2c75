"""The command line: exit codes, what is printed where, what is written."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from lcopa_bayes.bench.command import on_off
from lcopa_bayes.bench.device import Bench, Device, simulate
from lcopa_bayes.cli import main
from lcopa_bayes.data.record import Axis, save_record
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.report.page import tied

DEVICE = Device(
    ((TransferPath(2.0, 0.5, (1.5,), (1.2,), 1.0),),), (Axis("in", "V"),), (Axis("out", "mm"),), (0.3,)
)
STATED = "[model]\nterms = 1\n"
"""The structure, which then is not chosen."""


@pytest.fixture
def record(tmp_path) -> Path:
    measured = simulate(
        DEVICE,
        Bench(camera=0.2, noise_sd=0.02),
        on_off(1.0, hold=6.0, at=0.1),
        duration=14.0,
        name="pulse",
        rng=np.random.default_rng(3),
    )
    path = tmp_path / "pulse.csv"
    save_record(measured, path)
    return path


def study(record: Path, more: str = "") -> Path:
    path = record.parent / "study.toml"
    path.write_text(
        '[records]\nfit = ["pulse.csv"]\n[noise]\nkind = "white"\n[sampler]\ntarget_ess = 100\n' + more
    )
    return path


def run(capsys, *words: object) -> tuple[int, str, str]:
    code = main([str(word) for word in words])
    out, err = capsys.readouterr()
    return code, out, err


@pytest.mark.usefixtures("undrawn")
def test_fit_prints_one_json_object_and_writes_the_run_folder(record, tmp_path, capsys):
    out = tmp_path / "run"
    code, printed, _ = run(
        capsys, "fit", study(record, STATED), "--out", out, "--json", "--quiet", "--jobs", 1
    )
    reported = json.loads(printed)
    assert code == 0
    names = {p["name"] for p in reported["parameters"]}
    assert names == {"gain", "time_1", "order_1", "delay", "offset", "sigma"}
    assert reported["grade"] in {"reliable", "tentative", "unusable"}
    gain = next(p for p in reported["parameters"] if p["name"] == "gain")
    assert abs(gain["mean"] - 2.0) < 5 * gain["sd"]
    for name in ("report.html", "results.json", "posterior.nc", "chain.h5", "provenance.json"):
        assert (out / name).stat().st_size > 0
    stored = json.loads((out / "results.json").read_text())
    page = (out / "report.html").read_text(encoding="utf-8")
    opening = f"Grade {stored['grade']}: {stored['grade_reason']}. "
    assert stored["verdict"].startswith(opening)
    assert all(
        tied(part) in page
        for part in (*stored["grade_reason"].split("; "), stored["verdict"].removeprefix(opening))
    )
    code, printed, _ = run(capsys, "report", out, "--json")
    assert code == 0
    assert json.loads(printed)["report"] == str(out / "report.html")


@pytest.mark.usefixtures("undrawn")
def test_records_alone_are_a_study(record, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, printed, _ = run(capsys, "fit", record, "--json", "--quiet", "--quick", "--jobs", 1)
    assert code == 0
    assert json.loads(printed)["study"] == "pulse"
    assert (tmp_path / "runs" / "pulse" / "report.html").exists()


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("[modl]\nterms = 1\n", ["modl", "model"]),
        ("[priors]\ndelya = 3.0\n", ["delya", "delay"]),
        ('[priors]\norder_1 = { dist = "uniform", loc = 3, scale = 1 }\n', ["order_1", "no mass", "(0, 2]"]),
        ("[model]\nterms = { direct = 1 }\n", ["direct"]),
    ],
)
def test_a_bad_study_is_reported_and_nothing_is_written(record, tmp_path, capsys, more, words):
    out = tmp_path / "run"
    code, printed, reported = run(capsys, "fit", study(record, more), "--out", out)
    assert code == 2
    assert printed == ""
    assert reported.startswith("fit: loading\nerror: ")
    assert all(word in reported for word in words)
    assert not out.exists()


def test_all_problems_of_a_broken_record_are_reported_at_once(tmp_path, capsys):
    path = tmp_path / "broken.csv"
    path.write_text("time_ms,drive_x_V,response_y_V\n0,0,1\n1,,2\n0.5,1,two\n")
    code, _, reported = run(capsys, "fit", path, "--out", tmp_path / "run")
    assert code == 2
    assert reported.count("error: ") >= 3
    assert "line 3" in reported
    assert "line 4" in reported
    assert "'two'" in reported
    assert not (tmp_path / "run").exists()


def test_too_few_samples(tmp_path, capsys):
    path = tmp_path / "short.csv"
    path.write_text("time_ms,drive_x_V,response_y_V\n0,0,0\n1,1,0.2\n2,1,0.4\n")
    code, _, reported = run(capsys, "fit", path, "--out", tmp_path / "run")
    assert code == 2
    assert "3 samples cannot determine 8 free parameters" in reported


def test_an_output_folder_that_is_a_file(record, tmp_path, capsys):
    (tmp_path / "taken").write_text("here first")
    code, _, reported = run(capsys, "fit", study(record), "--out", tmp_path / "taken")
    assert code == 2
    assert "--out" in reported
    assert (tmp_path / "taken").read_text() == "here first"


@pytest.mark.slow
def test_a_killed_run_resumes_to_the_same_draws(record, tmp_path):
    """Killed without warning as soon as a first round is stored, then resumed."""
    script = "import sys; from lcopa_bayes.cli import main; sys.exit(main(sys.argv[1:]))"
    words = ["fit", str(study(record)), "--quiet", "--jobs", "1", "--out"]
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert main([*words, str(whole)]) == 0
    killed = subprocess.Popen([sys.executable, "-c", script, *words, str(cut)])
    while not (cut / "chain.h5").exists() and killed.poll() is None:
        time.sleep(0.01)
    killed.kill()
    killed.wait()
    assert (cut / "chain.h5").exists()
    assert not (cut / "results.json").exists(), "the run ended before it could be killed"
    assert main([*words, str(cut), "--resume"]) == 0
    reported = [json.loads((folder / "results.json").read_text()) for folder in (whole, cut)]
    assert reported[0] == reported[1]
    assert os.listdir(whole / "tables") == os.listdir(cut / "tables")


def test_simulate_writes_a_study_that_loads(tmp_path, capsys):
    campaign = tmp_path / "campaign.toml"
    campaign.write_text(
        '[campaign]\nname = "demo"\nseed = 3\n[bench]\nnoise_sd = [1e-4, 2e-4]\n'
        '[[record]]\nname = "a"\nduration = 5.0\nx = { step = 1.0 }\n'
        '[[record]]\nname = "b"\nduration = 5.0\nheld_out = true\ny = { prbs = [0, 1], hold = 1.0 }\n'
    )
    code, printed, _ = run(capsys, "simulate", campaign, "--out", tmp_path / "demo", "--json")
    assert code == 0
    assert len(json.loads(printed)["files"]) == 3
    before = (tmp_path / "demo" / "a.csv").read_bytes()
    code, _, reported = run(capsys, "simulate", campaign, "--out", tmp_path / "demo")
    assert code == 2
    assert "there already" in reported
    run(capsys, "simulate", campaign, "--out", tmp_path / "demo", "--overwrite", "--quiet")
    assert (tmp_path / "demo" / "a.csv").read_bytes() == before


BAD_PATH = """[[record]]
name = "a"
duration = 5
[[path]]
response = "x"
drive = "x"
delay = 1.0
orders = [1.0]
stiffness = 1.0
"""


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["[[record]]"]),
        ('[[record]]\nname = "a"\n', ["duration"]),
        ('[[record]]\nname = "a"\nduration = 5\nx = { stp = 1 }\n', ["stp", "step"]),
        ('[[record]]\nname = "a"\nduration = 5\nx = { on_off = 1 }\n', ["hold"]),
        ('[bensch]\n[[record]]\nname = "a"\nduration = 5\n', ["bensch", "bench"]),
        ('[[record]]\nname = "a"\nduration = "x"\n', ["[[record]] 1", "`duration` must be a number"]),
        ('[[record]]\nname = "a"\nduration = 5\nx = 3\n', ["`x` must be a table such as"]),
        ('[[record]]\nname = "a"\nduration = 5\nx = { step = "b" }\n', ["`step` must be a number"]),
        ('[record]\nname = "a"\n', ["[[record]]"]),
        ('[bench]\ncamera = "x"\nnoise_sd = []\n[[record]]\nname = "a"\n', ["`camera` must be a number"]),
        ('[bench]\ncamera = -1.0\n[[record]]\nname = "a"\nduration = 5\n', ["campaign.toml", "`camera`"]),
        ('[campaign]\nseed = "x"\n[[record]]\nname = "a"\nduration = 5\n', ["`seed` must be a whole"]),
        ('[undeclared]\neffects = "cubic_stiffness"\n', ["`effects` must be a list"]),
        (f"{BAD_PATH}gain = '0.1'\n", ["[[path]] 1", "`gain` must be a number"]),
        (f"{BAD_PATH}gain = -0.1\netas = [-1.0]\n", ["[[path]]", "must be positive"]),
    ],
)
def test_a_bad_campaign_is_reported(tmp_path, capsys, text, words):
    campaign = tmp_path / "campaign.toml"
    campaign.write_text(text)
    code, _, reported = run(capsys, "simulate", campaign, "--out", tmp_path / "demo")
    assert code == 2
    assert all(word in reported for word in words)
    assert not (tmp_path / "demo").exists()


def test_what_cannot_be_resumed_has_no_such_option(record, capsys):
    """`loop` keeps nothing to go on from."""
    with pytest.raises(SystemExit) as ended:
        main(["loop", str(record), "--resume"])
    assert ended.value.code == 2
    assert "--resume is not an option of" in capsys.readouterr().err
