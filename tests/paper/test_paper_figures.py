"""Figures 13 to 17 and Table 1: which record is which figure, and metrics against closed forms."""

from __future__ import annotations

import json
from dataclasses import replace
from math import exp, inf, log, pi, sqrt

import numpy as np
import pytest

from lcopa_bayes.bench.command import on_off, step
from lcopa_bayes.bench.device import PAPER_DEVICE, Bench, simulate
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.model.literature import PAPER
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.paper.identify import identify
from lcopa_bayes.paper.intervals import Interval, Scan
from lcopa_bayes.paper.steptable import (
    KINDS,
    METRICS,
    load_posterior,
    panels,
    paper_figure,
    step_of,
    step_table,
)

NOISE = 1e-4
FEW = Scan(
    orders=(Interval(1.7, 1.9), Interval(0.8, 1.0)),
    delay=Interval(2.8, 3.3),
    stiffness=(1.0,),
    rounds=1,
)


def measured(name: str, level: tuple[float, float], rest: tuple[float, float] = (0.0, 0.0)):
    rng = np.random.default_rng([4, len(name)])
    drive = step(level, rest=rest)
    bench = Bench(camera=0.4, noise_sd=NOISE)
    return simulate(PAPER_DEVICE, bench, drive, duration=25.0, name=name, rng=rng)


ON = measured("on", (pi / 2, 0.0))
OFF = measured("off!", (0.0, 0.0), (pi / 2, 0.0))
QUARTER = measured("quart", (pi / 4, 0.0))
Y = measured("y only", (0.0, pi / 4))
BOTH = measured("both!!!", (pi / 3, pi / 5))


def test_records_know_their_figure():
    found = [paper_figure(each) for each in (ON, OFF, QUARTER, Y, BOTH)]
    assert found == ["Fig. 13", "Fig. 14", "Fig. 16", "", "Fig. 17"]


def test_a_record_is_a_figure_by_the_stated_drive():
    other = replace(PAPER, records=replace(PAPER.records, step_drive=1.0))
    assert paper_figure(ON, other) == ""
    assert paper_figure(measured("one", (1.0, 0.0)), other) == "Fig. 13"


def test_a_pulse_is_no_step():
    pulse = simulate(
        PAPER_DEVICE,
        Bench(camera=0.5),
        on_off([pi / 2, 0.0], hold=5.0),
        duration=25.0,
        name="pulse",
        rng=np.random.default_rng(0),
    )
    assert paper_figure(pulse) == ""


# -- metrics ---------------------------------------------------------------------------------------


def model(orders=(1.0,), etas=(2.0,), gain=0.3, delay=1.5) -> TransferPath:
    return TransferPath(gain, delay, etas, orders, 1.0)


def test_first_order_metrics():
    found = step_of(model(), 2.0, 40.0)
    assert found["rise"] == pytest.approx(2.0 * log(9), rel=1e-3)
    assert found["settling 2 %"] == pytest.approx(1.5 + 2.0 * log(50), rel=1e-3)
    assert found["settling 5 %"] == pytest.approx(1.5 + 2.0 * log(20), rel=1e-3)
    assert found["steady"] == pytest.approx(0.6)
    assert found["at end"] == found["peak"] == pytest.approx(0.6 * (1 - exp(-38.5 / 2)), rel=1e-6)
    assert found["overshoot"] == 0.0


def test_second_order_overshoots():
    damping = 0.3
    found = step_of(model((2.0, 1.0), (1.0, 2 * damping)), -1.0, 60.0)
    assert found["overshoot"] == pytest.approx(exp(-pi * damping / sqrt(1 - damping**2)), rel=2e-3)
    assert found["peak"] == pytest.approx(-0.3 * (1 + found["overshoot"]))
    assert found["steady"] == -0.3


def test_what_is_not_reached_is_open():
    found = step_of(model(), 1.0, 3.0)
    assert found["rise"] == found["settling 2 %"] == found["settling 5 %"] == inf
    assert found["at end"] == pytest.approx(0.3 * (1 - exp(-0.75)), rel=1e-4)


# -- a study ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def identified():
    study = Study(
        "small",
        None,
        "ms",
        1,
        (ON, Y),
        held_out=(BOTH,),
        model=ModelSettings(terms=2),
    )
    return study, identify(study, plan=FEW)


