"""What audit, design, comparison and calibration take from a study with effects, each by a second method."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from small import record, study, with_effect

import lcopa_bayes as lb
from lcopa_bayes.bench.command import Command, staircase
from lcopa_bayes.calibration.replica import exact_responses, model_gap
from lcopa_bayes.calibration.truths import Truths
from lcopa_bayes.cli import main
from lcopa_bayes.comparison.candidates import candidates_of, derived, known_settings
from lcopa_bayes.data.settings import EffectsSettings, PriorSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.data.studywriter import write_study
from lcopa_bayes.experiments.information import Bench, refit
from lcopa_bayes.identifiability.curvature import sensitivities
from lcopa_bayes.identifiability.profile import profile
from lcopa_bayes.identifiability.symmetries import DIFFERENCED, structure
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.likelihood import Landscape
from lcopa_bayes.inference.nestedmodels import lifted
from lcopa_bayes.inference.simulation import Simulation
from lcopa_bayes.results.fit import plan_of
from lcopa_bayes.results.nearby import surrogate_about
from lcopa_bayes.sampling.weightedrun import weighted_run

TRUTH = {
    "gain": 2.0, "time": 1.5, "order": 0.8, "delay": 0.73, "offset": 0.3, "sigma": 0.02, "coefficient": 0.4,
}  # fmt: skip


def campaign() -> Study:
    commands = [staircase([a, -0.7 * a, 0.4 * a, 0.0], hold=3.0, start=0.55) for a in (1.0, 0.5)]
    made = [record(k, command=c, camera=0.3, duration=15.0, name=f"r{k}") for k, c in enumerate(commands)]
    return study(*made, noise="white", seed=4)


@pytest.fixture(scope="module")
def stiff() -> tuple[Problem, np.ndarray]:
    made, truth = with_effect(campaign(), ["cubic_stiffness"], TRUTH)
    return problem_of(made), truth


def test_a_climb_with_the_effect_held_is_a_profile(stiff: tuple[Problem, np.ndarray]):
    """The maximum is no lower than the truth; held to either side it is lower by about as much."""
    problem, truth = stiff
    landscape = Landscape(problem.posterior)
    k = problem.posterior.table.names.index("cubic_stiffness.c")
    best = landscape.maximise(truth)
    assert best.log_likelihood > float(landscape.log_likelihood(truth[None])[0])
    apart = []
    for step in (-0.05, 0.05):
        start = best.values.copy()
        start[k] += step
        held = landscape.maximise(start, held=k)
        assert held.values[k] == start[k]
        apart.append(best.log_likelihood - held.log_likelihood)
    assert min(apart) > 0.2
    assert apart[0] == pytest.approx(apart[1], rel=0.5)


@pytest.mark.slow
def test_profiles_by_a_surrogate_are_those_of_the_posterior(
    stiff: tuple[Problem, np.ndarray], monkeypatch: pytest.MonkeyPatch
):
    """Its maxima are found by the surrogate, its heights are the posterior's: one response per point."""
    problem, _ = stiff
    found = weighted_run(problem.posterior, plan_of(problem, quick=True), quick=True)
    assert found is not None
    draws, exact = found[1], Landscape(problem.posterior)
    surrogate = surrogate_about(problem.posterior, draws, np.random.default_rng(2))
    assert surrogate is not None
    near = Landscape.about(replace(problem.posterior, surrogate=surrogate), draws.flat)
    simulated, called = [], Simulation.__call__
    monkeypatch.setattr(Simulation, "__call__", lambda self, v: simulated.append(len(v)) or called(self, v))
    best = draws.flat[np.argmax(draws.log_density)]
    k, profiles = problem.posterior.table.names.index("cubic_stiffness.c"), []
    step = 0.1 * float(draws.column("cubic_stiffness.c").std())
    for landscape in (exact, near):
        simulated.clear()
        profiles.append(profile(landscape, k, landscape.maximise(best), draws.thinned(50), step))
    assert sum(simulated) <= len(profiles[1].values)
    (low, high), ends = profiles[0].intervals[0.9], profiles[1].intervals[0.9]
    assert_allclose(ends, (low, high), atol=0.05 * (high - low))  # type: ignore[operator]
    assert profiles[1].best == pytest.approx(profiles[0].best, abs=0.05)


def test_a_symmetry_is_seen_through_differences(stiff: tuple[Problem, np.ndarray]):
    """None with two heights of the drive; a drive that never moves hides gain, element and effect."""
    problem, truth = stiff
    rng = np.random.default_rng(1)
    points = [
        sensitivities(Landscape(problem.posterior), truth * (1 + 0.02 * rng.random(truth.size)))
        for _ in range(3)
    ]
    found = structure(
        points[0].names, [p.relative() for p in points], [p.values for p in points], tolerances=DIFFERENCED
    )
    assert found.certain
    assert found.rank == found.parameters == 7
    doubled = [np.column_stack([p.relative(), p.relative()[:, -1]]) for p in points]
    twice = structure(
        (*points[0].names, "again"),
        doubled,
        [np.append(p.values, p.values[-1]) for p in points],
        tolerances=DIFFERENCED,
    )
    assert twice.rank == 7
    assert twice.blind == {"cubic_stiffness.c", "again"}


