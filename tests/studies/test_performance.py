"""The performance study's arithmetic on known cases, its probe on a known clock, and its page."""

from __future__ import annotations

import importlib
import inspect
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import kstest
from small import record, study

from lcopa_bayes.bench.undeclared import NOISE
from lcopa_bayes.cli import VERBS
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.conditional import Conditional
from lcopa_bayes.sampling.unitcube import UnitCube

FOLDER = Path(__file__).parents[2] / "studies" / "performance"
sys.path.insert(0, str(FOLDER))

import comparison  # noqa: E402
import effects  # noqa: E402
import forward  # noqa: E402
import growth  # noqa: E402
import page  # noqa: E402
import plots  # noqa: E402
import probe  # noqa: E402
import samplers  # noqa: E402
import scatter  # noqa: E402
import targets  # noqa: E402
import verbs  # noqa: E402
from comparison import Estimate, Reference, Spread  # noqa: E402

EXACT = Reference(np.array([3.0]), np.zeros(1))
VARIANCE = np.array([4.0])


def shown(estimates, reference=EXACT) -> float:
    return float(comparison.shown_by_errors(np.asarray(estimates), VARIANCE, reference)[0])


@pytest.mark.parametrize("draws", [25, 400])
def test_means_of_independent_draws_are_worth_their_number(draws, rng):
    estimates = rng.normal(3.0, np.sqrt(4.0 / draws), (2000, 1))
    assert shown(estimates) == pytest.approx(draws, rel=4 * np.sqrt(2 / 2000))
    assert shown(estimates, None) == pytest.approx(draws, rel=4 * np.sqrt(2 / 2000))


def test_a_common_error_is_not_averaged_away():
    """Two estimates at 5 and 7 of 3: scatter 2 and a squared distance of 9, of which chance explains 1."""
    assert shown([[5.0], [7.0]]) == pytest.approx(4.0 / (2.0 + 8.0))
    assert shown([[5.0], [7.0]], None) == pytest.approx(4.0 / 2.0)


def test_chance_in_the_reference_is_not_held_against_a_method():
    rough = Reference(np.array([3.0]), np.array([8.5]))
    assert shown([[5.0], [7.0]], rough) == pytest.approx(4.0 / 2.0)


def test_chains_that_agree_on_the_wrong_mode_are_worth_little():
    assert shown([[7.0], [7.0], [7.0]]) == pytest.approx(4.0 / 16.0)


def test_a_reference_is_the_mean_of_methods_with_its_squared_error():
    one, other = np.array([[1.0], [3.0]]), np.array([[3.0], [5.0], [7.0]])
    alone, both = Reference.of([one]), Reference.of([one, other])
    assert alone is not None
    assert both is not None
    assert_allclose((alone.means, alone.variances), [[2.0], [1.0]])
    assert_allclose((both.means, both.variances), [[3.5], [(1.0 + 4.0 / 3.0) / 4]])
    assert Reference.of([one[:1]]) is None


def test_ratios_are_taken_round_by_round():
    """Where every round is twice as slow as the one before, the ratio is still exact."""
    ours, other = [1.0, 2.0, 4.0], [3.0, 6.0, 12.0]
    assert comparison.ratio(other, ours) == Spread(3.0, 3.0, 3.0, 3)
    assert comparison.ratio([1.0, np.nan], [2.0, 1.0]) == Spread(0.5, 0.5, 0.5, 1)
    assert comparison.ratio([np.nan], [1.0]) is None
    assert str(Spread.of([1.0, 2.0, 3.0, 4.0, 5.0])) == "3 (2 to 4)"


def runs(means, *, stated: float, cpu: float, finished: bool = True) -> list[Estimate]:
    """Of two quantities with posterior variance near 1, the second with thrice the errors of the first."""
    return [
        Estimate(np.array([m, 3 * m]), np.ones(2), stated, cpu, 2 * cpu, 1000, finished, log_evidence=5.0)
        for m in means
    ]


