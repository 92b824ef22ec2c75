"""Effects behind a generic class, which describes what several of them leave better than any one does."""

from dataclasses import replace

import numpy as np
import pytest

from lcopa_bayes.bench.command import Command, on_off, staircase, step
from lcopa_bayes.bench.device import Bench, Device, simulate
from lcopa_bayes.core.arrays import Flags, Vector
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch import rounds
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.model.effects.catalogue import catalogue
from lcopa_bayes.model.path import TransferPath

AXIS = (Axis("x", "rad"),)
DEVICE = Device(((TransferPath(1.0, 1.0, (3.0,), (0.9,), 1.0),),), AXIS, AXIS, (0.0,))
LIBRARY = [catalogue()[name] for name in ("odd_curvature", "trigger_jitter", "unmodelled_smooth")]
NOISE, CAMERA = 5e-3, 0.2
"""[rad] and [ms]."""


def commands(begin: float) -> list[Command]:
    return [
        on_off(1.0, hold=12.0, at=begin),
        on_off(-0.7, hold=9.0, at=begin),
        staircase([0.4, 1.0, -0.5, 0.2], hold=6.4, start=begin),
        step(0.5, at=begin),
        staircase([-0.9, 0.8, 0.3], hold=7.2, start=begin),
    ]


def study(seed: int, *, curvature: float, late: float, wave: float = 0.0) -> Study:
    """Records with a curvature, triggers that come `late` [ms rms], and a slow `wave` of each [rad]."""
    rng, out = np.random.default_rng(seed), []
    for number, command in enumerate(commands(8.0)):
        shifted = commands(8.0 + late * rng.standard_normal())[number]
        written, taken = (
            simulate(DEVICE, Bench(camera=CAMERA), one, duration=36.0, name=f"r{number}", rng=rng)
            for one in (command, shifted)
        )
        time, y = written.time, taken.response[frames(taken.time)]
        moving = np.sin(2 * np.pi * (time / 17.0 + rng.uniform())) * (time > 8.0)
        y = y + curvature * y**3 + NOISE * rng.standard_normal(y.shape) + wave * moving[:, None]
        out.append(Record(written.name, time, written.drive, y, AXIS, AXIS, "ms"))
    settings = ModelSettings(terms=1, offset="shared")
    return Study("generic", None, "ms", seed, tuple(out[:4]), tuple(out[4:]), settings)


def frames(time: Vector) -> Flags:
    """Rows of the camera, without those of commands beside its clock."""
    return np.abs(time / CAMERA - np.round(time / CAMERA)) < 1e-6


def names(one: Study) -> set[str]:
    found = loop(one, library=LIBRARY, sample=False, quick=True, as_stated=True)
    return set(found.names)


@pytest.mark.parametrize(
    ("seed", "curvature", "late"), [(3, 0.15, 0.2), pytest.param(5, 0.1, 0.15, marks=pytest.mark.slow)]
)
def test_effects_are_found_past_a_class_that_is_ahead_of_each(
    monkeypatch: pytest.MonkeyPatch, seed: int, curvature: float, late: float
) -> None:
    """Any smooth residual takes 373 nat, a curvature alone 305: without the search for pairs, whose rank a
    plant that bends towards what is missing may spoil, no name was given."""
    monkeypatch.setattr(rounds, "_pair", lambda *known: ([], {}))
    past, before = rounds._past_generic, []

    def recorded(known, *others):
        before.append([one.chosen for one in known])
        return past(known, *others)

    monkeypatch.setattr(rounds, "_past_generic", recorded)
    both = study(seed, curvature=curvature, late=late)
    assert names(both) == {"odd_curvature", "trigger_jitter"}
    assert before[0] == [None]  # beside the class no effect was added


def test_a_class_that_is_ahead_of_all_that_effects_take_together_keeps_its_place() -> None:
    """A curvature under a wave takes 151 nat, is significant and predicts better; the class takes 932."""
    bent = study(4, curvature=0.15, late=0.0, wave=0.05)
    found = loop(bent, library=LIBRARY, sample=False, quick=True, as_stated=True)
    assert found.names == ()
    assert [one.chosen for one in found.rounds] == [None]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [4, 5])
def test_a_wave_alone_gives_no_name(seed: int) -> None:
    assert names(replace(study(4, curvature=0.0, late=0.0, wave=0.05), seed=seed)) == set()
