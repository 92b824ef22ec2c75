"""Integer orders beside the plant of a loop: taken where the records let them be, element by element, with
the odds of a fit of the stated orders, and refused where a fractional order shows."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from math import log

import numpy as np
import pytest

from lcopa_bayes.bench.inversion import unit_step
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import ModelSettings, PriorSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.basemodel import Base, fitted_base
from lcopa_bayes.effectsearch.integerplants import IntegerPlant, integer_dynamics, integer_plant
from lcopa_bayes.effectsearch.lags import lags_of
from lcopa_bayes.effectsearch.lesseffects import less_effects
from lcopa_bayes.effectsearch.plantsbeside import PlantsBeside
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.inference import lagsum
from lcopa_bayes.model.effects.effect import Effect
from lcopa_bayes.model.effects.response import EvenCurvature
from lcopa_bayes.model.effects.sensor import SensorLag
from lcopa_bayes.model.path import TransferPath

RINGING = TransferPath.of_times(1.0, 0.4, (2.0, 1.6), (2.0, 1.0))
"""Second order, damping 0.4."""
HALF = TransferPath.of_times(0.8, 0.3, (1.5,), (0.5,))
SLOW = TransferPath(0.8, 0.3, (0.8 * 1.5**0.5, 0.8, 1.5**0.5), (1.5, 1.0, 0.5), 1.0)
"""One term of order 0.5 and 1.5 s behind a lag of 0.8 s."""
NOISE = 0.004
_SAMPLES, _SPAN = 250, 30.0


def record(name: str, paths: tuple[TransferPath, ...], seed: int) -> Record:
    """Each drive steps up and half down again at times of its own, after a rest."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, _SPAN, _SAMPLES)
    drive, response = np.zeros((_SAMPLES, len(paths))), 0.02 + NOISE * rng.standard_normal(_SAMPLES)
    for j, path in enumerate(paths):
        changes = time[[40 + 45 * j, 150 + 30 * j]]
        for at, size in zip(changes, (1.0, -0.5), strict=True):
            drive[time >= at, j] += size
            since = time - at - path.delay
            response += size * path.gain * np.where(since > 0, unit_step(path, np.maximum(since, 1e-9)), 0.0)
    drives = tuple(Axis(f"u{j + 1}", "V") for j in range(len(paths)))
    return Record(name, time, drive, response[:, None], drives, (Axis("y", "V"),), "s")


@cache
def based(paths: tuple[TransferPath, ...], terms: int | tuple[int, ...]) -> Base:
    """The base fit of two records with so many terms, of each element where several are given."""
    fit = tuple(record(f"run{k}", paths, 5 + k) for k in range(2))
    own = terms if isinstance(terms, int) else {f"y_u{j + 1}": n for j, n in enumerate(terms)}
    model = ModelSettings(terms=own, share="none", delay="path")
    study = Study("orders", None, "s", 3, fit, (), model)
    return fitted_base(study, (), as_stated=True, draws=100)


def found(paths: tuple[TransferPath, ...], terms: int | tuple[int, ...]) -> IntegerPlant | None:
    base = based(paths, terms)
    return integer_plant(base.start, base.problem)


@pytest.mark.parametrize("terms", [1, 2])
def test_a_second_order_plant_has_integer_orders(terms: int) -> None:
    """Whatever the number of fractional terms, with the numbers of the plant that made the records."""
    integer = found((RINGING,), terms)
    assert integer is not None
    assert integer.orders == {"": (2.0, 1.0)}
    assert (0.5 <= integer.weight < 0.9) if terms == 2 else (integer.weight > 0.999)  # one term does not ring
    state = integer.plant.state
    model, optimum = state.model, state.optimum
    truth = {"gain": 1.0, "delay": 0.4, "time_1": log(2.0), "time_2": log(1.6)}
    for name, value in truth.items():
        k = model.names.index(name)
        assert abs(optimum.x[k] - value) < 4 * optimum.sd[k], name
        assert optimum.sd[k] < 0.1
    assert not any(name.startswith("order") for name in model.names)


def test_its_interval_holds_a_delay_that_free_orders_put_elsewhere() -> None:
    """Half of the draws of a delay and no draws of a time are those of the plant with integer orders."""
    base = based((RINGING,), 2)
    integer = integer_plant(base.start, base.problem)
    assert integer is not None
    drawn = integer.plant.number("delay")
    assert drawn is not None
    assert abs(np.mean(drawn) - 0.4) < 4 * np.std(drawn)
    assert np.std(drawn) < base.start.optimum.sd[base.start.model.names.index("delay")]
    assert integer.plant.number("order_1") is None


