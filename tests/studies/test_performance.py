"""The performance study's own arithmetic: draws shown by errors on known cases, and the table of methods."""

from __future__ import annotations

import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from numpy.testing import assert_allclose


def loaded(name: str) -> ModuleType:
    path = Path(__file__).parents[2] / "studies" / "performance" / f"{name}.py"
    spec = spec_from_file_location(f"performance_{name}", path)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


comparison = loaded("comparison")
Known, Piece = comparison.Known, comparison.Piece
EXACT = Known(np.array([3.0]), np.zeros(1))
VARIANCE = np.array([4.0])


def shown(estimates: np.ndarray, reference=EXACT, parts: int = 1) -> float:
    return float(comparison.shown_by_errors(np.asarray(estimates), VARIANCE, reference, parts)[0])


@pytest.mark.parametrize("draws", [25, 400])
@pytest.mark.parametrize("parts", [1, 4])
def test_means_of_independent_draws_are_worth_their_number(draws, parts, rng):
    estimates = rng.normal(3.0, np.sqrt(4.0 / draws), (2000, 1))
    assert shown(estimates, parts=parts) == pytest.approx(parts * draws, rel=4 * np.sqrt(2 / 2000))


def test_a_common_error_is_not_averaged_away():
    """Two estimates at 5 and 7 of 3: scatter 2 and a squared distance of 9, of which chance explains 1."""
    assert shown([[5.0], [7.0]]) == pytest.approx(4.0 / (2.0 + 8.0))
    assert shown([[5.0], [7.0]], parts=2) == pytest.approx(4.0 / (1.0 + 8.0))


def test_chance_in_the_reference_is_not_held_against_a_method():
    rough = Known(np.array([3.0]), np.array([8.5]))
    assert shown([[5.0], [7.0]], rough) == pytest.approx(4.0 / 2.0)


def test_chains_that_agree_on_the_wrong_ridge_are_worth_little():
    assert shown([[7.0], [7.0], [7.0]]) == pytest.approx(4.0 / 16.0)


def test_one_estimate_has_its_distance_alone():
    assert shown([[4.0]]) == pytest.approx(4.0)


def test_known_is_the_mean_with_its_squared_error():
    first = Known.of(np.array([[1.0], [3.0]]))
    assert_allclose((first.means, first.variances), [[2.0], [1.0]])
    both = first.averaged(Known(np.array([4.0]), np.array([3.0])))
    assert_allclose((both.means, both.variances), [[3.0], [1.0]])


def pieces(means: list[float], *, told: float, cpu: float, finished: bool = True) -> list:
    """Of two quantities with posterior variance near 1, the second with thrice the errors of the first."""
    return [
        Piece(np.array([m, 3 * m]), np.ones(2), told, cpu, 2 * cpu, log_evidence=5.0, finished=finished)
        for m in means
    ]


@pytest.fixture(scope="module")
def report() -> dict:
    found = {
        "ours": pieces([-0.1, 0.1], told=50.0, cpu=2.0),
        "second": pieces([-0.2, 0.2], told=40.0, cpu=1.0),
        "stuck": pieces([1.0, 1.0], told=30.0, cpu=8.0, finished=False),
    }
    return comparison.compared(["a", "b"], found, {"ours": 4, "second": 1, "stuck": 1})


def test_the_worst_quantity_counts(report):
    ours, second, stuck = report["methods"]
    assert ours["ess_shown_limited_by"] == "b"
    assert ours["ess_shown"] == pytest.approx(4 / (9 * 0.02))
    assert ours["ess_shown_per_s"] == pytest.approx(ours["ess_shown"] / 8.0)
    assert (ours["ess_told"], ours["cpu_s_per_run"], ours["wall_s_per_run"]) == (200.0, 8.0, 16.0)
    assert second["ess_shown"] == pytest.approx(1 / (9 * 0.08))
    variances = [report["reference"]["b"]["standard_error"] ** 2, 9 * (0.02 / 2 + 0.08 / 2) / 4]
    assert variances[0] == pytest.approx(variances[1])
    assert stuck["ess_shown"] == pytest.approx(1 / (9 - variances[0]))


def test_ratios_are_those_of_rates_and_verdicts_follow(report):
    ours, second, stuck = report["methods"]
    assert (ours["ratio_told"], ours["ratio_shown"], ours["reached"]) == (1.0, 1.0, None)
    assert second["ratio_shown"] == pytest.approx(2.0)
    assert second["ratio_told"] == pytest.approx(25.0 / 40.0)
    assert second["reached"] is False
    assert stuck["ratio_shown"] == pytest.approx(ours["ess_shown_per_s"] * 8.0 / stuck["ess_shown"])
    assert stuck["ratio_told"] == pytest.approx(25.0 / (30.0 / 8.0))
    assert stuck["reached"] is False  # by one account only


def test_reached_by_both_accounts_counts():
    found = {
        "ours": pieces([-0.1, 0.1], told=50.0, cpu=2.0),
        "second": pieces([-0.2, 0.2], told=40.0, cpu=1.0),
        "slow": pieces([1.0, 1.0], told=1.0, cpu=8.0),
    }
    *_, slow = comparison.compared(["a", "b"], found, {"ours": 4, "second": 1, "slow": 1})["methods"]
    assert slow["ratio_told"] == pytest.approx(200.0)
    assert slow["ratio_shown"] > 20
    assert slow["reached"] is True


def test_the_table_has_a_row_per_method_and_says_what_stopped(report):
    head, line, ours, second, stuck, _, wanted, _, apart = comparison.table(report).splitlines()
    assert len({row.count("|") for row in (head, line, ours, second, stuck)}) == 1
    assert "stopped" in stuck
    assert "stopped" not in ours + second
    assert "second: told 0.625, shown 2 (not reached)" in wanted
    assert "0.0 standard errors" in apart
    assert f"stuck: told 6.67, shown {report['methods'][2]['ratio_shown']:.3g} (not reached)" in wanted
