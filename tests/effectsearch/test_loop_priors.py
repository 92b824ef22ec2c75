"""An effect far beyond its default prior: the loop widens the prior, and pays for it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from test_loop import LIBRARY, study

from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import ModelSettings, PriorSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch import basemodel, noise, priorwidth, refits, signature
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.effectsearch.loopresult import Loop
from lcopa_bayes.effectsearch.refits import evidence_over, refit
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.defaultpriors import Scales
from lcopa_bayes.model.effects.catalogue import catalogue

AXIS = (Axis("x", "rad"),)
CUBE = 0.2
"""Cubic part of the reading of the lags, per deflection squared [1/rad^2]."""
NOISE = 0.02
CURVATURE = 0.29
"""Cubic part of the response at a deflection of 1 [-]: ten standard deviations of the default prior."""


def bent(seed: int) -> Study:
    """Records of a plant so bent, with more noise than `study` gives."""
    made = study(seed, CURVATURE)
    rng = np.random.default_rng(seed + 100)
    return replace(
        made,
        fit=tuple(
            replace(one, response=one.response + NOISE * rng.standard_normal(one.response.shape))
            for one in made.fit
        ),
    )


def searched(seed: int) -> Loop:
    return loop(bent(seed), library=LIBRARY, sample=False, quick=True, as_stated=True)


looped = cache(searched)
"""With the prior that the loop widens."""


def error(found: Loop) -> float:
    """Of the coefficient [posterior sd]."""
    state = found.after.state
    assert found.names == ("odd_curvature",)
    (k,) = [k for k, name in enumerate(state.model.names) if name == "odd_curvature.c"]
    truth = CURVATURE * state.model.effected.ranges.response[0] ** 2
    return float((state.optimum.x[k] - truth) / state.optimum.sd[k])


def test_a_large_effect_is_estimated_without_bias(monkeypatch):
    """Two draws of noise; held to the default prior the same refits are wrong by three sd."""
    seeds = (1, 2)
    found = [looped(seed) for seed in seeds]
    errors = np.array([error(one) for one in found])
    assert np.abs(errors).max() < 3.0
    assert abs(errors.mean()) < 3.0 / np.sqrt(len(seeds))
    monkeypatch.setattr(priorwidth, "_FAR", np.inf)
    assert error(searched(seeds[0])) < -3.0
    for one in found:
        assert one.after.state.model.wider == {"odd_curvature": 4.0}
        assert "prior of odd_curvature is too narrow" in one.verdict.sentence


def lag(name: str, height: float, rng: np.random.Generator) -> Record:
    """A first-order lag of 2 ms under a step, read by a sensor that adds a fifth of the cube."""
    t = np.arange(-15.0, 12.0, 0.25)
    y = height * -np.expm1(-np.maximum(t, 0) / 2)
    y = y + CUBE * y**3 + 0.01 * rng.normal(size=t.size)
    return Record(name, t, (height * (t >= 0))[:, None], y[:, None], AXIS, AXIS, "ms")


def of_lags(seed: int) -> Study:
    """Three steps of such a lag, and one held out."""
    rng = np.random.default_rng(seed)
    fit = tuple(lag(f"step{k}", height, rng) for k, height in enumerate((0.4, 0.8, 1.2)))
    return Study(
        "lags",
        None,
        "ms",
        seed,
        fit,
        (lag("held", 1.0, rng),),
        ModelSettings(terms=1, orders=(1.0,), offset="none"),
        priors={"delay": PriorSettings("delay", fixed=0.0)},
    )


def test_what_a_narrow_prior_takes_away_is_no_further_effect():
    found = loop(of_lags(0), sample=False, quick=True, as_stated=True)
    assert found.names == ("odd_curvature",)
    state = found.after.state
    k = state.model.plant_size
    truth = CUBE * state.model.effected.ranges.response[0] ** 2
    assert abs(state.optimum.x[k] - truth) < 3.5 * state.optimum.sd[k]


@pytest.mark.slow
def test_held_to_the_default_prior_a_search_does_not_end_with_the_curvature_alone(monkeypatch):
    monkeypatch.setattr(priorwidth, "_FAR", np.inf)
    held = loop(of_lags(0), sample=False, quick=True, as_stated=True)
    assert held.names != ("odd_curvature",)


def drifting(seed: int, period: float) -> Study:
    """A first-order lag in a single record whose sensor drifts by a fifth of the range, twenty times the
    default prior; it is at rest for 20 s, too short to know the noise by."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 300.0, period)

    def rise(start: float) -> np.ndarray:
        return -np.expm1(-np.maximum(t - start, 0.0) / 18.0)

    drive = np.where((t >= 20.0) & (t < 160.0), 5.0, 0.0)
    y = 10.0 * (rise(23.0) - rise(163.0)) + 0.006 * t + 0.05 * rng.standard_normal(t.size)
    record = Record("heating", t, drive[:, None], y[:, None], (Axis("u", "V"),), (Axis("y", "degC"),), "s")
    return Study("drifting", None, "s", seed, (record,), model=ModelSettings(terms=1))


