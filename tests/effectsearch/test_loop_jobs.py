"""Processes that share a search change none of its numbers."""

import os
import sys
from dataclasses import replace

import numpy as np
import pytest
from test_loop import LIBRARY, study

from lcopa_bayes.core import crew
from lcopa_bayes.data.settings import EffectsSettings
from lcopa_bayes.effectsearch.explained import declarable
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.model.effects.catalogue import catalogue

loops = sys.modules[loop.__module__]

OWN = """
import os
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from lcopa_bayes.model.effects.effect import Card, ReadoutEffect, single

@dataclass(frozen=True)
class Cubed(ReadoutEffect):
    card: ClassVar[Card] = Card("cubed", "output", "y -> y + c y^3", "here", "all", "a test")
    def coefficients(self, ranges):
        return single("c", 0.1)
    def seen(self, y, scene, psi):
        with open(Path(__file__).parent / "who.txt", "a") as file:
            print(os.getpid(), file=file)
        return y + psi[0] * y**3
"""


@pytest.fixture
def pools(monkeypatch):
    """Number of processes of each pool that is opened, and a search that opens one at once."""
    opened, plain = [], crew.workers
    monkeypatch.setattr(loops, "WORTHWHILE", 0.0)
    monkeypatch.setattr(crew, "workers", lambda *given, jobs: opened.append(jobs) or plain(*given, jobs=jobs))
    return opened


def numbers(found):
    """Every number that a search leaves."""
    scores = (*found.after.fit, *found.after.unseen)
    return {
        "names": found.names,
        "verdict": (found.verdict, found.groups),
        "traced": [[(t.name, t.log_bayes_factor, t.best) for t in one.trace.traced] for one in found.rounds],
        "chance": [(one.trace.threshold, one.trace.p_value) for one in found.rounds],
        "refits": [[(r.added, r.log_bayes_factor, r.left_out) for r in one.refits] for one in found.rounds],
        "optimum": found.after.state.optimum.x.tolist(),
        "covariance": found.after.state.covariance.tolist(),
        "evidence": found.after.state.log_evidence,
        "errors": [(one.rmse, one.variance.tolist()) for one in scores],
    }


@pytest.mark.parametrize("quiet", [pytest.param(8.0, marks=pytest.mark.slow), 0.4])
def test_numbers_do_not_depend_on_the_number_of_processes(pools, quiet):
    """With noise that samples at rest give, and with noise fitted jointly."""
    made = study(2, 0.06, quiet=quiet)
    made = replace(made, fit=made.fit[:2])
    library = [*LIBRARY, *(catalogue()[name] for name in ("outliers", "overdrive_pulse"))]
    one, two = (
        loop(made, library=library, jobs=jobs, sample=False, quick=True, as_stated=True) for jobs in (1, 2)
    )
    assert pools == [2]
    assert any(each.refits for each in one.rounds)
    assert numbers(one) == numbers(two)
    assert two.after.state.model.plant is two.before.state.model.plant  # no copy comes back


@pytest.mark.slow
def test_a_richer_structure_is_the_same_too(pools):
    one, two = (loop(study(2), library=LIBRARY, jobs=jobs, sample=False, quick=True) for jobs in (1, 2))
    assert pools == [2]
    assert numbers(one) == numbers(two)


def test_an_effect_of_the_user_is_searched_in_this_process(pools, tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    made = replace(study(2, 0.06), folder=tmp_path, effects=EffectsSettings(add=("own.py:Cubed",)))
    made = replace(made, fit=made.fit[:2])
    library = [catalogue(["own.py:Cubed"], tmp_path)["cubed"], LIBRARY[1]]
    one, two = (
        loop(made, library=library, jobs=jobs, sample=False, quick=True, as_stated=True) for jobs in (1, 2)
    )
    assert pools == [2]
    assert two.names == ("cubed",)
    assert numbers(one) == numbers(two)
    assert np.unique((tmp_path / "who.txt").read_text().split()).tolist() == [str(os.getpid())]


def test_a_short_search_starts_no_process(monkeypatch):
    monkeypatch.setattr(loops, "WORTHWHILE", 1e9)
    monkeypatch.setattr(crew, "workers", None)  # no call of it would end
    found = loop(study(2), library=LIBRARY[:1], jobs=2, sample=False, quick=True, as_stated=True)
    assert found.verdict.kind == "clean"


def test_a_study_with_an_effect_of_the_user_is_sampled(tmp_path):
    """The file is read again for it; a class of the same name from elsewhere is not what the study names."""
    (tmp_path / "own.py").write_text(OWN)
    made = replace(study(2, 0.06), folder=tmp_path, effects=EffectsSettings(add=("own.py:Cubed",)))
    kind = catalogue(["own.py:Cubed"], tmp_path)["cubed"]
    assert declarable(made, [kind()])
    assert not declarable(made, [type("Cubed", (kind,), {"__module__": "elsewhere"})()])
    found = loop(replace(made, fit=made.fit[:2]), library=[kind], quick=True, as_stated=True)
    assert found.names == ("cubed",)
    assert found.draws is not None
    assert "cubed.c" in found.draws.table.names
