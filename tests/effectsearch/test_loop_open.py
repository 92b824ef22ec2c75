"""What effects leave open of the numbers of a loop that the records neither show nor exclude."""

from dataclasses import replace
from math import log
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import truncnorm
from test_loop_joint import AXIS
from test_loop_unseen import fitted

from lcopa_bayes.data.record import Record
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.effectsearch.loopresult import Loop
from lcopa_bayes.effectsearch.noiselaw import Law
from lcopa_bayes.effectsearch.openeffects import (
    LEAST,
    Alternative,
    Mixture,
    Weighed,
    _step,
    alternatives,
    mixture,
    odds,
    step_figures,
)
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.summary import results
from lcopa_bayes.effectsearch.trace import LEAST as CHANCE
from lcopa_bayes.effectsearch.trace import trace
from lcopa_bayes.model.effects.commands import OverdrivePulse
from lcopa_bayes.model.effects.sensor import Exposure, SensorLag
from lcopa_bayes.results.averages import parts_of_sd, pooled

DELAY, FRAME, SD = 3.0, 2.0, 0.02


def pulsed(name: str, size: float, seed: int) -> Record:
    """A first-order plant with a delay whose every step begins with a pulse of that size."""
    rng = np.random.default_rng(seed)
    time, at = np.arange(600) * 0.5, 20.0 + 30.0 * np.arange(9)
    jumps = np.resize([1.0, -1.0, 0.5, -0.5], at.size)
    drive = np.concatenate([[0.0], np.cumsum(jumps)])[np.searchsorted(at, time, side="right")]

    def risen(late: float) -> np.ndarray:
        return (1 - np.exp(-np.maximum(time[:, None] - at - DELAY - late, 0.0) / 8.0)) @ jumps

    response = 2.0 * ((1 + size) * risen(0.0) - size * risen(FRAME)) + SD * rng.standard_normal(time.size)
    return Record(name, time, drive[:, None], response[:, None], AXIS, AXIS, "ms")


def study_of(size: float) -> Study:
    records = tuple(pulsed(f"r{k}", size, 10 + k) for k in range(3))
    return Study("pulsed", None, "ms", 3, records[:2], records[2:], ModelSettings(offset="shared"))


@pytest.fixture(scope="module")
def faint() -> Loop:
    """A pulse that is too small to be seen, and large enough to move the delay."""
    return loop(
        study_of(0.075), library=[OverdrivePulse, SensorLag], sample=False, quick=True, as_stated=True
    )


def test_one_linear_step_is_the_optimum_with_the_effect():
    """Second method: the model with the effect, descended to its optimum."""
    _, state = fitted(study_of(0.075))
    state = replace(state, model=state.model.at_scales(state.optimum.x, {f"r{k}": 0.0 for k in range(2)}))
    seen = trace(state, [OverdrivePulse], np.random.default_rng(0), noise_samples=(500,), draws=400)
    (pulse,) = seen.traced
    shift, root, least = _step(state, pulse.signature, seen)
    assert least == -np.inf
    assert pulse.signature.width(seen.residual, seen.scale) == 1.0
    model = state.model.having(pulse.signature.effect)
    best = Regression(model, state.whitening).descend(np.append(state.optimum.x, 0.0))
    sd = best.sd[:-1]
    moved = (best.x[:-1] - state.optimum.x) / sd
    assert np.abs(moved).max() > 1.0
    np.testing.assert_allclose(shift / sd, moved, atol=0.15)
    whole = np.sqrt(np.diag(state.optimum.covariance + root @ root.T))
    np.testing.assert_allclose(whole, sd, rtol=0.1)


def test_what_only_the_prior_tells_apart_has_a_width_under_noise_of_nearly_nothing():
    """An effect that is a tangent: what others leave of it is rounding in a difference of products."""
    _, state = fitted(study_of(0.075))
    laws = tuple(Law(1e-10 * one.sd) for one in state.whitening.noise)
    white = replace(state.whitening, noise=laws, posterior=())
    optimum = Regression(state.model, white).at(state.optimum.x)
    for k, spread in enumerate(state.model.spread):
        same = SimpleNamespace(
            spread=state.model.spread, signature=lambda *_, k=k: (optimum.tangents[:, [k]], None)
        )
        clear = SimpleNamespace(model=same, whitening=white, optimum=optimum)
        unit = SimpleNamespace(effect=None, width=lambda *_: 1.0, one_signed=False)
        _, root, _ = _step(clear, unit, SimpleNamespace(residual=None, scale=None))
        # psi ~ N(0, 1) beside a coordinate of that spread, whose sum the records know
        expected = 1 / np.sqrt(1 + spread**-2)
        assert np.sqrt((root[k] ** 2).sum()) == pytest.approx(expected, rel=0.05)


def test_what_cannot_be_seen_is_in_the_interval(faint: Loop):
    assert faint.verdict.kind == "clean"
    (k,) = faint.after.state.model.delays
    delay = faint.estimate(k)
    low, _, high = delay["alone"]
    assert not low < DELAY < high
    assert delay["lower"] < DELAY < delay["upper"]
    assert delay["sd_structure"] > 0.5 * delay["sd_noise"]


