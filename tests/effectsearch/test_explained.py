"""The loop closes: what it found is a study, and a fit of it gives the numbers it reported."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from time import monotonic
from types import SimpleNamespace

import numpy as np
import pytest
import small
from small import path, record
from test_loop import LIBRARY, study

from lcopa_bayes.bench.command import on_off
from lcopa_bayes.bench.device import Device
from lcopa_bayes.cli import main
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.record import Axis
from lcopa_bayes.data.settings import NoiseSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.data.studyfile import load_study
from lcopa_bayes.data.studywriter import write_study
from lcopa_bayes.effectsearch import explained
from lcopa_bayes.effectsearch.explained import (
    _sampled,
    constant_about,
    coordinates_of,
    explained_draws,
    explained_study,
)
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.effectsearch.loopresult import Loop
from lcopa_bayes.effectsearch.summary import results
from lcopa_bayes.identifiability.audit import audit
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.optimum import find_optima
from lcopa_bayes.model.effects.commands import OverdrivePulse, RefreshHold
from lcopa_bayes.model.effects.records import Vibration
from lcopa_bayes.report.pages import write_page_of
from lcopa_bayes.results.fit import Fit, fit
from lcopa_bayes.sampling.convergence import Limitation
from lcopa_bayes.sampling.run import SamplePlan

loops = sys.modules[loop.__module__]


def short(seed: int, **changes: float) -> Study:
    """Of two fitted records."""
    made = study(seed, **changes)
    return replace(made, fit=made.fit[:2])


@pytest.fixture(scope="module")
def bent() -> Loop:
    return loop(study(1, curvature=0.08), library=LIBRARY, quick=True, as_stated=True)


@pytest.fixture(scope="module")
def again(bent: Loop, tmp_path_factory: pytest.TempPathFactory) -> Fit:
    path = tmp_path_factory.mktemp("run") / "explained.toml"
    write_study(bent.study, path)
    return fit(load_study(path), quick=True)


def test_a_fit_of_the_explained_study_gives_the_numbers_of_the_loop(bent: Loop, again: Fit):
    """Draws of both are independent: four standard errors of a normal distribution's quantiles."""
    reported = {one.name: one for one in again.draws.estimates()}
    model = bent.after.state.model
    assert bent.names == ("odd_curvature",)
    for k in range(len(model.names)):
        own = bent.estimate(k)
        there = reported[own["name"]]
        sd = (there.upper - there.lower) / (2 * 1.645)
        error = sd * np.sqrt(1 / there.ess + 1 / own["ess"]) * np.array([2.11, 1.25, 2.11])
        apart = np.array(own["alone"]) - [there.lower, there.value, there.upper]
        assert (np.abs(apart) < 4 * error).all(), own["name"]


def test_numbers_are_no_more_reliable_than_the_verdict_they_rest_on(bent: Loop):
    assert bent.draws is not None
    well = replace(bent, draws=replace(bent.draws, target_ess=50.0, limitations=()))
    for confidence, level in (("firm", "reliable"), ("tentative", "tentative")):
        said = replace(well, verdict=replace(well.verdict, confidence=confidence))
        numbers = results(said)
        grades = {one["grade"] for one in (*numbers["parameters"], *numbers["figures"])}
        assert (numbers["grade"], grades) == (level, {level})


def test_draws_are_spared_where_normal_ones_about_the_optimum_are_of_no_use(bent: Loop, monkeypatch):
    """They have the moments of the draws of a fit."""
    assert bent.draws is not None
    monkeypatch.setattr(explained, "weighted_run", None)  # no call of it would end
    drawn = explained_draws(bent.study, lambda draws, noise: False, quick=True)
    assert drawn is not None
    rows = [k for k, row in enumerate(bent.draws.table.rows) if row.free and not row.noise]
    normal, own = drawn[0].flat[:, rows], bent.draws.flat[:, rows]
    assert np.isfinite(drawn[0].flat).all()
    apart = np.abs(normal.mean(axis=0) - own.mean(axis=0)) / own.std(axis=0)
    assert apart.max() < 4 / np.sqrt(len(normal))
    assert np.abs(normal.std(axis=0) / own.std(axis=0) - 1).max() < 4 / np.sqrt(2 * len(normal))