@pytest.mark.parametrize("period", [pytest.param(0.5, marks=pytest.mark.slow), 1.0])
def test_a_drift_far_beyond_its_prior_is_named_and_nothing_else(period):
    """Neither another start of the plant nor effects of the device."""
    found = loop(drifting(3, period), sample=False, quick=True)
    assert found.names == ("pointing_drift",)
    assert found.verdict.kind == "disturbance"
    assert found.enlarged == ""
    assert found.base.smooth or period < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("period", [0.5, 1.0])
def test_a_drift_far_beyond_its_prior_is_not_named_otherwise(period, monkeypatch):
    """With one width of the prior the search sees no drift in the finer samples; the coarser ones leave a
    residual too smooth to be judged without."""
    if period < 1.0:
        monkeypatch.setattr(signature, "FACTORS", np.ones(1))
        monkeypatch.setattr(signature, "RARE", np.zeros(1))
    else:
        monkeypatch.setattr(basemodel, "_explained", lambda *given: np.inf)
    held = loop(drifting(3, period), sample=False, quick=True)
    assert held.names != ("pointing_drift",)


def saturated() -> Study:
    """A lag in a single record whose drive saturates: three levels, the largest less than stated."""
    rng = np.random.default_rng(11)
    t = np.arange(0.0, 400.0)
    times, levels = (30.0, 120.0, 220.0, 300.0), (1.0, 3.0, 2.0, 0.0)
    drive, y, last = np.zeros(t.size), np.zeros(t.size), 0.0
    for time, level in zip(times, levels, strict=True):
        drive[t >= time] = level
        y -= 0.5 * (min(level, 2.2) - last) * np.expm1(-np.maximum(t - time - 4.0, 0.0) / 12.0)
        last = min(level, 2.2)
    y += 0.01 * rng.standard_normal(t.size)
    record = Record("valve", t, drive[:, None], y[:, None], (Axis("v", "V"),), (Axis("i", "mA"),), "us")
    return Study("saturated", None, "us", 0, (record,), model=ModelSettings(terms=1))


@pytest.mark.slow
def test_more_than_the_whole_of_an_effect_is_no_name(monkeypatch):
    """Steps of the drive 2.7 times as uneven as its grey levels would make them follow any three levels."""
    assert "grey_quantisation" not in loop(saturated(), sample=False, quick=True).names
    monkeypatch.setattr(refits.Refit, "possible", True)
    monkeypatch.setattr(priorwidth, "_shares", lambda model: [])
    monkeypatch.setattr(signature.Signature, "_factors", signature.FACTORS)
    assert "grey_quantisation" in loop(saturated(), sample=False, quick=True).names


def test_a_response_that_began_inside_the_fitted_delay_is_no_noise():
    """A delay of 7 s where 3 s are true: samples from there on are left out, those alike are kept."""
    samples = problem_of(drifting(3, 0.5)).posterior.samples
    scale = Scales.of([one.record for one in samples])
    before, after = (noise._resting(samples, 0, delay, scale) for delay in (0.0, 7.0 / noise._SAFE))
    assert after[0].values.size == before[0].values.size == 40
    (kept,) = noise._resting(samples, 0, 2.5 / noise._SAFE, scale)
    assert kept.values.size == 45


