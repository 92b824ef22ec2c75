"""A study from a stranger executes nothing, reads nothing outside its folder, and puts no script on pages."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from markupsafe import escape
from small import check_page, record, study

import lcopa_bayes as lb
from lcopa_bayes.cli import main
from lcopa_bayes.data.record import Axis, Record, save_record

PACKAGE = Path(lb.__file__).parent
OWN = """
from pathlib import Path

Path(__file__).with_name("executed").touch()

from lcopa_bayes.model.effects.effect import Card, ReadoutEffect, single

class Mine(ReadoutEffect):
    estimated = single("c", 0.03)
    linear = True
    card = Card(
        name="mine", place="output", formula="y -> y + c y^5 / ymax^4", source="own", reveals="amplitudes",
        mistaken_for="odd_curvature",
    )

    def seen(self, y, scene, psi):
        return y + psi[0] * y * (y / scene.ranges.response) ** 4
"""
TINY = {"target_ess": 50}


@pytest.fixture
def stranger(tmp_path) -> Path:
    """A study whose effect leaves a mark where it is executed."""
    folder = tmp_path / "stranger"
    folder.mkdir()
    save_record(record(camera=0.8), folder / "step.csv")
    (folder / "own.py").write_text(OWN)
    (folder / "study.toml").write_text(
        '[effects]\nadd = ["own.py:Mine"]\nuse = ["mine"]\n[model]\nterms = 1\n'
    )
    return folder


VERBS = ("check", "look", "fit", "run", "audit", "design", "compare", "loop", "calibrate", "identify")


@pytest.mark.parametrize("verb", VERBS)
def test_no_verb_executes_what_a_study_brings(stranger, tmp_path, capsys, verb):
    out = tmp_path / "out"
    assert main([verb, str(stranger), "--out", str(out), "--quiet"]) == 2
    said = capsys.readouterr().err
    assert said == (
        f"error: {stranger}/study.toml, [effects]: would run code, own.py:Mine; read it, and if you trust "
        "its author, allow this with --trust, from Python with `load_study(..., trust=True)`\n"
    )
    assert not (stranger / "executed").exists()
    assert not out.exists()


def test_nothing_is_executed_where_something_else_is_wrong_too(stranger, capsys):
    text = (stranger / "study.toml").read_text()
    (stranger / "study.toml").write_text(text + '[noise]\nkind = "white"\n[typo]\n')
    assert main(["check", str(stranger), "--quiet"]) == 2
    assert not (stranger / "executed").exists()


def test_a_fleet_lists_a_device_that_would_run_code_as_failed(stranger, capsys):
    save_record(record(camera=0.8), stranger.parent / "sound.csv")
    assert main(["fleet", str(stranger.parent), "--out", str(stranger.parent / "runs"), "--quiet"]) == 2
    assert "would run code, own.py:Mine" in capsys.readouterr().err
    assert not (stranger / "executed").exists()


@pytest.mark.slow
def test_a_trusted_study_and_its_run_folder(stranger, tmp_path, capsys):
    assert main(["check", str(stranger), "--trust", "--quiet"]) == 0
    assert (stranger / "executed").exists()
    trusted = lb.load_study(stranger, trust=True)
    assert "mine.c" in set(lb.check(trusted).summary()["parameter"])
    with pytest.raises(lb.InputError, match="would run code"):
        lb.load_study(stranger)  # trust is of one call
    short = lb.Study(
        "short", stranger, fit=trusted.fit, model={"terms": 1}, effects=trusted.effects, sampler=TINY
    )
    run = lb.fit(short, folder=tmp_path / "run") and tmp_path / "run"
    (stranger / "executed").unlink()
    with pytest.raises(lb.InputError, match=r"fit\.json: effects of its own: would run code, own\.py:Mine"):
        lb.load_result(run)
    for words in (["report", run], ["audit", run], ["predict", run, stranger / "step.csv"]):
        assert main([*map(str, words), "--quiet"]) == 2
        assert "would run code" in capsys.readouterr().err
    assert not (stranger / "executed").exists()
    assert lb.load_result(run, trust=True).summary().shape[0] > 3
    assert (stranger / "executed").exists()


OUTSIDE = {
    "records": '[records]\nfit = ["../secret.csv"]\n',
    "absolute": '[records]\nheld_out = ["{home}/secret.csv"]\n',
    "inside, but absolute": '[records]\nheld_out = ["{home}/a/step.csv"]\n',
    "link": '[records]\nfit = ["link.csv"]\n',
    "folder behind a link": '[records]\nfit = ["up/secret.csv"]\n',
    "every table there": "[study]\nseed = 1\n",
    "no study file": "",
    "population": '[records]\nfit = ["step.csv"]\n[priors]\nfrom = "../secret.json#1"\n',
}


@pytest.mark.parametrize("case", OUTSIDE)
def test_files_outside_the_folder_are_read_of_a_trusted_study_alone(tmp_path, case):
    folder = tmp_path / "a"
    folder.mkdir()
    save_record(record(camera=0.8), folder / "step.csv")
    save_record(record(2, camera=0.8), tmp_path / "secret.csv")
    (tmp_path / "secret.json").write_text('{"secret": 1}')
    if case in ("link", "every table there", "no study file"):
        (folder / "link.csv").symlink_to("../secret.csv")
    if case == "folder behind a link":
        (folder / "up").symlink_to("..")
    if text := OUTSIDE[case].replace("{home}", str(tmp_path)):
        (folder / "study.toml").write_text(text)
    with pytest.raises(
        lb.InputError, match="is not inside the folder of the study; copy the file there, or if"
    ):
        lb.load_study(folder)
    if case in NOT_A_STUDY:
        with pytest.raises(lb.InputError, match=NOT_A_STUDY[case]):
            lb.load_study(folder, trust=True)
    else:
        assert lb.load_study(folder, trust=True).fit


def test_all_else_that_is_wrong_is_said_with_the_files_that_are_outside(stranger, capsys):
    """A file outside, code, a misspelt key and a faulty record: none hides another, and the file outside is
    not read."""
    secret = stranger.parent / "secret.csv"
    secret.write_text("top secret\n")
    (stranger / "faulty.csv").write_text("time_ms,drive_x_V,response_x_um\n0,0,0\n1,one,0\n2,1,1\n")
    text = (stranger / "study.toml").read_text()
    records = '[records]\nfit = ["faulty.csv", "../secret.csv"]\n[sampler]\nwalker = 20\n'
    (stranger / "study.toml").write_text(text + records)
    assert main(["check", str(stranger), "--quiet"]) == 2
    said = capsys.readouterr().err
    for one in ("'../secret.csv' is not inside", "would run code", "'walker'", "faulty.csv, line 3"):
        assert one in said
    assert f"{secret}:" not in said
    assert not (stranger / "executed").exists()


def test_a_held_out_file_outside_is_said_once(tmp_path):
    """By a link; where no record to fit is named it is none of them."""
    save_record(record(camera=0.8), tmp_path / "secret.csv")
    folder = tmp_path / "a"
    folder.mkdir()
    save_record(record(camera=0.8), folder / "step.csv")
    (folder / "link.csv").symlink_to("../secret.csv")
    (folder / "study.toml").write_text('[records]\nheld_out = ["link.csv"]\n')
    with pytest.raises(lb.InputError) as refused:
        lb.load_study(folder)
    assert len(refused.value.problems) == 1


def test_files_inside_the_folder_need_no_trust(tmp_path):
    folder = tmp_path / "real"
    (folder / "data").mkdir(parents=True)
    save_record(record(camera=0.8), folder / "data" / "step.csv")
    (folder / "link.csv").symlink_to("data/step.csv")
    (folder / "study.toml").write_text('[records]\nfit = ["data/../data/step.csv"]\n')
    (tmp_path / "linked").symlink_to("real")  # the user names it
    for place in (folder, tmp_path / "linked"):
        assert lb.load_study(place).fit[0].name == "step"
    (folder / "study.toml").write_text('[records]\nfit = ["link.csv"]\n')
    assert lb.load_study(folder).fit[0].name == "link"


NOT_A_STUDY = {"population": "holds no fleet", "inside, but absolute": "no record to fit"}
"""What is wrong with some of these besides."""
EVIL = '<script>alert("1")</script>&<svg onload=alert(1)>'


def evil() -> Record:
    plain = record(camera=0.8)
    axes = (Axis("=cmd('x')|y", "<b>V</b>"),), (Axis("@" + EVIL.replace("_", ""), "rad"),)
    return Record(f"={EVIL}", plain.time, plain.drive, plain.response, *axes, "ms")


def test_names_are_text_on_pages_and_no_formulas_in_tables(tmp_path):
    task = study(evil(), sampler=TINY, priors={"delay": 0.73, "order_1": 0.8})
    made = lb.fit(replace(task, name="<script>alert(1)<b>"), folder=tmp_path)
    page = check_page(made.report(tmp_path))
    allowed = re.sub(r"<script( type=\"application/json\")?>.*?</script>", "", page, flags=re.DOTALL)
    assert "<script" not in allowed
    assert "<script>alert" not in page
    assert "<svg onload" not in page
    assert "<b>V" not in page
    for drawing in (tmp_path / "figures").glob("*.svg"):
        assert not re.search(r"<script|<svg onload|<b>V", drawing.read_text())
    held = list(tmp_path.rglob("*.csv"))
    cells = {one.name: pd.read_csv(one, dtype=str, keep_default_na=False).to_numpy().ravel() for one in held}
    assert sum(f"'={EVIL}" in each for each in cells.values()) > 2
    for name, each in cells.items():
        for cell in each:
            assert not re.match(r"[=@\t\r]|[+-](?![\d.e+-]*$|inf)", cell), (name, cell)
    assert str(escape(f"={EVIL}")) in page
    assert str(escape(f"'={EVIL}")) not in page  # names are read back as they were
    read = lb.load_result(tmp_path)
    assert read.study.fit[0].name == f"={EVIL}"
    shutil.rmtree(tmp_path / "figures")
    assert read.report(tmp_path).read_text() == page


def test_nothing_of_the_package_is_read_or_written_by_pickle():
    """But for work that is given to processes of its own, by a module that opens no file."""
    sources = {path: path.read_text() for path in PACKAGE.rglob("*.py")}
    assert len(sources) > 200
    given = sources.pop(PACKAGE / "core" / "packing.py")
    assert not re.search(r"\bopen\(|\bPath\b|read_bytes|write_bytes|pickle\.(load|dump)\(", given)
    for path, text in sources.items():
        assert not re.search(
            r"\b(c?pickle|cloudpickle|joblib|shelve|marshal|dill)\b|allow_pickle=True", text
        ), path
        assert text.count("np.load(") == text.count("allow_pickle=False"), path
