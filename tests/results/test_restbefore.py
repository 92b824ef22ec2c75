"""Another drive before a record that moves at once is recognised, and rest is not taken for one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from small import TRUTH, problem, record, study

from lcopa_bayes.bench.command import Command
from lcopa_bayes.data.record import Record
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.results.firstlook import first_look
from lcopa_bayes.results.restbefore import rest_before
from lcopa_bayes.sampling.convergence import Limitation

CHANGES = 0.4 * np.arange(30)
"""The drive moves at the first sample and every 0.4 ms [ms]."""


def moving(seed: int, rest: float | None) -> Record:
    """A record whose drive moves at once, of a plant that rested under `rest`, None for its first row's."""
    levels = np.random.default_rng(seed).uniform(-1.0, 1.0, (CHANGES.size, 1))
    before = levels[0] if rest is None else np.array([rest])
    made = record(seed, command=Command(CHANGES, levels, before))
    first = int(np.isfinite(made.response).any(axis=1).argmax())
    parts = {key: getattr(made, key)[first:] for key in ("time", "drive", "response")}
    return replace(made, **parts)


def found(made: Problem) -> list[Limitation]:
    """Limitations at the truth; the search moves it to the optimum."""
    rows = made.posterior.table.rows
    truth = np.array([TRUTH[row.name.removesuffix("_second")] if row.free else row.value for row in rows])
    return list(rest_before(made, truth))


def test_the_drive_before_the_record_is_found():
    """Half the range of the drives from that of the first row, so that every parameter moves."""
    for seed in range(2):
        (limit,) = found(problem(moving(seed, 1.0), noise="white"))
        assert limit.level == "tentative"
        said = limit.reason.partition(" = ")[2].partition(" ")[0]
        assert float(said) == pytest.approx(1.0, abs=0.03)
        assert "of the first row before step, which moves at once: u = " in limit.reason
        assert "add a row before the first (time -" in limit.remedy


@pytest.mark.parametrize("rest", [1.0, 4.0])
def test_a_drive_too_far_away_to_be_fitted_is_noticed(rest):
    """The optimum of a plant at rest is another one, with a gain of the wrong sign."""
    (limit,) = found(problem(moving(2, rest), noise="white"))
    assert "another drive before it explains its start better (p = 0" in limit.reason


def test_a_plant_at_rest_is_rarely_limited():
    """One in a thousand is promised; of 40, more than the 99.9 % quantile of that fails."""
    alarms = sum(bool(found(problem(moving(seed, None), noise="white"))) for seed in range(40))
    assert alarms <= stats.binom.ppf(0.999, 40, 1e-3)


def test_an_early_row_or_samples_at_rest_settle_it():
    begun = moving(1, 1.0)
    assert found(problem(begun, noise="white"))
    assert not found(problem(begun.begun(np.array([1.0])), noise="white"))
    assert not found(problem(record(3), noise="white"))  # rests before its step


def test_the_record_that_did_not_rest_is_named():
    first, second = moving(1, None), replace(moving(2, 1.0), name="second")
    (limit,) = found(problem(first, second, noise="white", offset="shared"))
    assert "before second, which moves at once" in limit.reason


def test_the_first_look_says_so():
    said = first_look(study(moving(1, 1.0), noise="white")).verdict
    assert "Intervals hold only if the plant rested under the drive of the first row before step" in said
    assert "; add a row before the first (time -" in said