def test_a_slow_term_of_a_low_order_is_no_start_of_a_lag() -> None:
    """A plant one of whose paths has three times the gain and puts the rest into a term of order 0.2 and
    thousands of time units leads to the same plant with integer orders."""
    base = based((RINGING, RINGING), (2, 2))
    start = base.start
    other = {"gain": 3.0, "delay": 0.9, "time_1": 4.6, "order_1": 1.75, "time_2": 1650.0, "order_2": 0.17}
    values = start.model.values(start.optimum.x)
    for name, value in other.items():
        values[start.model.plant.table.names.index(f"{name}_y_u2")] = value
    optimum = Regression(start.model, start.whitening).at(start.model.coordinates(values))
    found = [integer_plant(state, base.problem) for state in (replace(start, optimum=optimum), start)]
    costs = [one.plant.state.optimum.cost for one in found if one is not None]
    assert costs == pytest.approx([0.5 * start.whitening.size] * 2, rel=0.2)


def test_a_fractional_order_that_shows_is_not_an_integer() -> None:
    assert found((HALF,), 1) is None


def test_elements_are_held_apart() -> None:
    """One of a second order beside one of order 0.5: only the first is held."""
    integer = found((RINGING, HALF), (2, 1))
    assert integer is not None
    assert integer.orders == {"y_u1": (2.0, 1.0)}
    assert any(name == "order_1_y_u2" for name in integer.plant.state.model.names)


def test_its_odds_are_those_of_a_fit_with_stated_orders() -> None:
    """By least squares of a study that states them, from its own starts, under the same noise."""
    base = based((RINGING,), 2)
    integer = integer_plant(base.start, base.problem)
    assert integer is not None
    study = base.problem.study
    stated = replace(study, model=replace(study.model, terms=2, orders=(2.0, 1.0)))
    whitening = base.start.whitening
    other = fitted_base(stated, (), as_stated=True, draws=100).start
    optimum = Regression(other.model, whitening).descend(other.optimum.x)
    squares = [float(at.white @ at.white) for at in (base.start.optimum, optimum)]
    gained = (squares[0] - squares[1]) / 2
    assert integer.plant.gained == pytest.approx(gained, abs=0.01)
    assert integer.log_odds == pytest.approx(gained + log(whitening.effective), abs=0.01)


def test_sums_of_lags_are_held_against_it() -> None:
    """One term of a free order does not ring: sums of lags follow better, and the second-order plant better
    still. Their criterion is that of a search beside the latter alone."""
    base = based((RINGING,), 1)
    start, integer = base.start, integer_plant(base.start, base.problem)
    assert integer is not None
    found = lags_of(start, base.problem)
    assert [one.support for one in found] == ["lags"]
    held = PlantsBeside(integer=integer).held_against(found, start, base.problem)
    direct = lags_of(integer.plant.state, base.problem)
    assert [one.support for one in held] == [one.support for one in direct] == ["plant"]
    assert held[0].advantage == pytest.approx(direct[0].advantage, abs=0.1 * abs(direct[0].advantage))
    swapped = PlantsBeside(integer=replace(integer, plant=replace(integer.plant, state=start)))
    assert swapped.held_against(found, start, base.problem)[0].advantage == found[0].advantage
    assert PlantsBeside().held_against(found, start, base.problem) == found


def test_of_long_records_both_are_of_the_samples_that_lags_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every second one here."""
    monkeypatch.setattr(lagsum, "_SAMPLES", 300)
    base = based((RINGING,), 1)
    start, integer = base.start, integer_plant(base.start, base.problem)
    assert integer is not None
    (found,), (direct,) = (lags_of(state, base.problem) for state in (start, integer.plant.state))
    (held,) = PlantsBeside(integer=integer).held_against([found], start, base.problem)
    assert found.square < float(start.optimum.white @ start.optimum.white)
    # both plants have four parameters: a gain, a delay, a time and an order; a gain, a delay and two times
    assert found.advantage - held.advantage == pytest.approx(found.square - direct.square)


def test_weights_follow_the_odds() -> None:
    """A quarter where they are one to three; half where only the number of parameters speaks for it, and more
    where its likelihood does."""
    base = based((RINGING,), 2)
    integer = integer_plant(base.start, base.problem)
    assert integer is not None
    weight = partial(replace, integer)
    assert weight(log_odds=50.0, plant=replace(integer.plant, gained=-0.5)).weight == 0.5
    assert weight(log_odds=50.0, plant=replace(integer.plant, gained=log(4.0))).weight == pytest.approx(0.8)
    assert weight(log_odds=5000.0, plant=replace(integer.plant, gained=4000.0)).weight == 1.0
    assert weight(log_odds=-log(3.0)).weight == pytest.approx(0.25)
    beside = PlantsBeside(integer=weight(log_odds=-log(3.0)))
    assert [share for _, share in beside.shares] == pytest.approx([0.75, 0.25])
    assert (
        "Of their draws 75 % are of the plant chosen, 25 % of a plant with integer orders (2 and 1"
        in beside.sentence
    )
    assert not PlantsBeside().sentence


def test_three_terms_stay_as_they_are() -> None:
    base = based((RINGING,), 2)
    study = base.problem.study
    richer = fitted_base(replace(study, model=replace(study.model, terms=3)), (), as_stated=True, draws=100)
    assert integer_plant(richer.start, richer.problem) is None


def with_effect(base: Base, effect: Effect, psi: float) -> State:
    """A base fit's plant with one effect, descended to its optimum."""
    start = base.start
    model = start.model.having(effect)
    x = np.append(start.optimum.x, psi)
    return State(model, Regression(model, start.whitening).descend(x), start.whitening)