def test_the_explained_study_has_the_wider_prior():
    found = looped(1)
    table = problem_of(found.study).posterior.table
    (row,) = [row for row in table.rows if row.name == "odd_curvature.c"]
    assert row.prior is not None
    (default,) = catalogue()["odd_curvature"]().coefficients(found.after.state.model.effected.ranges)
    assert row.prior.parameters["scale"] == pytest.approx(4 * default.scale)


def test_the_evidence_of_a_wider_prior_is_that_of_the_integral():
    """Two methods: Laplace evidence of the refit, or the integral over the coefficient of optima there."""
    found = looped(2)
    state, start = found.after.state, found.before.state
    effect = state.model.effects[0]
    made = refit(start.model, start.optimum, start.whitening, [(effect, np.ones(1))], 1e9)
    assert made.model.wider == {"odd_curvature": 4.0}
    assert made.paid == pytest.approx(-np.log(priorwidth.COMMON) - np.log(len(effect.grid(None))))
    k = made.model.plant_size
    sd = made.model.scale[0]
    grid = made.optimum.x[k] + np.linspace(-6, 6, 61) * made.optimum.sd[k]
    profile = np.array([_marginal(made.model, made.optimum.x, k, at, made.whitening) for at in grid])
    density = profile - 0.5 * (grid / sd) ** 2 - np.log(sd * np.sqrt(2 * np.pi))
    integral = np.log(np.trapezoid(np.exp(density - density.max()), grid)) + density.max()
    before = start.optimum.log_evidence
    assert integral - before == pytest.approx(made.log_bayes_factor - made.paid, abs=0.1)


def test_an_effect_is_worth_what_its_refit_is():
    """The wider prior is paid for in either."""
    first = looped(1).rounds[0]
    chosen = first.chosen
    assert chosen.paid == pytest.approx(-np.log(priorwidth.COMMON))
    gained, _ = evidence_over(first.state, chosen.state, chosen.quiet)
    assert gained == pytest.approx(chosen.log_bayes_factor)


def test_sizes_of_effects_are_over_their_default_priors():
    """As a refit takes them, whose priors are not widened yet."""
    state = looped(1).after.state
    ((effect, (size,)),) = state.model.sizes(state.optimum.x)
    (coefficient,) = effect.coefficients(state.model.effected.ranges)
    assert size * coefficient.scale == pytest.approx(state.optimum.x[state.model.plant_size])


def _marginal(model: ExtendedModel, x: np.ndarray, k: int, at: float, whitening) -> float:
    """Log evidence of the plant alone, the coefficient held at a value, linearised there [nat]."""
    moved = x.copy()
    moved[k] = at
    here = Regression(model, whitening).at(moved)
    others = np.arange(x.size) != k
    information = here.information[np.ix_(others, others)]
    mean, spread = np.nan_to_num(model.centre[others]), model.spread[others]
    precision = np.where(np.isnan(model.centre[others]), 0.0, 1 / spread**2)
    slope = here.jacobian[:, others].T @ here.white - precision * (moved[others] - mean)
    own = 0.5 * ((at - 0.0) / model.spread[k]) ** 2
    cost = here.cost - own - 0.5 * slope @ np.linalg.solve(information, slope)
    constant = 0.5 * here.white.size * np.log(2 * np.pi) + whitening.log_scale
    return float(-cost - constant - 0.5 * np.linalg.slogdet(information * np.outer(spread, spread))[1])


def test_an_effect_within_its_prior_keeps_it():
    made = study(2, 0.06)
    made = replace(made, fit=made.fit[:2])
    found = loop(made, library=LIBRARY, sample=False, quick=True, as_stated=True)
    assert found.names == ("odd_curvature",)
    assert found.after.state.model.wider == {}
    assert "too narrow" not in found.verdict.sentence
