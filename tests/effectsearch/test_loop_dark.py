"""The loop on campaigns with records in which no drive moves, fitted and held out."""

from __future__ import annotations

import json

import numpy as np
import pytest

from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.effectsearch.loopresult import Loop
from lcopa_bayes.effectsearch.summary import results

NOISE = 0.05
"""[degC]."""
GAINS, LAGS, DELAY = np.array([[0.4, 0.1], [0.15, 0.5]]), np.array([[60.0, 90.0], [90.0, 60.0]]), 8.0
"""[degC/pct], [s], [s]."""
AXES = (
    (Axis("left", "pct"), Axis("right", "pct")),
    (Axis("left", "degC"), Axis("right", "degC")),
)
TIMES = 2.0 * np.arange(240)


def record(name: str, axes: int, commands: dict[int, list[tuple[float, float]]], *, level=0.0) -> Record:
    """First-order lags about `level` [pct], exactly; `commands` gives each axis' instants and values."""
    rng = np.random.default_rng([axes, len(name), ord(name[-1])])
    drive, response = np.full((TIMES.size, axes), level), np.full((TIMES.size, axes), 21.0)
    response += GAINS[:axes, :axes] @ np.full(axes, level)
    for j, changes in commands.items():
        previous = level
        for at, value in changes:
            drive[at <= TIMES, j] = value
            since = np.maximum(TIMES - at - DELAY, 0.0)[:, None]
            response += (value - previous) * GAINS[:axes, j] * -np.expm1(-since / LAGS[:axes, j])
            previous = value
    response += NOISE * rng.standard_normal(response.shape)
    return Record(name, TIMES, drive, response, AXES[0][:axes], AXES[1][:axes], "s")


def with_dark(axes: int) -> Study:
    """Two records that move, one without any drive and one at rest; as many held out."""
    first, last = 0, axes - 1
    fit = (
        record("r1", axes, {first: [(100.0, 50.0), (300.0, 0.0)]}),
        record("r2-dark", axes, {}),
        record("r3", axes, {last: [(100.0, 30.0), (250.0, -20.0)]}),
        record("r4-rest", axes, {}, level=10.0),
    )
    held_out = (
        record("r5-dark", axes, {}),
        record("r6-rest", axes, {}, level=-15.0),
        record("r7", axes, {first: [(80.0, 20.0)], last: [(200.0, 60.0)]}),
    )
    return Study("oven", None, "s", 1, fit, held_out, ModelSettings(offset="record"))


def assert_scored(found: Loop) -> None:
    """Every record has a finite error in every axis, none far above the noise."""
    printed = results(found)
    json.dumps(printed, allow_nan=False)
    study = found.study
    for side in ("before", "after"):
        scores = printed[side]["scores"]
        records = len(study.fit) + len(study.held_out)
        assert len(scores) == records * len(study.response_axes)
        # 240 samples: the standard error of an rmse is 4.6 % of the noise
        assert all(score["rmse"] < 1.3 * NOISE for score in scores), scores


@pytest.mark.parametrize(
    ("axes", "sample"),
    [
        pytest.param(1, True, marks=pytest.mark.slow),
        pytest.param(2, True, marks=pytest.mark.slow),
        (2, False),
    ],
)
def test_the_whole_catalogue_with_dark_records_fitted_and_held_out(axes: int, sample: bool):
    found = loop(with_dark(axes), quick=True, sample=sample)
    assert found.base.failed == ""
    assert found.verdict.kind == "clean"
    assert {one.name: one.failed for one in found.trace.traced if one.failed} == {}
    assert_scored(found)
