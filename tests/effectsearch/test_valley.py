"""Valleys of a posterior that no normal about its optimum follows: against quadrature, and where none are."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import quad

from lcopa_bayes.bench.inversion import unit_step
from lcopa_bayes.bench.undeclared import campaign, drawn
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import ModelSettings, PriorSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch import explained as explained_module
from lcopa_bayes.effectsearch.basemodel import fitted_base
from lcopa_bayes.effectsearch.drawsabout import likely_draws
from lcopa_bayes.effectsearch.explained import explained_draws, explained_study
from lcopa_bayes.effectsearch.refits import refit
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.sidednormal import SidedNormal
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.optimum import Optimum
from lcopa_bayes.model.effects.effect import Effect
from lcopa_bayes.model.effects.response import CrossFade, OddCurvature
from lcopa_bayes.model.path import TransferPath

LAG = TransferPath.of_times(1.0, 1.0, (2.0,), (1.0,))
NOISE, COUNT = 0.03, 20000


@cache
def studied() -> Study:
    """One step of a lag whose centroid waits, its gain and order known."""
    time = np.arange(0.0, 30.0, 0.25)
    part = np.where(time > 7.0, unit_step(LAG, np.maximum(time - 7.0, 1e-9)), 0.0)
    new, old = np.sinc(1 - part) ** 2, np.sinc(part) ** 2
    waiting = np.where((part > 0) & (part < 1), 0.6 * (new / (new + old) - part), 0.0)
    response = part + waiting + NOISE * np.random.default_rng(1).standard_normal(time.size)
    drive = (time >= 6.0).astype(float)
    made = Record("run", time, drive[:, None], response[:, None], (Axis("u", "V"),), (Axis("y", "V"),), "s")
    known = {"gain": 1.0, "offset": 0.0, "order_1": 1.0}
    priors = {name: PriorSettings(name, fixed=value) for name, value in known.items()}
    model = ModelSettings(terms=1, offset="shared")
    return Study("valley", None, "s", 3, (made,), (), model, priors=priors)


@cache
def explained(effect: type[Effect]) -> State:
    """The same with an effect at its optimum: how late the response is, its delay and the effect share."""
    start = fitted_base(studied(), (), as_stated=True, draws=100).start
    added = [(effect(), np.array([0.5]))]
    return refit(start.model, start.optimum, start.whitening, added, 100.0).state


def quadrature(state: State) -> list[tuple[np.ndarray, np.ndarray]]:
    """Values of each coordinate and their distribution function, by the sum over a grid."""
    regression, x, sd = Regression(state.model, state.whitening), state.optimum.x, state.optimum.sd
    low, high = state.model.bounds
    first, last = np.maximum(low, x - 5 * sd), np.minimum(high, x + 5 * sd)
    lines = [np.linspace(*ends, count) for *ends, count in zip(first, last, (27, 27, 21), strict=True)]
    cost = regression.costs(np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3))
    density = np.exp(cost.min() - cost).reshape([line.size for line in lines])
    out = []
    for k, line in enumerate(lines):
        own = density.sum(axis=tuple({0, 1, 2} - {k}))
        below = np.append(0.0, np.cumsum(own[1:] + own[:-1]))
        out.append((line, below / below[-1]))
    return out


def farthest(drawn: np.ndarray, exact: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Largest difference of the distribution functions of each coordinate (Kolmogorov and Smirnov)."""
    return np.array(
        [
            np.abs(np.searchsorted(np.sort(own), line) / own.size - below).max()
            for own, (line, below) in zip(drawn.T, exact, strict=True)
        ]
    )


