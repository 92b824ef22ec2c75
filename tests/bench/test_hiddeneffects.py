"""Campaigns with hidden effects: their numerics against exact answers, their records, their truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import solve_ivp

from lcopa_bayes.bench.campaignfile import load_plan
from lcopa_bayes.bench.command import on_off
from lcopa_bayes.bench.driveeffects import by_axis, joined
from lcopa_bayes.bench.hiddeneffects import MarchError, marched, step_means
from lcopa_bayes.bench.inversion import unit_step
from lcopa_bayes.bench.undeclared import (
    LARGEST,
    NAMED,
    NOISE,
    OUTSIDE,
    UndeclaredPlan,
    campaign,
    drawn,
    plain_schedules,
    rich_schedules,
    steerer,
)
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.studyfile import load_study
from lcopa_bayes.model.path import TransferPath

STUDY = Path(__file__).parents[2] / "studies" / "undeclared"
DEVICE = steerer(np.random.default_rng(1))


def made(names: list[str], *, seed: int = 5, **options):
    options = {"device": DEVICE, "noise_sd": 0.0} | options
    return campaign(drawn(names, np.random.default_rng(3)), np.random.default_rng(seed), **options)


def test_march_without_a_change_is_the_step_response():
    element = TransferPath(1.0, 0.0, (1.5, 0.8), (1.7, 0.6), 1.0)
    edges = 0.05 * np.arange(401)
    force = step_means(edges, np.array([0.0]), np.array([2.0]))[None]
    reported = marched((element,), force, lambda f, y, rate, k: f, np.zeros(1), 0.05)
    assert_allclose(reported[0], 2.0 * unit_step(element, edges[1:]), atol=1e-10)


@pytest.mark.parametrize("orders", [(1.0,), (2.0, 1.0)])
def test_march_of_a_cubic_force_is_second_order(orders):
    """Against a Runge-Kutta solution of the differential equation."""
    etas = (1.5,) if len(orders) == 1 else (0.6, 0.5)

    def law(t, y):
        force = 1.0 - y[0] - 2.0 * y[0] ** 3
        return [force / etas[0]] if len(orders) == 1 else [y[1], (force - etas[1] * y[1]) / etas[0]]

    exact = solve_ivp(law, (0, 6), [0.0] * len(orders), t_eval=[6.0], rtol=1e-11, atol=1e-12).y[0, -1]
    errors = []
    for n in (60, 120, 240):
        reported = marched(
            (TransferPath(1.0, 0.0, etas, orders, 1.0),),
            np.ones((1, n)),
            lambda f, y, rate, k: f - 2.0 * y**3,
            np.zeros(1),
            6 / n,
        )
        errors.append(abs(reported[0, -1] - exact))
    slope = np.log2(errors[0] / errors[1]), np.log2(errors[1] / errors[2])
    assert all(1.7 < one < 2.4 for one in slope)


def test_march_tells_of_a_runaway():
    with pytest.raises(MarchError):
        marched(
            (TransferPath(1.0, 0.0, (1.0,), (1.0,), 1.0),),
            np.ones((1, 400)),
            lambda f, y, rate, k: f + 5 * y,
            np.zeros(1),
            0.1,
        )


@pytest.mark.parametrize("name", ["rise_fall_asymmetry", "duffing_with_memory"])
@pytest.mark.slow
def test_halving_the_steps_changes_nothing_that_matters(name: str):
    coarse, fine = (made([name], steps=steps) for steps in (4, 8))
    gap = max(np.nanmax(np.abs(coarse.truth[k] - fine.truth[k])) for k in coarse.truth)
    assert gap < 0.15 * NOISE


def test_command_survives_its_parts():
    command = on_off((1.0, -0.5), hold=3.0, at=0.7, rest=(0.2, 0.0))
    times, jumps = by_axis(command)
    again = joined(times, jumps, command.rest)
    assert_allclose(again.times, command.times)
    assert_allclose(again.values, command.values)


@pytest.mark.parametrize("schedules", [rich_schedules, plain_schedules])
@pytest.mark.parametrize("seed", range(5))
def test_schedules(schedules, seed):
    reported = schedules(np.random.default_rng(seed))
    assert len(reported) == 11
    assert sum(one.held_out for one in reported) == 3
    for one in reported:
        assert 30 <= one.duration <= 100
        assert one.command.times[0] >= 3.0
        assert np.abs(one.command.values).max() <= LARGEST + 1e-12
    late = np.concatenate([one.command.times for one in reported])
    assert np.std(late % 1.0) > 0.2  # commands at any time, not on the refresh grid
    if schedules is plain_schedules:
        assert all(one.command.times.size == 1 for one in reported)
    else:
        assert all(one.command.times[0] >= 6.0 for one in reported)
        assert_array_equal(reported[0].command.values, reported[10].command.values)  # the repeat
        assert min(one.command.values.min() for one in reported) < 0


def test_control_is_the_device_with_noise():
    clean, noisy = made([]), made([], noise_sd=NOISE, correlation=0.6)
    assert len(noisy.fit) == 8
    assert len(noisy.held_out) == 3
    left = np.concatenate([r.response - clean.truth[r.name] for r in (*noisy.fit, *noisy.held_out)])
    left = left[~np.isnan(left[:, 0])]
    assert left.std() == pytest.approx(NOISE, rel=0.05)
    assert np.corrcoef(left[1:, 0], left[:-1, 0])[0, 1] == pytest.approx(0.6, abs=0.05)


def test_a_seed_makes_the_same_campaign():
    first, second = (made(["overdrive_pulse"], noise_sd=NOISE) for _ in range(2))
    for a, b in zip(first.fit, second.fit, strict=True):
        assert_array_equal(a.response, b.response)


MARCHED = {
    "cubic_stiffness",
    "rise_fall_asymmetry",
    "level_dependent_speed",
    "overflow",
    "duffing_with_memory",
}
"""Slow to simulate; `test_hidden_agreement` has the first four, the slow test above the last."""
CONTROL = made([], noise_sd=NOISE)


@pytest.mark.parametrize("name", sorted({*NAMED, *OUTSIDE} - MARCHED))
def test_every_hidden_effect_is_felt(name: str):
    """On the records, and on the truth unless it is a disturbance."""
    with_it = made([name], noise_sd=NOISE)
    disturbance = with_it.hidden[0].disturbance
    moved = max(np.nanmax(np.abs(with_it.truth[k] - CONTROL.truth[k])) for k in CONTROL.truth)
    assert (moved == 0.0) if disturbance else (moved > 0.1 * NOISE)
    if disturbance:
        pairs = zip(with_it.fit, CONTROL.fit, strict=True)
        assert max(np.nanmax(np.abs(a.response - b.response)) for a, b in pairs) > 0.3 * NOISE


def test_two_effects_at_once():
    both, one = made(["clipping", "overdrive_pulse"]), made(["clipping"])
    assert len(both.hidden) == 2
    assert max(np.nanmax(np.abs(both.truth[k] - one.truth[k])) for k in one.truth) > NOISE


def test_sizes_are_drawn():
    sizes = [drawn(["odd_curvature"], np.random.default_rng(k))[0].numbers["c"] for k in range(40)]
    assert min(sizes) < -0.01 < 0.01 < max(sizes)
    assert max(np.abs(sizes)) <= 0.04


def test_unknown_effect_is_reported():
    with pytest.raises(InputError, match="did you mean 'backflow'"):
        drawn(["backflaw"], np.random.default_rng(0))


def test_there_are_outsiders():
    assert len(OUTSIDE) >= 5
    assert not set(OUTSIDE) & set(NAMED)


# ------------------------------------------------------------ the bundled campaign


def test_bundled_campaign_is_made_again():
    plan = load_plan(STUDY / "campaign.toml")
    assert isinstance(plan, UndeclaredPlan)
    study = load_study(STUDY)
    assert tuple(record.name for record in study.held_out) == plan.held_out
    again = {record.name: record for record in plan.run(np.random.default_rng(plan.seed))}
    for record in (*study.fit, *study.held_out):
        assert_allclose(record.response, again[record.name].response, atol=1e-9)


def test_its_study_says_nothing_of_the_effect():
    text = (STUDY / "study.toml").read_text()
    assert not any(name in text for name in {**NAMED, **OUTSIDE})


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ('[undeclared]\neffects = ["backflaw"]', "did you mean 'backflow'"),
        ("[undeclared]\ndrive = 1", "unknown key 'drive'"),
        ('[undeclared]\ndrives = "poor"', "rich"),
        ("[undeclared]\n[bench]\ncamera = 1", "not used beside"),
    ],
)
def test_bad_campaign_files(tmp_path, text, what):
    (tmp_path / "campaign.toml").write_text(text)
    with pytest.raises(InputError, match=what):
        load_plan(tmp_path / "campaign.toml")
