"""The verb over small fleets: its table, its populations, what fails, what is done again, and its priors."""

import json
import math
import os
import signal
import sys
import tomllib
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Timer

import numpy as np
import pandas as pd
import pytest
from small import ONE, check_page, path, record

import lcopa_bayes as lb
from lcopa_bayes.cli import main
from lcopa_bayes.data.settings import CandidateSettings
from lcopa_bayes.data.studywriter import write_folder
from lcopa_bayes.fleets.devices import basis, row_of
from lcopa_bayes.fleets.summary import _shares, results
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.model.effects.catalogue import catalogue
from lcopa_bayes.plot.theme import look
from lcopa_bayes.report import fleet as page_of_fleet
from lcopa_bayes.results import fit as fits
from lcopa_bayes.verbs import fleet as verb

sys.path.insert(0, str(Path(__file__).parents[2] / "studies" / "fleet"))
import make

GAINS = {"a": 1.9, "b": 2.0, "c": 2.1}
SETTINGS = """
[model]
terms = 1

[noise]
kind = "white"

[priors]
order_1 = 0.8
delay = 0.73
"""


def device(name: str, gain: float, folder: Path) -> None:
    """A device of a gain, as a folder with its study."""
    made = replace(ONE, paths=((path(gain, 0.73, (1.5,), (0.8,)),),))
    taken = record(seed=len(name) + ord(name[0]), device=made, camera=0.5)
    write_folder(folder / name, lb.Study(name, fit=taken, seed=3), settings=SETTINGS)


