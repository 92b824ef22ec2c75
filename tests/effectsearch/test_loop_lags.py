"""Numbers of a loop over sums of lags, which are named where a linear effect would be a guess."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq
from test_loop_joint import AXIS

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.data.record import Record
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.lags import lags_of, linear_dynamics
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.effectsearch.loopresult import Loop
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.summary import results
from lcopa_bayes.effectsearch.verdict import Verdict
from lcopa_bayes.model.effects.dynamics import RiseFallAsymmetry
from lcopa_bayes.model.effects.generic import UnmodelledLag
from lcopa_bayes.model.effects.response import Clipping
from lcopa_bayes.model.effects.sensor import SensorLag

GAIN, DELAY, TIMES, SD, LIMIT = 0.8, 1.0, np.array([30.0, 10.0, 5.0]), 0.004, 0.6


def risen(time: Vector, times: Vector = TIMES) -> Vector:
    """Unit step response of lags one behind the other, by partial fractions."""
    late = np.maximum(np.asarray(time) - DELAY, 0.0)
    shares = [np.prod([own / (own - one) for one in times if one != own]) for own in times]
    return 1 - sum(share * np.exp(-late / own) for share, own in zip(shares, times, strict=True))


def record(name: str, levels: list[float], seed: int, times: Vector = TIMES, limit: float = np.inf) -> Record:
    rng = np.random.default_rng(seed)
    time, at = np.arange(500.0), 30.0 + 110.0 * np.arange(len(levels))
    drive = np.concatenate([[0.0], levels])[np.searchsorted(at, time, side="right")]
    jumps = np.diff([0.0, *levels])
    response = GAIN * sum(jump * risen(time - start, times) for jump, start in zip(jumps, at, strict=True))
    response = np.clip(response, -limit, limit) + SD * rng.standard_normal(time.size)
    return Record(name, time, drive[:, None], response[:, None], AXIS, AXIS, "ms")


def study_of(times: Vector = TIMES, limit: float = np.inf, terms: int = 1) -> Study:
    patterns = {"a": [1.0, -0.5, 0.25, 0.0], "b": [-0.6, 1.0, 0.4, -1.0], "c": [0.5, 1.0, 0.0, -0.8]}
    made = [record(name, levels, k, times, limit) for k, (name, levels) in enumerate(patterns.items())]
    return Study("chain", None, "ms", 3, tuple(made[:2]), tuple(made[2:]), ModelSettings(terms=terms))


LIBRARY = [SensorLag, RiseFallAsymmetry, Clipping, UnmodelledLag]


@pytest.fixture(scope="module")
def chain() -> Loop:
    """Three lags in a chain, which no Kelvin element with a delay is, and nothing else."""
    return loop(study_of(), library=LIBRARY, sample=False, quick=True)


def test_a_chain_of_lags_takes_no_name(chain: Loop):
    assert chain.verdict.kind == "unexplained"
    assert chain.names == ()
    assert chain.verdict.sentence.startswith("Unmodelled linear dynamics are missing: sums of 3 to 4 lags")
    assert [one.support for one in chain.lags] == ["lags"]
    shown = results(chain)
    assert "Sums of 3 to 4 lags follow the records better" in shown["alternatives"]["sentence"]
    assert "sample their onset" in shown["next_measurement"]


def test_figures_hold_the_truth_where_the_plant_of_the_loop_does_not(chain: Loop):
    rise = brentq(lambda t: risen(t) - 0.9, 1.0, 300.0) - brentq(lambda t: risen(t) - 0.1, 1.0, 300.0)
    truth = {"rise_10_90[x]": rise, "delay[x]": DELAY, "steady_state[x]": GAIN}
    figures = {one.name: one for one in chain.figures}
    missed = 0
    for name, true in truth.items():
        shown = figures[name].as_json(ess=100.0, grade="tentative", interval="Laplace")
        assert shown["lower"] <= true <= shown["upper"]
        missed += not shown["alone"][0] <= true <= shown["alone"][2]
    assert missed >= 1
    names = chain.after.state.model.names
    for name, figure in (("gain", "steady_state[x]"), ("delay", "delay[x]")):
        own, other = chain.number(names.index(name)), figures[figure]
        assert np.quantile(own.values, (0.05, 0.5, 0.95)) == pytest.approx(
            np.quantile(other.values, (0.05, 0.5, 0.95)), rel=0.02
        )


def test_a_structure_that_is_stated_stays_alone():
    found = loop(study_of(TIMES[:1]), library=LIBRARY, sample=False, quick=True, as_stated=True)
    assert found.verdict.kind == "clean"
    assert found.lags == ()


def test_what_stays_unexplained_keeps_its_sums_of_lags(monkeypatch: pytest.MonkeyPatch):
    """Whatever is missing, a plant of another form is as likely as before, and intervals are over it too."""
    unexplained = Verdict("unexplained", "tentative", "Something is missing.")
    monkeypatch.setattr("lcopa_bayes.effectsearch.loop.decide", lambda findings: unexplained)
    found = loop(study_of(TIMES[:1]), library=[], sample=False, quick=True)
    assert found.verdict.kind == "unexplained"
    (one,) = found.lags
    assert one.support == "both"
    assert one.drawn is None  # without `sample` they are drawn where they are asked for
    parts = {}
    for name, each in (("over", found), ("without", replace(found, lags=()))):
        parts[name] = next(len(figure.parts) for figure in each.figures if figure.name == "delay[x]")
    assert parts["over"] == parts["without"] + 1


@pytest.mark.slow
def test_what_a_nonlinear_effect_adds_is_taken_off_first():
    found = loop(study_of(TIMES[:1], LIMIT), library=LIBRARY, sample=False, quick=True)
    assert found.names == ("clipping",)
    (one,) = found.lags
    best = one.search.best
    assert 0.8 < best.square / best.size < 1.2
    gain = next(one for one in found.figures if one.name == "steady_state[x]")
    low, high = np.quantile(gain.values, (0.05, 0.95))
    assert low <= GAIN <= high
    (raw,) = lags_of(found.before.state, found.problem)
    assert raw.search.best.square > 2 * raw.search.best.size


def test_a_linear_effect_is_weighed_with_its_parameters_and_named_where_lags_have_no_support(chain: Loop):
    """Second method: Akaike's criterion of two descents."""
    state = chain.before.state
    (lag,) = (effect for effect in SensorLag.grid(state.model.effected.ranges)[:1])
    model = state.model.having(lag)
    optimum = Regression(model, state.whitening).descend(np.append(state.optimum.x, 0.1))
    lagged = replace(state, model=model, optimum=optimum)
    (one,) = lags_of(lagged, chain.problem)
    rows = model.plant.table.rows
    free = sum(row.free and row.kind in ("gain", "delay", "time", "order") for row in rows)
    square = float((state.whitening(optimum.residual) ** 2).sum())
    best = one.search.best
    expected = square + 2 * (free + 1) - min(one.search.fits[lags - 1].aic for lags in one.search.lags)
    assert one.advantage == pytest.approx(expected, abs=0.1)
    quiet = chain.base.noise_samples
    assert linear_dynamics(lagged, [one], quiet, -np.inf)
    # without support they still follow as well unless the effect is ahead by more than chance gives
    far, ahead = replace(one, advantage=-11.0), 0.5 * (best.misfit - square)
    assert linear_dynamics(lagged, [far], quiet, ahead + 0.1)
    assert not linear_dynamics(lagged, [far], quiet, ahead - 0.1)
    assert not linear_dynamics(lagged, [one], [100_000], 8.0)  # its residual is too large for that noise
    assert not linear_dynamics(chain.before.state, [far], quiet, np.inf)  # no effect to be held against
    model = model.having(lag, RiseFallAsymmetry())
    beside = replace(
        lagged, model=model, optimum=Regression(model, state.whitening).at(np.append(optimum.x, 0.1))
    )
    assert not linear_dynamics(beside, [one], quiet, np.inf)