def test_information_of_a_new_drive_holds_the_effect(stiff: tuple[Problem, np.ndarray]):
    """White slopes against differences of the simulated device's responses."""
    problem, truth = stiff
    bench = Bench(problem, 12.0, 0.3)
    assert bench.names[-1] == "cubic_stiffness.c"
    command = Command(np.array([0.6, 5.1]), np.array([[0.9], [-0.4]]), np.zeros(1))
    (slopes,) = bench.slopes(truth, command, {})
    up, down = truth.copy(), truth.copy()
    k = bench.columns[-1]
    up[k] += 1e-3
    down[k] -= 1e-3
    sides = [bench.responses(values, command, bench.sample_times)[:, 0] for values in (up, down)]
    change = (sides[0] - sides[1]) / 2e-3 / TRUTH["sigma"]
    level = np.full(change.size, 1 / np.sqrt(change.size))
    assert_allclose(slopes[-1], change - (change @ level) * level, atol=2e-3 * np.abs(change).max())


def test_a_refit_keeps_what_deflections_are_counted_in(stiff: tuple[Problem, np.ndarray]):
    problem, _ = stiff
    smaller = record(7, command=staircase([0.2], hold=3.0, start=0.55), camera=0.3, duration=12.0, name="new")
    again = refit(problem, smaller, Bench(problem, 12.0, 0.3))
    assert problem.ranges is not None
    assert again.ranges is not None
    assert_allclose(again.ranges.response, problem.ranges.response)


def test_candidates_with_and_without(stiff: tuple[Problem, np.ndarray]):
    problem, _ = stiff
    reported = candidates_of(problem.study)
    assert [one.name for one in reported] == ["study", "study-no-effects"]
    assert [one.study.effects.use for one in reported] == [("cubic_stiffness",), ()]
    assert "cubic_stiffness" in reported[0].about
    assert "no effects" in reported[1].about
    priced = replace(problem.study, priors={})
    richer = derived(priced, known_settings("fractional-2", priced))
    assert richer.study.effects.use == ("cubic_stiffness",)


def test_the_plant_alone_is_contained_in_the_one_with_an_effect(stiff: tuple[Problem, np.ndarray]):
    problem, truth = stiff
    plain = problem_of(candidates_of(problem.study)[1].study).posterior
    values = truth[: len(plain.table.rows)][None]
    inside = lifted(values, plain, problem.posterior, np.random.default_rng(0))
    assert inside is not None
    assert_allclose(
        problem.posterior.joint_log_likelihood(inside), plain.joint_log_likelihood(values), rtol=1e-10
    )
    assert lifted(truth[None], problem.posterior, plain, np.random.default_rng(0)) is None


def test_records_of_a_calibration_have_the_effect(stiff: tuple[Problem, np.ndarray]):
    """Simulated on finer blocks: close to the study's own, far from the plant without."""
    problem, truth = stiff
    exact = exact_responses(problem, truth)
    assert model_gap(problem, truth, exact) < 1.0
    off = truth.copy()
    off[-1] = 0.0
    assert model_gap(problem, off, exact) > 20.0
    drawn = Truths(problem.posterior.table).draw(np.random.default_rng(1))
    assert drawn.shape == truth.shape


@pytest.mark.parametrize("verb", ["fit", "audit", "design", "compare", "loop", "calibrate"])
def test_effects_that_cannot_be_used_end_with_code_2_and_nothing_written(
    verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    uses = EffectsSettings(use=("cubic_stifness", "axis_rotation"))
    priors = {"ion_creep.k": PriorSettings("ion_creep.k", fixed=0.1)}
    (tmp_path / "in").mkdir()
    write_study(replace(campaign(), effects=uses, priors=priors), tmp_path / "in" / "study.toml")
    out = tmp_path / "out"
    assert main([verb, str(tmp_path / "in"), "--out", str(out), "--jobs", "1", "--quiet"]) == 2
    said = capsys.readouterr().err
    assert "did you mean 'cubic_stiffness'?" in said
    assert "'axis_rotation' has no place" in said
    assert "'ion_creep' is not used" in said
    assert not out.exists()


@pytest.mark.slow
def test_verbs_on_a_finished_fit_with_effects_take_few_simulations(
    stiff: tuple[Problem, np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Audit, comparison and prediction rest on the draws of the fit, and the effect is preferred."""
    explained = stiff[0].study
    plain = replace(explained, name="plain", effects=EffectsSettings(), priors={})
    lb.fit(explained, quick=True, folder=tmp_path / "fit")
    simulated, called = [], Simulation.__call__
    monkeypatch.setattr(Simulation, "__call__", lambda self, v: simulated.append(len(v)) or called(self, v))
    verdicts = lb.audit(tmp_path / "fit").summary().set_index("parameter")["verdict"]
    assert verdicts["cubic_stiffness.c"] == "identified"
    assert sum(simulated) < 1_500
    simulated.clear()
    compared = lb.compare([plain, tmp_path / "fit"], quick=True)
    assert sum(simulated) < 6_000
    assert compared.preferred == explained.name
    simulated.clear()
    drive = lb.Drive.steps(u=[(0, 0.5), (4.0, 0.0)])
    lb.load_result(tmp_path / "fit").predict(drive)
    assert 0 < sum(simulated) <= 400
