"""Internal constants of an effect with two optima that explain alike: the numbers of a loop hold both."""

from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import ClassVar

import numpy as np
import pytest
from test_loop_joint import AXIS

from lcopa_bayes.data.record import Record
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch import openeffects
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.effectsearch.loopresult import Loop
from lcopa_bayes.effectsearch.summary import results
from lcopa_bayes.inference.priors import Prior
from lcopa_bayes.model.effects.effect import Card, ParallelEffect, single
from lcopa_bayes.model.effects.parallel import relaxed

DELAY, TIME, SLOW, FAST, GAIN, SIZE, SD = 3.0, 8.0, 40.0, 1.5, 2.0, 0.4, 0.02
FLAT = Prior("uniform", {"loc": 0.5, "scale": 3.0})


@dataclass(frozen=True)
class Twofold(ParallelEffect):
    """A slow response, and at level 2 that of the plant too, which the gain then lacks: levels 1 and 2
    explain alike, others add what no record has."""

    level: float
    units = MappingProxyType({"level": "-"})
    estimated = single("k", 0.1)
    card: ClassVar[Card] = Card("twofold", "plant", "", "", "", "")

    @classmethod
    def grid(cls, ranges):
        return tuple(cls(level) for level in (0.7, 1.0, 1.4, 2.0, 2.8))

    def added(self, scene, psi):
        plant, slow, fast = (relaxed(scene, 0, 0, time) for time in (TIME, SLOW, FAST))
        share = np.log2(self.level)
        unit = scene.ranges.response[0] / scene.ranges.drive[0]
        return psi[0] * unit * (slow + share * plant + 4 * share * (share - 1) * (fast - plant))[:, None]


def recorded(name: str, seed: int) -> Record:
    rng = np.random.default_rng(seed)
    time, at = np.arange(600) * 0.5, 20.0 + 30.0 * np.arange(9)
    jumps = np.resize([1.0, -1.0, 0.5, -0.5], at.size)
    drive = np.concatenate([[0.0], np.cumsum(jumps)])[np.searchsorted(at, time, side="right")]

    def risen(slowness: float) -> np.ndarray:
        return (1 - np.exp(-np.maximum(time[:, None] - at - DELAY, 0.0) / slowness)) @ jumps

    response = GAIN * risen(TIME) + SIZE * risen(SLOW) + SD * rng.standard_normal(time.size)
    return Record(name, time, drive[:, None], response[:, None], AXIS, AXIS, "ms")


@pytest.fixture(scope="module")
def found() -> Loop:
    records = tuple(recorded(f"r{k}", 40 + k) for k in range(3))
    study = Study("twofold", None, "ms", 3, records[:2], records[2:], ModelSettings(offset="shared"))
    return loop(study, library=[Twofold], sample=False, quick=True, as_stated=True)


def test_both_optima_of_a_constant_are_in_the_intervals(found: Loop):
    assert found.names == ("twofold",)
    (here,) = found.effects
    (other,) = [one for one in found.open if one.instance]
    assert sorted([here.level, other.instance.level]) == pytest.approx([1.0, 2.0], rel=0.02)
    assert other.weight == pytest.approx(1.0, rel=0.5)
    names = list(found.after.state.model.names)
    gain = found.estimate(names.index("gain"))
    both = GAIN, GAIN - SIZE
    low, _, high = gain["alone"]
    assert sum(low < one < high for one in both) == 1
    assert all(gain["lower"] < one < gain["upper"] for one in both)
    assert gain["sd_structure"] == pytest.approx(SIZE / 2, rel=0.2)
    size = found.estimate(names.index("twofold.k"))
    assert size["sd_structure"] < 0.5 * size["sd_noise"]  # alike in both
    (said,) = results(found)["open"]
    assert said["said"].startswith(f"twofold with level {other.instance.level:.3g} in place of twofold (")


def test_an_instance_that_draws_reach_counts_once(found: Loop):
    (other,) = [one for one in found.open if one.instance]
    table = found.after.state.model.posterior.table
    assert not other.within(table)  # held at the other level
    assert found.number(0).weights.size == 2
    rows = [replace(row, prior=FLAT) if row.name == "twofold.level" else row for row in table.rows]
    assert other.within(replace(table, rows=tuple(rows)))


def test_an_instance_far_likelier_than_the_one_named_takes_all_the_weight(found: Loop, monkeypatch):
    """And none that is no number: odds of e^5000 are no float."""
    monkeypatch.setattr(openeffects, "log_bayes_factor", lambda *_: 5_000.0)
    every = openeffects.alternatives(found.after.state, found.rounds)
    (other,) = [one for one in every if one.instance]
    weights = openeffects.mixture(found.after.state, None, every).weights
    assert weights.sum() == pytest.approx(1.0)
    assert weights[1 + every.index(other)] == pytest.approx(1.0)