def test_figures_of_the_step_response_are_over_what_is_open(faint: Loop):
    """Second methods: the delay by the parameters, the rise of a lag in closed form, the static gain."""
    reported = {one.name: one for one in faint.figures}
    (k,) = faint.after.state.model.delays
    low, high = (np.quantile(reported["delay[x]"].values, at) for at in (0.05, 0.95))
    delay = faint.estimate(k)
    assert [low, high] == pytest.approx([delay["lower"], delay["upper"]], abs=0.15 * delay["sd"])
    assert reported["delay[x]"].weights.size == len(reported["delay[x]"].parts) > 1
    rise, end = reported["rise_10_90[x]"], reported["value_at_end[x]"]
    for one, truth in ((rise, 8 * np.log(9)), (end, 2.0)):
        shown = one.as_json(ess=100.0, grade="reliable", interval="Laplace")
        assert shown["lower"] < truth < shown["upper"]
        assert np.hypot(shown["sd_noise"], shown["sd_structure"]) == pytest.approx(shown["sd"], rel=0.05)
        assert shown["upper"] - shown["lower"] < 0.1 * truth
    shown = results(faint)["figures"]
    assert {one["name"] for one in shown} == set(reported) - {"delay[x]", "steady_state[x]"}
    assert all(one["interval"] == "Laplace" and one["grade"] == "tentative" for one in shown)


def test_a_number_that_is_open_keeps_its_open_side():
    values = [np.array([1.0, 2.0, 3.0, np.inf]), np.full(3, np.inf)]
    both = pooled(values, np.array([0.5, 0.5]))
    assert not np.isnan(both).any()
    assert np.mean(np.isinf(both)) == pytest.approx(0.625, abs=0.13)


def test_a_mixture_has_the_moments_of_its_parts():
    rng = np.random.default_rng(1)
    parts, weights = [rng.normal(0.0, 1.0, 20_000), rng.normal(3.0, 0.5, 20_000)], np.array([0.7, 0.3])
    values = pooled(parts, weights)
    noise, structure = parts_of_sd(parts, weights)
    assert values.mean() == pytest.approx(0.9, abs=0.03)
    assert noise == pytest.approx(np.sqrt(0.7 + 0.3 * 0.25), abs=0.02)
    assert structure == pytest.approx(3 * np.sqrt(0.21), abs=0.02)
    assert values.std() == pytest.approx(np.hypot(noise, structure), abs=0.02)


def test_draws_outside_the_support_take_weight_away(faint: Loop):
    state = faint.after.state
    (k,) = state.model.delays
    far = np.zeros(state.optimum.x.size)
    far[k] = (
        -state.optimum.x[k] if not state.model.posterior.table.rows[state.model.columns[k]].log_scale else 0
    )
    one = Alternative("a", 1.0, far, 1e-9 * np.eye(far.size))
    parts, weights, _ = mixture(state, None, [one])
    assert weights[1] == pytest.approx(1 / 3, abs=0.02)
    assert (parts[1] >= state.model.bounds[0]).all()


def test_a_rival_may_have_one_more_effect_beside_it_too(faint: Loop):
    """Second method: the sum over both, of odds that do not depend on each other."""
    state = faint.after.state
    size = state.optimum.x.size
    still = np.zeros(size), 1e-9 * np.eye(size)
    more, further = Alternative("more", 0.5, *still), Alternative("further", 0.25, *still)
    rival = Alternative("rival", 0.6, *still, instead="pulse")
    drawn = mixture(state, None, [more, rival, further])
    odds_of = {(second, third): second * third for second in (1.0, 0.6) for third in (1.0, 0.5, 0.25)}
    whole = sum(odds_of.values())
    assert drawn.rivals == (2,)
    assert drawn.weights[2] == pytest.approx(sum(v for (k, _), v in odds_of.items() if k == 0.6) / whole)
    np.testing.assert_allclose(drawn.weights[[0, 1, 3]], np.array([1.0, 0.5, 0.25]) / whole)


def test_what_stands_beside_the_final_model_takes_nothing_from_rivals_of_its_effects():
    parts = [np.zeros(3), np.ones(3), np.full(3, 2.0)]
    number = Weighed("a", "V", parts, np.array([0.5, 0.3, 0.2]), rivals=(1,))
    over = number.beside([np.full(3, 3.0), np.full(3, 4.0)], 0.8)
    np.testing.assert_allclose(over.weights, [0.1, 0.3, 0.04, 0.28, 0.28])
    assert over.rivals == (1,)
    again = over.beside([np.full(3, 5.0)], 0.5)
    np.testing.assert_allclose(again.weights, [0.05, 0.3, 0.02, 0.14, 0.14, 0.35])


def test_figures_know_which_of_their_parts_are_of_a_rival(faint: Loop):
    state, x = faint.after.state, faint.after.state.optimum.x
    outside = x.copy()
    # no plant: its part is left out, and those after it move up
    outside[np.isin(state.model.names, ("time_1", "order_1"))] = -30.0, 1.5
    parts = [np.tile(one, (12, 1)) for one in (x, outside, x)]
    shown = step_figures(state, Mixture(parts, np.array([0.5, 0.2, 0.3]), (2,)), span=50.0, time_unit="ms")
    assert all(one.rivals == (1,) for one in shown)
    np.testing.assert_allclose(shown[0].weights, [0.625, 0.375])


