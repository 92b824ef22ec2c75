"""Linear dynamics that a model lacks take no name, and take none from what is no linear dynamics."""

import functools
import types
from dataclasses import replace

import numpy as np
import pytest

from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.candidates import offered
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.effectsearch.openeffects import Mixture, Weighed, step_figures
from lcopa_bayes.effectsearch.plantsbeside import PlantsBeside
from lcopa_bayes.effectsearch.unnameddynamics import UnnamedDynamics
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.effects import effected
from lcopa_bayes.model.effects.catalogue import bundled
from lcopa_bayes.model.effects.generic import UnmodelledLag, UnmodelledLinear

DELAY, NOISE = 0.1, 0.01
LEVELS = [(0.0, 1.0), (4.0, 0.0), (8.0, -0.6), (12.0, 0.3)]
FASTER = (0.6, 1.0), (0.4, 0.15)
LIBRARY = [bundled()[name] for name in ("backflow", "overdrive_pulse", "unmodelled_lag", "unmodelled_linear")]


def lagged(*parts, kick=0.0, unit="V", gains=((1.0,),)):
    """A study of a sum of lags, (share, time) each, in closed form, with a kick after falls."""
    rng = np.random.default_rng(3)
    frames = []
    for scale in (1.0, -0.7):
        t = np.arange(-4.0, 16.0, 0.1)
        frame = {"time_s": t}
        jumps = np.diff([scale * level for _, level in LEVELS], prepend=0.0)
        drive = sum(jump * (t >= at - 1e-9) for (at, _), jump in zip(LEVELS, jumps, strict=True))
        falls = np.diff([abs(level) for _, level in LEVELS], prepend=0.0) < 0
        y = np.zeros(t.size)
        for (at, _), jump, fall in zip(LEVELS, jumps, falls, strict=True):
            past = np.maximum(t - at - DELAY, 0.0)
            y += jump * sum(share * -np.expm1(-past / time) for share, time in parts)
            y += kick * fall * jump * 0.5 * (past / 0.5) ** 2 * np.exp(-past / 0.5)
        frame |= {f"drive_u{j + 1}_V": drive for j in range(len(gains[0]))}
        for i, row in enumerate(gains):
            frame[f"response_y{i + 1}_{unit}"] = sum(row) * y + NOISE * rng.standard_normal(t.size)
        frames.append(frame)
    return Study("lags", fit=frames[:1], held_out=frames[1:], seed=1)


def looped(study, library=LIBRARY):
    return loop(study, library=library, sample=False, quick=True, as_stated=True)


@functools.cache
def second_lag(*parts):
    return looped(lagged(*parts))


def test_a_second_lag_is_no_effect():
    """One term cannot have the zero of two lags, which an overdriven frame can imitate."""
    found = second_lag(*FASTER)
    assert found.names == ()
    assert found.verdict.kind == "unexplained"
    assert "linear dynamics" in found.verdict.sentence
    assert any(each.chosen.dynamics for each in found.rounds if each.chosen)
    said = found.plants.sentence
    assert said.endswith(
        "of the plant chosen with linear dynamics without a name, which are part of its response."
    )


def interval(number, level=0.9):
    return np.quantile(number.values, [(1 - level) / 2, (1 + level) / 2])


@pytest.mark.parametrize(
    "parts",
    [
        FASTER,
        pytest.param(((0.75, 1.0), (0.25, 4.0)), marks=pytest.mark.slow),
        pytest.param(((1.2, 1.0), (-0.2, 3.0)), marks=pytest.mark.slow),
    ],
    ids=["faster", "slower", "back"],
)
def test_numbers_are_those_of_the_response_with_unnamed_dynamics(parts):
    """A second lag beside one term: gain, delay and value at the end of the record in closed form; the gain
    of the plant alone is another."""
    found = second_lag(*parts)
    assert found.names == ()
    alone = replace(found, plants=PlantsBeside())
    names, span = found.after.state.model.names, found.problem.scales.span
    end = sum(share * -np.expm1(-(span - DELAY) / time) for share, time in parts)
    own = {one.name: one for one in found.figures}
    (low, high), (least, most) = (interval(one.number(names.index("gain"))) for one in (found, alone))
    assert low < 1.0 < high
    assert not least < 1.0 < most
    assert np.array_equal(found.number(names.index("gain")).values, own["steady_state[y1]"].values)
    low, high = interval(found.number(names.index("delay")), 0.99)
    assert low < DELAY < high
    low, high = interval(own["value_at_end[y1]"])
    assert low < end < high


