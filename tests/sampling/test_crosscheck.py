"""The second method beside the first: agreement passes, what was planted is found and lowers every grade."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.stats import kstwobign, norm
from small import draws_of, problem, record, study

from lcopa_bayes.cli import main
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.record import save_record
from lcopa_bayes.plot.rundata import load_run
from lcopa_bayes.report import write_report
from lcopa_bayes.results.fit import Fit, fit
from lcopa_bayes.results.summary import results, verdict
from lcopa_bayes.sampling.convergence import Grade, Quality, limited
from lcopa_bayes.sampling.crosscheck import ALARM, CrossCheck, holm
from lcopa_bayes.sampling.draws import Draws
from lcopa_bayes.sampling.nested import Nested, NestedPlan

TABLE = problem(record(camera=0.6), terms=2, priors={"offset": 0.3}).posterior.table
FREE = [k for k, row in enumerate(TABLE.rows) if row.free]
SIZE = 400


def normal(seed: int, size: int = SIZE) -> np.ndarray:
    values = np.random.default_rng(seed).normal(size=(size, len(TABLE.rows)))
    values[:, [k for k in range(len(TABLE.rows)) if k not in FREE]] = 0.3
    return values


def ours(seed: int = 1, *, ess: float = SIZE) -> Draws:
    found = tuple(Quality(TABLE.names[k], ess, ess, 1.0) for k in FREE)
    return replace(draws_of(TABLE, normal(seed)), qualities=found, target_ess=min(ess, SIZE))


def theirs(seed: int = 2, *, log_evidence: float = 100.0, values: np.ndarray | None = None) -> Nested:
    drawn = normal(seed) if values is None else values
    return Nested(TABLE, drawn, np.full(len(TABLE.rows), float(SIZE)), log_evidence, 0.2, (99.8, 100.1), 999)


def shifted(by: float, name: str = "order_2") -> Nested:
    values = normal(2)
    values[:, TABLE.names.index(name)] += by
    return theirs(values=values)


# -- the comparison --------------------------------------------------------------------------------


def test_draws_of_one_posterior_agree_as_often_as_promised():
    trials = 300
    alarms = sum(
        not CrossCheck.of(
            ours(2 * seed),
            theirs(2 * seed + 1, log_evidence=100 + np.hypot(0.2, 0.1) * norm.ppf((seed + 0.5) / trials)),
            log_evidence=100.0,
            log_evidence_sd=0.1,
        ).agrees
        for seed in range(trials)
    )
    assert alarms <= trials * ALARM + 4 * np.sqrt(trials * ALARM)


def test_a_shifted_marginal_is_found_and_named():
    check = CrossCheck.of(ours(), shifted(0.5))
    assert not check.agrees
    worst = max(check.parameters, key=lambda one: one.distance)
    assert worst.name == "order_2"
    assert worst.p < 1e-4
    assert worst.distance == pytest.approx(2 * norm.cdf(0.25) - 1, abs=4 * 0.5 / np.sqrt(SIZE))
    assert [one.name for one in check.parameters if one.p < ALARM] == ["order_2"]
    assert "disagrees: the marginal of order_2 differs by 0." in check.sentence


def test_fewer_effective_draws_prove_less():
    check = CrossCheck.of(ours(ess=20), shifted(0.5))
    assert check.agrees
    assert {one.run.ess for one in check.parameters} == {20.0}
    assert all(one.resolution > 0.4 for one in check.parameters)
    assert f"a difference of {check.parameters[0].resolution:.2f}" in check.sentence
    blind = CrossCheck.of(ours(ess=np.nan), shifted(0.5))
    assert blind.agrees
    assert "too few effective draws of gain to detect any" in blind.sentence


def test_the_distance_that_is_called_a_disagreement_is_where_the_p_value_is():
    check = CrossCheck.of(ours(), theirs())
    size = np.sqrt(SIZE / 2)
    for one in check.parameters:
        p = kstwobign.sf(one.resolution * (size + 0.12 + 0.11 / size))
        assert p * len(check.parameters) == pytest.approx(ALARM)


def test_another_evidence_is_found():
    reported = {"log_evidence": 101.5, "log_evidence_sd": 0.1}
    check = CrossCheck.of(ours(), theirs(), **reported)
    assert not check.agrees
    assert check.evidence_p == pytest.approx((1 + len(FREE)) * 2 * norm.sf(1.5 / np.hypot(0.1, 0.2)))
    assert "disagrees: log evidence 101.50 ± 0.10 against 100.00 ± 0.20" in check.sentence
    near = CrossCheck.of(ours(), theirs(), log_evidence=100.3, log_evidence_sd=0.1)
    assert near.agrees
    assert "and log evidence 100.30 ± 0.10 against 100.00 ± 0.20" in near.sentence


def test_a_run_without_evidence_is_compared_without():
    for reported in ({}, {"log_evidence": 150.0}):
        check = CrossCheck.of(ours(), theirs(), **reported)
        assert check.agrees
        assert (check.log_evidence, check.evidence_p) == (None, None)
        assert "log evidence" not in check.sentence


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03, 0.5]) == pytest.approx([0.04, 0.09, 0.09, 0.5])
    assert holm([0.6, 0.7]) == [1.0, 1.0]


# -- grades ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("before", "after"),
    [("reliable", "tentative"), ("tentative", "unusable"), ("unusable", "unusable")],
)
def test_disagreement_lowers_a_grade_by_one(before, after):
    grade = Grade(before, "the reason before")
    lowered = limited(grade, CrossCheck.of(ours(), shifted(0.5)).limitations(grade))
    assert lowered.level == after
    assert "order_2" in lowered.reason
    assert "sample more steps" in lowered.reason
    assert "the reason before" in lowered.reason
    assert CrossCheck.of(ours(), theirs()).limitations(grade) == ()


def test_no_number_of_limited_draws_is_graded_better():
    draws = ours()
    assert draws.grade.level == "reliable"
    doubtful = draws.limited(CrossCheck.of(draws, shifted(0.5)).limitations(draws.grade))
    assert doubtful.grade.level == "tentative"
    assert {estimate.grade for estimate in doubtful.estimates()} == {"tentative"}
    assert {estimate.grade for estimate in draws.estimates()} == {"reliable"}


# -- the whole fit ---------------------------------------------------------------------------------

TINY = {"target_ess": 100}
KNOWN = {"time_1": 1.5, "order_1": 0.8, "offset": 0.3}


@pytest.fixture(scope="module")
def checked() -> Fit:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(NestedPlan, "of", lambda *_, **__: NestedPlan(2, 80, 15, 3))
        return fit(study(record(camera=0.6), sampler=TINY, priors=KNOWN), cross_check=True, quick=True)


def test_a_simple_posterior_passes(checked):
    assert checked.cross_check is not None
    assert checked.cross_check.agrees
    assert not [one for one in checked.draws.limitations if "ested" in one.reason]
    assert "Nested sampling, an independent method, agrees" in verdict(checked)
    reported = results(checked)["cross_check"]
    assert json.loads(json.dumps(reported, allow_nan=False)) == reported
    assert {"agrees", "log_evidence", "log_evidence_sd", "evaluations", "parameters"} <= reported.keys()
    assert [row["name"] for row in reported["parameters"]] == ["gain", "delay", "sigma"]
    for row in reported["parameters"]:
        assert row["run"]["lower"] < row["nested"]["value"] < row["run"]["upper"]


@pytest.fixture(scope="module")
def doubted(checked) -> Fit:
    """The same fit with a second method that finds other delays."""
    honest = checked.cross_check.nested
    values = honest.values.copy()
    k = checked.draws.table.names.index("delay")
    values[:, k] += 2 * values[:, k].std()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lcopa_bayes.results.fit.nested", lambda *_, **__: replace(honest, values=values))
        return fit(checked.study, cross_check=True, quick=True)


def test_every_number_of_a_fit_that_is_doubted_is_lowered(checked, doubted):
    before, after = checked.draws.grade.level, doubted.draws.grade.level
    assert (before, after) in {("reliable", "tentative"), ("tentative", "unusable")}
    reported = results(doubted)
    assert reported["grade"] == after
    assert {row["grade"] for row in reported["parameters"]} == {after}
    assert {row["grade"] for row in reported["step_metrics"]} == {after}
    assert "disagrees: the marginal of delay" in reported["verdict"]
    assert verdict(doubted).count("disagrees") == 1


@pytest.mark.usefixtures("undrawn")
def test_the_report_shows_both_methods(checked, doubted, tmp_path):
    for made, word in ((checked, "agrees"), (doubted, "disagrees")):
        folder = tmp_path / word
        folder.mkdir()
        made.save(folder)
        page = write_report(folder).read_text(encoding="utf-8")
        assert "Second method" in page
        assert f"Nested sampling, an independent method, {word}" in page
        assert (folder / "figures" / "cross_check_01.svg").exists()
        density = load_run(folder).tables["cross_check_density"]
        for _, own in density.groupby("name"):
            edges = np.append(own["left"], own["right"].iloc[-1])
            widths = np.diff(np.log(edges) if own["log_scale"].any() else edges)
            assert own["nested"] @ widths == pytest.approx(1.0, abs=0.05)
        table = pd.read_csv(folder / "tables" / "cross_check.csv")
        assert list(table["name"]) == ["gain", "delay", "sigma"]
    (folder / "tables" / "cross_check_density.csv").unlink()
    with pytest.raises(InputError, match=r"cross_check_density\.csv: this file of the run folder is missing"):
        load_run(folder)


@pytest.mark.usefixtures("undrawn")
def test_without_a_second_method_nothing_is_claimed(checked, tmp_path):
    alone = replace(checked, cross_check=None)
    assert results(alone)["cross_check"] is None
    assert "ested sampling" not in verdict(alone)
    alone.save(tmp_path)
    page = write_report(tmp_path).read_text(encoding="utf-8")
    assert "Not run: <code>fit --cross-check</code>" in page
    assert not (tmp_path / "tables" / "cross_check.csv").exists()


def test_the_command_line_asks_for_it(monkeypatch, tmp_path):
    asked = []

    def stop(*_, **options):
        asked.append(options["cross_check"])
        raise InputError("asked")

    monkeypatch.setattr("lcopa_bayes.verbs.fit.fit", stop)
    save_record(record(camera=0.6), tmp_path / "one.csv")
    for words in (["fit"], ["fit", "--cross-check"], ["run", "--cross-check"]):
        assert main([*words, str(tmp_path / "one.csv")]) == 2
    assert asked == [False, True, True]
