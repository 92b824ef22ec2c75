"""A richer model of the loop is at least as likely as those it contains, wherever its own starts lead."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small import path, record, study

from lcopa_bayes.bench.command import joint, on_off, staircase
from lcopa_bayes.bench.device import Device
from lcopa_bayes.data.record import Axis
from lcopa_bayes.effectsearch import basefit, basemodel, refits
from lcopa_bayes.effectsearch.refits import refit
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.model.effects.catalogue import bundled

NOISE = 0.01
STUDY = study(
    record(1, command=on_off(1.0, hold=8.0, at=4.0), duration=20.0, noise_sd=NOISE, name="r1"),
    record(
        2, command=staircase([0.5, -0.8, 0.3], hold=5.0, start=4.0), duration=20.0, noise_sd=NOISE, name="r2"
    ),
    offset="shared",
)
TWO = replace(STUDY, model=replace(STUDY.model, terms=2))
PAIR = [bundled()["odd_curvature"](), bundled()["overdrive_pulse"](1.0)]


@pytest.fixture(scope="module")
def base():
    return basemodel._based(STUDY)


def astray(heeds_near):
    """A base fit that ends far from the records' plant with two terms, unless it `heeds_near` starts."""

    def fit(model, rng, *, starts=4, near=(), crew=None):
        found = basefit.base_fit(model, rng)
        if len(model.posterior.table.of_kind("order")) < 2:
            return found
        away = found.optimum.x.copy()
        away[0] += 1.0  # the gain
        ends = [found.regression.at(away)]
        ends += [found.regression.descend(start) for start in near if heeds_near]
        return replace(found, optimum=min(ends, key=lambda one: one.cost))

    return fit


@pytest.mark.parametrize("heeds_near", [True, False])
def test_more_terms_are_at_least_as_likely_as_fewer(base, monkeypatch, heeds_near):
    """Though the wider fit's own starts lead astray: from the smaller model's optimum, at first or again."""
    monkeypatch.setattr(basemodel, "base_fit", astray(heeds_near))
    lost = basemodel._based(TWO, 2)
    wider = basemodel._wider(TWO, base, 2)
    inner = Regression(base.fit.model, wider.fit.regression.whitening).descend(base.fit.optimum.x)
    assert wider.fit.optimum.cost <= inner.cost + 0.5
    assert wider.fit.failed == ""
    assert wider.start.optimum is wider.fit.optimum
    assert lost.fit.optimum.cost > inner.cost + 100.0  # the starts do lead astray


def test_more_terms_that_stay_less_likely_are_no_base(base, monkeypatch):
    """Where no start reaches what the smaller model does, the wider one is not used."""
    monkeypatch.setattr(basemodel, "base_fit", astray(False))
    monkeypatch.setattr(Regression, "best", lambda self, starts, crew: self.at(starts[0]))
    wider = basemodel._wider(TWO, base, 2)
    assert "less likely than that of fewer" in wider.fit.failed


def test_starts_of_a_wider_model_are_close_to_the_smaller_one(base):
    problem = basemodel.problem_of(replace(STUDY, model=replace(STUDY.model, terms=3)))
    model = basemodel.ExtendedModel(problem.posterior)
    regression = Regression(model, base.fit.regression.whitening)
    starts = basemodel._lifted(model, base, np.random.default_rng(1))
    low, high = model.bounds
    assert len(starts) == 6
    costs = [regression.cost(np.clip(start, low, high)) for start in starts]
    spread = np.std(np.concatenate([one.values for s in problem.posterior.samples for one in s.axes]))
    power = 0.5 * problem.posterior.size * (spread / NOISE) ** 2
    assert min(costs) < base.fit.optimum.cost + 0.01 * power


@pytest.mark.parametrize("effect", PAIR, ids=lambda one: one.name)
def test_a_refit_is_at_least_as_likely_as_without_its_effect(base, effect, monkeypatch):
    """Though its constants are moved to where it is worse, and under another noise."""
    state = base.start

    def spoilt(model, x, whitening, names):
        away = x.copy()
        away[model.plant_size :] += 3.0
        away[: model.plant_size] = 0.5 * (away[: model.plant_size] + model.bounds[0][: model.plant_size])
        return model, np.where(np.isfinite(away), away, x)

    monkeypatch.setattr(refits, "freed", spoilt)
    monkeypatch.setattr(refits, "_SLIGHT", -np.inf)
    made = refit(state.model, state.optimum, state.whitening, [(effect, np.ones(1))], 50.0)
    assert made.optimum.cost <= state.optimum.cost + 1e-9
    assert made.taken >= 0.0
    worse = made.optimum.x.copy()
    worse[: made.model.plant_size] = made.model.bounds[0][: made.model.plant_size] + 0.1
    regression = Regression(made.model, made.whitening)
    stuck = replace(made, optimum=regression.at(np.where(np.isfinite(worse), worse, made.optimum.x)))
    assert stuck.optimum.cost > made.before.cost + 10.0
    again = stuck.under(state.whitening)
    assert again.optimum.cost <= again.before.cost + 1e-9


