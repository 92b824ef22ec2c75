"""The loop on small campaigns of one axis: a hidden effect is found, a clean one stays clean."""

import json
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from lcopa_bayes.bench.command import on_off, staircase, step
from lcopa_bayes.bench.device import Bench, Device, simulate
from lcopa_bayes.core.estimate import HALF_WIDTH
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch import findings
from lcopa_bayes.effectsearch.bandwidening import Widening
from lcopa_bayes.effectsearch.basefit import base_fit
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.heldouteffects import unseen_share
from lcopa_bayes.effectsearch.heldoutscores import _about_optimum
from lcopa_bayes.effectsearch.leavingout import log_scores
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.effectsearch.noise import axis_noise, repeat_pieces
from lcopa_bayes.effectsearch.openeffects import Weighed
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.rounds import Round, Search
from lcopa_bayes.effectsearch.scores import risen
from lcopa_bayes.effectsearch.summary import drawn, next_measurement, results, words
from lcopa_bayes.effectsearch.verdict import COVERED, Dynamics, Findings, Miss, decide
from lcopa_bayes.effectsearch.whitening import Whitening
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.defaultpriors import Scales
from lcopa_bayes.model.effects.catalogue import catalogue
from lcopa_bayes.model.effects.effect import UnstableError
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.sampling.convergence import Grade

loops = sys.modules[loop.__module__]
NOISE = 5e-3
NAMES = ("odd_curvature", "even_curvature", "gain_drift", "unmodelled_smooth")
LIBRARY = [catalogue()[name] for name in NAMES]
AXIS = (Axis("x", "rad"),)


def records(seed, curvature=0.0, quiet=8.0, noise=NOISE):
    rng = np.random.default_rng(seed)
    path = TransferPath(1.0, 1.0, (3.0,), (0.9,), 1.0)
    device = Device(((path,),), AXIS, AXIS, (0.0,))
    commands = [
        on_off(1.0, hold=12.0, at=quiet),
        on_off(-0.7, hold=9.0, at=quiet),
        staircase([0.4, 1.0, -0.5, 0.2], hold=6.3, start=quiet),
        step(0.5, at=quiet),
        staircase([-0.9, 0.8, 0.3], hold=7.1, start=quiet),
    ]
    out = []
    for number, command in enumerate(commands):
        taken = simulate(device, Bench(camera=0.2), command, duration=36.0, name=f"r{number}", rng=rng)
        y = taken.response + curvature * taken.response**3
        y = y + noise * rng.standard_normal(y.shape)
        out.append(Record(taken.name, taken.time, taken.drive, y, AXIS, AXIS, "ms"))
    return out


def study(seed, curvature=0.0, held_out=1, **changes):
    made = records(seed, curvature, **changes)
    fit, apart = made[: len(made) - held_out], made[len(made) - held_out :]
    return Study("small", None, "ms", seed, tuple(fit), tuple(apart), ModelSettings(terms=1, offset="shared"))


@pytest.fixture(scope="module")
def clean():
    return loop(study(1), library=LIBRARY, sample=False, quick=True, as_stated=True)


@pytest.fixture(scope="module")
def bent():
    made = study(2, 0.06)
    return loop(replace(made, fit=made.fit[:2]), library=LIBRARY, quick=True, as_stated=True)


def test_a_clean_campaign_stays_clean(clean):
    assert clean.verdict.kind == "clean"
    assert clean.effects == ()
    assert clean.trace is not None
    assert clean.trace.p_value > 0.005


def test_the_noise_is_measured_before_the_drive_moves(clean):
    (noise,) = clean.base.noise
    assert noise.source == "quiet"
    assert noise.law.sd == pytest.approx(NOISE, rel=4 / np.sqrt(2 * noise.samples))