@pytest.fixture(scope="module")
def compared() -> dict:
    found = {
        "ours": runs([-0.1, 0.1], stated=200.0, cpu=8.0),
        "second": runs([-0.2, 0.2], stated=40.0, cpu=1.0),
        "stuck": runs([1.0, 1.0], stated=30.0, cpu=8.0, finished=False),
        "stopped": runs([np.nan, np.nan], stated=np.nan, cpu=9.0, finished=False),
    }
    return comparison.compared(["a", "b"], found, ["ours", "second"], {"gone": "gone is not installed"})


def test_the_quantity_that_errs_most_counts(compared):
    ours, second, stuck, stopped = compared["methods"]
    variance = 1.0
    assert ours["ess_shown_by"] == "b"
    assert ours["ess_shown"] == pytest.approx(variance / (9 * 0.02))
    assert ours["shown_per_cpu_s"] == pytest.approx(ours["ess_shown"] / 8.0)
    assert second["ess_shown"] == pytest.approx(variance / (9 * 0.08))
    error = 9 * (0.02 / 2 + 0.08 / 2) / 4
    assert compared["quantities"][1]["standard_error"] == pytest.approx(error**0.5)
    assert stuck["ess_shown"] == pytest.approx(variance / (9 - error))
    assert "ess_shown" not in stopped
    assert (ours["finished"], stuck["finished"]) == (2, 0)


def test_ratios_are_those_of_rates(compared):
    ours, second, stuck, stopped = compared["methods"]
    assert ours["ratio_stated"].median == 1.0
    assert second["ratio_stated"].median == pytest.approx((200 / 8) / (40 / 1))
    assert stuck["ratio_stated"].median == pytest.approx(200 / 30)
    assert stopped["ratio_stated"] is None
    assert second["evaluations_per_stated_draw"].median == pytest.approx(1000 / 40)
    # two runs resampled have the scatter of the two, or none and are dropped: the ratio is that of the rates
    rates = ours["shown_per_cpu_s"] / second["shown_per_cpu_s"]
    assert second["ratio_shown"].median == pytest.approx(rates)


def test_a_method_is_not_judged_by_itself():
    """Two references far apart: each is found wrong by the other."""
    found = {
        "ours": runs([-0.1, 0.1], stated=10.0, cpu=1.0),
        "other": runs([0.2, 0.4], stated=10.0, cpu=1.0),
    }
    ours, other = comparison.compared(["a", "b"], found, ["ours", "other"], {})["methods"]
    assert ours["ess_shown"] == pytest.approx(other["ess_shown"])
    alone = comparison.compared(["a", "b"], found, ["ours"], {})["methods"]
    assert alone[0]["judged_by_scatter_alone"]
    assert alone[0]["ess_shown"] == pytest.approx(1 / (9 * 0.02))
    assert alone[1]["ess_shown"] == pytest.approx(1 / (9 * (0.02 + 0.09 - 0.01 - 0.01)))


def test_ordered_points_of_the_cube_are_draws_of_the_prior(rng):
    posterior = problem_of(study(record(), terms=3)).posterior
    cube = UnitCube(posterior)
    points = samplers.ordered(posterior, rng.random((4000, posterior.dimension)))
    assert (np.diff(points[:, cube._orders[0]], axis=1) <= 0).all()
    points = points[cube.inside(cube.coordinates(points))]
    direct = cube.points(cube.coordinates(cube.draw(4000, rng)))
    for column in range(posterior.dimension):
        assert kstest(points[:, column], direct[:, column]).pvalue > 1e-4


