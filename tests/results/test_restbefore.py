"""Another drive before a record that moves at once is recognised, and rest is not taken for one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from small import TRUTH, problem, record, study

from lcopa_bayes.bench.command import Command
from lcopa_bayes.data.record import Record
from lcopa_bayes.data.requirements import not_at_rest
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
    return stripped(record(seed, command=Command(CHANGES, levels, before)))


def stripped(made: Record) -> Record:
    """Without early rows."""
    first = int(np.isfinite(made.response).any(axis=1).argmax())
    parts = {key: getattr(made, key)[first:] for key in ("time", "drive", "response")}
    return replace(made, **parts)


def found(made: Problem) -> list[Limitation]:
    """Limitations at the truth; the search moves it to the optimum."""
    rows = made.posterior.table.rows
    known = TRUTH | {"rho": 0.9}
    truth = np.array([known[row.name.removesuffix("_second")] if row.free else row.value for row in rows])
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


def late(seed: int, rest: float, correlation: float = 0.0) -> Record:
    """A record with fourteen samples before its step, of a plant that rested under `rest` until just before
    the first of them."""
    command = Command(np.array([-1.0, 2.5]), np.array([[0.0], [1.0]]), np.array([rest]))
    made = stripped(record(seed, command=command, correlation=correlation))
    return replace(made, drive=np.where(made.time[:, None] < 2.5, 0.0, made.drive))


def test_movement_before_the_step_is_seen():
    """By a twentieth of the range of the response, which the test of rest lets pass."""
    moving = late(4, 0.1)
    assert not not_at_rest([moving])
    (limit,) = found(problem(moving, noise="white"))
    assert "before step, whose response moves before its drive does: u = 0." in limit.reason
    assert "explains its start better" in limit.reason


def test_samples_at_rest_have_to_agree():
    """A creep after the step, which the model lacks, is explained by another drive before the record too."""
    resting = late(4, 0.0)
    since = np.maximum(resting.time - 2.5, 0.0)[:, None]
    creeping = replace(resting, response=resting.response + 0.3 * np.exp(-since / 2.0) * (since > 0))
    assert not found(problem(creeping, noise="white"))
    short = np.where(resting.time[:, None] < 1.5, np.nan, creeping.response)
    assert found(problem(stripped(replace(creeping, response=short)), noise="white"))


def test_correlated_noise_before_the_step_is_rarely_taken_for_movement():
    """One in a thousand is promised; of 30, more than the 99.9 % quantile of that fails."""
    alarms = sum(bool(found(problem(late(seed, 0.0, 0.9), noise="ar1"))) for seed in range(30))
    assert alarms <= stats.binom.ppf(0.999, 30, 1e-3)


def test_the_record_that_did_not_rest_is_named():
    first, second = moving(1, None), replace(moving(2, 1.0), name="second")
    (limit,) = found(problem(first, second, noise="white", offset="shared"))
    assert "before second, which moves at once" in limit.reason


def test_the_first_look_says_so():
    said = first_look(study(moving(1, 1.0), noise="white")).verdict
    assert "Intervals hold only if the plant rested under the drive of the first row before step" in said
    assert "; add a row before the first (time -" in said