def test_intervals_of_the_optimum_are_in_the_units_of_the_parameters(clean):
    """A time constant of 3^(1 / 0.9) ms, found by its logarithm."""
    model = clean.after.state.model
    reported = {one["name"]: one for one in (clean.estimate(k) for k in range(len(model.names)))}
    for name, truth in (("gain", 1.0), ("time_1", 3.0 ** (1 / 0.9)), ("order_1", 0.9), ("delay", 1.0)):
        one = reported[name]
        assert one["lower"] < one["value"] < one["upper"]
        assert abs(one["value"] - truth) < 4 * one["sd"]
        assert one["upper"] - one["lower"] == pytest.approx(2 * 1.645 * one["sd"], rel=0.02)
    assert reported["time_1"]["unit"] == "ms"


def test_the_hidden_effect_is_named_and_its_size_recovered(bent):
    assert bent.verdict.kind == "explained"
    assert [effect.name for effect in bent.effects] == ["odd_curvature"]
    (effect,) = results(bent)["effects"]
    (size,) = effect["parameters"]
    truth = 0.06 * bent.after.state.model.effected.ranges.response[0] ** 2
    assert size["lower"] - 2 * size["sd"] < truth < size["upper"] + 2 * size["sd"]


def test_errors_fall_to_the_noise_floor(bent):
    reported = results(bent)
    before, after = (reported[side]["held_out_rmse_over_noise"]["x"] for side in ("before", "after"))
    assert after < before
    assert after < 1.15
    assert 0.8 < reported["after"]["held_out_coverage_90"] < 0.97
    assert reported["after"]["held_out_level_from"] == [
        "shared with the fit records"
    ]  # one offset for all records


def test_what_is_known_is_said_as_the_search_goes_on(capsys):
    """Second method: the errors of the result."""
    made = study(2, 0.06)
    made = replace(made, fit=made.fit[:2])
    found = loop(made, library=LIBRARY, sample=False, quick=True, as_stated=True, quiet=False)
    said, reported = capsys.readouterr().err, results(found)
    for side, name in (("before", "without effects"), ("after", "with odd_curvature")):
        fitted, unseen = (reported[side][f"{kind}_rmse_over_noise"]["x"] for kind in ("fit", "held_out"))
        where = f"{fitted:.2f} times the noise on fitted records, {unseen:.2f} on those held out"
        assert f"{name} errors are {where}" in said
    assert "explained" in said


def test_held_out_bands_by_draws_are_those_of_the_linearised_model(clean):
    """Draws through the model, or its tangents on the record; 100 draws know a variance to 14 %."""
    state, (score,) = clean.before.state, clean.before.unseen
    apart = problem_of(replace(clean.problem.study, fit=clean.problem.study.held_out, held_out=()))
    model = ExtendedModel(replace(apart.posterior, table=state.model.plant.table))
    mean, tangents = model.tangents(state.optimum.x)
    variance = np.einsum("nk,kl,nl->n", tangents, state.optimum.covariance, tangents)
    assert np.abs(score.predicted - mean).max() < 0.5 * np.sqrt(variance.max())
    assert score.variance.mean() == pytest.approx(variance.mean(), rel=0.35)
    settled = score.time > 20.0
    assert np.corrcoef(np.sqrt(score.variance[settled]), np.sqrt(variance[settled]))[0, 1] > 0.8


def test_what_leaves_is_plain_json_with_grades(bent):
    reported = results(bent)
    text = json.dumps(reported, allow_nan=False)
    assert '"explained"' in text
    assert {p["grade"] for p in reported["parameters"]} <= {"reliable", "tentative", "unusable"}
    json.dumps(drawn(bent), allow_nan=False)
    assert any("odd_curvature" in line for line in words(reported))


@pytest.mark.parametrize(("confidence", "level"), [("firm", "reliable"), ("tentative", "tentative")])
def test_a_loop_is_no_more_reliable_than_its_verdict(bent, confidence, level):
    draws = SimpleNamespace(grade=Grade("reliable", "draws agree"))
    one = replace(bent, verdict=replace(bent.verdict, confidence=confidence), draws=draws)
    assert one.grade.level == level