def test_draws_begin_where_the_search_ended(bent: Loop, monkeypatch):
    """No search for the optimum; without a place to begin there is one, which leads to the same draws: a
    descent ends where no step gains 0.02 nat, a fifth of a standard deviation from the optimum."""
    state, asked = bent.after.state, []
    names = state.model.posterior.table.names
    known = dict(zip(names, state.model.values(state.optimum.x).tolist(), strict=True))
    start = explained.weighted_start
    monkeypatch.setattr(
        explained, "weighted_start", lambda *given, **how: asked.append(1) or start(*given, **how)
    )
    drawn, searches = [], []
    for near in (known, None):
        drawn.append(explained_draws(bent.study, lambda draws, noise: False, near=near, quick=True))
        searches.append(len(asked))
    assert searches == [0, 1]
    rows = [k for k, row in enumerate(drawn[0][0].table.rows) if row.free and not row.noise]
    flat = [one[0].flat[:, rows] for one in drawn]
    apart = np.abs(flat[0].mean(axis=0) - flat[1].mean(axis=0)) / flat[1].std(axis=0)
    assert apart.max() < 0.2 + 4 * np.sqrt(2 / len(flat[0]))


def test_it_agrees_with_the_descent_of_the_loop(bent: Loop):
    """Another noise model and a linearisation: within half a standard deviation of each other."""
    state = bent.after.state
    assert bent.draws is not None
    drawn = coordinates_of(state.model, bent.draws)
    apart = (np.median(drawn, axis=0) - state.optimum.x) / drawn.std(axis=0)
    assert np.abs(apart).max() < 0.5
    size = np.sqrt(np.diag(state.optimum.covariance)) / drawn.std(axis=0)
    assert size.min() > 0.7
    assert size.max() < 1.4


def test_what_the_loop_descends_is_the_posterior_of_the_explained_study(bent: Loop):
    """Two methods to the residual at one place: effects put beside a plant, or declared in a study."""
    state, made = bent.after.state, problem_of(bent.study).posterior
    assert bent.problem.refinement == 1
    values = dict(zip(state.model.posterior.table.names, state.model.values(state.optimum.x), strict=True))
    there = np.array([values.get(row.name, 1.0) for row in made.table.rows])
    least = LeastSquares(made, held=state.whitening.held)
    residual = least.misfit(least.coordinates(there), there)
    own = state.model.least(state.whitening.held).misfit(state.optimum.x, state.model.template)
    np.testing.assert_allclose(residual, own, atol=1e-9)
    np.testing.assert_allclose(own[: made.size], -state.optimum.white, atol=1e-9)


def test_the_truth_lies_within(again: Fit):
    """``y + 0.08 y^3`` in units of the largest deflection."""
    assert again.problem.ranges is not None
    scale = again.problem.ranges.response[0]
    (own,) = [one for one in again.draws.estimates() if one.name == "odd_curvature.c"]
    assert abs(own.value - 0.08 * scale**2) < 4 * own.sd


def test_held_out_records_are_predicted_to_the_noise(again: Fit):
    (band,) = [one for one in again.bands if one.held_out]
    assert band.rmse < 1.2 * 5e-3
    assert 0.8 < band.coverage(0.9) <= 1.0


def test_an_audit_of_the_explained_study_is_of_the_same_effect(again: Fit):
    """Ends of the profile are those of the draws where the prior says little."""
    found = {one.profile.parameter: one for one in audit(again).findings}["odd_curvature.c"]
    (own,) = [one for one in again.draws.estimates() if one.name == "odd_curvature.c"]
    assert "identified" in found.verdict
    ends = found.profile.intervals[0.9]
    np.testing.assert_allclose(ends, (own.lower, own.upper), atol=0.5 * own.sd)  # type: ignore[arg-type]


def test_constants_are_free_about_where_the_loop_left_them(bent: Loop):
    """But those of the noise and of clocks; coefficients of single records share a prior, and an explained
    study is not explained twice."""
    state = bent.after.state
    listed = OverdrivePulse.grid(state.model.effected.ranges)
    model = state.model.having(OverdrivePulse(listed[5].frame), Vibration(0.21), RefreshHold(1.0, 0.5))
    made = explained_study(bent.problem.study, model)
    assert made.effects.use == ("overdrive_pulse", "vibration", "refresh_hold")
    table = problem_of(made).posterior.table
    rows = {row.name: row for row in table.rows}
    ends = rows["overdrive_pulse.frame"].prior.frozen.support()  # type: ignore[union-attr]
    assert ends == pytest.approx((listed[3].frame, listed[7].frame))
    assert rows["vibration.frequency"].value == 0.21
    assert rows["refresh_hold.refresh"].value == 1.0
    past = constant_about(listed[0], "frame", listed[-1].frame + 1.0, model.effected.ranges)
    assert past.fixed == listed[-1].frame + 1.0
    scale = 0.005 * model.effected.ranges.response[0]
    assert rows["vibration.a[r2]"].prior.parameters["scale"] == pytest.approx(scale)  # type: ignore[union-attr]
    assert explained_study(made, model).name == made.name == "small-explained"


