"""What a name is held to: constants that other records share, ripples that go on at rest, limits per axis."""

from dataclasses import replace

import numpy as np
import pytest
from test_loop_unseen import fitted

from lcopa_bayes.bench.undeclared import campaign, drawn
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.explained import explained_study
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.effectsearch.refits import refit
from lcopa_bayes.effectsearch.trace import SEEN
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.effects import effected
from lcopa_bayes.model.effects.catalogue import catalogue
from lcopa_bayes.model.effects.parallel import ExtraMode
from lcopa_bayes.model.effects.response import Clipping

AXIS = (Axis("x", "rad"),)
PERIOD, TIME, DELAY, NOISE = 0.1, 2.0, 1.5, 2e-3
"""Sampling period, time constant and delay [ms], noise [rad]."""
REFRESH, PHASE = 1.0, 0.75
"""Period of the drive's refresh [ms] and its first over that [-]."""
SEED = 300000207


def commanded(name, seed, *, held=False, ripple=None):
    """A first-order plant, exactly, rested for 15 ms and then commanded at random times."""
    rng, t = np.random.default_rng(seed), np.arange(600) * PERIOD
    at = 15.0 + np.sort(rng.uniform(0, 40.0, 12))
    levels = rng.uniform(-1, 1, 12)
    acts = REFRESH * (np.ceil(at / REFRESH - PHASE) + PHASE) if held else at
    since = np.maximum(t[:, None] - acts - DELAY, 0.0)
    y = -np.expm1(-since / TIME) @ np.diff(levels, prepend=0.0)
    y = y if ripple is None else ripple(t, y)
    y = y + NOISE * rng.standard_normal(t.size)
    drive = np.concatenate([[0.0], levels])[np.searchsorted(at, t, side="right")]
    # rows of commands between samples
    times = np.concatenate([t, at])
    order = np.argsort(times, kind="stable")
    drives = np.concatenate([drive, levels])[order][:, None]
    read = np.concatenate([y, np.full(at.size, np.nan)])[order][:, None]
    return Record(name, times[order], drives, read, AXIS, AXIS, "ms")


def study_of(**more):
    fit = tuple(commanded(f"r{k}", k, **more) for k in range(3))
    return Study("s", None, "ms", 1, fit, (commanded("r9", 9, **more),), ModelSettings(offset="shared"))


def looped(study, *names):
    library = [catalogue()[name] for name in names]
    return loop(study, library=library, sample=False, quick=True, as_stated=True)


@pytest.mark.slow
def test_a_phase_that_moves_with_the_delay_stays_where_it_is_likely():
    found = looped(study_of(held=True), "refresh_hold", "trigger_jitter", "unmodelled_linear")
    assert [effect.name for effect in found.effects] == ["refresh_hold"]
    assert found.effects[0].constants["phase"] == PHASE
    assert found.effects[0].constants["refresh"] == pytest.approx(REFRESH, rel=1e-9)
    assert found.after.unseen[0].rmse == pytest.approx(NOISE, rel=0.1)


def shaken(t, y):
    return y + 2 * NOISE * np.sin(2 * np.pi * 0.23 * t + 1.0)


def flickered(t, y):
    return y * (1 + 5 * NOISE * np.sin(2 * np.pi * 0.23 * t + 1.0))


def test_a_ripple_that_goes_on_at_rest_is_a_vibration():
    found = looped(study_of(ripple=shaken), "vibration")
    assert [effect.name for effect in found.effects] == ["vibration"]
    assert found.rounds[0].refits[0].resting
    assert found.verdict.kind == "disturbance"
    # a parameter of the refit: the frequencies that were traced lie further away
    traced = [one.effect.frequency for one in found.trace.of("vibration").signatures]
    error = abs(found.effects[0].constants["frequency"] - 0.23)
    assert error < 2e-4
    assert min(abs(one - 0.23) for one in traced) > 4 * error


def test_a_ripple_of_the_deflection_is_no_vibration():
    found = looped(study_of(ripple=flickered), "vibration")
    assert found.trace.alarmed
    assert not found.rounds[0].refits[0].resting
    assert found.effects == ()
    assert found.verdict.kind == "unexplained"