@pytest.mark.parametrize(
    ("kind", "left", "level"),
    [
        ("explained", None, "reliable"),
        ("clean", None, "reliable"),
        ("partly explained", None, "tentative"),
        ("unexplained", None, "tentative"),
        ("unexplained", 0.9, "reliable"),
        ("unexplained", 1.8, "tentative"),
    ],
)
def test_numbers_of_a_model_that_leaves_something_are_tentative(bent, kind, left, level):
    """Unless sums of lags, which the numbers are over too, follow what it leaves down to the noise."""
    draws = SimpleNamespace(grade=Grade("reliable", "draws agree"))
    verdict = replace(bent.verdict, kind=kind, confidence="firm")
    one = replace(bent, verdict=verdict, draws=draws, lags=lags_leaving(left))
    assert one.grade.level == level
    apart = replace(one, lags=lags_leaving(left, support="plant"))  # the numbers are not over them
    assert apart.grade.level == ("tentative" if verdict.leaves else "reliable")


def lags_leaving(ratio, support="lags"):
    """Sums of lags that leave so many times the noise, none without a ratio, where the plant leaves twice."""
    best = SimpleNamespace(size=400, misfit=400 * 2.0**2)
    search, square = SimpleNamespace(axis=0, best=best), 400 * (ratio or 0.0) ** 2
    found = SimpleNamespace(search=search, square=square, support=support, paths=())
    return (found,) if ratio else ()


@pytest.mark.parametrize(("end", "extrapolates"), [(0.95, False), (0.85, True), (0.2, True)])
def test_steady_values_beyond_the_records_are_unusable_where_something_remains(bent, end, extrapolates):
    """Three lags behind a clock of uncertain start had five times their gain, from 3 to 6 where 0.8 is true,
    graded reliable."""
    shown = (("steady_state[x]", 2.0), ("value_at_end[x]", 2.0 * end), ("rise_10_90[x]", 9.0))
    figures = tuple(Weighed(name, "-", [np.full(8, value)], np.ones(1)) for name, value in shown)
    for kind, left in (("unexplained", None), ("explained", None), ("unexplained", 0.9)):
        verdict = replace(bent.verdict, kind=kind, confidence="firm")
        one = replace(bent, verdict=verdict, lags=lags_leaving(left))
        one.__dict__["figures"] = figures
        beyond = extrapolates and kind == "unexplained" and left is None
        assert bool(one.extrapolated.shares) == beyond
        if left is not None:
            continue
        reported = results(one)
        graded = {row["name"]: row for row in reported["parameters"] + reported["figures"]}
        for name in ("gain", "rise_10_90[x]"):
            assert (graded[name]["grade"] == "unusable") == beyond
            assert (f"{100 * (1 - end):.0f} % of the steady value" in graded[name].get("note", "")) == beyond
        assert "unusable" not in {graded[name]["grade"] for name in ("delay", "value_at_end[x]")}


def test_parameters_without_draws_are_values_and_not_coordinates(clean):
    """A time was printed as its logarithm, 1.2 ms where the viscosity of 3 makes it 3.39 ms."""
    printed = {row["name"]: row for row in results(clean)["parameters"]}
    time = 3.0 ** (1 / 0.9)
    for name, truth in (("gain", 1.0), ("time_1", time), ("order_1", 0.9), ("delay", 1.0)):
        row = printed[name]
        assert row["lower"] < row["value"] < row["upper"]
        assert row["lower"] - 2 * row["sd"] < truth < row["upper"] + 2 * row["sd"]
        assert row["upper"] - row["lower"] < 0.5 * truth


def test_a_further_record_separates_an_effect_from_the_nearest_of_many(bent):
    """It was to separate seventeen names by as many excitations."""
    names = tuple(catalogue())[:9]
    said = next_measurement(replace(bent, groups=(("odd_curvature", *names),)))
    assert said.startswith(f"To separate odd_curvature from {', '.join(names[:4])} and 5 more, record ")
    few = next_measurement(replace(bent, groups=(("odd_curvature", "even_curvature"),)))
    assert few.startswith("To separate odd_curvature from even_curvature, record ")


def test_parameters_biased_by_the_effect_are_listed(bent):
    assert "gain" in {row["name"] for row in results(bent)["moved"]}


def test_the_same_seed_gives_the_same_numbers(clean):
    again = loop(study(1), library=LIBRARY, sample=False, quick=True, as_stated=True)
    assert results(again) == results(clean)


