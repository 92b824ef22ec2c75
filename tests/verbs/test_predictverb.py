"""The verb `predict` on the folder of a finished fit: what it writes, and what it refuses without writing."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from small import record, study

from lcopa_bayes.bench.command import on_off
from lcopa_bayes.cli import main
from lcopa_bayes.data.record import save_record
from lcopa_bayes.results.fit import fit

TINY = {"target_ess": 50}
HELD = record(3, command=on_off(-0.7, hold=4.0, at=1.3), camera=0.3, name="held")
GOOD = "time_ms,drive_u_V\n-1,0\n0,0.8\n3,-0.2\n9,-0.2\n"


@pytest.fixture(scope="module")
def fitted():
    return fit(study(record(camera=0.4), held_out=(HELD,), sampler=TINY))


@pytest.fixture(scope="module")
def saved(fitted, tmp_path_factory) -> Path:
    return fitted.save(tmp_path_factory.mktemp("saved") / "run")


@pytest.fixture
def folder(saved, tmp_path) -> Path:
    """A copy for each test: many change it."""
    return Path(shutil.copytree(saved, tmp_path / "run"))


def plan(folder: Path, text: str) -> Path:
    path = folder.parent / "plan.csv"
    path.write_text(text)
    return path


def test_bands_of_a_drive_are_written_with_a_page_and_are_those_of_python(fitted, folder, capsys):
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    path = plan(folder, GOOD)
    assert main(["predict", str(folder), str(path), "--json"]) == 0
    known = json.loads(capsys.readouterr().out)
    place = folder / "predict" / "plan"
    assert known["report"] == str(place / "predict.html")
    page = (place / "predict.html").read_text()
    assert "response to plan" in page
    assert page.count("<svg") == 1
    assert json.loads((place / "provenance.json").read_text())["predict"]["command"][1] == "predict"
    result = fitted.predict(path)
    table = pd.read_csv(place / "tables" / "predict_bands.csv")
    pd.testing.assert_frame_equal(table, result.table(), check_dtype=False)
    kinds = {name.rpartition("_")[0] for name in table.columns if name[-2:].isdigit()}
    assert kinds == {
        f"{what}_{kind}" for what in ("plant", "noisy") for kind in ("pointwise", "simultaneous")
    }
    assert (table["time"].iloc[0], table["time"].iloc[-1]) == (pytest.approx(-0.8), pytest.approx(8.8))
    assert {path: path.read_bytes() for path in before} == before
    # the page is drawn again from what is stored
    (place / "predict.html").unlink()
    assert main(["report", str(place), "--quiet"]) == 0
    assert (place / "predict.html").read_text() == page


def test_a_record_is_scored_as_it_was_when_held_out_from_the_start(fitted, folder, capsys, tmp_path):
    save_record(HELD, tmp_path / "held.csv")
    out = tmp_path / "elsewhere"
    assert main(["predict", str(folder), str(tmp_path / "held.csv"), "--out", str(out)]) == 0
    assert "RMSE" in capsys.readouterr().out
    declared = json.loads((folder / "results.json").read_text())["held_out"]
    assert json.loads((out / "predict.json").read_text())["scores"] == declared
    assert "Scores" in (out / "predict.html").read_text()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time_ms,drive_v_V\n0,0\n1,1\n", ["no drive axis 'v'", "'u' [V] is absent"]),
        ("time_ms,drive_u_mV\n0,0\n1,1\n", ["is in mV, in the study it is in V"]),
        ("time_ms,drive_u_V\n0,0.5\n1,1\n", ["is at 0.5 V before its first change"]),
        ("time_ms,drive_u_V\n0,0\n2,1\n1,0\n", ["line 4, column 'time_ms': 1.0 does not come after"]),
        ("time_ms,drive_u_V\n0,0\n2,\n", ["line 3, column 'drive_u_V': the cell is empty"]),
        ("time_week,drive_u_V\n0,0\n2,1\n", ["the time unit 'week' is not known"]),
        ("time_ms\n0\n2\n", ["has no drive column"]),
    ],
)
def test_a_drive_that_does_not_suit_is_refused_and_nothing_written(folder, capsys, text, words):
    path = plan(folder, text)
    before = sorted(folder.rglob("*"))
    assert main(["predict", str(folder), str(path)]) == 2
    known = capsys.readouterr()
    assert known.out == ""
    lines = known.err.splitlines()
    assert len(lines) == len(words)
    assert all(word in line for word, line in zip(words, lines, strict=True))
    assert sorted(folder.rglob("*")) == before


def test_a_fitted_record_is_refused_and_nothing_written(fitted, folder, capsys, tmp_path):
    save_record(fitted.study.fit[0], tmp_path / "step.csv")
    before = sorted(folder.rglob("*"))
    assert main(["predict", str(folder), str(tmp_path / "step.csv")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "record 'step' is 'step' of the fit" in line
    assert sorted(folder.rglob("*")) == before


def other_version(folder: Path) -> None:
    values = json.loads((folder / "fit.json").read_text()) | {"version": "0.0.1"}
    (folder / "fit.json").write_text(json.dumps(values))


def halved(folder: Path) -> None:
    whole = (folder / "posterior.nc").read_bytes()
    (folder / "posterior.nc").write_bytes(whole[: len(whole) // 2])


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (other_version, "was written by lcopa-bayes 0.0.1"),
        (halved, "posterior.nc: cannot be read as draws"),
        (lambda folder: (folder / "fit.json").unlink(), "fit.json: this file of the run folder is missing"),
    ],
)
def test_a_run_folder_of_another_version_or_cut_short_is_refused(folder, capsys, spoil, words):
    path = plan(folder, GOOD)
    spoil(folder)
    before = sorted(folder.rglob("*"))
    assert main(["predict", str(folder), str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert sorted(folder.rglob("*")) == before


def test_a_missing_drive_or_folder_is_reported(folder, capsys):
    assert main(["predict", str(folder), str(folder / "none.csv")]) == 2
    assert "no such file" in capsys.readouterr().err
    assert main(["predict", str(folder / "none"), str(plan(folder, GOOD))]) == 2
    assert "there is no such run folder" in capsys.readouterr().err


@pytest.mark.usefixtures("undrawn")
def test_the_report_of_a_prediction_and_zero_offset(fitted, folder, tmp_path):
    path = plan(folder, GOOD)
    assert (
        main(["predict", str(folder), str(path), "--offset", "zero", "--out", str(tmp_path / "a"), "--quiet"])
        == 0
    )
    (axis,) = json.loads((tmp_path / "a" / "predict.json").read_text())["axes"]
    assert axis["offset_from"] == "no offset"
    page = fitted.predict(path).report(tmp_path / "b")
    assert page.read_text().startswith("<!")
    end = pd.read_csv(tmp_path / "b" / "tables" / "predict_bands.csv").iloc[-1]
    with_offset = end["plant_pointwise_50"] - axis["value_at_end"]
    assert with_offset == pytest.approx(np.median(fitted.draws.column("offset")), abs=0.02)
