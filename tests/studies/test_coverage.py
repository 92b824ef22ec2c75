"""The study of coverage: its plants have the figures they are said to have, and it counts what holds."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

FOLDERS = [Path(__file__).parents[2] / "studies" / name for name in ("coverage", "measured")]
sys.path[:0] = map(str, FOLDERS)

import intervals  # noqa: E402
import records  # noqa: E402
import truths  # noqa: E402


@pytest.mark.parametrize("kind", truths.KINDS)
def test_a_plant_starts_at_its_delay_and_settles_at_its_gain(kind: str) -> None:
    path = truths.drawn(kind, np.random.default_rng(3))
    times = np.array([0.5 * path.delay, path.delay, 1e4, 1e5])
    read = path.step(times)
    assert read[:2] == pytest.approx(0.0, abs=1e-9)
    slow = 0.05 if kind in ("one term", "two terms") else 1e-3  # algebraic tails
    assert read[2:] == pytest.approx(path.gain, rel=slow)
    assert path.figures["steady_state"] == path.gain
    assert path.figures["value_at_end"] == pytest.approx(float(path.step(np.array([truths.SPAN]))[0]))


def test_the_rise_of_a_lag_is_that_of_the_closed_form() -> None:
    path = truths.drawn("lag", np.random.default_rng(1))
    time = -1.0 / np.log1p(-float(path.step(np.array([path.delay + 1.0]))[0]) / path.gain)
    assert path.figures["rise_10_90"] == pytest.approx(time * np.log(9), rel=1e-3)


def test_a_wall_is_the_sum_of_its_series_and_slower_than_it_begins() -> None:
    rises = truths.drawn("wall", np.random.default_rng(0)).rises
    early, late = rises(np.array([1e-3, 1e3]))
    assert early == pytest.approx(0.0, abs=1e-6)
    assert late == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_a_campaign_is_made_of_its_plants(seed: int) -> None:
    made, again = truths.campaign("chain", seed), truths.campaign("chain", seed)
    drives, responses = truths.SHAPES[seed]
    assert len(made.paths) == drives * responses
    assert len(made.study.fit) == 2 * drives + 1
    assert (made.study.fit[-1].drive == 0).all()
    for one, other in zip(made.study.fit, again.study.fit, strict=True):
        assert (one.response == other.response).all()
    first = made.study.fit[0]
    path = made.paths["y0" if drives == responses == 1 else "y0_u0"]
    left = first.response[:, 0] - 10.0 * path.step(first.time)
    assert np.std(left) < 0.05 * 10 * max(abs(one.gain) for one in made.paths.values())


def row(holds: bool, width: float, grade: str = "reliable") -> dict:
    side = {"lower": 0.0, "upper": width, "holds": holds, "grade": grade}
    alone = side | {"upper": 1.0, "holds": False}
    return {"path": "y", "kind": "lag", "figure": "delay", "truth": 0.5, "alone": alone, "reported": side}


def test_the_summary_counts_what_holds() -> None:
    rows = [row(True, 2.0), row(True, 4.0), row(False, 3.0, "tentative")]
    found = [{"number": 0, "figures": rows, "cpu_seconds": 1.0, "support": ["both"], "grade": "reliable"}]
    delay = next(line for line in intervals.summary(found)["by_figure"] if line["name"] == "delay")
    assert (delay["alone"]["count"], delay["reported"]["count"], delay["reported"]["of"]) == (0, 2, 3)
    assert delay["reported_reliable"]["share"] == 1.0
    assert delay["median_width_ratio"] == 3.0
    assert delay["reported"]["lower"] < 2 / 3 < delay["reported"]["upper"]


def test_a_record_without_a_row_or_refused_says_so() -> None:
    fitted = {
        "record": "a", "verb": "fit", "structure": "1 term", "grade": "reliable", "sums_of_lags": ["both"],
        "cpu_seconds": 3.2, "held_out": [{"axis": "t", "rmse": 0.0512, "unit": "K"}],
    }  # fmt: skip
    orders = {"verdict": "warranted", "log_bayes_factor": 22.04, "integer": "second-order"}
    weighed = {"record": "a", "verb": "compare", "preferred": None, "fractional": orders, "cpu_seconds": 9.0}
    refused = {"record": "b", "verb": "fit", "refused": "no drive", "cpu_seconds": 0.1}
    text = records.page([fitted, weighed, refused], records.VERBS)
    assert "| a | 1 term | reliable | both | t 0.0512 K | 3 | not run |" in text
    assert "| none | warranted, +22.0 nat against second-order | 9 |" in text
    assert "| b | no drive |" in text
    lengths = {line.count("|") for line in text.splitlines() if line.startswith("| ")}
    assert lengths == {2 + sum(map(len, records.HEADS.values()))}
    alone = records.page([weighed], ["compare"])
    assert "| a | none | warranted, +22.0 nat against second-order | 9 |" in alone
    assert "root mean squares" not in alone


def test_a_row_that_does_not_end_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def endless(_: Path) -> dict[str, object]:
        while True:
            pass

    monkeypatch.setitem(records.ACTIONS, "loop", endless)
    row = records.perform(str(tmp_path / "tank"), "loop", 1)
    assert row["refused"] == "did not end in 1 s"
    assert row["seconds"] < 10.0
    assert "| did not end in 1 s |" in records.page([row], ["loop"])
    monkeypatch.setitem(records.ACTIONS, "loop", lambda _: {"verdict": "clean"})
    assert records.perform(str(tmp_path / "tank"), "loop", 1)["verdict"] == "clean"
