"""The verb `audit` from records to its page, and the claims it decides."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from small import TWO, check_page, problem, record

from lcopa_bayes.bench.command import on_off, step
from lcopa_bayes.cli import main
from lcopa_bayes.data.record import save_record
from lcopa_bayes.identifiability.curvature import delays
from lcopa_bayes.paper.claims import judge
from lcopa_bayes.paper.verdict import Evidence
from lcopa_bayes.report.page import write_page
from lcopa_bayes.sampling.convergence import Limitation

STUDY = """[records]
fit = ["one.csv"]
[model]
terms = 2
orders = [0.8, 0.8]
[priors]
gain = { dist = "uniform", loc = 0, scale = 10 }
time_1 = { dist = "loguniform", a = 0.2, b = 5.0 }
time_2 = { dist = "loguniform", a = 0.2, b = 5.0 }
offset = 0.3
[noise]
kind = "white"
[sampler]
target_ess = 100
"""
VERDICTS = {
    *("identified", "one-sided", "practically unidentifiable", "structurally unidentifiable"),
    *("prior-dominated", "weakly identified", "unresolved"),
}


@pytest.fixture(scope="module")
def study(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("study")
    save_record(record(camera=0.6), folder / "one.csv")
    (folder / "study.toml").write_text(STUDY)
    return folder


@pytest.fixture(scope="module")
def run(study) -> Path:
    """With empty figures."""
    folder, empty = study / "run", '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1 1"></svg>'
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lcopa_bayes.report.svg.svg_of", lambda figure: empty)
        assert main(["audit", str(study), "--quick", "--jobs", "1", "--quiet", "--out", str(folder)]) == 0
    return folder


def test_audit_tells_what_other_tools_rely_on(run):
    reported = json.loads((run / "audit.json").read_text())
    rows = {row["name"]: row for row in reported["parameters"]}
    assert set(rows) == {"gain", "time_1", "time_2", "delay", "sigma"}
    for row in rows.values():
        assert row["verdict"] in VERDICTS
        assert row["reason"]
        assert {"unit", "partners", "profile", "contraction"} <= set(row)
        assert {"lower", "upper", "level", "interval"} <= set(row["profile"])
    merged = [rows[name]["verdict"] for name in ("time_1", "time_2")]
    assert merged == ["structurally unidentifiable"] * 2  # the search sees that only T1^0.8 + T2^0.8 acts
    assert rows["time_1"]["partners"][0] == "time_2"
    assert [rows[name]["verdict"] for name in ("gain", "delay", "sigma")] == ["identified"] * 3
    assert reported["verdict"].startswith("Given this model, ")
    assert reported["limitations"] == json.loads((run / "results.json").read_text())["limitations"]
    assert reported["spectrum"][-1]["prior_knows_more"]
    advised = {row["name"]: row for row in reported["next_measurement"]["parameters"]}
    assert set(advised) == {name for name, row in rows.items() if row["verdict"] != "identified"}
    assert advised["time_1"]["drive"] is None  # no drive separates what only acts as a sum
    assert "structurally unidentifiable" in advised["time_1"]["reason"]
    assert {row["name"] for row in reported["functions"]} >= {"steady_state[y]", "rise_10_90[y]"}


def test_the_page_stands_alone_and_shows_every_verdict(run):
    page = check_page(run / "audit.html")
    assert page.count("structurally unidentifiable") >= 2
    assert {"profiles_01.svg", "sloppy_spectrum.svg", "degenerate_pairs.svg"} <= {
        path.name for path in (run / "figures").iterdir()
    }


@pytest.mark.slow
def test_resumed_and_in_two_processes_it_says_the_same(study, run, capsys):
    before = (run / "audit.json").read_bytes()
    words = ["audit", study, "--quick", "--resume", "--jobs", 2, "--out", run, "--json"]
    assert main([str(word) for word in words]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert (run / "audit.json").read_bytes() == before
    assert printed.pop("report") == str(run / "audit.html")
    assert printed == json.loads(before)


@pytest.mark.usefixtures("undrawn")
def test_claims_read_an_audit(run, tmp_path, capsys):
    assert main(["claims", "--audit", str(run), "--out", str(tmp_path), "--json"]) == 0
    rows = {row["id"]: row for row in json.loads(capsys.readouterr().out)["claims"]}
    assert rows["I1"]["verdict"] == "undecided"  # orders are fixed: there is no printed form to look at
    assert [rows[claim]["verdict"] for claim in ("I2", "I3", "I4")] == ["contradicted"] * 3
    assert rows["I4"]["number"] == pytest.approx(2 / 4)
    assert rows["I6"]["verdict"] == "undecided"
    assert "one path" in rows["I6"]["how"]


def test_claims_refuse_a_folder_without_an_audit(tmp_path, capsys):
    assert main(["claims", "--audit", str(tmp_path), "--out", str(tmp_path)]) == 2
    assert "audit.json" in capsys.readouterr().err


def reported(**changes: object) -> dict:
    """An audit in which every claim holds."""
    row = {
        "name": "order_1",
        "verdict": "identified",
        "profile": {"lower": 1.75, "upper": 1.85, "level": 0.9, "searched": [0.0, 2.0]},
    }
    form = {"parameters": 8, "rank": 8, "certain": True, "symmetries": []}
    pair = {"pair": ["x_x", "x_y"], "smallest_difference": 5e-4}
    delay = {
        "paths": [{"unit": "ms"}],
        "separations": [pair],
        "sentence": "all path delays can be distinguished",
    }
    whole = {
        "study": "s",
        "grade": "reliable",
        "parameters": [row],
        "printed_form": form,
        "spectrum": [{"prior_knows_more": False, "direction": {"gain": 1.0}}],
        "local": {"collinearity": 3.0, "most_alike": []},
        "delays": delay,
    }
    return whole | changes


ROW = reported()["parameters"][0]
OTHERWISE = {
    "I1": {"printed_form": reported()["printed_form"] | {"rank": 7}},
    "I2": {"spectrum": [{"prior_knows_more": True, "direction": {"gain": 1.0}}]},
    "I3": {"local": {"collinearity": None, "most_alike": []}},
    "I4": {"parameters": [ROW, ROW | {"verdict": "one-sided"}]},
    "I5": {"parameters": [ROW | {"profile": ROW["profile"] | {"upper": None}}]},
    "I6": {
        "delays": reported()["delays"] | {"separations": [{"pair": ["a", "b"], "smallest_difference": 0.2}]}
    },
}


@pytest.mark.parametrize("claim", OTHERWISE)
def test_another_audit_gives_another_verdict(claim):
    def verdict(audit: dict) -> str:
        judged = judge(Evidence((audit,)))
        return judged[claim].kind.value

    assert verdict(reported()) == "supported"
    assert verdict(reported(**OTHERWISE[claim])) == "contradicted"


def test_the_first_audit_that_can_answer_decides():
    silent = reported(delays={"paths": [], "separations": [], "sentence": "one path"}, study="one path")
    judged = judge(Evidence((silent, reported())))
    assert judged["I6"].kind.value == "supported"
    assert judged["I1"].how.startswith("Audit of the study one path")


@pytest.mark.usefixtures("undrawn")
def test_audits_of_bundled_studies_are_read_where_they_are(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "reports" / "paper-step"
    folder.mkdir(parents=True)
    (folder / "audit.json").write_text(json.dumps(reported(study="found")))
    assert main(["claims", "--out", str(tmp_path / "page"), "--json"]) == 0
    rows = {row["id"]: row for row in json.loads(capsys.readouterr().out)["claims"]}
    assert rows["I6"]["verdict"] == "supported"
    assert "found" in rows["I6"]["how"]


# -- delays ----------------------------------------------------------------------------------------


def separated(command, **model: object):
    fitted = problem(record(device=TWO, command=command, camera=0.5), **model)
    table = fitted.posterior.table
    known = {"delay": 0.4, "offset_x": 0.1, "offset_y": -0.2, "sigma_x": 0.02, "sigma_y": 0.02}
    known |= {"gain_x_x": 1.0, "gain_x_y": 0.2, "gain_y_x": 0.3, "gain_y_y": 1.5}
    known |= {"time_1_direct": 1.2, "order_1_direct": 1.6, "time_2_direct": 2.5, "order_2_direct": 0.7}
    known |= {"time_1_cross": 2.0, "order_1_cross": 0.9}
    return delays(fitted.study, table, np.array([known[name] for name in table.names]))


TERMS = {"terms": {"direct": 2, "cross": 1}}


def test_delays_of_one_path_are_not_in_question():
    only = problem(record(camera=0.6))
    values = only.posterior.table.draw(1, np.random.default_rng(1))[0]
    assert delays(only.study, only.posterior.table, values)["separations"] == ()


def test_paths_driven_one_after_the_other_are_told_apart_and_an_idle_drive_is_not():
    apart = separated(on_off((1.0, 0.6), hold=5.0, at=0.35), **TERMS)
    single = separated(step((1.0, 0.0), at=0.35), **TERMS)
    assert len(apart["separations"]) == len(single["separations"]) == 6
    finite = {one["pair"] for one in single["separations"] if one["smallest_difference"] < float("inf")}
    assert finite == {("x_x", "y_x")}
    assert single["paths"][1]["sd"] == float("inf")
    assert "cannot be distinguished" in single["sentence"]


# -- what is said when every parameter is identified ----------------------------------------------


def advice(run: Path, tmp_path: Path, limitations: list[dict]) -> str:
    values = json.loads((run / "audit.json").read_text())
    values |= {"next_measurement": None, "limitations": limitations}
    drawn = {"profiles": (), "spectrum": (), "pairs": ()}
    page = write_page(tmp_path, "audit.html", "audit", values, drawn).read_text(encoding="utf-8")
    section = page[page.index('<section id="what-to-measure-next">') :]
    return " ".join(re.findall(r"<p>(.*?)</p>", section[: section.index("</section>")]))


def test_a_model_that_passes_its_checks_needs_no_further_record(run, tmp_path):
    assert advice(run, tmp_path, []).startswith("Given this model every parameter is identified")


def test_a_model_that_fails_its_checks_is_corrected_first(run, tmp_path):
    limit = Limitation("tentative", "intervals hold only if A", "add terms").as_json()
    said = advice(run, tmp_path, [limit])
    assert "nothing more" not in said
    assert "checks of the model fail" in said
    assert "Intervals hold only if A. Remedy: add terms." in said