def test_a_coefficient_of_one_sign_moves_to_one_side():
    """Second method: moments of a normal cut off at 0, in closed form."""
    rng, own = np.random.default_rng(2), np.zeros((40_000, 1))
    for mean, sd in ((0.0, 1.0), (1.5, 0.8), (-2.0, 0.7)):
        one = Alternative("a", 1.0, np.array([-3.0 * mean]), np.array([[-3.0 * sd]]), -mean / sd)
        moved = one.draws(own, np.zeros(1), rng)[:, 0]
        cut = truncnorm(-mean / sd, np.inf, mean, sd)
        assert moved.max() <= 1e-9
        assert moved.mean() == pytest.approx(-3.0 * cut.mean(), abs=4 * 3.0 * cut.std() / 200)
        assert moved.std() == pytest.approx(3.0 * cut.std(), rel=0.03)


def test_what_every_reading_has_is_as_probable_as_not():
    """Of an exposure and a lag of the sensor each has half the odds of none by its evidence, unless the study
    states the exposure; the pulse has its share of those of all effects. A lag takes the place of a part of
    the delay that it looks like."""
    stated = replace(study_of(0.0), model=ModelSettings(offset="shared", exposure_ms=0.01))
    library = [OverdrivePulse, SensorLag, Exposure]
    clean = loop(stated, library=library, sample=False, quick=True, as_stated=True)
    last, state = clean.rounds[-1].trace, clean.after.state
    evidence = {
        one.name: np.exp([last.alone(each) * CHANCE / last.threshold for each in one.signatures]).mean()
        for one in last.traced
    }

    def assert_odds(found: tuple[Alternative, ...], **beforehand: float) -> None:
        for name, own in beforehand.items():
            weights, instances = [one.weight for one in found if one.name == name], last.of(name).signatures
            light = (len(instances) - len(weights)) * LEAST  # instances that weigh less are left out
            assert (
                own * evidence[name] - light <= sum(weights) * (1 + 1e-9) <= own * evidence[name] * (1 + 2e-9)
            )

    assert_odds(clean.open, sensor_lag=0.5, exposure=1 / 3, overdrive_pulse=1 / 3)
    assert_odds(alternatives(state, clean.rounds), sensor_lag=0.5, exposure=0.5, overdrive_pulse=1 / 3)
    (lag,) = (one for one in clean.open if one.name == "sensor_lag")
    (k,) = state.model.delays
    own = np.tile(state.optimum.x, (1000, 1))
    later = lag.draws(own, own[0], np.random.default_rng(1))[:, k] - own[:, k]
    assert later.max() <= 0.0
    assert later.min() < 0.0


def test_odds_are_those_of_the_evidence_even_where_a_float_does_not_hold_them():
    of_four = SimpleNamespace(threshold=CHANCE, traced=(None,) * 4)
    assert odds(of_four, log(20.0)) == pytest.approx(5.0)
    assert odds(SimpleNamespace(threshold=2 * CHANCE, traced=(None,)), 2 * log(20.0)) == pytest.approx(20.0)
    assert np.isfinite(2 * odds(of_four, 1e9))  # weights are divided by their sum


def test_coordinates_at_an_end_of_their_support_are_drawn_inside_of_it(faint: Loop):
    """Second methods: the density of a normal cut off at its end, by quadrature; regression of the others on
    those that are held, over normal draws of all."""
    state = faint.after.state
    optimum, names = state.optimum, state.model.names
    stuck = np.isin(names, ("order_1", "time_1"))
    white = optimum.white + optimum.jacobian[:, stuck] @ (np.array([1.0, -1.5]) * optimum.sd[stuck])
    held = replace(state, optimum=replace(optimum, stuck=stuck, white=white))
    ((draws,), *_) = mixture(held, None, [])
    slope = optimum.jacobian.T @ white
    for k in np.flatnonzero(stuck):
        inward = np.sign(slope[k]) * (optimum.x[k] - draws[:, k])
        assert inward.min() >= 0.0
        far = np.linspace(0.0, 8.0 * optimum.sd[k], 20_000)
        density = np.exp(-np.abs(slope[k]) * far - 0.5 * far**2 / optimum.sd[k] ** 2)
        mean = float(density @ far / density.sum())
        assert inward.mean() == pytest.approx(mean, rel=0.06)
    k = names.index("gain")
    drawn = np.random.default_rng(0).multivariate_normal(np.zeros(len(names)), state.covariance, 20_000)
    slopes = np.linalg.lstsq(drawn[:, stuck], drawn[:, k], rcond=None)[0]
    left = draws[:, k] - optimum.x[k] - (draws[:, stuck] - optimum.x[stuck]) @ slopes
    assert left.mean() == pytest.approx(0.0, abs=0.1 * left.std())
    assert left.std() == pytest.approx((drawn[:, k] - drawn[:, stuck] @ slopes).std(), rel=0.05)