def test_tangents_are_the_derivative_of_the_prediction(bent):
    model, x = bent.after.state.model, bent.after.state.optimum.x
    _, tangents = model.tangents(x)
    for k in range(x.size):
        shift = np.zeros(x.size)
        shift[k] = 1e-5
        numeric = (model.predict(x + shift) - model.predict(x - shift)) / 2e-5
        np.testing.assert_allclose(tangents[:, k], numeric, atol=2e-4 * np.abs(numeric).max())


def test_left_out_scores_are_the_conditional_density_of_the_linear_model():
    """Two methods: one Gauss-Newton step, or the conditional of one normal density."""
    rng = np.random.default_rng(8)
    tangents, prior, data = rng.normal(size=(12, 3)), np.diag([0.5, 2.0, 1.0]), rng.normal(size=12)
    whole = np.eye(12) + tangents @ prior @ tangents.T
    mode = SimpleNamespace(
        jacobian=tangents,
        settled=np.linalg.solve(whole, data),
        information=tangents.T @ tangents + np.linalg.inv(prior),
    )
    rows, rest = np.arange(4), np.arange(4, 12)
    gain = whole[np.ix_(rows, rest)] @ np.linalg.inv(whole[np.ix_(rest, rest)])
    conditional = whole[np.ix_(rows, rows)] - gain @ whole[np.ix_(rest, rows)]
    miss = data[rows] - gain @ data[rest]
    direct = -0.5 * miss @ np.linalg.solve(conditional, miss) - 0.5 * np.linalg.slogdet(conditional)[1]
    assert log_scores(mode, [rows])[0] == pytest.approx(direct, rel=1e-10)


def test_without_held_out_records_each_is_left_out_in_turn():
    found = loop(study(3, held_out=0), library=LIBRARY[:1], sample=False, quick=True, as_stated=True)
    reported = results(found)
    assert found.left_out
    assert reported["unseen_by"] == "leaving records out in turn"
    assert len(found.before.unseen) == len(found.study.fit)


def test_a_single_record_without_quiet_samples_is_at_most_tentative():
    made = records(4, quiet=0.2)[2]
    alone = Study("one", None, "ms", 4, (made,), (), ModelSettings(offset="shared"))
    found = loop(alone, library=LIBRARY[:1], sample=False, quick=True, as_stated=True)
    assert found.verdict.confidence == "tentative"
    assert "too few" in found.base.noise[0].sentence
    assert "quiet" in results(found)["next_measurement"] or "stretch" in results(found)["next_measurement"]


def test_quiet_samples_within_one_step_of_the_sensor_are_said_to_be_alike():
    one, other = (records(seed, quiet=12.0)[2] for seed in (4, 5))
    steps = 20 * NOISE
    coarse, repeat = (
        replace(made, name=name, response=steps * np.round(made.response / steps))
        for name, made in (("one", one), ("repeat", other))
    )

    def noise(*own):
        posterior = problem_of(Study("coarse", None, "ms", 4, own)).posterior
        return axis_noise(posterior.samples, 0, 0.0, Axis("x", "rad"), Scales.of(own))

    said = noise(coarse)
    assert "quiet samples are all alike" in said
    assert "too few" not in said
    assert "record repeats" in said
    assert "differences of repeats are all alike" in noise(coarse, replace(coarse, name="copy"))
    assert "differences of repeats; 118 quiet samples are all alike" in noise(coarse, repeat).sentence


def test_no_effect_is_named_from_a_base_fit_that_failed():
    made = records(5)
    rng = np.random.default_rng(5)
    wild = [replace(r, response=rng.standard_normal(r.response.shape)) for r in made]
    bad = Study("bad", None, "ms", 5, tuple(wild[:4]), (wild[4],), ModelSettings(offset="shared"))
    found = loop(bad, library=LIBRARY, sample=False, quick=True, as_stated=True)
    assert found.verdict.kind == "unexplained"
    assert found.effects == ()
    assert "less than half" in found.verdict.sentence
    json.dumps(results(found), allow_nan=False)


