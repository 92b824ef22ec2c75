"""From a table to a study that can be fitted: `new`, `check`, and a folder without a study file."""

from __future__ import annotations

import json
import tracemalloc
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose
from scipy.stats import halfnorm
from small import ON_OFF_TABLE as TABLE
from small import record

import lcopa_bayes as lb
from lcopa_bayes.bench.command import step
from lcopa_bayes.cli import main
from lcopa_bayes.data.record import Record, save_record
from lcopa_bayes.results.result import _text_table


@pytest.fixture
def oven(tmp_path):
    path = tmp_path / "oven.csv"
    path.write_text(TABLE, encoding="utf-8-sig")
    return path


def test_a_spreadsheet_becomes_a_study_that_is_checked_and_looked_at(oven, tmp_path, capsys):
    folder, run = tmp_path / "study", tmp_path / "run"
    assert main(["new", str(folder), str(oven)]) == 0
    said = capsys.readouterr().out
    assert "'Zeit [min]' is the time, in min." in said
    assert "lcopa-bayes check" in said
    study = lb.load_study(folder)
    assert (study.name, study.time_unit, [one.name for one in study.fit]) == ("study", "min", ["oven"])
    assert "# - 'Heater [%]' is a drive" in (folder / "study.toml").read_text()
    assert main(["check", str(folder), "--out", str(run)]) == 0
    said = capsys.readouterr().out
    assert "Heater changes once, at 2 min, between 0 and 40 %" in said
    assert "The records can be fitted." in said
    assert (run / "check.html").stat().st_size > 10_000
    page = (run / "check.html").read_bytes()
    assert lb.load_result(run).to_json() == json.loads((run / "check.json").read_text())
    assert main(["report", str(run)]) == 0
    assert (run / "check.html").read_bytes() == page
    assert main(["look", str(folder), "--out", str(run)]) == 0


