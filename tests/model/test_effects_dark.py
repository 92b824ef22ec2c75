"""Every effect of the catalogue on records in which nothing moves, or with a single sample."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from small import problem

from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.inference.effects import Effected, effected
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.model.effects.catalogue import bundled
from lcopa_bayes.model.effects.parallel import relaxation, summed
from lcopa_bayes.model.effects.response import CrossFade
from lcopa_bayes.model.forward import forward_model

ALL = bundled()
LAYOUTS = [(1, 1), (1, 2), (2, 1), (3, 2)]
"""Drives and responses."""
SHORT = [(1, 1), (3, 2)]
"""Of them those of the short form: what applies to any of them applies to the last."""
TIMES = 0.2 * np.arange(48)
DARK, ONE_SAMPLE = ("dark", "resting"), ("one dark", "one resting", "one moving", "one of many")


def noise_record(drives: int, responses: int, kind: str) -> Record:
    """A record of noise: only its drive and the times of its samples matter here."""
    rng = np.random.default_rng([drives, responses, len(kind)])
    drive, taken = np.zeros((TIMES.size, drives)), np.ones(TIMES.size, dtype=bool)
    if kind.startswith("one"):
        taken = np.arange(TIMES.size) == TIMES.size - 2
    if kind.endswith("resting"):
        drive += 0.4 - 0.1 * np.arange(drives)
    elif kind.endswith("moving"):
        edges = np.array([1.1, 3.3, 5.5, 7.5])
        for j in range(drives):
            drive[:, j] = np.array([0.0, 1.0, -0.5, 0.3, 0.0])[
                np.searchsorted(edges + 0.3 * j, TIMES, side="right")
            ]
    elif kind.endswith("many"):  # more changes than samples
        drive = np.repeat(rng.normal(size=(TIMES.size * 2, 1)), drives, axis=1)
    time = TIMES if len(drive) == TIMES.size else 0.5 * TIMES[1] * np.arange(len(drive))
    response = np.full((time.size, responses), np.nan)
    response[:: time.size // TIMES.size][taken] = rng.normal(size=(taken.sum(), responses))
    axes = [tuple(Axis(f"a{k}", unit) for k in range(n)) for n, unit in ((drives, "V"), (responses, "rad"))]
    return Record(kind.replace(" ", "-"), time, drive, response, *axes, "ms")


@cache
def plants(drives: int, responses: int) -> tuple[Effected, Effected, np.ndarray]:
    """A plant fitted to one moving record and many that are not; the same over the latter held out."""
    records = [noise_record(drives, responses, kind) for kind in ("moving", *DARK, *ONE_SAMPLE)]
    posterior = problem(*records, share="none", delay="path").posterior
    table = posterior.table
    truth = {
        "gain": lambda p: 1.0 + 0.3 * p.first - 0.2 * p.second,
        "time": lambda p: 1.5,
        "order": lambda p: 0.9,
        "delay": lambda p: 0.43,
        "offset": lambda p: 0.1,
    }
    values = np.array([truth.get(row.kind, lambda p: 0.01)(row.place) for row in table.rows])
    base = effected(posterior, values)
    samples = [Samples.of(record, 0.2) for record in records[1:]]
    model = forward_model(table.layout, records[1:], [sample.times for sample in samples])
    return base, base.over(model, samples, np.linspace(-0.5, 0.5, len(samples))), values


CASES = [
    pytest.param(
        *layout,
        name,
        id=f"{layout[0]}x{layout[1]}-{name}",
        marks=[pytest.mark.slow] * (layout not in SHORT),
    )
    for layout in LAYOUTS
    for name in ALL
    if ALL[name].applies(plants(*layout)[0].table.layout)
]


@pytest.mark.parametrize(("drives", "responses", "name"), CASES)
def test_an_effect_stands_records_without_motion(drives: int, responses: int, name: str):
    """Responses, signatures and Jacobians are finite, fitted or held out; without drive nothing deflects."""
    base, held, values = plants(drives, responses)
    grid = ALL[name].grid(base.ranges)
    # of many axes one instance: instances differ in what a single pair shows as well
    chosen = (grid[-1],) if drives == 3 else (grid[0], grid[len(grid) // 2], grid[-1])
    for instance in {str(effect): effect for effect in chosen}.values():
        both = base.with_effects([instance]), held.with_effects([instance])
        for model, plain in zip(both, (base, held), strict=True):
            shared = model is both[1]  # coefficients of fitted records are none of other records'
            own = np.array(
                [
                    0.0 if shared and placed.record is not None else placed.coefficient.scale
                    for placed in model.coefficients
                ]
            )
            still = model.responses(values, model.vanishing)
            for a, b in zip(still, plain.responses(values, plain.vanishing), strict=True):
                assert_allclose(a, b, rtol=0, atol=1e-9)
            there = dict(zip(model.records, model.responses(values, own), strict=True))
            slopes = model.signature(values), model.jacobian(values, 0.5 * own)
            for part in (*there.values(), *slopes[0], *slopes[1]):
                assert np.isfinite(part).all()
            if instance.card.disturbance:
                continue
            offset = 0.0 if model is both[1] else 0.1
            for record in ("dark", "one-dark"):
                assert_allclose(there[record], offset, rtol=0, atol=1e-9)
            assert np.ptp(there["resting"], axis=0).max() < 1e-9


def test_a_transition_on_one_axis_leaves_a_dark_axis_alone():
    """The drives of a record share their instants of change; only the axis that moves fades."""
    base, _, values = plants(3, 2)
    model = base.with_effects([CrossFade()])
    scene = replace(model.simulator.scene(0, model.plant(values)), gains=np.eye(2, 3))
    y = np.column_stack([1.0 - np.exp(-np.maximum(scene.times - 1.6, 0.0)), np.zeros(scene.times.size)])
    seen = CrossFade().seen(y, scene, np.ones(1))
    assert_allclose(seen[:, 1], 0.0, atol=1e-12)
    assert np.abs(seen[:, 0] - y[:, 0]).max() > 1e-2


@pytest.mark.parametrize("samples", [1, 2, 20, 60, 400])
def test_many_changes_under_few_samples(samples: int):
    """Against the sum change by change: a grid coarser than the changes does not share them out."""
    rng = np.random.default_rng(3)
    drive = AxisDrive(0.05 + 0.11 * np.arange(80), rng.normal(size=80))
    times = np.linspace(0.0, 10.0, samples) if samples > 1 else np.array([9.0])
    total = summed(times, drive, 0.3, drive.jumps, lambda t: -np.expm1(-t / 0.4))
    late = np.maximum(times[:, None] - drive.times - 0.3, 0.0)
    exact = (-np.expm1(-late / 0.4)) @ drive.jumps
    assert np.abs(total - exact).max() < (1e-12 if samples < 80 else 1e-2)


@pytest.mark.parametrize("changes", [0, 1, 80])
@pytest.mark.parametrize(("rate", "weight"), [(2.5, 1.0), (1e-9, 1.0), (1e9, 1.0), (0.3 + 40j, 1 + 0.2j)])
def test_a_relaxation_is_the_sum_change_by_change(changes: int, rate: complex, weight: complex):
    """At changes, between them and before the first, under drives that follow each other at once too."""
    rng = np.random.default_rng(5)
    begin = np.sort(rng.uniform(0.0, 6.0, changes))
    drive = AxisDrive(begin, rng.normal(size=changes))
    times = np.sort(np.concatenate([[-1.0, 0.0, 12.0], begin + 0.25, rng.uniform(0.0, 10.0, 60)]))
    late = times[:, None] - (drive.times + 0.25)
    shape = np.where(late >= 0, 1 - (weight * np.exp(-rate * np.maximum(late, 0.0))).real, 0.0)
    total = relaxation(times, drive, 0.25, drive.jumps, rate, weight)
    assert_allclose(total, shape @ drive.jumps, atol=1e-12 * max(changes, 1))
