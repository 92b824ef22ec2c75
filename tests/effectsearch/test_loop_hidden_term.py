"""A term that does not show until an effect is there: an oscillator that is clipped does not ring."""

import numpy as np

from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch import basemodel
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.effectsearch.rounds import search
from lcopa_bayes.model.effects.catalogue import catalogue

GAIN, TIME, DAMPING, DELAY, LIMIT, NOISE = 2.0, 0.4, 0.35, 0.15, 1.15, 0.01
LIBRARY = [catalogue()[name] for name in ("clipping", "unmodelled_smooth")]
U, Y = (Axis("u", "V"),), (Axis("y", "mm"),)
CHANGES = {
    "up": ((1.0, 0.9), (4.0, -0.7), (5.6, 0.0)),
    "small": ((1.0, 0.3), (3.6, -0.9), (5.6, 0.0)),
    "stairs": ((1.0, 0.5), (2.4, 1.0), (4.4, -0.5)),
}
"""Times [s] and levels [V] of the drive, record by record."""


def ringing(t: np.ndarray) -> np.ndarray:
    """Response of a second-order plant of unit gain to a unit step, by its closed form."""
    decay, angle = DAMPING / TIME, np.sqrt(1 - DAMPING**2) / TIME
    late = np.maximum(t, 0.0)
    swing = np.cos(angle * late) + decay / angle * np.sin(angle * late)
    return np.where(t > 0, 1 - np.exp(-decay * late) * swing, 0.0)


def study(seed: int, limit: float) -> Study:
    rng, records = np.random.default_rng(seed), []
    for name, changes in CHANGES.items():
        time = np.arange(0.0, 7.0, 0.04)
        drive, response, before = np.zeros_like(time), np.zeros_like(time), 0.0
        for at, level in changes:
            drive[time > at - 1e-9] = level
            response += GAIN * (level - before) * ringing(time - at - DELAY)
            before = level
        read = np.clip(response, -limit, limit) + NOISE * rng.standard_normal(time.size)
        records.append(Record(name, time, drive[:, None], read[:, None], U, Y, "s"))
    return Study("clipped", None, "s", seed, tuple(records[:2]), tuple(records[2:]), ModelSettings(terms=1))


def test_a_term_that_an_effect_hides_is_found_beside_it():
    found = loop(study(1, LIMIT), library=LIBRARY, sample=False, quick=True)
    assert found.verdict.kind == "explained"
    assert found.names == ("clipping",)
    assert "2 terms: beside clipping what is added is worth" in found.enlarged
    ends = {one.name: np.quantile(one.values, (0.005, 0.995)) for one in found.figures}
    low, high = ends["steady_state[y]"]
    assert low < GAIN < high


def test_a_term_that_nothing_hides_needs_no_effect():
    found = loop(study(1, np.inf), library=LIBRARY, sample=False, quick=True)
    assert found.verdict.kind == "clean"
    assert "beside clipping" not in found.enlarged


def test_a_richer_plant_stays_out_where_it_is_worth_too_little(monkeypatch):
    """Second method: the evidence with both signs."""
    base = basemodel.fitted_base(study(1, LIMIT), LIBRARY, as_stated=False, draws=100)
    searched = search(
        base.start, LIBRARY, np.random.default_rng(1), noise_samples=base.fit.noise_samples, draws=100
    )
    assert base.richer
    assert basemodel.beside_effects(base, searched) is not None
    assert basemodel.beside_effects(base._replace(richer=()), searched) is None
    gain = basemodel._gain
    monkeypatch.setattr(basemodel, "_gain", lambda *given: -gain(*given))
    assert basemodel.beside_effects(base, searched) is None