def test_what_no_other_record_determines_says_nothing_of_an_effect(base, monkeypatch):
    """Before and after, the log density of such a record is minus infinity; of one alone it decides."""
    state = base.start
    made = refit(state.model, state.optimum, state.whitening, [(PAIR[0], np.ones(1))], 50.0)
    for now, was, gain in (((-np.inf, -3.0), (-np.inf, -5.0), 2.0), ((-np.inf, -3.0), (-1.0, -5.0), -np.inf)):
        scores = {id(made.optimum): np.array(now), id(made.before): np.array(was)}
        monkeypatch.setattr(refits, "log_scores", lambda optimum, _, scores=scores: scores[id(optimum)])
        assert replace(made).left_out == gain


def test_a_residual_too_large_to_be_squared_is_not_likely(base):
    state = base.start
    far = np.where(np.arange(state.optimum.x.size) == 0, 1e160, state.optimum.x)
    regression = Regression(state.model, state.whitening)
    assert regression.cost(far) == np.inf
    with pytest.raises(FloatingPointError, match="too large"):
        regression.at(far)


@pytest.mark.parametrize("known", [True, False])
def test_constants_are_moved_only_where_an_effect_is_worth_something(base, monkeypatch, known):
    """Under noise that is known: noise of the residual alone holds the effect too."""
    moved = []
    monkeypatch.setattr(refits, "freed", lambda model, x, *_: (moved.append(model), (model, x))[1])
    state, effect = base.start, PAIR[1]
    whitening = replace(state.whitening, dependence=() if known else (2.0,))
    refit(state.model, state.optimum, whitening, [(effect, np.ones(1))], 50.0)
    assert bool(moved) is not known  # the records have no pulse
    monkeypatch.setattr(refits, "_SLIGHT", -np.inf)
    refit(state.model, state.optimum, whitening, [(effect, np.ones(1))], 50.0)
    assert moved


def test_other_starts_are_left_out_where_the_first_reaches_enough(base):
    """Descents of one evaluation, from where the others end lower."""
    x = base.start.optimum.x
    regression = Regression(base.start.model, base.start.whitening)
    low, high = regression.model.bounds
    away = np.clip(x + 0.3 * base.start.model.spread, low, high)
    first, best = regression.cost(away), base.start.optimum.cost
    assert first > best + 10.0

    def glanced(enough):
        return [one.cost for one in regression.glanced([away, x, away], gain=1e12, enough=enough)]

    (alone,) = glanced(first)
    assert first >= alone > best + 1.0
    assert glanced(best) == glanced(-np.inf) == [pytest.approx(best, abs=0.01), alone, alone]


APART = Device(
    (
        (path(0.8, 2.0, (8.0,), (1.0,)), path(2.5, 5.0, (15.0,), (1.0,))),
        (path(-0.5, 4.0, (25.0,), (1.0,)), path(0.01, 4.0, (5.0,), (1.0,))),
    ),
    (Axis("heater", "%"), Axis("fan", "V")),
    (Axis("warm", "degC"), Axis("damp", "%")),
    (25.0, 50.0),
)


@pytest.mark.slow
def test_a_plant_of_separate_paths_at_rest_is_not_said_to_have_begun_elsewhere():
    """Before the first change of a drive it rests; paths that share too much make it look otherwise."""
    command = joint(on_off(40.0, hold=60.0, at=10.2, rest=20.0), on_off(3.0, hold=60.0, at=40.2, rest=1.0))
    one = record(3, device=APART, command=command, duration=120.0, camera=0.5, noise_sd=0.15)
    seen = ~np.isnan(one.response).any(axis=1)  # without the early row that states the rest
    made = study(replace(one, time=one.time[seen], drive=one.drive[seen], response=one.response[seen]))
    base = basemodel.fitted_base(made, (), as_stated=False, draws=100)
    assert not base.fit.noise_known
    assert "before the first row" not in base.sentence
    assert "an element and a delay of its own" in base.sentence
    shared = basemodel._based(made)
    mended = basemodel.started(made, shared.fit)
    assert mended is not None  # what the shared structure alone would have said