def test_what_a_sampler_asks_is_counted_and_its_time_ends():
    posterior = problem_of(study(record())).posterior
    counted = samplers.Counted(posterior, budget=np.inf)
    coordinates = counted.coordinates(np.full((3, posterior.dimension), 0.5))
    assert_allclose(
        counted.log_likelihood(coordinates), posterior.log_likelihood(posterior.values(coordinates))
    )
    counted.log_density(coordinates)
    assert counted.evaluations == 6
    with samplers.counting(counted):  # whoever asks for responses or slopes of plants
        Conditional(posterior, delays=True).expanded(posterior.values(coordinates))
    assert counted.evaluations == 9
    counted.budget = -1.0
    with pytest.raises(samplers.OutOfTimeError):
        counted.log_likelihood(coordinates)
    assert not counted.nothing(2).usable


@pytest.mark.parametrize("method", forward.METHODS, ids=lambda method: method.name)
def test_every_forward_method_converges_to_the_exact_response(method):
    if method.needs:
        pytest.importorskip(method.needs)
    coarse, fine = (forward.errors(method, n, method.prepared(n)())[1] for n in (128, 512))
    assert fine < (0.35 * coarse if method.needs != "control" else 1e-3)
    assert coarse < 1e-2


def test_an_error_is_seen():
    method = forward.METHODS[0]
    values = method.prepared(128)()
    assert forward.errors(method, 128, values + 0.01)[0] == pytest.approx(0.01, rel=0.05)


def test_sizes_out_of_reach_are_left_out_with_the_reason():
    dense = next(method for method in forward.METHODS if "triangular" in method.name)
    assert forward.out_of_reach(dense, 1024, None, 1.0, 1e3) is None
    assert forward.out_of_reach(dense, 1024, None, 1.0, 10.0) == "needs 0.0336 GB"
    assert "would take about 0.84 s" in str(forward.out_of_reach(dense, 1024, (512, 0.183), 0.5, 1e3))
    assert forward.out_of_reach(dense, 1024, (512, 0.01), 0.5, 1e3) is None
    absent = forward.Method("none", lambda n: lambda: np.zeros(n), needs="no_such_package")
    assert forward.out_of_reach(absent, 8, None, 1.0, 1.0) == "no_such_package is not installed"


def test_time_goes_to_the_innermost_stage_and_to_the_likelihood_within_it():
    now = iter(range(100))
    watch = probe.Probe(clock=lambda: float(next(now)))  # one second from event to event
    inner = watch.likelihood("ForwardModel.unit_responses", lambda model, dynamics: None)
    outer = watch.likelihood("Simulation.__call__", lambda simulation, values: inner(None, None))
    plain = watch.likelihood(
        "ForwardModel.unit_slopes", lambda model, dynamics: watch.stage("page", lambda: None)()
    )
    watch.stage("sampling", lambda: outer(None, [0, 0, 0]))()
    plain(None, SimpleNamespace(batch=4))
    found = watch.results()
    assert found["stages"] == {"start": [3.0, 2.0], "sampling": [2.0, 3.0], "page": [1.0, 0.0]}
    assert (found["likelihood_s"], found["process_s"]) == (5.0, 11.0)
    assert (found["plants"], found["plants_with_slopes"]) == (7, 4)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere workers are children of the command")