def test_draws_along_a_valley_have_the_distribution_of_quadrature() -> None:
    """Of the size and of what goes with it; normal draws have not, so that this tests something."""
    state = explained(CrossFade)
    assert state.model.names == ("time_1", "delay", "cross_fade.strength")
    assert state.valley is not None
    exact, chance = quadrature(state), 1.63 / np.sqrt(COUNT)  # 1 in 100
    middle, _, shift = state.valley.draws(np.random.default_rng(1), COUNT)
    assert (farthest(middle + shift, exact) < 0.004 + chance).all()
    likely = likely_draws(state, np.random.default_rng(1), COUNT // 10)
    assert (farthest(likely, exact) < 0.004 + np.sqrt(10) * chance).all()
    x, covariance = state.optimum.x, state.optimum.covariance
    normal = np.random.default_rng(1).multivariate_normal(x, covariance, COUNT)
    assert (farthest(normal, exact) > 0.08).all()


def test_the_floor_is_the_least_cost_at_its_value() -> None:
    """Its slope along every other coordinate vanishes, and no draw of the others is below it."""
    state = explained(CrossFade)
    valley, regression = state.valley, Regression(state.model, state.whitening)
    assert valley is not None
    assert (np.diff(valley.values) > 0).all()
    for one in valley.floor:
        ends = np.minimum(one.x - state.model.bounds[0], state.model.bounds[1] - one.x) < 1e-6
        slope = regression.gradient(one)[:2] * one.sd[:2]
        assert np.abs(slope[~ends[:2]]).max(initial=0.0) < 0.25  # a step gains less than 0.03 nat
    middle, least, shift = valley.draws(np.random.default_rng(2), 300)
    assert_allclose(shift[:, valley.known], 0.0, atol=1e-12)
    assert_allclose(regression.costs(middle), least, atol=0.1)
    assert (regression.costs_inside(middle + shift) > least - 0.1).all()
    assert least.max() < state.optimum.cost + 6 + 1.5


def test_points_along_it_are_where_draws_are_looked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of the floor whose density counts, the optimum first, beside the noise of their residuals."""
    state = explained(CrossFade)
    assert state.valley is not None
    found: list[Optimum] = []
    monkeypatch.setattr(explained_module, "_sampled", lambda _, optima, **options: found.extend(optima))
    aside = state.valley.aside(state.optimum)
    names = state.model.posterior.table.names
    near, *along = (
        dict(zip(names, state.model.values(x).tolist(), strict=True)) for x in (state.optimum.x, *aside)
    )
    study = explained_study(studied(), state.model)
    assert explained_draws(study, lambda *_: True, near=near, along=along) is None
    place = problem_of(study).posterior.table.names.index("cross_fade.strength")
    sizes = np.array([one.values[place] for one in found])
    assert_allclose(sizes[1:], [x[2] for x in aside], rtol=1e-6)
    assert sizes[0] == pytest.approx(state.optimum.x[2], abs=0.1 * state.optimum.sd[2])
    assert len(aside) > 4
    assert np.ptp(sizes) > 3 * state.optimum.sd[2]


def test_of_a_normal_posterior_there_is_none() -> None:
    assert explained(OddCurvature).valley is None


def test_a_plant_without_effects_has_none() -> None:
    state = explained(OddCurvature)
    model = state.model.having()
    plain = Regression(model, state.whitening).descend(state.optimum.x[:2])
    assert State(model, plain, state.whitening).valley is None


def test_volumes_are_those_of_the_normal_given_a_coordinate() -> None:
    state = explained(OddCurvature)
    optimum, x = state.optimum, state.optimum.x
    precision = np.linalg.inv(optimum.covariance)
    free = replace(optimum, stuck=np.zeros(3, dtype=bool))

    def costs(many: np.ndarray) -> np.ndarray:
        return optimum.cost + 0.5 * np.einsum("bk,kl,bl->b", many - x, precision, many - x)

    whole = SidedNormal.about(free, state.model.spread, costs)
    assert whole.log_volume == pytest.approx(0.5 * np.linalg.slogdet(2 * np.pi * optimum.covariance)[1])
    given = SidedNormal.about(free, state.model.spread, costs, known=1)
    others = np.linalg.inv(precision[np.ix_([0, 2], [0, 2])])
    assert given.log_volume == pytest.approx(0.5 * np.linalg.slogdet(2 * np.pi * others)[1])
    shift = given.draw(np.random.default_rng(3), COUNT)
    assert_allclose(shift[:, 1], 0.0)
    assert_allclose(np.cov(shift[:, [0, 2]].T) / others, 1.0, atol=0.15)


@pytest.mark.parametrize("slope", [0.5, 4.0])
def test_the_volume_of_a_coordinate_at_an_end_is_that_of_its_side(slope: float) -> None:
    held = SidedNormal(
        np.array([True]),
        np.array([False]),
        np.array([-slope]),
        np.array([0.7]),
        np.empty((0, 1)),
        np.empty((0, 1)),
        np.empty((0, 2)),
    )
    exact = quad(lambda d: np.exp(-slope * d - 0.5 * (d / 0.7) ** 2), 0, np.inf)[0]
    assert held.log_volume == pytest.approx(np.log(exact))


def test_an_effect_that_is_like_a_delay_is_looked_for_beside_shorter_ones() -> None:
    """A plant without it has a delay of 3.89 for 3.10 ms, and from there an optimum at half the true size is
    found, 26 nat above the other."""
    rng = np.random.default_rng([12, 77])
    hidden = drawn(["cross_fade"], rng)
    made = campaign(hidden, rng, drives="plain")
    model = ModelSettings(terms={"direct": 2, "cross": 1})
    start = fitted_base(
        Study("late", None, "ms", 12, made.fit, (), model), (), as_stated=True, draws=100
    ).start
    found = refit(start.model, start.optimum, start.whitening, [(CrossFade(), np.array([0.5]))], 100.0)
    size, delay = (found.optimum.x[found.model.names.index(key)] for key in ("cross_fade.strength", "delay"))
    assert start.optimum.x[start.model.names.index("delay")] > made.device.paths[0][0].delay + 0.5
    assert delay == pytest.approx(made.device.paths[0][0].delay, abs=0.2)
    assert size == pytest.approx(hidden[0].numbers["strength"], abs=4 * found.optimum.sd[-1])