@pytest.fixture(scope="module")
def devices(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("devices")
    for name, gain in GAINS.items():
        device(name, gain, folder)
    (folder / "broken").mkdir()
    (folder / "broken" / "study.toml").write_text("[model]\nterms = 99\n")
    return folder


@pytest.fixture(scope="module")
def out(devices, tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("runs") / "fleet"


@pytest.fixture(scope="module")
def fleet(devices, out) -> lb.FleetResult:
    return lb.fleet(devices, jobs=2, folder=out)


def test_a_fleet_is_one_table_and_its_population(fleet, out):
    table = fleet.summary().set_index("device")
    assert table.index[0] == "broken"  # the worst first
    assert table.loc["broken", "grade"] == "failed"
    assert "`terms` must be" in table.loc["broken", "reason"]
    for name, gain in GAINS.items():
        assert table.loc[name, "grade"] in ("reliable", "tentative")
        assert table.loc[name, "gain_lower"] - 0.05 < gain < table.loc[name, "gain_upper"] + 0.05
    rows = fleet.population().set_index("parameter")
    assert set(rows.index) == {"gain", "time_1"}
    assert (rows["grade"] == "tentative").all()  # of three devices
    assert 1.8 < rows.loc["gain", "mean"] < 2.2
    assert rows.loc["time_1", "mean"] == pytest.approx(1.5, rel=0.1)
    assert rows.loc["time_1", "unit"] == "ms"
    assert "Failed: broken; broken: " in fleet.verdict
    assert "`terms` must be" in fleet.verdict
    read = pd.read_parquet(out / "tables" / "fleet.parquet")
    pd.testing.assert_frame_equal(read, fleet.summary(), check_dtype=False)
    kept = lb.load_result(out / "devices" / "a")
    assert kept.verb == "fit"
    tree = kept.to_datatree()  # of all draws, but few of what has a number for each sample
    assert tree["posterior_predictive"].sizes["draw"] * 4 <= 400 < kept.draws.log_density.size
    assert tree["posterior"].sizes["draw"] == kept.draws.log_density.shape[1]


def test_the_page_of_a_fleet_stands_alone(fleet, out):
    page = check_page(fleet.report(out))
    assert page.index(">broken<") < page.index(">a<")
    for word in ("Devices", "Population", "Devices that differ", "Worst devices"):
        assert f"<h2>{word}</h2>" in page
    figure = lb.plot.fleet(fleet, ["gain"])
    assert len(figure.axes) == 1
    with pytest.raises(lb.InputError, match="no group 2"):
        lb.plot.fleet(fleet, group=2)


def test_finished_devices_are_kept_until_their_study_changes(devices, out, fleet, tmp_path):
    stamps = {name: (out / "devices" / name / "posterior.nc").stat().st_mtime_ns for name in GAINS}
    studies = [lb.load_study(devices / name) for name in GAINS]
    origin = out.parent / "again"
    again = lb.fleet(devices, folder=out)
    assert again.to_json() == fleet.to_json()
    changed = devices / "b" / "study.toml"
    text = changed.read_text()
    try:
        changed.write_text(text.replace("order_1 = 0.8", "order_1 = 0.79"))
        after = lb.fleet(devices, folder=out)
    finally:
        changed.write_text(text)
    kept = {name: (out / "devices" / name / "posterior.nc").stat().st_mtime_ns for name in GAINS}
    assert {name for name in GAINS if kept[name] != stamps[name]} == {"b"}
    assert after.to_json() != fleet.to_json()
    assert not origin.exists()
    assert [one.name for one in studies] == list(GAINS)


@pytest.fixture(scope="module")
def alone(devices, tmp_path_factory) -> tuple[lb.FleetResult, list[str], Path]:
    """The fleet by one process, the devices whose numbers were computed, and the run folder."""
    counts, compute, folder = [], fits.results, tmp_path_factory.mktemp("alone")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fits, "results", lambda fit: counts.append(fit.study.name) or compute(fit))
        return lb.fleet(devices, folder=folder), counts, folder


def test_the_numbers_of_a_device_are_computed_once(alone):
    found, counts, folder = alone
    assert counts == list(GAINS)
    row = found.summary().set_index("device").loc["a"]
    assert row["gain"] == lb.load_result(folder / "devices" / "a").to_json()["parameters"][0]["value"]


def test_a_folder_that_takes_no_devices_is_refused_once(devices, tmp_path):
    (tmp_path / "devices").write_text("")
    with pytest.raises(lb.InputError, match="devices: the output folder cannot be written to") as caught:
        lb.fleet(devices, folder=tmp_path)
    assert len(caught.value.problems) == 1


def without_times(fleet: lb.FleetResult) -> dict:
    return {key: value for key, value in fleet.to_json().items() if key != "seconds"}


def test_a_lost_worker_is_said_in_words(tmp_path):
    killed = RuntimeError("Attempted to run task 'a' on 4 different workers, but all died. Inspect the logs.")
    work = verb._Work("fit", tmp_path, quick=True, resume=False)
    row = work.lost(("devices/a", lb.Study("a", fit=[record()])), killed)["row"]
    assert row["grade"] == "failed"
    assert row["reason"].startswith("its worker was lost, perhaps for want of memory (Attempted")
    assert "Inspect" not in row["reason"]


def test_what_is_compared_is_part_of_what_a_device_rests_on():
    """So that a resumed fleet compares again where other candidates are asked for."""
    one = lb.Study("a", fit=[record(camera=0.5)])
    bases = {
        basis(each, "compare", quick=True)
        for each in (
            one,
            replace(one, compare=replace(one.compare, pick=("fractional-1", "first-order"))),
            replace(one, candidates=(CandidateSettings("own", terms=2),)),
        )
    }
    assert len(bases) == 3
    assert basis(one, "compare", quick=True) in bases


@pytest.mark.slow
def test_a_dask_cluster_that_loses_a_worker_gives_the_same_table(fleet, devices, tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=":0", memory_limit=0
    ) as cluster:
        pid = next(iter(cluster.workers.values())).pid
        Timer(2.0, os.kill, (pid, signal.SIGKILL)).start()
        lost = lb.fleet(devices, dask=cluster.scheduler_address, folder=tmp_path)
    assert without_times(lost) == without_times(fleet)


def test_processes_change_no_number(fleet, alone):
    assert without_times(alone[0]) == without_times(fleet)


def test_a_population_is_the_prior_of_the_next_study(fleet, out, devices, tmp_path):
    priors = fleet.priors()
    assert priors["gain"]["dist"] == "norm"
    assert priors["time_1"]["dist"] == "lognorm"
    low, high = (
        fleet.population().set_index("parameter").loc["time_1", ["next_device_lower", "next_device_upper"]]
    )
    for quantile, end in ((-1.6448536269514722, low), (1.6448536269514722, high)):
        own = priors["time_1"]["scale"] * math.exp(quantile * priors["time_1"]["s"])
        assert own == pytest.approx(end, rel=0.15)  # of the interval's width, which is not symmetric
    fleet.save(tmp_path / "next")
    device("next", 2.0, tmp_path)
    study = tmp_path / "next" / "study.toml"
    stated = study.read_text().replace("[priors]\n", '[priors]\nfrom = "fleet.json"\ngain = 2.0\n')
    study.write_text(stated)
    read = lb.load_study(tmp_path / "next")
    assert read.priors["gain"].fixed == 2.0  # what is stated stands
    assert read.priors["time_1"].parameters == {k: v for k, v in priors["time_1"].items() if k != "dist"}
    assert "fleet.json" in read.inputs
    rows = {row.name: row for row in problem_of(read).posterior.table.rows}
    assert rows["time_1"].prior.frozen.median() == pytest.approx(priors["time_1"]["scale"])
    study.write_text(stated.replace("fleet.json", "nothing.json").replace("terms = 1", "terms = 77"))
    with pytest.raises(lb.InputError) as refused:
        lb.load_study(tmp_path / "next")
    assert len(refused.value.problems) == 2
    assert "nothing.json" in str(refused.value)
    values = json.loads((tmp_path / "next" / "fleet.json").read_text())
    for change, words in (
        ({"groups": "none"}, "holds no fleet"),
        ({"groups": values["groups"] * 2}, "holds several groups of devices; name one"),
        ({"groups": [values["groups"][0] | {"time_unit": "s"}]}, "is in s, this study is in ms"),
        ({"groups": [values["groups"][0] | {"parameters": [], "sentence": ""}]}, "has no population"),
    ):
        (tmp_path / "next" / "fleet.json").write_text(json.dumps(values | change))
        study.write_text(stated)
        with pytest.raises(lb.InputError, match=words):
            lb.load_study(tmp_path / "next")


def broken_row(*args: object) -> None:
    raise ZeroDivisionError("nothing to divide by")


def test_an_unforeseen_error_is_listed_with_its_details(devices, out, fleet, tmp_path, monkeypatch):
    """It ends the device, not the fleet; where no device is left it is said."""
    study, fitted = lb.load_study(devices / "a"), lb.load_result(out / "devices" / "a")
    monkeypatch.setitem(verb._VERBS, "fit", lambda *_, **__: fitted)
    monkeypatch.setattr(verb, "row_of", broken_row)
    with pytest.raises(
        lb.InputError, match=r"not one of 1 devices could be done; the first, a: unforeseen Zero"
    ):
        lb.fleet([study], folder=tmp_path / "run", quick=True)
    details = tmp_path / "run" / "devices" / "a" / "error.txt"
    assert "broken_row" in details.read_text()


def test_what_is_no_fleet_is_refused_with_one_message(devices, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    (tmp_path / "none").mkdir()
    (tmp_path / "none" / "notes.txt").write_text("nothing")
    for folder, words in (
        (tmp_path / "nowhere", "there is no such folder"),
        (tmp_path / "empty", "is empty"),
        (tmp_path / "none", "holds no study"),
        (devices / "a", "is one study, not a fleet"),
    ):
        assert main(["fleet", str(folder), "--out", str(tmp_path / "out")]) == 2
        (line,) = capsys.readouterr().err.removeprefix("fleet: loading\n").splitlines()
        assert words in line
        assert not (tmp_path / "out").exists()
    one = lb.load_study(devices / "a")
    with pytest.raises(lb.InputError, match="2 devices are named 'a'"):
        lb.fleet([one, one.with_seed(4)])
    with pytest.raises(lb.InputError, match="one study or more"):
        lb.fleet([])
    with pytest.raises(lb.InputError, match="`verb` must be one of"):
        lb.fleet([one], "calibrate")  # type: ignore[arg-type]


# ---- fleets of draws alone


def outcome(name: str, grade: str = "reliable", *, drives: str = "u [V]", **more: object) -> dict:
    plant = {
        "drives": [drives],
        "responses": ["y [rad]"],
        "time_unit": "ms",
        "parameters": [{"name": "time_1", "unit": "ms", "log": True}],
    }
    row = {"device": name, "source": name, "grade": grade, "reason": "", **more}
    return {"row": row, "plant": plant, "curve": None, "seconds": 1.0}


def draws(names, rng, *, shift=0.0):
    return {
        name: np.stack([rng.normal(rng.normal(shift, 0.1), 0.05, 400), np.zeros(400)], axis=1)
        for name in names
    }


def test_two_devices_have_no_spread():
    made = draws("ab", np.random.default_rng(1))
    values = results("two", "fit", [outcome("a"), outcome("b")], made)
    assert values["grade"] == "unusable"
    assert "A spread cannot be estimated from two devices." in values["verdict"]
    with pytest.raises(lb.InputError, match="no population to take priors from: a spread cannot"):
        lb.FleetResult(values, {}).priors()


def test_devices_of_other_axes_are_groups_and_unusable_draws_are_left_out():
    names = [f"d{k}" for k in range(12)]
    made = draws([*names, "other", "poor"], np.random.default_rng(2))
    members = [
        *(outcome(name) for name in names),
        outcome("other", drives="v [A]"),
        outcome("poor", "unusable"),
    ]
    values = results("many", "fit", members, made)
    assert [len(one["devices"]) for one in values["groups"]] == [12, 1]
    assert values["groups"][0]["left_out"] == ["poor"]
    assert values["groups"][1]["parameters"] == []
    assert "Devices of other axes or structures are 2 groups, of 12 and 1." in values["verdict"]
    assert "other stands alone" in values["verdict"]
    (row,) = values["groups"][0]["parameters"]
    assert row["grade"] == "reliable"
    assert row["mean"]["value"] == pytest.approx(1.0, abs=0.15)
    # half the range of 68 % of the devices, of a spread of 0.1 in the logarithm
    assert row["spread"]["value"] == pytest.approx(
        row["mean"]["value"] * np.sinh(row["log_spread"]["value"]), rel=0.05
    )
    assert values["devices"][0]["device"] == "poor"
    three = results("three", "fit", members[:3], made)
    assert three["grade"] == "tentative"
    assert "3 devices leave the spread uncertain" in three["grade_reason"]


def test_curves_of_the_worst_devices_have_the_units_of_each(tmp_path):
    """The worst are those that no population takes up, or of another plant."""
    time = list(map(float, range(4)))
    curve = dict.fromkeys(("time", "observed", "residual", "lower", "median", "upper"), time)
    members = [outcome("a"), outcome("b"), outcome("poor", "unusable"), outcome("other", "tentative")]
    for one in members:
        one["curve"] = curve | {"axis": "y", "unit": "rad"}
    members[3]["plant"] |= {"time_unit": "h"}
    values = results("many", "fit", members, draws(["a", "b", "poor", "other"], np.random.default_rng(2)))
    assert values["curves"][0]["device"] == "poor"
    with look():
        (figure,) = page_of_fleet.drawn(tmp_path, values)["curves"]
    assert figure.svg.count("time [ms]") == 3
    assert figure.svg.count("time [h]") == 1
    assert figure.svg.count("y [rad]") == 4


def test_an_odd_device_is_named_with_what_it_differs_in():
    rng = np.random.default_rng(3)
    names = [f"d{k}" for k in range(12)]
    made = draws(names, rng) | draws(["odd"], rng, shift=1.5)
    values = results("many", "fit", [outcome(name) for name in (*names, "odd")], made)
    assert "1 does not belong to the population: odd (time_1)." in values["verdict"]
    assert values["devices"][0]["differs_in"] == "time_1"


def test_shares_of_effects_have_binomial_intervals():
    rows = [{"grade": "reliable", "effects": "overdrive_pulse; hysteresis"}] * 3
    rows += [{"grade": "reliable", "effects": ""}] * 7 + [{"grade": "failed"}]
    shares = {one["name"]: one for one in _shares("loop", rows)}
    assert {name: one["devices"] for name, one in shares.items()} == {
        "none": 7,
        "overdrive_pulse": 3,
        "hysteresis": 3,
    }
    assert shares["hysteresis"]["share"] == 0.3
    x = np.linspace(0, 1, 100_001)
    below = np.cumsum(x**2.5 * (1 - x) ** 6.5)  # Brown, Cai and DasGupta 2001: beta(3.5, 7.5)
    for end, mass in (("lower", 0.05), ("upper", 0.95)):
        assert np.interp(shares["hysteresis"][end], x, below / below[-1]) == pytest.approx(mass, abs=1e-3)
    (every,) = _shares("compare", [{"grade": "reliable", "preferred": "study"}] * 5)
    assert every["upper"] == 1.0


def test_the_bench_makes_a_fleet_of_a_known_population_with_odd_devices(tmp_path):
    truth = make.make(tmp_path, 40, 1)
    assert list(truth["odd"]).count(True) == len(make.ODD) == 3
    usual = truth[~truth["odd"]]
    for name, mean in make.MEAN.items():
        values = np.log(usual[name]) if name == "time_1" else usual[name]
        assert abs(values.mean() - mean) < 4 * make.SPREAD[name] / np.sqrt(len(usual))
    study = lb.load_study(tmp_path / "device-001")
    assert study.fit[0].time.size == 250
    assert tomllib.loads((tmp_path / "device-001" / "study.toml").read_text())["model"] == {"terms": 1}


@pytest.mark.usefixtures("undrawn")
def test_a_fleet_by_loop_tells_its_effects(devices, tmp_path, monkeypatch):
    few = [catalogue()[name] for name in ("odd_curvature", "gain_drift", "unmodelled_smooth")]
    monkeypatch.setattr("lcopa_bayes.effectsearch.loop.offered", lambda study: few)
    monkeypatch.setitem(verb._VERBS, "loop", partial(lb.loop, as_stated=True))
    found = lb.fleet([lb.load_study(devices / "a")], "loop", quick=True, folder=tmp_path)
    (row,) = found.summary().to_dict("records")
    own = lb.load_result(tmp_path / "devices" / "a", "loop")
    assert (row["verdict"], row["confidence"]) == (own.values["verdict"], own.values["confidence"])
    assert row["effects"] == "; ".join(own.study.effects.use)
    assert [one["name"] for one in found.to_json()["shares"]] == (row["effects"] or "none").split("; ")
    assert found.to_json()["groups"] == []
    check_page(found.report(tmp_path))


def test_a_device_of_a_comparison_tells_what_it_prefers():
    values = lb.load_result(Path(__file__).parents[2] / "reports" / "paper-step", "compare").to_json()
    row = row_of("compare", values, None)
    (preferred,) = (one for one in values["models"] if one["name"] == values["preferred"])
    assert (row["preferred"], row["grade"]) == (values["preferred"], preferred["grade"])
    assert row["probability"] == preferred["probability"]
    assert row_of("compare", values | {"preferred": None}, None)["grade"] == "unusable"