def test_a_limit_may_differ_from_axis_to_axis():
    axes = (Axis("x", "rad"), Axis("y", "rad"))
    one, other = commanded("r0", 0), commanded("r0", 0)
    both = Record(
        "r0",
        one.time,
        np.hstack([one.drive, other.drive]),
        np.hstack([one.response, other.response]),
        axes,
        axes,
        "ms",
    )
    posterior = problem_of(Study("s", None, "ms", 1, (both,), (), ModelSettings(offset="shared"))).posterior
    values = posterior.table.draw(1, np.random.default_rng(0))[0]
    made = effected(posterior, values, [Clipping(0.5, skew=0.8)])
    free, clipped = (made.responses(values, psi)[0] for psi in (np.zeros(1), np.ones(1)))
    offsets = made.plant(values).offsets[0]
    limits = np.array([0.5, 0.4]) * made.ranges.response
    np.testing.assert_allclose(clipped - offsets, np.clip(free - offsets, -limits, limits), atol=1e-12)


def test_limits_that_differ_from_axis_to_axis_are_found():
    """Both are parameters of the refit; of one axis there is nothing to compare."""
    limits, axes = np.array([0.6, 0.54]), (Axis("x", "rad"), Axis("y", "rad"))

    def record(name: str, seed: int, axis: int) -> Record:
        clipped = commanded(name, seed, ripple=lambda t, y: np.clip(y, -limits[axis], limits[axis]))
        still = NOISE * np.random.default_rng(seed + 99).standard_normal(clipped.response.shape)
        still[np.isnan(clipped.response)] = np.nan
        drives, read = [np.zeros_like(clipped.drive)] * 2, [still] * 2
        drives[axis], read[axis] = clipped.drive, clipped.response
        return Record(name, clipped.time, np.hstack(drives), np.hstack(read), axes, axes, "ms")

    records = tuple(record(f"r{k}", k, k) for k in range(2))
    study = Study("s", None, "ms", 1, records, (), ModelSettings(offset="shared"))
    _, start = fitted(study)
    model = start.model.at_scales(start.optimum.x, {"r0": 0.0, "r1": 0.0})
    made = refit(model, start.optimum, start.whitening, [(Clipping(0.7), np.ones(1))], 500.0)
    (found,), ranges = made.model.effects, made.model.effected.ranges
    reached = found.constants["level"] * found.constants["skew"] ** np.arange(2) * ranges.response
    np.testing.assert_allclose(reached, limits, rtol=5e-3)
    assert explained_study(study, made.model).priors["clipping.skew"].fixed is None
    single = replace(ranges, response=ranges.response[:1])
    held = {one.name: one.low == one.high for one in Clipping.internal(single)}
    assert held == {"level": False, "skew": True}


def test_a_resonance_may_ring_longer_than_those_that_are_traced():
    """A damping below the grid's is reached, and is open in the explained study."""
    one, frequency, damping = commanded("r0", 0), 0.3, 0.012
    rows = np.flatnonzero(np.diff(one.drive[:, 0], prepend=0.0))
    jumps = np.diff(one.drive[:, 0], prepend=0.0)[rows]
    since = np.maximum(one.time[:, None] - one.time[rows] - DELAY, 0.0)
    w, root = 2 * np.pi * frequency * since, np.sqrt(1 - damping**2)
    step = 1 - np.exp(-damping * w) * (np.cos(w * root) + damping / root * np.sin(w * root))
    ringing = replace(one, response=one.response + 0.05 * (step @ jumps)[:, None])
    study = Study("s", None, "ms", 1, (ringing,), (), ModelSettings(offset="shared"))
    _, start = fitted(study)
    model = start.model.at_scales(start.optimum.x, {"r0": 0.0})
    made = refit(model, start.optimum, start.whitening, [(ExtraMode(0.29, 0.03), np.ones(1))], 500.0)
    assert made.model.effects[0].constants == pytest.approx(
        {"frequency": frequency, "damping": damping}, rel=0.05
    )
    assert explained_study(study, made.model).priors["extra_mode.damping"].fixed is None


@pytest.mark.slow
def test_a_lag_that_the_base_model_imitates_to_first_order_is_in_the_group():
    """A lag of 0.4 ms is a delay and an order but for 2 % of its signature; a refit of it shows the rest."""
    rng = np.random.default_rng([SEED, 77])
    made = campaign(drawn(("sensor_lag",), rng), rng)
    model = ModelSettings(terms={"direct": 2, "cross": 1})
    study = Study("hidden", None, "ms", SEED, made.fit, made.held_out, model)
    found = looped(study, "sensor_lag", "exposure", "overdrive_pulse", "ion_creep", "unmodelled_linear")
    assert found.trace.of("sensor_lag").survival < SEEN
    assert found.trace.of("sensor_lag").log_bayes_factor < found.trace.threshold
    assert "sensor_lag" in found.groups[0]