def test_what_workers_take_is_counted(tmp_path):
    """Two that are busy for half a second each, forks of a process that outlives the command."""
    (tmp_path / "busy.py").write_text(
        "import time\n\ndef busy(shared, one):\n    while time.process_time() < 0.5: pass\n"
    )
    code = (
        "from busy import busy\nfrom lcopa_bayes.core.parallel import workers\n"
        "with workers(None, jobs=2) as crew: list(crew.each(busy, range(2)))"
    )
    environment = dict(os.environ) | {"PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    idle = "import lcopa_bayes.core.parallel"
    (_, alone), *_ = verbs.observed([sys.executable, "-c", idle], environment, tmp_path, 60, 60)
    command = [sys.executable, "-c", code]
    (_, spent), ended, _, problems = verbs.observed(command, environment, tmp_path, 60, 60)
    assert (ended, problems) == (0, "")
    assert spent > alone + 0.9


def test_what_is_watched_is_there():
    """A renamed function would leave its time unnamed."""
    code = (
        "import json, importlib, probe; watch = probe.Probe(); "
        "[watch.watch(importlib.import_module(name)) for name in {*probe.LIKELIHOOD, *probe.STAGES}]; "
        "print(json.dumps(watch.missing))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=FOLDER, capture_output=True, text=True, check=True
    )
    assert json.loads(done.stdout) == []


def test_every_verb_is_measured_on_every_study_and_after_what_it_needs():
    cells = verbs.cells(verbs.SOURCES)
    places = [cell.place for cell in cells]
    assert len(set(places)) == len(places)
    assert {cell.verb for cell in cells} == set(VERBS) - {*verbs.APART}
    for source in verbs.SOURCES:
        of = {verb for verb, name in places if name == source.name}
        assert of | {"simulate"} == set(VERBS) - {*verbs.APART, *verbs.WITHOUT_STUDY}
        for verb in verbs.ON_FIT:
            assert places.index(("fit", source.name)) < places.index((verb, source.name))
        if source.folder is None:
            assert places.index(("simulate", source.name)) < places.index(("fit", source.name))
            assert source.campaign.is_file()


def test_cells_asked_for_come_with_what_makes_their_study():
    cells = [cell.place for cell in verbs.cells(verbs.SOURCES) if verbs.wanted(cell, ("fit",), ("rich",))]
    assert cells == [("simulate", "rich"), ("fit", "rich")]
    assert all(verbs.wanted(cell, (), ()) for cell in verbs.cells(verbs.SOURCES))


def test_share_of_the_likelihood_in_sampling():
    stages = {"search": [1.0, 2.0], "walkers": [0.0, 1.0], "page": [9.0, 9.0]}
    assert verbs.share_of_sampling(stages) == 0.75
    assert verbs.share_of_sampling({"page": [9.0, 9.0]}) is None


def test_measured_records_are_added_where_there_are_any(tmp_path, monkeypatch):
    monkeypatch.setenv("LCOPA_BAYES_DATA", str(tmp_path))
    assert verbs.sources() == verbs.SOURCES
    there = tmp_path / "records" / verbs.MEASURED[0]
    there.mkdir(parents=True)
    (there / "study.toml").touch()
    assert [each.name for each in verbs.sources()[len(verbs.SOURCES) :]] == [verbs.MEASURED[0]]


def test_a_cell_is_run_measured_and_its_study_completed(tmp_path):
    source = verbs.SOURCES[1]
    shop = verbs.Workshop(tmp_path, quick=True)
    one = shop.measured(verbs.Cell("simulate", source), 120.0, np.inf)
    assert (one.outcome, one.message) == ("done", "")
    assert one.wall > 0 < one.cpu
    assert one.probe["peak_MB"] > 20
    assert 0.5 * one.cpu < one.probe["process_s"] < 1.05 * one.cpu  # that of its end is not in it
    assert source.model in (tmp_path / "studies" / source.name / "study.toml").read_text()
    fit = shop.arguments(verbs.Cell("fit", source))
    assert fit[:2] == ["fit", str(tmp_path / "studies" / source.name)]
    assert {"--quick", "--jobs", "--json"} <= set(fit)
    predict = shop.arguments(verbs.Cell("predict", source))
    drive = Path(predict[2]).read_text().splitlines()
    assert drive[0] == "time_ms,drive_x_rad"
    assert len(drive) == 252  # of the record held out, which is named last
    time = shop.arguments(verbs.Cell("design", source))
    assert float(time[time.index("--time") + 1]) == pytest.approx(1000 * 0.1)
    assert not shop.ready(verbs.Cell("audit", source))


def test_a_verb_that_is_refused_or_stopped_says_so(tmp_path):
    shop = verbs.Workshop(tmp_path)
    (tmp_path / "studies" / "correlated").mkdir(parents=True)
    (tmp_path / "studies" / "correlated" / "study.toml").write_text("[nothing]\n")
    refused = shop.measured(verbs.Cell("look", verbs.SOURCES[1]), 60.0, np.inf)
    assert refused.outcome == "refused"
    assert "nothing" in refused.message
    late = shop.measured(verbs.Cell("optics", None), 60.0, 0.05)
    stopped = shop.measured(verbs.Cell("optics", None), 1.0, np.inf)
    assert (late.outcome, stopped.outcome, stopped.probe) == ("stopped", "stopped", {})
    assert late.cpu < 0.5 < stopped.cpu < 2.0
    row = verbs.row_of(verbs.Cell("optics", None), [stopped], [])
    assert (row["runs"], row["cpu_s_at_least"]) == (0, stopped.cpu)


def measurement(cpu: float, yardstick: float = 0.5, outcome: str = "done", ess: float | None = None):
    counts = {
        **{"plants": 600, "plants_with_slopes": 200, "likelihood_s": 3.0, "process_s": 4.0},
        **{"stages": {"import": [1.0, 0.0], "page": [0.0, 3.0]}, "missing": [], "peak_MB": 100.0},
    }
    results = {} if ess is None else {"smallest_ess": ess, "target_ess": 400, "method": "m", "grade": "good"}
    return verbs.Measurement(2 * cpu, cpu, yardstick, outcome, "", counts, results)


@pytest.fixture(scope="module")
def result() -> dict:
    """Of a fit and an audit in three rounds, each slower than the last; the second audit was stopped."""
    source = verbs.SOURCES[0]
    fits = [measurement(cpu, ess=300.0) for cpu in (2.0, 4.0, 8.0)]
    audits = [measurement(1.0), measurement(9.0, outcome="stopped"), measurement(4.0)]
    rows = [
        verbs.row_of(verbs.Cell("fit", source), fits, fits),
        verbs.row_of(verbs.Cell("audit", source), audits, fits),
    ]
    left_out = {"verb": "loop", "study": source.name, "outcome": "left out", "message": "no time", "runs": 0}
    return {"jobs": 1, "rounds": 3, "studies": [source.name], "rows": [*rows, left_out]}


def test_rows_hold_ratios_to_the_fit_of_the_same_round(result):
    fit, audit, _ = result["rows"]
    assert fit["cpu_s"] == Spread(4.0, 3.0, 6.0, 3)
    assert fit["yardsticks"].median == 8.0
    assert fit["plants_per_draw"] == 2.0
    assert (fit["likelihood_share"], fit["grade"]) == (0.75, "good")
    assert "of_fit" not in fit
    assert audit["of_fit"] == Spread(0.5, 0.5, 0.5, 2)
    assert audit["runs"] == 2


def test_page_and_figures_show_every_row(result, compared, tmp_path):
    rows = [
        {"method": "a", "blocks": 128, "reason": "needs 8 GB"},
        {
            **{"method": "b", "blocks": 128, "reason": None, "error": 1e-3, "error_rms": 1e-4},
            **{"memory_MB": 2.0, "cpu_s": Spread.of([1e-3]), "ratio": Spread.of([2.0, 4.0])},
        },
    ]
    easy = compared | {"dimension": 2, "cpu_s_allowed": 1.0}
    results = comparison.plain(
        {
            **{"quick": True, "machine": "A machine.", "software": "Python.", "settings": {"ours": "set"}},
            **{"forward": rows, "samplers": {"easy": easy}, "verbs": result},
        }
    )
    json.dumps(results, allow_nan=False)
    earlier = json.loads(json.dumps(results["verbs"]))
    earlier["rows"][0]["yardsticks"]["median"] = 24.0
    text = page.page(results, {"verbs": earlier})
    assert "A quick run" in text
    assert "| a | 128 | needs 8 GB |  |" in text
    assert "3 (2.5 to 3.5)" in text
    assert "| gone: gone is not installed |" in text
    assert "| one-term | audit | 5 (3.5 to 6.5) | 2.5 (1.75 to 3.25) |" in text
    assert "Left out, no time: loop one-term." in text
    assert "| one-term | fit | 24 | 8 | 3 |" in text
    assert "| page | 3 |" in text
    tables = [part for part in text.split("\n\n") if part.startswith("|")]
    for table in tables:
        assert len({line.count("|") for line in table.splitlines()}) == 1
    for name in ("forward", "samplers", "verbs"):
        getattr(plots, name)(results[name], tmp_path / f"{name}.svg")
        assert "</svg>" in (tmp_path / f"{name}.svg").read_text()


@pytest.mark.parametrize("overstated", [1.0, 4.0])
def test_the_scatter_of_fits_shows_what_their_stated_errors_are_worth(overstated, rng, tmp_path):
    """Fits of 400 independent draws, a fifth of them in a second mode, that state so many times as many."""
    fits = []
    for _ in range(200):
        second = rng.random(400) < 0.2
        draws = rng.normal(np.where(second, 8.0, 0.0), 1.0)[:, None]
        share = np.array([(~second).mean(), second.mean()])
        errors = np.sqrt(share * (1 - share) / (400 * overstated))
        modes = {"a": {"boundaries": [4.0], "shares": share.tolist(), "errors": errors.tolist()}}
        worth = np.array([400.0 * overstated])
        fits.append({"names": ["a"], "draws": draws, "bulk": worth, "tail": worth, "modes": modes})
    rows = scatter.scattered(fits)
    assert [row["quantity"] for row in rows] == [
        "5 %",
        "50 %",
        "95 %",
        "mean",
        "share of mode 1",
        "share of mode 2",
    ]
    assert_allclose([row["ratio"] for row in rows], np.sqrt(overstated), rtol=4 / np.sqrt(2 * 200))
    scatter.drawn({"a": {"rows": rows, "fits": 200}}, tmp_path / "scatter.svg")
    assert "share" in (tmp_path / "scatter.svg").read_text()


def test_jobs_are_counted_against_what_is_wanted():
    """One within its limit, one beyond it, one that did not end, one in fits of its study."""
    row = {"study": "s", "cpu": 1.0, "outcome": "done", "grade": None, "smallest_ess": None, "unit": ""}
    rows = [
        row | {"verb": "fit", "wanted": 5, "took": 4.0, "wall": 4.0, "grade": "reliable"},
        row | {"verb": "design", "wanted": 5, "took": 6.0, "wall": 6.0},
        row | {"verb": "audit", "wanted": 5, "took": 1.0, "wall": 1.0, "outcome": "stopped"},
        row | {"verb": "compare", "wanted": 3, "took": 2.5, "wall": 10.0, "unit": "fits"},
    ]
    rows[0] |= {"smallest_ess": 412.4, "target_ess": 400.0}
    text = targets.text_of(rows, "A machine.")
    assert "| fit | s | 5 s | 4.0 | 4.0 | 1.0 | reliable | 412 of 400 |" in text
    assert "| compare | s | 3 fits | 2.5 | 10.0 | 1.0 |  |  |" in text
    assert "| audit | s | 5 s | 1.0 | 1.0 | 1.0 | stopped |  |" in text
    assert text.endswith("\n2 of 4 within what is wanted.\n")


def test_jobs_are_verbs_of_known_studies():
    known = {one.name for one in verbs.SOURCES} | set(verbs.MEASURED)
    assert all(verb in VERBS and study in known for verb, study, _, _ in targets.WANTED)


def test_plants_are_counted_however_a_response_is_called():
    """Every argument a response takes, by place or by name."""
    for name, count in probe.PLANTS.items():
        kind, method = name.split(".")
        for module in probe.LIKELIHOOD:
            own = getattr(importlib.import_module(module), kind, None)
            if own is not None:
                rest = list(inspect.signature(getattr(own, method)).parameters.values())[2:]
                at = [None for one in rest if one.kind is not one.KEYWORD_ONLY]
                by_name = {one.name: None for one in rest if one.kind is one.KEYWORD_ONLY}
                assert (
                    count(None, SimpleNamespace(batch=1) if "Forward" in kind else [0], *at, **by_name) == 1
                )


@pytest.mark.slow
def test_growth_is_measured_in_processes_of_their_own_and_drawn(tmp_path, capsys):
    rows = growth.measured(["response", "csv", "quick fit"], [1000], 300.0)
    late = growth.measured(["response"], [2000], 0.1)
    assert [row["task"] for row in rows] == ["response", "csv", "quick fit"]
    assert all(0.0 < row["memory_MB"] < 1000.0 for row in rows)
    assert 0.0 < rows[0]["response_s"] < rows[0]["slopes_s"] < rows[2]["fit_s"]
    assert late[0]["reason"] == "took more than 0.1 s"
    assert rows[2]["least_ess"] > 100
    said = growth.page([*rows, *late, rows[2] | {"losses": ["Means of 5 samples lose little."]}])
    assert said.count("| quick fit | 1,000 |") == 2
    assert "| response | 2,000 | took more than 0.1 s |" in said
    assert "- 1,000 samples: Means of 5 samples lose little." in said
    growth.drawn([*rows, *late], tmp_path / "growth.svg")
    assert "peak memory" in (tmp_path / "growth.svg").read_text()


def test_memory_is_that_of_the_process_and_not_of_the_one_that_started_it():
    """That of a process of its own is the same below one that holds 400 MB."""
    held = np.ones(50_000_000)
    code = "import sys; sys.path.insert(0, sys.argv[1]); import growth; print(growth.peak_memory())"
    words = [sys.executable, "-c", code, str(Path(growth.__file__).parent)]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert held.nbytes / 1e6 > float(done.stdout) > 50.0


@pytest.mark.slow
def test_a_growth_record_of_means_states_its_loss(monkeypatch):
    monkeypatch.setattr(growth, "WHOLE", 500)
    row = growth.fitted(1000, quick=True)
    assert row["count"] == 2
    for one, count in zip(row["losses"], (2, 4), strict=True):
        assert one.startswith(f"Means of {count} samples")
    assert row["memory_MB"] >= row["loss_MB"] > 0


def test_the_cost_of_an_effect_is_that_of_the_plants_with_it():
    """Many plants and one at a time respond alike; a pair has a line of the table, each a stored row."""
    study, device = effects.campaign_study(2)
    every = effects.tried()
    assert ("outliers",) not in every
    assert {("cubic_stiffness",), ("clock_skew", "rise_fall_asymmetry")} <= set(every)
    rows = [
        effects.measured(names, study, device, plants=8, rounds=2)
        for names in (("odd_curvature",), ("voltage_knee", "cubic_stiffness"))
    ]
    assert all(one.differs < effects.SAME for one in rows)
    assert all(one.over_plain.count == one.over_alone.count == 2 for one in rows)
    assert "| voltage_knee, cubic_stiffness |" in effects.report(rows, 8)
    stored = json.loads(json.dumps(effects.stored(rows), allow_nan=False))
    assert [one["names"] for one in stored] == [list(one.names) for one in rows]


def test_plants_near_a_device_respond_as_it_does():
    """Second method: records of the bench, which a hundredth of every number moves by as much."""
    study, device = effects.campaign_study(2)
    posterior = problem_of(study).posterior
    values = effects.near_device(posterior.table, device, 3, np.random.default_rng(0))
    gains = posterior.table.gains(values)
    assert_allclose(gains[:, 0, 1], device.paths[0][1].steady, rtol=0.05)
    for k in range(3):
        for r, samples in enumerate(posterior.samples):
            units = effects.responses(posterior, values)[r][:, k]
            for axis, observed in enumerate(samples.axes):
                moved = sum(
                    gains[k, axis, j] * units[unit]
                    for j, unit in enumerate(posterior.table.layout.unit_of[axis])
                )[observed.index]
                own = observed.values - device.offsets[axis]
                assert np.std(own - moved) < 1.2 * NOISE + 0.05 * np.std(own)
