"""A study with effects calibrated to its end: what cannot be simulated, what is ranked, what is written."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from small import record, study, with_effect

from lcopa_bayes.bench.command import staircase
from lcopa_bayes.calibration.replica import Replication, exact_responses
from lcopa_bayes.calibration.truths import Truths, truths_stated
from lcopa_bayes.cli import main
from lcopa_bayes.data.study import Study
from lcopa_bayes.data.studywriter import write_study
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.model.effects.effect import UnstableError
from lcopa_bayes.results.fit import plan_of
from lcopa_bayes.sampling.tempering import temper

TRUTH = {
    "gain": 2.0, "time": 1.5, "order": 0.8, "delay": 0.73, "offset": 0.3, "sigma": 0.02, "coefficient": 0.4,
}  # fmt: skip
NARROW = {
    "gain": ("norm", {"loc": 2.0, "scale": 0.2}),
    "time_1": ("loguniform", {"a": 1.0, "b": 2.0}),
    "order_1": 0.8,
    "delay": ("uniform", {"loc": 0.5, "scale": 0.5}),
    "offset": 0.3,
    "sigma": 0.02,
}
SOFT = -50.0
"""Of a spring that softens so much that it gives way."""


def stiff(**settings: object) -> Study:
    command = staircase([1.0, -0.7, 0.0], hold=2.0, start=0.55)
    one = record(command=command, camera=0.5, duration=6.5, name="r0")
    base = study(one, noise="white", seed=4, blocks=60, **settings)
    return with_effect(base, ["cubic_stiffness"], TRUTH)[0]


@pytest.fixture(scope="module")
def problem() -> Problem:
    return problem_of(stiff(priors=NARROW))


def with_prior_of_the_effect(problem: Problem, low: float, high: float) -> Problem:
    prior = {"cubic_stiffness.c": {"dist": "uniform", "loc": low, "scale": high - low}}
    return problem_of(replace(problem.study, priors=dict(problem.study.priors) | prior))


def replication(problem: Problem, truths: Truths | None = None) -> Replication:
    table = problem.posterior.table
    return Replication(problem, plan_of(problem, quick=True), truths or Truths(table))


def test_a_truth_without_a_bounded_response_is_drawn_again(problem):
    """Truths are those draws of the prior, in their order, of which the likelihood is above 0."""
    wide = with_prior_of_the_effect(problem, SOFT, -SOFT)
    posterior, rng = wide.posterior, np.random.default_rng(3)
    drawn = [posterior.table.draw(1, rng)[0] for _ in range(30)]
    bounded = [np.isfinite(posterior.joint_log_likelihood(one[None])[0]) for one in drawn]
    assert 3 < sum(bounded) < 27
    again = np.random.default_rng(3)
    for expected in [one for one, kept in zip(drawn, bounded, strict=True) if kept][:3]:
        truth, exact = replication(wide)._bounded(again)
        assert_array_equal(truth, expected)
        assert np.isfinite(exact[0]).all()


def test_a_stated_truth_without_a_bounded_response_fails(problem):
    wide = with_prior_of_the_effect(problem, SOFT, -SOFT)
    rows = [row for row in wide.posterior.table.rows if row.free]
    stated = {row.name: SOFT if row.name == "cubic_stiffness.c" else TRUTH[row.kind] for row in rows}
    made = replication(wide, truths_stated(stated, wide.posterior.table))
    with pytest.raises(UnstableError):
        exact_responses(wide, made.truths.draw(np.random.default_rng(0)))
    with pytest.raises(UnstableError):
        made._bounded(np.random.default_rng(0))


def test_tempering_begins_where_responses_are_bounded(problem):
    posterior = with_prior_of_the_effect(problem, SOFT, -SOFT).posterior
    state = tuple(np.random.RandomState(1).get_state())
    rng = np.random.default_rng(3)
    drawn = posterior.log_density(posterior.coordinates(posterior.table.draw(8, np.random.default_rng(3))))
    assert np.isneginf(drawn).any()
    population, _ = temper(posterior, 4, 1, rng, state)
    assert np.isfinite(population.log_density).all()
    assert population.position.shape == (4, posterior.dimension)


@pytest.mark.usefixtures("undrawn")
def test_calibrate_with_an_effect_goes_to_its_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Truths are ranked, the effect's too; the page shows it; the same again from what is stored."""
    (tmp_path / "in").mkdir()
    write_study(stiff(priors=NARROW), tmp_path / "in" / "study.toml")
    out = tmp_path / "run"
    words = ["calibrate", str(tmp_path / "in"), "--replicas", "1", "--jobs", "1", "--quick", "--json"]
    assert main([*words, "--out", str(out)]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert reported["replicas"] == 1
    assert reported["failures"] == []
    assert reported["engine"]["importance"] == 1
    assert reported["grades"]["unusable"] == 0
    ranked = {one["parameter"] for one in reported["ranks"]}
    assert {"gain", "cubic_stiffness.c", "log_likelihood"} <= ranked
    assert reported["model_gap"]["largest"] < 1.0
    assert "cubic_stiffness.c" in (out / "report.html").read_text()
    assert main([*words, "--out", str(out), "--resume"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["coverage"] == reported["coverage"]
