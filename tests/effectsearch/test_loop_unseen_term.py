"""Terms that only unseen records show: fitted ones move two drives alike, the others do not."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from small import path, record

from lcopa_bayes.bench.command import joint, on_off
from lcopa_bayes.bench.device import Device
from lcopa_bayes.data.record import Axis
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch import basemodel
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.effectsearch.rounds import Search, search
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.verdict import CHANCE, Miss
from lcopa_bayes.model.effects.response import OddCurvature
from lcopa_bayes.results.structure import with_least_terms

GAINS = {"gain_x_u": 0.02, "gain_x_v": 0.016}
DEVICE = Device(
    (tuple(path(gain, 2.0, (1.9, 2.26), (1.6, 0.85)) for gain in GAINS.values()),),
    (Axis("u", "rad"), Axis("v", "rad")),
    (Axis("x", "rad"),),
    (0.0,),
)
LIBRARY = [OddCurvature]
HEIGHTS = ((1.2, -0.8), (-0.8, 0.6), (0.6, 1.2))


def study() -> Study:
    commands = [joint(on_off(u, hold=8.0, at=1.0), on_off(v, hold=11.0, at=3.0)) for u, v in HEIGHTS]
    fitted = [
        record(k, device=DEVICE, command=one, camera=0.5, duration=30.0, noise_sd=2e-4, name=f"r{k}")
        for k, one in enumerate(commands)
    ]
    return Study("alike", fit=fitted[:2], held_out=fitted[2:], seed=11)


@pytest.fixture(scope="module")
def base() -> basemodel.Base:
    return basemodel.fitted_base(with_least_terms(study()), LIBRARY, as_stated=False, draws=100)


def searched(base: basemodel.Base) -> Search:
    rng, quiet = np.random.default_rng(1), base.fit.noise_samples
    return search(base.start, LIBRARY, rng, noise_samples=quiet, draws=100)


def test_unseen_records_ask_for_the_terms_that_they_show(base: basemodel.Base):
    assert base.counts == {"x_u": 1, "x_v": 1}
    found = searched(base)
    richer = basemodel.beside_unseen(base, found)
    assert richer is not None
    assert richer.counts == {"x_u": 2, "x_v": 2}
    assert (
        "unseen ones, which had a part in this choice, are missed by 17.4 times the noise" in richer.sentence
    )
    assert basemodel.beside_unseen(base._replace(richer=()), found) is None


def test_nothing_is_asked_for_where_chance_explains_the_errors_or_those_of_no_other_plant(
    base: basemodel.Base, monkeypatch: pytest.MonkeyPatch
):
    found, seen = searched(base), basemodel.missed

    def unlike(p: float, state: State, *given: Any) -> Miss:
        """The errors of the chosen plant, or of all others, by chance so often."""
        miss = seen(*given, state)
        return replace(miss, p=p) if (state is found.state) == (p > CHANCE) else miss

    for p in (2 * CHANCE, 0.5 * CHANCE):
        monkeypatch.setattr(basemodel, "missed", lambda *given, p=p: unlike(p, given[-1], *given[:-1]))
        assert basemodel.beside_unseen(base, found) is None


def test_nothing_is_asked_for_where_an_effect_explains_them(base: basemodel.Base):
    found = searched(base)
    curved = replace(found.state, model=found.state.model.having(OddCurvature()))
    assert basemodel.beside_unseen(base, replace(found, state=curved)) is None


@pytest.mark.slow
def test_a_clean_campaign_of_such_a_plant_is_clean_and_its_gains_are_held():
    found = loop(study(), library=LIBRARY, sample=False, quick=True)
    assert found.verdict.kind == "clean"
    names = found.after.state.model.names
    for name, truth in GAINS.items():
        low, high = np.quantile(found.number(names.index(name)).values, (0.05, 0.95))
        assert low < truth < high
