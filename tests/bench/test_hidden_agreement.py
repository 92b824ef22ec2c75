"""Every effect that library and bench both have, simulated by both: two methods to one response."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from small import study

from lcopa_bayes.bench.device import Bench, truth
from lcopa_bayes.bench.hiddeneffects import HiddenDevice
from lcopa_bayes.bench.undeclared import NAMED, NOISE, drawn, rich_schedules, shot_of, steerer
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.effects import Effected, effected
from lcopa_bayes.model.effects.catalogue import bundled
from lcopa_bayes.model.effects.response import CrossFade

DEVICE = steerer(np.random.default_rng(1))
CHOSEN = ((0, 50.0), (5, 60.0), (8, 50.0))
"""Positions among the rich schedules, and how much of each is simulated [ms]."""
NO_MEAN = {"outliers"}


@cache
def base() -> tuple[Effected, np.ndarray, tuple]:
    """The linear plant at the truth, over records with several kinds of drive."""
    schedules = rich_schedules(np.random.default_rng(5))
    bench = Bench(camera=0.1)
    records = [
        truth(DEVICE, bench, schedules[k].command, duration=length, name=f"r{k}") for k, length in CHOSEN
    ]
    posterior = problem_of(
        study(*records, terms={"direct": 2, "cross": 1}, share="paper", offset="shared")
    ).posterior
    table = posterior.table
    values = np.ones(len(table.rows))
    for k, row in enumerate(table.rows):
        first, second = row.place
        path = DEVICE.paths[0][first]
        if row.kind == "gain":
            values[k] = DEVICE.paths[first][second].steady
        elif row.kind == "time":
            values[k] = path.etas[second] ** (1 / path.orders[second])
        elif row.kind == "order":
            values[k] = path.orders[second]
        elif row.kind == "delay":
            values[k] = path.delay
        elif row.kind == "offset":
            values[k] = DEVICE.offsets[first]
    made = effected(posterior, values)
    shot = shot_of(DEVICE, 0.0, np.random.default_rng(0))
    ranges = replace(made.ranges, drive=shot.drive, response=shot.deflection)
    made = replace(made, simulator=replace(made.simulator, ranges=ranges))
    return made, values, tuple(schedules[k].command for k, _ in CHOSEN)


def from_bench(name: str, seed: int) -> tuple[dict, list]:
    """Numbers of the hidden effect and the responses the bench gives."""
    made, _, commands = base()
    hidden = drawn([name], np.random.default_rng(seed))
    out = []
    for r, command in enumerate(commands):
        shot = shot_of(DEVICE, float(made.simulator.epochs[r]), np.random.default_rng(r))
        out.append(HiddenDevice(DEVICE, hidden, shot).response(command, made.simulator.times[r]))
    return dict(hidden[0].numbers), out


def waves(size: float, phases: np.ndarray) -> list[float]:
    """Cosine and sine parts of ``size cos(w t + phase)``."""
    return [part * size for phase in phases for part in (np.cos(phase), -np.sin(phase))]


CONSTANTS = {"frame", "refresh", "phase", "levels", "width", "time", "cycles"}
CONSTANTS |= {"frequency", "damping", "level"}
WHOLE = ("refresh_hold", "grey_quantisation", "clipping")
"""Their formula at a strength of 1 is the bench's."""


def declared(name: str, numbers: dict) -> tuple[dict, np.ndarray]:
    """Internal constants of the library's effect, and psi, that stand for the bench's numbers."""
    constants = {key: value for key, value in numbers.items() if key in CONSTANTS}
    of_records = {
        "trigger_jitter": lambda g: [numbers["sd"] * g.standard_normal()],
        "pointing_offset": lambda g: numbers["sd"] * g.standard_normal(2),
        "vibration": lambda g: waves(numbers["a"], 2 * np.pi * g.random(2)),
        "flicker": lambda g: waves(numbers["a"], 2 * np.pi * g.random(1)),
    }
    if name in of_records:
        parts = [of_records[name](np.random.default_rng(r)) for r in range(len(CHOSEN))]
        return constants, np.concatenate(parts)
    if name in WHOLE:
        return constants, np.ones(1)
    constants |= {"rising": False} if name == "backflow" else {}
    return constants, np.array([value for key, value in numbers.items() if key not in constants])


SHARED = sorted(set(NAMED) & set(bundled()) - NO_MEAN - {"pointing_drift"})