def test_an_effect_that_cannot_be_simulated_is_reported_not_raised(clean):
    class Broken(LIBRARY[0]):  # type: ignore[misc,valid-type]
        def seen(self, y, scene, psi):
            raise UnstableError(("odd_curvature",), "r0", "it runs away")

    found = loop(study(1), library=[Broken], sample=False, quick=True, as_stated=True)
    assert found.verdict.kind == "clean"
    assert "runs away" in results(found)["evidence"]["classes"][0]["failed"]


def test_repeats_measure_the_noise():
    made = records(6)[:1]
    rng = np.random.default_rng(6)
    twin = replace(
        made[0], name="twin", response=made[0].response + NOISE * rng.standard_normal(made[0].response.shape)
    )
    posterior = problem_of(
        Study("twin", None, "ms", 6, (made[0], twin), (), ModelSettings(offset="shared"))
    ).posterior
    pieces = repeat_pieces(posterior.samples, 0)
    assert sum(piece.values.size for piece in pieces) == np.isfinite(made[0].response).sum()
    noise = axis_noise(posterior.samples, 0, 0.0, Axis("x", "rad"), Scales.of(made))
    assert noise.known
    assert f"noise of sd {noise.law.sd:.3g} rad and" in noise.sentence


def test_descent_reaches_the_least_squares_optimum():
    problem = problem_of(study(7))
    base = base_fit(ExtendedModel(problem.posterior), np.random.default_rng(0))
    slope = base.optimum.jacobian.T @ base.optimum.white
    step = np.linalg.solve(base.optimum.information, slope)
    assert slope @ step < 0.1
    assert base.failed == ""
    other = Regression(base.model, base.regression.whitening).descend(base.optimum.x + 1e-3)
    assert other.cost == pytest.approx(base.optimum.cost, abs=0.1)


def test_a_plant_with_effects_at_zero_is_the_plant():
    problem = problem_of(study(7))
    model = ExtendedModel(problem.posterior)
    x = model.coordinates(problem.posterior.table.draw(1, np.random.default_rng(3))[0])
    places = {one.record.name: 0.0 for one in problem.posterior.samples}
    extended = model.at_scales(x, places).having(next(iter(LIBRARY[0].grid(None))))
    np.testing.assert_allclose(extended.predict(np.append(x, 0.0)), model.predict(x), atol=1e-10)


def test_bands_are_not_given_outside_the_excited_range(clean):
    state = clean.before.state
    wide = Widening.of(state.whitening.samples, state.optimum.residual, state.whitening.noise)
    samples = state.whitening.samples[0]
    assert np.isfinite(wide.variance(samples, 0)).all()
    beyond = replace(samples, record=replace(samples.record, drive=3.0 * samples.record.drive))
    assert np.isnan(wide.variance(beyond, 0)).any()


def test_errors_on_held_out_records_count_while_the_drive_stays_in_range(clean):
    """Twice the noise before, 1.5 times after; beyond the fitted range the effect may say what it likes."""
    made = study(1)
    (record,) = made.held_out
    made = replace(made, fit=(*made.fit, replace(record, name="again")))  # drives of the whole range
    score = replace(clean.before.unseen[0], variance=np.zeros_like(clean.before.unseen[0].variance))
    before = replace(score, predicted=score.observed - 2 * score.noise_sd)
    after = replace(score, predicted=score.observed - 1.5 * score.noise_sd)
    state = clean.before.state
    assert unseen_share(made, [before], [after], state) == pytest.approx(1.25 / 3)
    assert np.isnan(unseen_share(made, [replace(score, predicted=score.observed)], [after], state))
    late = record.time > record.time[np.flatnonzero(np.diff(record.drive[:, 0]))[1]]
    wild = replace(record, drive=np.where(late[:, None], 9.0, record.drive))
    far = score.time > record.time[late][0]
    worse = replace(after, predicted=np.where(far, 1e3, after.predicted))
    changed = replace(made, held_out=(wild,))
    assert unseen_share(changed, [before], [worse], state) == pytest.approx(1.25 / 3)
    assert unseen_share(made, [before], [worse], state) > 1.0