@pytest.mark.parametrize(
    ("level", "searches"), [("reliable", 0), ("tentative", 1), pytest.param(None, 1, marks=pytest.mark.slow)]
)
def test_a_plant_without_effects_is_searched_where_a_first_proposal_is_not_close(
    monkeypatch, level: str | None, searches: int
):
    """Both give the same draws but for their Monte Carlo errors."""
    run, search, found, given = explained.weighted_run, explained.by_search, [], []

    def around(*given, attempts: int | None, **how):
        assert attempts == 1  # the longer ones are for where no search gives any
        found.append(run(*given, attempts=attempts, **how))
        limited = found[-1][1].limited((Limitation("tentative", "not close", "search"),))
        return {None: None, "reliable": found[-1], "tentative": (found[-1][0], limited)}[level]

    monkeypatch.setattr(explained, "weighted_run", around)
    monkeypatch.setattr(
        explained, "by_search", lambda *a, **how: given.append(search(*a, **how)) or given[-1]
    )
    draws, _ = explained_draws(short(1), lambda draws, noise: True, quick=True)
    assert len(given) == searches
    assert draws.grade.level == "reliable"
    own = found[0][1]
    for name in ("gain", "time_1", "delay"):
        sd, error = own.column(name).std(), np.sqrt(1 / own.ess + 1 / draws.ess)
        assert draws.column(name).mean() == pytest.approx(own.column(name).mean(), abs=4 * sd * error)


@pytest.mark.parametrize("stated", [None, 300.0])
@pytest.mark.parametrize(
    ("effects", "limit", "ways"), [((), explained.LIMIT, 3), (("trigger_jitter",), explained.AROUND, 1)]
)
def test_draws_have_little_time_unless_the_study_states_more(monkeypatch, stated, effects, limit, ways):
    """Around the optimum, by a search, and around it again, within one time; those with effects around it
    alone."""
    plans: list[SamplePlan] = []
    begun: list[float] = []

    def way(posterior, plan: SamplePlan, *_, begin: float, **how) -> None:
        plans.append(plan)
        begun.append(begin)

    for name in ("weighted_run", "by_search"):
        monkeypatch.setattr(explained, name, way)
    own = study(1)
    own = replace(own, sampler=replace(own.sampler, seconds=stated))
    own = replace(own, effects=replace(own.effects, use=effects))
    assert explained_draws(own, lambda draws, noise: True, quick=True) is None
    assert [plan.seconds for plan in plans] == [stated or limit] * ways
    assert len(set(begun)) == 1


@pytest.mark.parametrize("axes", [1, 2])
def test_a_search_that_one_axis_ended_counts_for_every_axis(monkeypatch, axes: int):
    """The others would have taken as long: what is tried next has the rest, and says when it really ended."""
    clock, given = [0.0], list[tuple[float, float]]()

    def searched(*_, **how) -> None:
        clock[0] += 40.0

    def around(posterior, plan: SamplePlan, *, begin: float, **how) -> None:
        given.append((plan.seconds, begin))

    monkeypatch.setattr(explained, "monotonic", lambda: clock[0])
    monkeypatch.setattr(explained, "by_search", searched)
    monkeypatch.setattr(explained, "weighted_run", around)
    one = path(1.0, 0.3, (1.2,), (0.9,))
    responses = (Axis("x", "rad"), Axis("y", "rad"))[:axes]
    device = Device(((one,),) * axes, (Axis("u", "V"),), responses, (0.0,) * axes)
    problem = problem_of(small.study(record(device=device, command=on_off([1.0], hold=5.0))))
    start = SimpleNamespace(values=problem.posterior.table.draw(1, np.random.default_rng(0))[0])
    assert _sampled(problem, [start], jobs=1, quick=True) is None
    assert given == [(explained.LIMIT, 0.0), (explained.LIMIT - 40.0 * (axes - 1), 0.0)]