def gap(name: str, seed: int, wrong: float = 1.0) -> tuple[float, float]:
    """Largest difference of the two methods, and size of the effect [noise sd]."""
    made, values, _ = base()
    numbers, exact = from_bench(name, seed)
    constants, psi = declared(name, numbers)
    with_effect = made.with_effects([bundled()[name](**constants)])
    reported = with_effect.responses(values, wrong * psi)
    plain = made.responses(values, made.vanishing)
    linear = [DEVICE.response(c, t) for c, t in zip(base()[2], made.simulator.times, strict=True)]
    own = [
        b - a for a, b in zip(plain, reported, strict=True)
    ]  # free of the grid's error of the linear plant
    other = [b - a for a, b in zip(linear, exact, strict=True)]
    difference = max(np.abs(a - b).max() for a, b in zip(own, other, strict=True))
    return difference / NOISE, max(np.abs(b).max() for b in other) / NOISE


@pytest.mark.parametrize("name", SHARED)
def test_library_and_bench_agree(name: str):
    """Well under the noise, and to a few per cent of the effect: a grid of one block per sample."""
    difference, size = gap(name, 3)
    assert difference < 0.12 + 0.04 * size
    assert difference < 0.35
    assert size > 5 * difference or size < 0.5


def test_a_turn_in_the_tail_of_a_step_is_one():
    """Late after a step a response hardly moves, for long: a switch between rise and fall that is as wide as
    that motion leaves 0.1 of the noise there, and the size of the effect 5 sd off."""
    made, values, commands = base()
    hidden = drawn(["rise_fall_asymmetry"], np.random.default_rng(7))
    psi = np.array([hidden[0].numbers["e"]])
    assert psi[0] > 0.6
    told = made.with_effects([bundled()["rise_fall_asymmetry"]()]).responses(values, psi)
    plain = made.responses(values, made.vanishing)
    for r, most in ((0, 0.02), (1, 0.05)):
        shot, times = shot_of(DEVICE, 0.0, np.random.default_rng(r)), made.simulator.times[r]
        exact = HiddenDevice(DEVICE, hidden, shot).response(commands[r], times)
        other = exact - DEVICE.response(commands[r], times)
        assert np.sqrt(np.nanmean((told[r] - plain[r] - other) ** 2)) < most * NOISE


@pytest.mark.parametrize("skipped", [0, 3, 7])
def test_a_transition_starts_from_the_same_deflection_whatever_the_camera(skipped: int):
    """The response turns where a transition starts: what a sample after it says must not count. Every tenth
    sample, begun at different places between commands, on the bench (exact) and in the library."""
    made, values, commands = base()
    hidden = drawn(["cross_fade"], np.random.default_rng(3))
    psi = np.array([hidden[0].numbers["strength"]])
    model = made.with_effects([bundled()["cross_fade"]()])
    y = made.responses(values, made.vanishing)
    for r, command in enumerate(commands):
        shot, times = shot_of(DEVICE, 0.0, np.random.default_rng(r)), made.simulator.times[r]
        device = HiddenDevice(DEVICE, hidden, shot)
        few = times[skipped::10]
        assert_allclose(
            device.response(command, few), device.response(command, times)[skipped::10], atol=1e-9
        )
        scene = model.simulator.scene(r, model.plant(values))
        offsets = np.array(DEVICE.offsets)
        fine = CrossFade().seen(y[r] - offsets, scene, psi)[skipped::10]
        coarse = CrossFade().seen((y[r] - offsets)[skipped::10], replace(scene, times=few), psi)
        size = np.abs(fine - (y[r] - offsets)[skipped::10]).max()
        assert size > 5 * NOISE
        assert np.sqrt(np.mean((coarse - fine) ** 2)) < 0.7 * NOISE
        if np.diff(command.times).min() > 20 * 0.1:  # three samples of every transition
            assert np.abs(coarse - fine).max() < 0.002 * size


@pytest.mark.parametrize("name", ["cubic_stiffness", "backflow", "axis_rotation", "voltage_knee"])
def test_another_size_is_seen(name: str):
    assert gap(name, 3, wrong=1.3)[0] > 0.15


def test_nearly_every_effect_is_covered():
    assert set(bundled()) - set(SHARED) == NO_MEAN | {
        "pointing_drift",
        "sampled_drive",
        "late_logging",
        "unmodelled_linear",
        "unmodelled_lag",
        "unmodelled_smooth",
        "unmodelled_nonlinear",
    }