FOUND = Findings((), True, 50.0, 3.0, ("a",), (), 48.0, 20.0, "smooth", 1.0, 3.0, "b", 1.0)


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        ({}, "explained"),
        ({"alarmed": False}, "clean"),
        ({"alarmed": False, "scatter": 50.0}, "disturbance"),
        ({"alarmed": False, "missed": Miss("y", 1.2, 0.9, 0.019)}, "unexplained"),
        ({"alarmed": False, "missed": Miss("y", 1.0, 0.8, 0.019)}, "unexplained"),
        ({"alarmed": False, "missed": Miss("y", 1.2, 0.8, 0.021)}, "clean"),
        ({"alarmed": False, "missed": Miss("y", 1.09, 0.87, 0.001)}, "clean"),
        ({"alarmed": False, "scatter": 50.0, "missed": Miss("y", 3.0, 0.5, 0.001)}, "unexplained"),
        ({"missed": Miss("y", 1.0, 0.8, 0.019)}, "partly explained"),
        ({"effects": ()}, "unexplained"),
        ({"disturbances": ("a",)}, "disturbance"),
        ({"remaining": 40.0, "share": 0.5}, "unexplained"),
        ({"remaining": 4.0, "share": 0.95}, "explained"),
        ({"remaining": 40.0, "share": 0.95, "generic": 90.0}, "unexplained"),
        ({"unseen": 0.2}, "explained"),
        ({"unseen": 0.8}, "unexplained"),
        ({"risen": 1.04}, "explained"),
        ({"risen": 1.06}, "unexplained"),
        ({"reached": 1.09}, "explained"),
        ({"reached": 1.11}, "partly explained"),
        ({"reached": 1.11, "missed": Miss("y", 1.11, 0.88, 0.019)}, "partly explained"),
        ({"reached": 1.11, "missed": Miss("y", 1.11, 0.88, 0.3)}, "partly explained"),
        ({"reached": 1.09, "missed": Miss("y", 1.09, 0.8, 0.019)}, "partly explained"),
        ({"reached": 1.09, "missed": Miss("y", 1.09, 0.8, 0.021)}, "explained"),
        ({"dynamics": True}, "partly explained"),
        ({"dynamics": True, "effects": ()}, "unexplained"),
    ],
)
def test_the_verdict_follows_from_what_was_found(change, kind):
    assert decide(replace(FOUND, **change)).kind == kind


def test_a_verdict_says_given_what_held_out_records_were_judged():
    said = decide(replace(FOUND, effects=("a", "b"), varying=("b",), reached=1.02)).sentence
    assert "Given b of each held-out record, which no other record tells, the error there is 1.02" in said
    assert "Given" not in decide(replace(FOUND, reached=1.02)).sentence


def test_what_chance_may_explain_is_said_beside_a_name():
    """It does not doubt the name; but above 1.1 times the noise no name is all."""
    above = decide(replace(FOUND, reached=1.12, missed=Miss("y", 1.12, 0.88, 0.3)))
    assert (above.kind, above.confidence) == ("partly explained", "tentative")
    assert "but perhaps not all that is" in above.sentence
    assert "1.12 times the noise, which chance gives with probability 0.3." in above.sentence
    linear = decide(replace(FOUND, dynamics=True, missed=Miss("y", 1.0, 0.9, 0.5))).sentence
    assert linear.endswith(
        "Linear dynamics without a name are missing too."
    )  # errors as of noise say nothing
    left = decide(replace(FOUND, reached=1.12, missed=Miss("y", 1.12, 0.88, 0.3), remaining=4.0, share=0.96))
    assert "but not all that is" in left.sentence
    assert "chance" not in left.sentence
    uncovered = decide(replace(FOUND, missed=Miss("y", 1.0, 0.8, 0.3)))
    assert (uncovered.kind, uncovered.confidence) == ("explained", "firm")
    assert "(by chance with probability 0.3)" in uncovered.sentence
    disturbed = decide(replace(FOUND, disturbances=("a",), missed=Miss("y", 1.0, 0.8, 0.3)))
    assert (disturbed.kind, disturbed.confidence) == ("disturbance", "firm")
    assert "by chance" in disturbed.sentence
    assert "chance" not in decide(replace(FOUND, missed=Miss("y", 1.0, 0.9, 0.3))).sentence
    quiet = decide(replace(FOUND, alarmed=False, effects=(), gained=0.0, missed=Miss("y", 1.2, 0.84, 0.93)))
    assert (quiet.kind, quiet.confidence) == ("clean", "tentative")
    assert "On unseen records the error of y is 1.20" in quiet.sentence
    assert "But" not in quiet.sentence


