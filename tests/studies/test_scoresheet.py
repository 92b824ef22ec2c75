"""The score sheet of the loop: its truths are those of the simulated device in the scales of the loop."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "studies" / "undeclared-effects"))

import campaigns
import devicetruth
import scoresheet

from lcopa_bayes.bench.command import Command
from lcopa_bayes.bench.device import Device
from lcopa_bayes.bench.hiddeneffects import Hidden, HiddenDevice, Shot
from lcopa_bayes.bench.planteffects import beside
from lcopa_bayes.bench.undeclared import NAMED, shot_of
from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.data.record import Axis
from lcopa_bayes.model.effects.catalogue import catalogue
from lcopa_bayes.model.path import TransferPath

SIZE = np.array([0.02, 0.03])
RATIO = np.array([1.1, 1.1])
RANGES = SimpleNamespace(
    response=RATIO * SIZE, column=(RATIO * SIZE)[:, None], axes=2, devices=np.zeros(2, int)
)
SCENE = SimpleNamespace(ranges=RANGES)
LEVELS = np.random.default_rng(3).uniform(-1.2, 1.2, (2, 40)) * SIZE[:, None]


def both(name: str) -> tuple:
    """A hidden effect, the device that it is in, and the catalogue's at its sizes in the scales of a loop."""
    hidden = NAMED[name](np.random.default_rng(5))
    reported = devicetruth.SIZES[name](hidden.numbers, RATIO)
    kind = catalogue((), None)[name]
    fields = kind.__dataclass_fields__ if hasattr(kind, "__dataclass_fields__") else {}
    effect = kind(**{key: reported[key] for key in fields if key in reported})
    psi = np.array([value for key, value in reported.items() if key not in fields])
    shot = Shot(0.0, np.ones(2), SIZE, 3.0, np.eye(2), np.random.default_rng(0))
    return hidden, shot, effect, psi


@pytest.mark.parametrize(
    "name", ["odd_curvature", "even_curvature", "bilinear_crosstalk", "axis_rotation", "centroid_locking"]
)
def test_a_reading_is_the_same_at_the_size_in_the_scale_of_the_loop(name: str) -> None:
    hidden, shot, effect, psi = both(name)
    read = hidden.seen(LEVELS.T, None, None, shot)
    np.testing.assert_allclose(effect.seen(LEVELS.T, SCENE, psi), read, rtol=1e-12)
    assert np.abs(read - LEVELS.T).max() > 1e-3 * SIZE.min()


def test_a_limit_is_the_same() -> None:
    hidden, shot, effect, _ = both("clipping")
    read = hidden.seen(LEVELS.T, None, None, shot)
    np.testing.assert_allclose(effect.seen(LEVELS.T, SCENE, np.ones(1)), read, rtol=1e-12)


@pytest.mark.parametrize("name", ["cubic_stiffness", "overflow"])
def test_a_force_is_the_same(name: str) -> None:
    hidden, shot, effect, psi = both(name)
    acts = hidden.balance(shot, 0.1)
    f = 0.5 * LEVELS[:, ::-1]
    expected = np.stack([acts(f[:, k], LEVELS[:, k], 0 * f[:, k], k) for k in range(f.shape[1])], axis=1)
    motion = SimpleNamespace(y=LEVELS)
    np.testing.assert_allclose(effect.force(f, motion, SCENE, psi), expected, rtol=1e-9, atol=1e-15)