def test_each_of_several_dynamics_has_the_part_that_evidence_gives_it():
    """Second method: odds of each against none, over their sum."""
    plants = tuple(
        types.SimpleNamespace(log_bayes_factor=one, number=lambda _: np.ones(2)) for one in (1.0, 2.5)
    )
    known = UnnamedDynamics(plants)
    whole = 1 + np.exp(1.0) + np.exp(2.5)
    assert known.weight == pytest.approx(1 - 1 / whole)
    plain = Weighed("delay", "s", [np.zeros(2)], np.ones(1))
    row = types.SimpleNamespace(kind="delay", name="delay")
    np.testing.assert_allclose(
        known.number(plain, row).weights, np.array([1.0, np.exp(1.0), np.exp(2.5)]) / whole
    )
    assert known.number(plain, types.SimpleNamespace(kind="order", name="order")) is plain
    assert UnnamedDynamics().weight == 0.0
    assert UnnamedDynamics().number(plain, row) is plain
    plants = tuple(types.SimpleNamespace(draws=np.zeros((count, 2))) for count in (120, 90))
    assert UnnamedDynamics(plants).ess == 90
    assert UnnamedDynamics().ess == np.inf


def test_figures_of_a_final_model_hold_its_unnamed_dynamics():
    """Second method: the response of the plant and a share of it that follows later, in closed form."""
    found = second_lag(*FASTER)
    state = found.rounds[-1].state
    (effect,), (c,) = state.model.effects, state.optimum.x[state.model.plant_size :]
    values = state.model.values(state.optimum.x)
    bare = step_figures(
        replace(state, model=state.model.having()),
        Mixture([state.optimum.x[None, :-1]], np.ones(1)),
        span=20.0,
        time_unit="s",
    )
    whole = step_figures(state, Mixture([state.optimum.x[None]], np.ones(1)), span=20.0, time_unit="s")
    gain, delay = (
        float(values[state.model.posterior.table.at(kind, *at)])
        for kind, at in (("gain", (0, 0)), ("delay", (0,)))
    )
    before, after = ({one.name: float(one.values[0]) for one in each} for each in (bare, whole))
    assert after["steady_state[y1]"] == pytest.approx((1 + c) * before["steady_state[y1]"], rel=1e-6)
    later = -np.expm1(-(20.0 - delay) / effect.time)
    assert after["value_at_end[y1]"] == pytest.approx(before["value_at_end[y1]"] + c * gain * later, rel=1e-6)


@pytest.mark.slow
def test_a_second_lag_is_an_overdriven_frame_where_nothing_better_is_offered():
    assert looped(lagged((0.6, 1.0), (0.4, 0.15)), LIBRARY[:2]).names == ("overdrive_pulse",)


def test_a_kick_after_falls_is_no_linear_dynamics():
    found = looped(lagged((1.0, 1.0), kick=0.2))
    assert found.names == ("backflow",)
    assert found.verdict.kind in ("explained", "partly explained")


@pytest.mark.parametrize(
    ("effect", "psi", "size"),
    [(UnmodelledLag(0.3), np.array([0.2]), 1), (UnmodelledLinear(), np.eye(24)[13] * 0.2, 24)],
    ids=["one lag", "spectrum"],
)
def test_linear_dynamics_in_closed_form(effect, psi, size):
    """Of two drives that move alike and two responses: what is added to each, from the exponentials alone."""
    study = lagged((1.0, 1.0), gains=((0.7, 0.3), (0.2, 0.8)))
    posterior = problem_of(study).posterior
    values = posterior.table.draw(1, np.random.default_rng(0))[0]
    model = effected(posterior, values, [effect])
    assert len(model.coefficients) == size
    plain, more = (model.responses(values, factor * psi)[0] for factor in (0.0, 1.0))
    table, ranges = posterior.table, model.ranges
    delay = values[table.at("delay", 0)]
    jumps = np.diff([level for _, level in LEVELS], prepend=0.0)
    times = posterior.samples[0].times
    past = [np.maximum(times - at - delay, 0.0) for at, _ in LEVELS]
    lags = np.geomspace(ranges.speed / 8, ranges.span, 6)
    own = 0.3 if size == 1 else lags[13 % 6]
    moved = sum(-jump * np.expm1(-one / own) for jump, one in zip(jumps, past, strict=True))
    if size == 1:
        gains = [[values[table.at("gain", i, j)] for j in range(2)] for i in range(2)]
        exact = np.stack([0.2 * sum(row) * moved for row in gains], axis=1)
    else:  # the third path, of the second response and the first drive
        exact = np.zeros_like(more)
        exact[:, 1] = 0.2 * ranges.response[1] / ranges.drive[0] * moved
    np.testing.assert_allclose(more - plain, exact, atol=1e-9 * np.abs(exact).max())


def test_a_thermal_plant_is_not_offered_what_only_displays_have():
    names = {kind.card.name for kind in offered(lagged((1.0, 1.0), unit="K"))}
    assert "overdrive_pulse" not in names
    assert "extra_mode" not in names
    assert {"overflow", "unmodelled_lag", "gain_drift"} <= names
    assert {kind.card.name for kind in offered(lagged((1.0, 1.0)))} == set(bundled())