def test_something_that_is_missing_is_not_said_to_be_nothing():
    """Of errors on unseen records alone: the fitted ones show nothing more."""
    one = decide(replace(FOUND, reached=1.3)).sentence
    assert "a was missing, but not all that is, worth 48 nat. Nothing significant remains in the" in one
    two = decide(replace(FOUND, effects=("a", "b"), reached=1.3)).sentence
    assert "a, b were missing, but not all that is, worth 48 nat together." in two


def test_what_remains_must_hold_against_the_refit(bent):
    """As at the first look: straight lines alone said that something significant remains, and shares of more
    than the whole."""
    *before, last = bent.rounds
    first, *others = last.trace.traced
    seen = replace(last.trace, traced=(replace(first, log_bayes_factor=20.0), *others))
    every = [SimpleNamespace(added=(one.name,), log_bayes_factor=-5.0) for one in seen.traced]
    sides = bent.before, bent.after
    given = {"outliers": None, "cautions": (), "alone": False}

    def found(*refits):
        searched = Search.ending((*before, replace(last, trace=seen, refits=refits)), dict)
        return findings.findings_of(bent.problem.study, searched, *sides, **given)

    alarm, none = found(), found(*every)
    assert (alarm.remaining, alarm.remaining_name) == (20.0, first.name)
    assert not alarm.apart
    assert alarm.share < 1.0
    assert none.remaining < none.remaining_threshold
    assert none.apart
    assert none.share == 1.0
    assert "Nothing significant remains." in decide(none).sentence


def test_cautions_are_those_of_the_base_fit_that_is_searched(clean):
    """Not of one that a richer plant took the place of."""

    def cautions(*said):
        base = SimpleNamespace(problem=clean.problem, fit=SimpleNamespace(caution=said))
        return replace(begun, base=base).cautions

    begun = loops._Begun(clean.problem.study, (), None, None, (), True)
    assert cautions() == ()
    assert cautions("time_1 at the end of the prior") == ("time_1 at the end of the prior",)


def test_an_axis_that_no_held_out_record_shows_has_no_error_there(clean):
    """A held-out record with an empty column: None is no number that a line could show."""
    said = results(clean)
    before, after = ({**said[side], "held_out_rmse": {"x": None}} for side in ("before", "after"))
    (line,) = [one for one in words({**said, "before": before, "after": after}) if one.startswith("axis x")]
    assert "unseen" not in line
    assert any(", unseen 0.00" in one for one in words(said))


def test_an_alarm_of_the_trace_must_hold_against_the_refit():
    """Straight lines gave 3.3 nat where chance gives 3.2; what was not refitted keeps what they gave."""

    def alarmed(refitted: float, *others: tuple[str, float, bool]) -> bool:
        traced = [SimpleNamespace(name="a", log_bayes_factor=3.3, scatters=False)]
        traced += [SimpleNamespace(name=n, log_bayes_factor=b, scatters=s) for n, b, s in others]
        seen = SimpleNamespace(traced=traced, threshold=3.2, alarmed=True)
        refit = SimpleNamespace(added=("a",), log_bayes_factor=refitted)
        return Round(None, seen, (refit,), (), None).alarmed

    assert alarmed(3.21)
    assert not alarmed(3.19)
    assert alarmed(3.19, ("b", 3.21, False))
    assert not alarmed(3.19, ("b", 9.0, True))  # noise that is not normal changes no response


@pytest.mark.parametrize(("unseen", "confidence"), [(np.nan, "firm"), (1.09, "firm"), (1.32, "tentative")])
def test_linear_dynamics_that_miss_unseen_records_are_not_all_that_is_missing(unseen, confidence):
    linear = Dynamics("elements of integer orders (2 and 1) follow the records as well", unseen)
    verdict = decide(replace(FOUND, linear=linear))
    assert (verdict.kind, verdict.confidence) == ("unexplained", confidence)
    assert ("1.32 times that on unseen ones" in verdict.sentence) == (confidence == "tentative")