def test_panels_hold_every_record_and_axis(identified):
    made = panels(*identified)
    assert [(p["record"], p["axis"], p["held_out"]) for p, _ in made] == [
        *(("on", "x", False), ("on", "y", False), ("y only", "x", False), ("y only", "y", False)),
        *(("both!!!", "x", True), ("both!!!", "y", True)),
    ]
    for values, samples in made:
        assert tuple(curve["model"] for curve in values["curves"]) == KINDS
        for curve in values["curves"]:
            rmse = np.sqrt(np.mean((samples["observed"] - samples[curve["model"]]) ** 2))
            assert curve["rmse"] == pytest.approx(rmse)
        json.dumps(values, allow_nan=False)


def test_models_add_up_on_a_record_of_both_drives(identified):
    """Identified from single drives, compared with what the bench does with both."""
    made = panels(*identified)[-2:]
    clean = PAPER_DEVICE.response(step([pi / 3, pi / 5]), made[0][1]["time"])
    for axis, (values, samples) in enumerate(made):
        kind = "fractional, output error"
        assert np.sqrt(np.mean((samples[kind] - clean[:, axis]) ** 2)) < 1.5 * NOISE
        rmse = {curve["model"]: curve["rmse"] for curve in values["curves"]}[kind]
        assert 0.7 * NOISE < rmse < 1.8 * NOISE


def test_printed_numbers_stand_beside_their_figures_only(identified):
    made = {(p["record"], p["axis"]): p for p, _ in panels(*identified)}
    assert made["on", "x"]["printed_level"] == PAPER.records.measured.steady
    assert made["both!!!", "y"]["printed_level"] == PAPER.records.two_axis_steady[1]
    assert made["y only", "y"]["printed_level"] is None
    said = [curve["printed_rmse"] for curve in made["both!!!", "x"]["curves"]]
    assert said == ["0.0002", "> 0.0011", "", ""]
    assert not any(curve["printed_rmse"] for curve in made["y only", "y"]["curves"])


def test_table_1(identified):
    study, found = identified
    rows = {(row["path"], row["metric"]): row for row in step_table(study, found)}
    assert set(rows) == {(p, m) for p in ("x_x", "x_y", "y_x", "y_y") for m in METRICS}
    settling = rows["x_x", "settling 5 %"]
    assert settling["step"] == pytest.approx(pi / 2)
    assert settling["printed"] == {"measured": 10.0, "fractional": 10.0, "integer": 12.0}
    assert rows["y_y", "settling 5 %"]["printed"] == {}
    assert rows["y_y", "steady"]["step"] == pytest.approx(pi / 4)
    assert rows["x_x", "at end"]["values"]["fractional, output error"] == pytest.approx(0.02732, rel=5e-3)
    assert rows["x_x", "RMSE"]["values"]["fractional"] == found[0].scan.output_rmse
    json.dumps(list(rows.values()), allow_nan=False)


def test_posterior_intervals_stand_beside(identified, tmp_path):
    study, found = identified
    reported = {"name": "steady_state[x_x]", "value": 0.018, "lower": 0.017, "upper": None, "level": 0.9}
    saved = {"study": "small", "step_metrics": [reported | {"grade": "tentative"}]}
    (tmp_path / "results.json").write_text(json.dumps(saved))
    rows = step_table(study, found, posterior=load_posterior(tmp_path, study))
    beside = {(row["path"], row["metric"]): row["posterior"] for row in rows}
    steady = beside.pop(("x_x", "steady"))
    assert steady == {
        "value": pytest.approx(0.018 * pi / 2),
        "lower": pytest.approx(0.017 * pi / 2),
        "upper": None,
        "level": 0.9,
        "grade": "tentative",
    }
    assert set(beside.values()) == {None}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "cannot be read"),
        ("{", "cannot be read"),
        ("{}", "lacks step_metrics"),
        ("[]", "no JSON object"),
    ],
)
def test_a_folder_that_is_no_fit(identified, tmp_path, text, said):
    if text is not None:
        (tmp_path / "results.json").write_text(text)
    with pytest.raises(InputError, match=said):
        load_posterior(tmp_path, identified[0])


def test_a_fit_of_another_study(identified, tmp_path):
    (tmp_path / "results.json").write_text('{"study": "other", "step_metrics": []}')
    with pytest.raises(InputError, match="'other', not 'small'"):
        load_posterior(tmp_path, identified[0])