def test_a_long_table_becomes_means_that_are_fitted_as_such(tmp_path, capsys, monkeypatch):
    long = tmp_path / "long.csv"
    save_record(record(camera=0.01), long)
    folder = tmp_path / "study"
    assert main(["new", str(folder), str(long), "--average", "10"]) == 0
    said = capsys.readouterr().out
    assert "Every sample written is the mean of 10." in said
    assert "Means of 10 samples make no standard deviation larger than 1." in said
    assert "Means of 20 samples" in said
    study, whole = lb.load_study(folder), lb.load_record(long)
    assert study.exposure == pytest.approx(0.1)
    assert study.fit[0].sampled.size == whole.sampled.size // 10
    advised = "`lcopa-bayes new --average` puts means in their place"
    assert advised not in str(lb.check(folder))
    monkeypatch.setattr("lcopa_bayes.verbs.check._MANY", study.fit[0].sampled.size - 1)
    assert advised in str(lb.check(folder))
    assert main(["new", str(tmp_path / "none"), str(long), "--average", "700"]) == 2
    assert "are no two means of 700" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("stamped", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_long_table_takes_little_memory_per_row(tmp_path, stamped):
    """A row of three numbers is 24 bytes; as objects of Python it took a thousand."""

    def peak(rows):
        at = 100 * np.arange(rows)
        time = pd.to_datetime(at, unit="ms").strftime("%d.%m.%Y %H:%M:%S.%f") if stamped else at
        rng = np.random.default_rng(1)
        drive = np.repeat(rng.normal(size=rows // 500), 500).round(6)
        table = tmp_path / f"{rows}.csv"
        columns = {"Time" if stamped else "Time [ms]": time, "Heater [V]": drive, "T": rng.normal(size=rows)}
        pd.DataFrame(columns).to_csv(table, sep=";", index=False)
        tracemalloc.start()
        try:
            lb.new(tmp_path / f"study{rows}", table)
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak(2000)  # what is loaded once
    assert (peak(25_000) - peak(12_500)) / 12_500 < 250


def test_nothing_is_replaced_unless_allowed_and_nothing_written_of_what_is_refused(oven, tmp_path, capsys):
    folder = tmp_path / "study"
    lb.new(folder, oven)
    (folder / "study.toml").write_text("# mine")
    assert main(["new", str(folder), str(oven)]) == 2
    assert "study.toml: is there already" in capsys.readouterr().err
    assert (folder / "study.toml").read_text() == "# mine"
    lb.new(folder, oven, overwrite=True)
    assert "mine" not in (folder / "study.toml").read_text()
    (tmp_path / "bad.csv").write_text("a;b\n1;x\n")
    assert main(["new", str(tmp_path / "other"), str(oven), str(tmp_path / "bad.csv")]) == 2
    assert not (tmp_path / "other").exists()
    assert main(["new", str(tmp_path / "other"), str(oven), "--time", "Zeitt"]) == 2
    assert "did you mean 'Zeit [min]'" in capsys.readouterr().err
    with pytest.raises(lb.InputError, match="another table is called 'oven' too"):
        lb.new(tmp_path / "other", [oven, oven])


def test_a_logger_that_writes_drives_late_is_recognised_and_converted(tmp_path, capsys):
    """The response of a tank at once, in the row in which the drive is written."""
    table = tmp_path / "tank.csv"
    rows = [f"{k},{2 * (k >= 20)},{3 + 0.7 * (k >= 20) + 0.001 * (-1) ** k}" for k in range(60)]
    table.write_text("\n".join(["time_s,pump (V),level (cm)", *rows]))
    assert main(["new", str(tmp_path / "late"), str(table)]) == 0
    assert (
        "warning: response 'level' of record 'tank' moves by 0.701 cm in the very row"
        in capsys.readouterr().out
    )
    assert main(["new", str(tmp_path / "own"), str(table), "--drive-until"]) == 0
    assert "warning" not in capsys.readouterr().out
    drives = [lb.load_study(tmp_path / name).fit[0].drive[:, 0] for name in ("late", "own")]
    assert (drives[1] == np.append(drives[0][1:], drives[0][-1])).all()


def test_roles_may_be_stated_on_the_command_line(oven, tmp_path):
    given = ["--time", "Zeit", "--drive", "u [V]=Heater", "--response", "T1", "--held-out"]
    assert main(["new", str(tmp_path / "s"), str(oven), *given, str(_renamed(oven))]) == 0
    study = lb.load_study(tmp_path / "s")
    assert [(axis.name, axis.unit) for axis in study.drive_axes] == [("u", "V")]
    assert [one.name for one in study.held_out] == ["again"]


def _renamed(path):
    copy = path.with_name("again.csv")
    copy.write_bytes(path.read_bytes())
    return copy


def test_a_folder_without_a_study_file_is_a_study_of_its_records(tmp_path):
    folder = tmp_path / "bench"
    folder.mkdir()
    for name, seed in (("a", 1), ("b", 2)):
        save_record(record(seed, camera=0.5, name=name), folder / f"{name}.csv")
    study = lb.load_study(folder)
    assert (study.name, [one.name for one in study.fit]) == ("bench", ["a", "b"])
    apart = lb.load_study(folder, held_out=[folder / "b.csv"])
    assert ([one.name for one in apart.fit], [one.name for one in apart.held_out]) == (["a"], ["b"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(lb.InputError, match=r"holds neither a study\.toml nor a record"):
        lb.load_study(tmp_path / "empty")


def test_a_check_counts_what_is_there():
    """Against the numbers the record was made with."""
    on = record(1, camera=0.2, name="on")
    values = lb.check(lb.Study("small", fit=[on], terms=1)).to_json()
    (one,) = values["records"]
    assert (one["rows"], one["even"]) == (on.time.size, True)
    assert_allclose(one["period"], 0.2, rtol=1e-6)
    (drive,) = one["drives"]
    assert (drive["changes"], drive["lowest"], drive["highest"]) == (1, 0.0, 1.0)
    (response,) = one["responses"]
    at_rest = (on.time <= drive["first_change"]) & np.isfinite(on.response[:, 0])
    assert response["at_rest"] == np.count_nonzero(at_rest)
    assert_allclose(response["scatter"], on.response[at_rest, 0].std(ddof=1))
    priors = {row["name"]: row for row in values["parameters"]}
    span = on.time[-1] - drive["first_change"]
    assert_allclose([priors["order_1"]["lower"], priors["order_1"]["upper"]], [0.1, 1.9])
    assert_allclose(
        [priors["delay"]["lower"], priors["delay"]["upper"]], [0.02 * span, 0.38 * span], rtol=1e-6
    )


def test_an_onset_is_not_before_the_delay():
    seen = []
    for seed in range(20):
        on = record(seed, camera=0.05, noise_sd=0.005)
        still = Record(
            "on", on.time + 5, on.drive, on.response, on.drive_axes, on.response_axes, time_unit=on.time_unit
        )
        values = lb.check(lb.Study("small", fit=[still], terms=1)).to_json()
        onset = values["records"][0]["responses"][0]["onset"]
        seen.append(onset)
    assert None not in seen
    assert min(seen) >= 0.73 - 0.1  # the delay; a sample is a mean over the exposure before it
    assert max(seen) < 1.5


def test_obstacles_to_a_fit_are_part_of_a_check(capsys, tmp_path):
    on = record(1, camera=0.5, name="on")
    flat = Record(
        "on",
        on.time,
        on.drive,
        0 * on.response + 1.0,
        on.drive_axes,
        on.response_axes,
        time_unit=on.time_unit,
    )
    result = lb.check(lb.Study("small", fit=[flat], terms=1))
    assert "constant throughout" in result.verdict
    with pytest.raises(lb.InputError, match="constant throughout"):
        lb.fit(lb.Study("small", fit=[flat], terms=1))


def test_a_level_prior_is_said_by_its_ends():
    """Nine tenths of a uniform prior begin above delays that it allows."""
    result = lb.check(lb.Study("small", fit=[record(1, name="on")], terms=1))
    said = {one["name"]: one for one in result.to_json()["parameters"]}
    assert said["delay"]["words"].startswith("anywhere between 0 and ")
    assert float(said["delay"]["words"].split()[-1]) == pytest.approx(said["delay"]["upper"] / 0.95, rel=1e-3)
    assert said["time_1"]["words"].endswith(", every decade alike")
    assert said["gain"]["words"].endswith(" with 90 % probability")


def test_equal_samples_at_rest_do_not_scatter():
    """Their mean may round away from them, as that of 0.1 seven times does: nor do they move before anything
    else does."""
    on = record(1, name="on", command=step(1.0, at=1.0))
    response = np.where(on.time[:, None] > 2.0, on.response, 0.1)
    result = lb.check(lb.Study("small", fit=[replace(on, response=response)], terms=1))
    (axis,) = result.to_json()["records"][0]["responses"]
    assert axis["at_rest"] == 7
    assert np.std([0.1] * 7) > 0.0
    assert axis["scatter"] == 0.0
    assert axis["onset"] > 1.0
    assert "7 at rest, which are all equal" in str(result)


def test_a_prior_that_reaches_beyond_its_parameter_is_said_within():
    """A normal prior of a delay about 0 is half a normal one, and a level one ends where orders do."""
    priors = {
        "delay": {"dist": "norm", "loc": 0.0, "scale": 1.0},
        "order_1": {"dist": "uniform", "loc": -1.0, "scale": 4.0},
    }
    result = lb.check(lb.Study("small", fit=[record(1, name="on")], terms=1, priors=priors))
    said = {one["name"]: one for one in result.to_json()["parameters"]}
    assert said["delay"]["lower"] == pytest.approx(halfnorm.ppf(0.05))
    assert said["delay"]["upper"] == pytest.approx(halfnorm.ppf(0.95))
    assert said["order_1"]["words"].startswith("anywhere between 0 and 2")


def test_sentences_of_a_printed_table_begin_in_one_column():
    table = pd.DataFrame(
        {"name": ["a", "long"], "size": [1234.567, 0.5], "reason": ["short", "many words " * 4]}
    )
    printed = _text_table(table).splitlines()
    at = printed[0].index("reason")
    assert [line[at:] for line in printed] == ["reason", "short", ("many words " * 4).rstrip()]
    assert [line[:at].split() for line in printed[1:]] == [["a", "1235"], ["long", "0.5"]]