def test_why_nothing_is_named_is_said():
    """No effect holds against a refit, or none is ahead of what has no name."""
    none = replace(FOUND, effects=(), generic_name="unmodelled_nonlinear")
    low, level = (replace(none, generic=none.largest - by) for by in (3.1, 2.9))
    assert "no effect of the library survives a full refit: no name" in decide(low).sentence
    assert "unmodelled_nonlinear describes it as well as any effect" in decide(level).sentence
    # that there is no name is firm, unless one is ahead of what has none, and that alone keeps it back
    ahead = replace(none, generic=none.largest)
    assert [decide(one).confidence for one in (low, level, ahead)] == ["firm", "tentative", "firm"]
    assert decide(replace(level, dynamics=True)).confidence == "firm"


def test_what_chance_may_explain_is_said_beside_clean():
    """And takes the firmness of the verdict."""
    sure = decide(replace(FOUND, alarmed=False))
    less = decide(replace(FOUND, alarmed=False, missed=Miss("y", 1.2, 0.84, 0.07)))
    assert (sure.confidence, less.confidence) == ("firm", "tentative")
    assert "1.20 times the noise and 90 % bands hold 84 % of the samples" in less.sentence
    doubted = decide(replace(FOUND, alarmed=False, nothing=0.4))
    assert doubted.confidence == "tentative"
    assert "more probable than not (60 %)" in doubted.sentence
    assert "probability 0.07" in less.sentence
    far = decide(replace(FOUND, alarmed=False, reached=8.1))
    assert (far.kind, far.confidence) == ("clean", "tentative")
    assert "8.10 times the noise, which may be chance or something that is missing" in far.sentence


def test_normal_errors_of_the_largest_size_are_held_as_often_as_bands_must_hold():
    errors = 1.1 * np.random.default_rng(2).normal(size=200_000)
    assert np.mean(np.abs(errors) <= HALF_WIDTH) == pytest.approx(COVERED, abs=4 * np.sqrt(0.12 / 200_000))


def test_the_error_that_has_risen_is_that_of_the_worst_axis(clean):
    (one,) = {score.axis: score for score in clean.before.unseen}.values()
    other = replace(one, axis="other")
    miss = 1.2 * (one.predicted - one.observed)
    worse = replace(other, predicted=one.observed + miss)
    assert risen([one, other], [worse, one]) == pytest.approx(1.2)
    assert risen([one, other], [one, replace(other, predicted=one.observed + miss / 1.44)]) == pytest.approx(
        1.0
    )


def test_draws_that_predict_worse_than_the_optimum_are_not_used(clean, monkeypatch):
    """As of another mode: the error after a loop is never above that before it."""
    scores = findings.unseen_scores

    def away(state, problem):
        made = scores(replace(state, sampled=None), problem)
        return [replace(one, predicted=one.predicted + 1.0) for one in made] if state.sampled else made

    def around(model, _):
        return np.random.default_rng(0).normal(size=(50, len(model.names)))

    drawn = _about_optimum(clean.after.state, 1)
    monkeypatch.setattr(loops, "explained_draws", lambda *_, **__: drawn)
    monkeypatch.setattr(findings, "coordinates_of", around)
    monkeypatch.setattr(findings, "unseen_scores", away)
    found = loop(study(1), library=LIBRARY, quick=True, as_stated=True)
    assert found.draws is None
    assert any("are not used" in caution for caution in found.cautions)
    assert found.after.unseen[0].rmse == pytest.approx(clean.after.unseen[0].rmse)


def test_whitening_of_records_is_that_of_their_parts(clean):
    state = clean.before.state
    both = Whitening(state.whitening.samples, state.whitening.noise)
    part = both.parts[1]
    alone = both.noise[0].whiten(both.observed[part.rows], both.samples[part.record].axes[part.axis].gaps)
    np.testing.assert_allclose(both(both.observed)[part.rows], alone)