def test_time_that_has_run_out_ends_what_is_tried_next():
    """Of 100 s that began 99.9 s ago next to nothing is left: fewer draws than otherwise, and limited."""
    posterior = problem_of(short(1)).posterior
    plan = SamplePlan.of(posterior.dimension, seed=3, seconds=100.0)
    optima = find_optima(posterior, np.random.default_rng(1), starts=1)
    late = explained.by_search(posterior, plan, optima, begin=monotonic() - 99.9)
    assert late is None or late.stopped_after > 99.9
    result = explained.weighted_run(posterior, plan, optima=optima, begin=monotonic() - 200.0)
    assert result is not None
    assert result[0].stopped_after > 200.0
    assert result[0].weighted.count < explained.weighted_run(posterior, plan, optima=optima)[0].weighted.count


def test_noise_that_is_not_gaussian_is_not_searched(monkeypatch):
    """A search of a campaign under Student's noise took five minutes where one proposal takes ten seconds."""
    monkeypatch.setattr(explained, "weighted_run", lambda *given, **how: None)
    monkeypatch.setattr(explained, "by_search", None)  # a call of it would raise
    one = replace(short(1), noise=NoiseSettings("student"))
    assert explained_draws(one, lambda draws, noise: True, quick=True) is None
    with pytest.raises(TypeError):
        explained_draws(short(1), lambda draws, noise: True, quick=True)


def test_many_samples_are_not_searched_and_have_one_proposal(monkeypatch):
    """A search of 10 700 took seven minutes, a loop is to take one, and gave draws of one axis of two."""
    asked: list[int | None] = []

    def around(*given, attempts: int | None = None, **how) -> None:
        asked.append(attempts)

    monkeypatch.setattr(explained, "weighted_run", around)
    monkeypatch.setattr(explained, "by_search", lambda *given, **how: None)
    size = problem_of(study(1)).posterior.size
    for most, expected in ((size - 1, [1]), (size, [1, None])):
        asked.clear()
        monkeypatch.setattr(explained, "_SEARCHED", most)
        assert explained_draws(study(1), lambda draws, noise: True, quick=True) is None
        assert asked == expected


def test_a_clean_loop_leaves_the_study_as_it_was(bent: Loop):
    made = explained_study(bent.problem.study, bent.before.state.model)
    assert made.effects == bent.problem.study.effects
    assert problem_of(made).posterior.simulation is None


def test_what_is_explained_already_is_refused(bent: Loop):
    with pytest.raises(InputError, match=r"uses odd_curvature already; .* leave `use` out of \[effects\]"):
        loop(bent.study, library=LIBRARY, quick=True)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of the command line, of a smaller catalogue."""
    folder = tmp_path_factory.mktemp("made")
    source = short(2, curvature=0.08)
    (folder / "in").mkdir()
    write_study(replace(source, name="made"), folder / "in" / "study.toml")
    arguments = ["loop", str(folder / "in"), "--out", str(folder / "run"), "--quick", "--jobs", "1"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loops, "offered", lambda study: LIBRARY)
        assert main([*arguments, "--quiet", "--as-stated"]) == 0
    return folder / "run"


def test_the_command_writes_it(run: Path):
    """From the command line: the study it ends with lies beside its results and can be loaded."""
    reported = json.loads((run / "loop.json").read_text())
    made = load_study(run / "explained.toml")
    assert list(made.effects.use) == [one["name"] for one in reported["effects"]]
    assert len(made.held_out) == 1


@pytest.mark.parametrize("support", ["plant", pytest.param("both", marks=pytest.mark.slow), "lags"])
@pytest.mark.usefixtures("undrawn")
def test_the_page_says_over_which_plants_its_numbers_are(run: Path, tmp_path: Path, support: str):
    """Gains and delays are over sums of lags too, unless the records do not support these."""
    folder = Path(shutil.copytree(run, tmp_path / "run"))
    values = json.loads((folder / "loop.json").read_text())
    values["alternatives"] |= {
        "sums_of_lags": [{"support": support}],
        "sentence": "Sums of lags.",
        "plants": "Of their draws.",
    }
    values["parameters"][0]["note"] = "An extrapolation."
    (folder / "loop.json").write_text(json.dumps(values))
    page = write_page_of("loop", folder).read_text("utf-8")
    assert page.count(f"{values['parameters'][0]['name']}: An extrapolation.") == 1
    assert ("Gains and delays above are over the same plants" in page) == (support != "plant")
    assert page.count("Of their draws.") == 1
