"""Integer orders beside a fit: as likely as by the loop's own descent, part of the numbers where the records
let them be, and none where a fractional order shows."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from effectsearch.test_integerplants import HALF, RINGING, based, record
from small import problem
from test_alternatives import QUICK, few_draws  # noqa: F401

from lcopa_bayes.data.settings import ModelSettings, PriorSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.integerplants import integer_plant
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.integerorders import Orders, nearest, starts, with_orders
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.results.alternatives import Alternatives, Averaged, with_alternatives
from lcopa_bayes.results.averages import pooled
from lcopa_bayes.results.fit import Fit, fit
from lcopa_bayes.results.integerfit import IntegerFit, integer_fit

LAG = TransferPath.of_times(1.0, 0.4, (2.0,), (1.0,))
WHITE = {"kind": "white"}


def fitted(path: TransferPath, terms: int, **settings: object) -> Fit:
    records = tuple(record(f"run{k}", (path,), 5 + k) for k in range(2))
    model = ModelSettings(terms=terms, share="none", delay="path")
    return fit(Study("orders", None, "s", 3, records, (), model, sampler=QUICK, **settings))


def parts(of: Fit) -> tuple[Alternatives, IntegerFit]:
    assert of.alternatives is not None
    assert of.alternatives.integer is not None
    return of.alternatives, of.alternatives.integer


def delay_of(of: Fit) -> Averaged:
    return {one.estimate.name: one for one in parts(of)[0].numbers}["delay[y]"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("run")


@pytest.fixture(scope="module")
def over(folder: Path) -> Fit:
    own = fitted(LAG, 1, noise=WHITE)
    return with_alternatives(own, integer_fit(own, folder=folder, quick=True))


def agree(integer: IntegerFit, path: TransferPath, orders: Orders, terms: int) -> None:
    base = based((path,), terms)
    other = integer_plant(base.start, base.problem)
    assert other is not None
    assert dict(integer.orders) == dict(other.orders) == orders
    assert integer.log_odds == pytest.approx(other.log_odds, abs=1.0)
    assert integer.weight == pytest.approx(other.weight, abs=0.1)
    table = integer.problem.posterior.table
    assert tuple(integer.values[table.of_kind("order")]) == orders[""]


def test_integer_orders_are_as_likely_as_by_the_descent_of_the_loop(over: Fit) -> None:
    """Second method: other descents, under noise measured at rest."""
    integer = parts(over)[1]
    agree(integer, LAG, {"": integer.orders[""]}, 1)
    assert integer.weight > 0.3


def test_numbers_are_over_plants_with_free_and_integer_orders(over: Fit) -> None:
    one, weight = delay_of(over), parts(over)[1].weight
    assert one.shares["integer"] == pytest.approx(weight * (1 - one.shares.get("lags", 0.0)))
    assert sum(one.shares.values()) == pytest.approx(1.0)
    assert list(one.parts) == list(one.shares)
    expected = pooled(list(one.parts.values()), np.array(list(one.shares.values())))
    assert one.estimate.lower == pytest.approx(float(np.quantile(expected, 0.05)), rel=1e-6)
    assert one.estimate.lower <= LAG.delay <= one.estimate.upper
    reported = {each.name: each for each in over.metrics}["delay[y]"]
    assert reported == one.estimate
    assert "integer orders" in reported.note


@pytest.mark.slow
def test_integer_orders_hold_what_free_ones_put_at_an_end() -> None:
    """Orders below 2 come with a longer delay: most draws of the fitted plant are beyond the true one."""
    own = fitted(RINGING, 2)
    ringing = with_alternatives(own, integer_fit(own))
    agree(parts(ringing)[1], RINGING, {"": (2.0, 1.0)}, 2)
    beyond = {kind: float(np.mean(own > RINGING.delay)) for kind, own in delay_of(ringing).parts.items()}
    assert beyond["plant"] > beyond["integer"] + 0.1


def test_a_fractional_order_leaves_no_integer_one() -> None:
    assert integer_fit(fitted(HALF, 1, noise=WHITE)) is None


def test_beside_unusable_draws_none_are_sampled(over: Fit) -> None:
    first, *rest = over.draws.qualities
    scarce = replace(over.draws, qualities=(replace(first, ess_bulk=3.0), *rest))
    assert scarce.sampling_grade.level == "unusable"
    assert integer_fit(replace(over, draws=scarce), quick=True) is None


def test_a_killed_run_goes_on_from_what_was_sampled(
    over: Fit, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def begun(*_: object) -> None:
        raise AssertionError("sampled from the start")

    monkeypatch.setattr("lcopa_bayes.sampling.sampler.Birth", begun)
    monkeypatch.setattr("lcopa_bayes.sampling.sampler.Search", begun)
    resumed = integer_fit(over, folder=folder, resume=True, quick=True)
    assert resumed is not None
    drawn = (one.sampled.draws.flat for one in (resumed, parts(over)[1]) if one.sampled)
    np.testing.assert_array_equal(*drawn)


def test_they_are_kept_with_the_run(over: Fit, tmp_path: Path) -> None:
    values = json.loads((over.save(tmp_path) / "results.json").read_text())["alternatives"]
    assert values["integer_orders"]["orders"] == {"": list(parts(over)[1].orders[""])}
    assert "A plant with integer orders (" in values["sentence"]


def test_starts_have_the_orders_that_are_held() -> None:
    """Not those of the plant with free ones, and its times and delays."""
    prepared = problem(record("a", (RINGING,), 1), terms=1)
    old = prepared.posterior.table
    values = np.array([row.value for row in old.rows])
    values[old.of_kind("order")], values[old.of_kind("delay")], values[old.of_kind("time")] = 1.4, 0.3, 1.7
    orders = dict(nearest(old, values))
    assert orders == {"": (2.0, 1.0)}
    study = with_orders(prepared.study, old, orders)
    assert study.priors["order_1"] == PriorSettings("order_1", fixed=2.0)
    new = problem_of(study).posterior.table
    found = list(starts(old, values, new, orders))
    assert [list(one[new.of_kind("order")]) for one in found] == [[2.0, 1.0]] * 2
    assert [list(one[new.of_kind("time")]) for one in found] == [[1.7, 1.7]] * 2
    assert [float(one[new.of_kind("delay")[0]]) for one in found] == pytest.approx([0.3, 0.15])