def test_what_depends_on_the_level_is_as_much_viscosity_of_a_slower_plant() -> None:
    e, share = 0.3, np.linspace(0.0, 1.0, 7)
    reported = devicetruth.SIZES["level_dependent_speed"]({"e": e}, RATIO)["e"]
    made = SimpleNamespace(hidden=[SimpleNamespace(name="level_dependent_speed", numbers={"e": e})])
    found = SimpleNamespace(names=("level_dependent_speed",))
    path = TransferPath(1.0, 0.0, (1.0,), (1.0,), 1.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(devicetruth, "ratios", lambda *_: RATIO)
        factor = devicetruth.as_told(path, found, made).etas[0]
    np.testing.assert_allclose(
        factor * (1 + reported * (1 - 2 * share / RATIO[0])), 1 + e * (1 - 2 * share), rtol=1e-12
    )


def test_every_named_effect_has_sizes_or_a_reason() -> None:
    reported = set(devicetruth.SIZES) | set(devicetruth.UNSCORED)
    assert reported == set(NAMED)
    assert not set(devicetruth.SIZES) & set(devicetruth.UNSCORED)
    for name, sizes in devicetruth.SIZES.items():
        kind, numbers = catalogue((), None)[name], NAMED[name](np.random.default_rng(0)).numbers
        fields = set(getattr(kind, "__dataclass_fields__", {}))
        names = {one.name for one in getattr(kind, "estimated", ())} | {"k_x_2", "k_y_1", "Ts", "Te", "e"}
        assert set(sizes(numbers, RATIO)) <= fields | names, name


def test_the_figures_of_a_lag_are_those_of_the_closed_form() -> None:
    path = TransferPath(0.6, 2.0, (4.0,), (1.0,), 2.0)  # time constant 2
    of = partial(devicetruth.risen, path), path.steady, path.delay
    reported = devicetruth.step_truth(*of, 12.0)
    assert reported["rise_10_90"] == pytest.approx(2.0 * np.log(9), rel=1e-6)
    assert reported["value_at_end"] == pytest.approx(0.3 * -np.expm1(-5.0), rel=1e-6)
    assert devicetruth.step_truth(*of, 6.0)["rise_10_90"] == np.inf


def device() -> Device:
    """Every path a lag of 2 ms behind a delay."""
    gains = (0.6, 0.1), (0.2, 0.5)
    paths = tuple(tuple(TransferPath(gain, 1.0, (2.0,), (1.0,), 1.0) for gain in row) for row in gains)
    drives, responses = (tuple(Axis(name, unit) for name in "xy") for unit in ("V", "rad"))
    return Device(paths, drives, responses, (0.3, -0.1))


def truth_of(hidden: Hidden, *named: str) -> dict[str, float]:
    """Figures that are scored, with places that are the truth itself."""
    made = SimpleNamespace(device=device(), hidden=(hidden,))
    scales = SimpleNamespace(span=30.0)
    found = SimpleNamespace(names=named, problem=SimpleNamespace(scales=scales))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(devicetruth, "places", lambda figures, truth, alone: truth)
        return devicetruth.step_deviations((), found, made) | {
            "steady": devicetruth.steady_truth(found, made)
        }


def test_an_unnamed_linear_effect_is_part_of_the_device_that_was_measured() -> None:
    lag = truth_of(Hidden("sensor_lag", {"Ts": 0.5}, lag=0.5))
    times = np.array([2.0, 0.5])

    def both_lags(time: Vector) -> Vector:
        weights = times / (times - times[::-1])
        return 1 - np.exp(-time[:, None] / times) @ weights

    expected = devicetruth.step_truth(both_lags, 0.6, 1.0, 30.0)
    assert lag["rise_10_90[x_x]"] == pytest.approx(expected["rise_10_90"], rel=1e-4)
    assert lag["value_at_end[x_x]"] == pytest.approx(expected["value_at_end"], rel=1e-6)
    assert lag["steady"] == pytest.approx(np.array([[0.6, 0.1], [0.2, 0.5]]), rel=1e-9)
    k, time = 0.04, 20.0
    creep = Hidden("ion_creep", {}, seen=beside(lambda t: k * (1 - np.exp(-t / time)), static=False))
    alone, named = truth_of(creep), truth_of(creep, "ion_creep")
    at_end = 0.6 * (1 - np.exp(-29.0 / 2.0) + k * (1 - np.exp(-29.0 / time)))
    assert alone["value_at_end[x_x]"] == pytest.approx(at_end, rel=1e-6)
    assert named["value_at_end[x_x]"] == pytest.approx(0.6 * (1 - np.exp(-29.0 / 2.0)), rel=1e-9)
    assert alone["steady"] == pytest.approx(np.array([[0.6 * (1 + k), 0.1], [0.2, 0.5 * (1 + k)]]), rel=1e-6)
    assert named["steady"] == pytest.approx(np.array([[0.6, 0.1], [0.2, 0.5]]), rel=1e-12)


@pytest.mark.parametrize("name", devicetruth.LINEAR)
def test_what_counts_as_linear_adds_up(name: str) -> None:
    """The response to two steps of one drive is the sum of those to each."""
    hidden, own = NAMED[name](np.random.default_rng(5)), device()
    time = np.linspace(0.0, 30.0, 601)
    later = np.concatenate([np.zeros((200, 2)), devicetruth.unit_responses(own, (hidden,), 0, time)[:-200]])
    shot = shot_of(own, 0.4, np.random.default_rng(1))
    both_steps = Command(np.array([0.0, 10.0]), np.array([[1.0, 0.0], [-1.5, 0.0]]), np.zeros(2))
    answered = HiddenDevice(own, (hidden,), shot).response(both_steps, time) - np.array(own.offsets)
    expected = devicetruth.unit_responses(own, (hidden,), 0, time) - 2.5 * later
    assert np.abs(answered - expected).max() < 1e-9


def test_the_place_of_a_truth_is_positive_where_values_lie_above_it() -> None:
    values = np.random.default_rng(0).normal(size=20_000)
    assert devicetruth.place(values, -1.5) == pytest.approx(1.5, abs=0.05)
    assert devicetruth.place(np.full(9, np.inf), np.inf) == pytest.approx(0.0)


def test_numbers_of_one_campaign_count_as_far_as_they_differ() -> None:
    """Copies count once; what has nothing in common counts by itself."""
    rng = np.random.default_rng(0)
    hits = rng.random((2_000, 4)) < 0.9
    assert scoresheet.independent(hits.tolist()) == pytest.approx(8_000, rel=0.1)
    copies = np.repeat(hits[:, :1], 4, axis=1).tolist()
    assert scoresheet.independent(copies) == pytest.approx(2_000, rel=0.01)
    assert scoresheet.independent([[True] * 4] * 5) == 5
    assert scoresheet.independent([[True, False], []]) == 1


def test_heavy_tailed_noise_keeps_its_size_and_correlation() -> None:
    rng = np.random.default_rng(2)
    noise = rng.normal(size=(400_000, 1))
    noise[1:] = 0.6 * noise[:-1] + 0.8 * noise[1:]
    heavy = campaigns.HEAVY.noise(noise, rng)
    assert heavy.std() == pytest.approx(noise.std(), rel=0.03)
    share = float(np.mean(heavy[1:] * heavy[:-1]) / np.mean(noise[1:] * noise[:-1]))
    assert share == pytest.approx(np.pi / 4, rel=0.05)  # twice the square of the mean of 1 / chi
    assert np.mean(np.abs(heavy) > 5 * heavy.std()) > 100 * np.mean(np.abs(noise) > 5 * noise.std())


def test_heavy_tails_by_their_name_are_no_alarm() -> None:
    row = {"verdict": "disturbance", "named": ["outliers"], "truth": ["outliers"]}
    assert not scoresheet.alarming(row)
    assert not scoresheet.alarming(row | {"verdict": "clean", "named": []})
    assert scoresheet.alarming(row | {"named": ["vibration"]})
    assert scoresheet.alarming(row | {"verdict": "unexplained", "named": []})


@pytest.mark.parametrize(
    ("hits", "trials", "target", "side", "expected"),
    [
        (90, 100, [0.85, 0.95], "within", "yes"),
        (15, 20, [0.85, 0.95], "within", "open"),  # 0.51 to 0.91
        (60, 100, [0.85, 0.95], "within", "no"),
        (300, 300, [0.85, 0.95], "within", "no"),  # 0.988 to 1
        (5, 6, 0.9, "least", "open"),
        (50, 100, 0.9, "least", "no"),
        (1, 14, 0.05, "most", "open"),
        (1, 48, 0.0, "most", "no"),  # a crash is one
    ],
)
def test_a_target_is_open_where_more_campaigns_decide(
    hits: int, trials: int, target: object, side: str, expected: str
) -> None:
    line = scoresheet.share("share", [True] * hits + [False] * (trials - hits), bool, target, side)
    assert scoresheet.standing(line) == expected
