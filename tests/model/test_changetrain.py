"""Changes anywhere between samples, convolved together, against those that are read one by one.

`test_stepresponse` holds them against Laplace inversions.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.data.record import Axis
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.model import superposition
from lcopa_bayes.model.forward import Dynamics, Experiment, ForwardModel
from lcopa_bayes.model.grid import Mesh
from lcopa_bayes.model.layout import Layout

AXIS = Axis("x", "rad")
PLANTS = Dynamics(
    (np.array([[3.4, 0.6], [2.0, 0.9]]),), (np.array([[1.3, 0.7], [0.9, 0.5]]),), np.array([[0.83], [1.234]])
)


def plant(drives: list[tuple[np.ndarray, np.ndarray]], times: list[np.ndarray], **options) -> ForwardModel:
    """A plant of one path with two terms on records of some changes and sample times."""
    layout = Layout.of((AXIS,), (AXIS,), ModelSettings(terms=2))
    experiments = []
    exposures = np.broadcast_to(options.pop("exposure", 0.0), len(times))
    for (at, jumps), when, exposure in zip(drives, times, exposures, strict=True):
        mesh = Mesh.of_samples(when, float(at.min()), exposure=float(exposure), **options)
        experiments.append(Experiment("one", mesh, (AxisDrive.of_jumps(at, jumps),), np.zeros(1)))
    return ForwardModel(layout, tuple(experiments))


def numbers(model: ForwardModel) -> list[list[np.ndarray]]:
    """Responses of each record, and their derivatives, of both plants."""
    slopes = model.unit_slopes(PLANTS)
    return [
        [value, of_slopes, *derivatives]
        for value, (of_slopes, derivatives) in zip(model.unit_responses(PLANTS), slopes, strict=True)
    ]


def records(rng) -> tuple[list[tuple[np.ndarray, np.ndarray]], list[np.ndarray]]:
    """Records of several lengths: one whose drive moves before its first sample, one in which it moves first
    long after it, one that ends before the delay is over, and one without every third sample."""
    spread = [(-5.3, 3.0, 7), (4.0, 17.0, 12), (19.3, 19.9, 5), (0.0, 15.0, 25)]
    drives = [(np.sort(rng.uniform(a, b, n)), rng.normal(size=n)) for a, b, n in spread]
    even = [np.arange(0.0, end, 0.25) for end in (12.0, 30.0, 20.0, 24.0)]
    even[3] = np.delete(even[3], np.arange(2, 90, 3))
    return drives, even


@pytest.mark.parametrize("exposure", [0.0, 0.13, 0.9, (0.0, 0.2, 0.0, 0.7)])
def test_many_phases_are_those_read_one_by_one(exposure, rng, monkeypatch):
    drives, times = records(rng)
    model = plant(drives, times, exposure=exposure, blocks=1)
    assert len(model.circles) == 1  # blocks of one width, so that the records are read together
    together = numbers(model)
    monkeypatch.setattr(superposition, "_APART", 10**6)
    for found, wanted in zip(together, numbers(model), strict=True):
        for one, other in zip(found, wanted, strict=True):
            assert_allclose(one, other, rtol=0, atol=1e-12 * max(1.0, float(np.abs(other).max())))


def test_nothing_moves_before_the_first_onset(rng):
    """To the last bit, of each plant by its own delay."""
    drives, times = records(rng)
    for found, (at, _), when in zip(numbers(plant(drives, times)), drives, times, strict=True):
        for own, delay in enumerate(PLANTS.delays[:, 0]):
            for each in found:
                early = each[:, own, when <= at[0] + delay]
                assert_array_equal(early, np.zeros_like(early))


def test_portions_of_records_are_superposed_alike(rng, monkeypatch):
    """What is convolved at once is limited by memory, which changes no response."""
    drives, times = records(rng)
    model = plant(drives, times)
    whole = numbers(model)
    monkeypatch.setattr(superposition, "_TOGETHER", 1)
    for found, wanted in zip(numbers(model), whole, strict=True):
        for one, other in zip(found, wanted, strict=True):
            assert_allclose(one, other, rtol=0, atol=1e-12)
