"""Units of time: known ratios, exact there and back, and one meaning from file to prior."""

from __future__ import annotations

from fractions import Fraction
from itertools import product

import numpy as np
import pytest

from lcopa_bayes.core.units import TIME_UNITS, in_time_unit, measured, per
from lcopa_bayes.data.studyfile import load_study
from lcopa_bayes.inference.assembly import problem_of


@pytest.mark.parametrize(
    ("time", "given", "wanted", "exact"),
    [(90.0, "min", "h", 1.5), (1.5, "h", "s", 5400.0), (3.0, "ms", "s", 0.003), (0.25, "min", "ms", 15000.0)],
)
def test_known_times(time, given, wanted, exact):
    assert in_time_unit(time, given, wanted) == exact


def test_conversion_rounds_once():
    """Against exact fractions, from every unit to every unit."""
    times = np.random.default_rng(1).uniform(0.0, 100.0, 50)
    for one, other in product(TIME_UNITS, TIME_UNITS):
        ratio = Fraction(TIME_UNITS[one], TIME_UNITS[other])
        exact = [float(Fraction(time) * ratio) for time in times.tolist()]
        np.testing.assert_array_equal(in_time_unit(times, one, other), exact)


def test_a_record_in_minutes_is_the_one_in_seconds(tmp_path):
    """Columns, drives, exposure and default priors: the same plant, in its own unit."""
    seconds = np.arange(20.0)
    cells = [f"{float(k > 1)},{1 - 0.8 ** max(k - 1, 0)}" for k in range(20)]
    tables = {}
    for unit, times in (("min", seconds / 60), ("s", seconds)):
        folder = tmp_path / unit
        folder.mkdir()
        rows = [f"{time!r},{cell}" for time, cell in zip(times.tolist(), cells, strict=True)]
        (folder / "a.csv").write_text("\n".join([f"time_{unit},drive_u_V,response_y_V", *rows]) + "\n")
        (folder / "study.toml").write_text("[model]\nexposure_ms = 300\n")
        study = load_study(folder)
        assert study.time_unit == unit
        assert study.exposure == pytest.approx(0.3 / (60 if unit == "min" else 1), rel=1e-15)
        tables[unit] = {row.name: row for row in problem_of(study).posterior.table.rows}
    assert tables["min"]["delay"].unit == "min"
    assert 60 * tables["min"]["delay"].domain[1] == pytest.approx(tables["s"]["delay"].domain[1], rel=1e-12)


@pytest.mark.parametrize(
    ("unit", "other", "ratio"),
    [
        ("rad", "V", "rad/V"),
        ("rad", "-", "rad"),
        ("-", "V", "1/V"),
        ("-", "-", "-"),
        ("°C", "L/min", "°C/(L/min)"),
        ("-", "m3/h", "1/(m3/h)"),
        ("rad", "1", "rad"),
        ("1", "V", "1/V"),
        ("1", "1", "1"),
    ],
)
def test_the_unit_of_a_ratio(unit, other, ratio):
    assert per(unit, other) == ratio


@pytest.mark.parametrize(("unit", "said"), [("V", "0.2 V"), ("-", "0.2"), ("1", "0.2")])
def test_a_number_without_a_unit_stands_alone(unit, said):
    assert measured("0.2", unit) == measured(0.2, unit) == said
    assert measured(0.123456, unit, ".1f") == said.replace("0.2", "0.1")
