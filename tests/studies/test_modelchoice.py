"""The study of model choice: truths that a record determines, shares with intervals, and its short form."""

from __future__ import annotations

import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.stats import binom


def loaded() -> ModuleType:
    path = Path(__file__).parents[2] / "studies" / "model-choice" / "choice.py"
    spec = spec_from_file_location("model_choice", path)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


choice = loaded()


@pytest.fixture(scope="module")
def made():
    return choice.problems()


def test_every_kind_of_truth_has_its_candidate(made):
    assert tuple(made) == choice.KINDS
    free = {name: sum(row.free for row in one.posterior.table.rows) for name, one in made.items()}
    assert free == {
        "fractional-1": 5,
        "fractional-2": 7,
        "fractional-3": 9,
        "first-order": 4,
        "second-order": 5,
    }


def test_truths_are_those_the_record_determines(made):
    one = made["fractional-1"]
    good, _ = choice.drawn(one, np.random.default_rng(3))
    assert choice.identified(one, good)
    order, sigma, time = (one.posterior.table.names.index(name) for name in ("order_1", "sigma", "time_1"))
    near, loud, unseen = good.copy(), good.copy(), good.copy()
    near[order] = 1.05
    loud[sigma] = 10.0
    unseen[time] = 1e-6
    assert not any(choice.identified(one, bad) for bad in (near, loud, unseen))


def test_shares_and_their_intervals():
    found = [
        {
            "kind": kind,
            "preferred": name,
            "candidates": [{"log_evidence_sd": 0.1, "usable": True}],
        }
        for kind, name in [
            *[("fractional-1", "fractional-1")] * 3,
            ("fractional-1", "first-order"),
            ("first-order", "fractional-1"),
            ("second-order", "second-order"),
            ("second-order", None),
        ]
    ]
    reported = choice.summary(found)
    right = reported["generating_model_preferred"]
    assert (right["count"], right["of"]) == (4, 7)
    assert binom.sf(3, 7, right["lower"]) == pytest.approx(0.05)
    assert binom.cdf(4, 7, right["upper"]) == pytest.approx(0.05)
    assert reported["integer_called_fractional"]["count"] == 1
    assert reported["kinds"][0]["others"] == {"first-order": 1}


@pytest.mark.slow
def test_the_generating_model_is_preferred_on_a_few_records(monkeypatch):
    """One truth of one term and one of first order, between these two candidates, sampled briefly."""
    monkeypatch.setattr(choice, "KINDS", ("fractional-1", "first-order"))
    monkeypatch.setattr(choice, "PLAN", {"ensembles": 2, "walkers": 16, "target_ess": 100})
    found = [choice.replica(number, quick=True) for number in (0, 1)]
    assert [one["preferred"] for one in found] == ["fractional-1", "first-order"]
    evidence = [{row["name"]: row["log_evidence"] for row in one["candidates"]} for one in found]
    assert evidence[0]["fractional-1"] > evidence[0]["first-order"] + 5
    assert 0 < evidence[1]["first-order"] - evidence[1]["fractional-1"] < 10  # Occam alone
