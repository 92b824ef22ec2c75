"""The integer-order rival: which orders it holds, and that its scores are its own."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from small import record

from lcopa_bayes.data.settings import ModelSettings, SamplerSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.report import write_report
from lcopa_bayes.results.fit import Fit, fit
from lcopa_bayes.results.integerrival import Rival, integer_rival, integer_study

FEW = SamplerSettings(target_ess=10)


@pytest.fixture(scope="module")
def fitted() -> Fit:
    """One term of order 0.7 seen twice; the second record is held out."""
    seen, kept = (record(seed=seed, name=name) for seed, name in ((1, "a"), (2, "b")))
    study = Study("two", None, "ms", 3, (seen,), (kept,), model=ModelSettings(terms=1), sampler=FEW)
    return fit(study)


@pytest.fixture(scope="module")
def rival(fitted) -> Rival:
    return integer_rival(fitted)


def test_every_free_order_is_held_at_its_nearest_integer_and_at_one_at_least(fitted):
    study, orders = integer_study(fitted)
    median = float(np.median(fitted.draws.column("order_1")))
    assert orders == {"order_1": max(1.0, round(median))}
    assert study.priors["order_1"].fixed == orders["order_1"]
    assert study.fit == fitted.study.fit


@pytest.mark.usefixtures("undrawn")
def test_the_rival_predicts_the_same_records_and_is_reported(fitted, rival, tmp_path):
    reported = rival.as_json()
    assert [row["record"] for row in reported["held_out"]] == ["b"]
    assert reported["held_out"][0]["rmse"] == next(b.rmse for b in rival.fit.bands if b.held_out)
    assert reported["held_out"][0]["rmse"] != fitted.bands[-1].rmse
    assert all("order" not in quality.name for quality in rival.fit.draws.qualities)
    both = replace(fitted, rival=rival)
    saved = json.loads((both.save(tmp_path) / "results.json").read_text())
    assert rival.sentence in saved["verdict"]
    assert json.loads((tmp_path / "results.json").read_text())["rival"]["orders"] == dict(rival.orders)
    grade = rival.fit.draws.grade
    reason = re.sub(r"`(.+?)`", r"<code>\1</code>", grade.reason)
    assert f"{grade.level}: {reason}" in write_report(tmp_path).read_text()


def test_no_rival_without_free_orders_or_held_out_records(fitted, rival):
    assert integer_study(replace(fitted, draws=rival.fit.draws)) is None
    assert (
        integer_rival(
            replace(fitted, problem=replace(fitted.problem, study=replace(fitted.study, held_out=())))
        )
        is None
    )