def test_beside_an_effect_it_is_that_of_a_descent_of_the_whole() -> None:
    """Though it is found on the records less the effect: by descents with stated orders and the effect, from
    the plant without it."""
    plain = based((RINGING,), 2).problem.study
    bent = tuple(replace(one, response=one.response + 0.2 * one.response**2) for one in plain.fit)
    base = fitted_base(replace(plain, fit=bent), (), as_stated=True, draws=100)
    state = with_effect(base, EvenCurvature(), 0.05)
    assert state.optimum.cost < base.start.optimum.cost - 50.0
    integer = integer_plant(state, base.problem)
    assert integer is not None
    assert integer.orders == {"": (2.0, 1.0)}
    stated = replace(plain, fit=bent, model=replace(plain.model, terms=2, orders=(2.0, 1.0)))
    other = fitted_base(stated, (), as_stated=True, draws=100)
    model = integer.plant.state.model
    assert other.start.model.names == model.names[:-1]
    starts = [np.append(other.start.optimum.x, psi) for psi in (0.0, 0.05)]
    optimum = Regression(model, state.whitening).best(starts)
    gained = 0.5 * (state.optimum.white @ state.optimum.white - optimum.white @ optimum.white)
    assert integer.plant.gained == pytest.approx(gained, abs=0.05)
    assert integer.log_odds == pytest.approx(gained + log(state.whitening.effective), abs=0.05)


def test_records_less_the_effects_are_those_of_the_plant_alone() -> None:
    base = based((RINGING,), 2)
    state = with_effect(base, EvenCurvature(), 0.05)
    held = replace(
        state, optimum=Regression(state.model, state.whitening).at(np.append(state.optimum.x[:-1], 0.3))
    )
    bare = less_effects(held)
    assert not bare.model.effects
    same = Regression(bare.model, bare.whitening).at(held.optimum.x[:-1])
    np.testing.assert_allclose(same.residual, held.optimum.residual, atol=1e-12)
    assert less_effects(base.start) is base.start


def test_a_lag_that_imitates_a_second_order_takes_no_name() -> None:
    """One fractional term behind a sensor lag follows a plant that rings; so do orders 2 and 1 without it."""
    base = based((RINGING,), 1)
    state = with_effect(base, SensorLag(), 0.5)
    assert state.optimum.cost < base.start.optimum.cost - 50.0  # the lag would be named
    found = integer_dynamics(state, base.problem)
    assert found is not None
    assert "2 and 1" in found.said
    assert not found.astray


def test_a_lag_behind_a_fractional_plant_keeps_its_name() -> None:
    """No integer orders follow it."""
    base = based((SLOW,), 1)
    state = with_effect(base, SensorLag(), 0.5)
    assert integer_dynamics(state, base.problem) is None


def test_nonlinear_effects_keep_their_names() -> None:
    """Integer orders stand in for linear dynamics alone."""
    base = based((RINGING,), 1)
    assert integer_dynamics(with_effect(base, EvenCurvature(), 0.01), base.problem) is None
    assert integer_dynamics(base.start, base.problem) is None


def test_integer_orders_are_held_against_unseen_records() -> None:
    """Those of a plant that is another one there are off by what both plants differ in."""
    base = based((RINGING,), 2)
    slower = record("held", (TransferPath.of_times(1.0, 0.4, (2.2, 1.6), (2.0, 1.0)),), 9)
    own, other = (
        replace(base.problem, study=replace(base.problem.study, held_out=(one,)))
        for one in (record("held", (RINGING,), 9), slower)
    )
    same, off = (integer_plant(base.start, one) for one in (own, other))
    assert same is not None
    assert off is not None
    assert same.unseen == pytest.approx(1.0, abs=0.15)
    apart = slower.response - record("held", (RINGING,), 9).response
    assert off.unseen == pytest.approx(np.hypot(1.0, np.sqrt(np.mean(apart**2)) / NOISE), rel=0.15)


def test_an_order_with_a_stated_prior_stays() -> None:
    """Its support may hold no integer."""
    base = based((RINGING,), 2)
    own = PriorSettings("order_1", dist="uniform", parameters={"loc": 1.2, "scale": 0.7})
    stated = fitted_base(replace(base.problem.study, priors={"order_1": own}), (), as_stated=True, draws=100)
    assert integer_plant(stated.start, stated.problem) is None
