"""Plants that a loop does not choose have a part in its numbers: a truth outside the chosen one is held."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "studies" / "undeclared-effects"))

from foreign import campaign, truths

from lcopa_bayes.core.estimate import quantile
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.effectsearch.loopresult import Loop
from lcopa_bayes.effectsearch.plantsbeside import PlantsBeside
from lcopa_bayes.effectsearch.refits import log_bayes_factor
from lcopa_bayes.effectsearch.richerplants import RicherPlants
from lcopa_bayes.results.structure import with_least_terms

SEED = 982200005
"""Of a campaign of three terms, of which the third is worth half a nat."""
KIND = "three terms"


def study() -> Study:
    return with_least_terms(campaign(KIND, (), SEED).study(SEED))


@pytest.fixture(scope="module")
def found() -> Loop:
    return loop(study(), library=[], sample=False, quick=True)


def ends(found: Loop, name: str) -> tuple[float, float]:
    (one,) = (one for one in found.figures if one.name == name)
    return float(quantile(one.values, 0.05)), float(quantile(one.values, 0.95))


@pytest.mark.slow
def test_a_steady_value_beyond_the_record_is_held(found: Loop) -> None:
    """By the interval over the plant that was not chosen too, and not by that of the others."""
    true = truths(campaign(KIND, (), SEED), found.problem.scales.span, ())["steady_state[y1]"]
    low, high = ends(found, "steady_state[y1]")
    assert low <= true <= high
    low, high = ends(replace(found, plants=PlantsBeside()), "steady_state[y1]")
    assert high < true


def test_a_richer_plant_contains_the_chosen_one(found: Loop) -> None:
    (one,) = found.plants.richer.plants
    assert found.verdict.kind == "clean"
    assert one.state.model.plant.table.layout.elements[0].terms == 3
    assert found.problem.posterior.table.layout.elements[0].terms == 2
    assert 0.0 <= one.gained < 3.0
    squares = []
    for state in (found.after.state, one.state):
        white = found.after.state.whitening
        left = white(white.observed - state.model.predict(state.optimum.x))
        squares.append(float(left @ left))
    assert one.gained == pytest.approx((squares[0] - squares[1]) / 2, abs=1e-6)


def test_its_evidence_is_that_of_a_refit_and_gives_its_weight(found: Loop) -> None:
    """By the same Laplace approximation with the noise scale integrated out, of which many quiet samples
    leave the known one; evidence raises the weight from a fifth, by the odds, to even ones."""
    richer = found.plants.richer
    (one,) = richer.plants
    own, other = found.after.state, one.state
    ordering = other.model.plant.table.log_support - own.model.plant.table.log_support
    evidence = log_bayes_factor(own.optimum, other.optimum, quiet=1e12) + ordering
    assert one.log_bayes_factor == pytest.approx(evidence, abs=1e-3)
    assert one.log_bayes_factor < 0.5
    for nats, weight in ((-30.0, 0.2), (0.0, 0.2), (np.log(4 * 0.4 / 0.6), 0.4), (30.0, 0.5)):
        weighed = replace(
            richer, plants=(replace(one, log_bayes_factor=nats), replace(one, log_bayes_factor=-9.0))
        )
        assert weighed.weight == pytest.approx(weight)
    assert RicherPlants().weight == 0.0


def test_its_part_is_the_stated_weight(found: Loop) -> None:
    """Of the plant's draws, before sums of lags take theirs; of gains, and not of times."""
    alone, weight = replace(found, lags=()), found.plants.richer.weight
    names = found.after.state.model.names
    for name, parts in (("gain", 2), ("time_1", 1)):
        number = alone.number(names.index(name))
        assert len(number.parts) == parts + len(found.open)
        assert number.weights.sum() == pytest.approx(1.0)
        assert parts == 1 or number.weights[-1] == pytest.approx(weight)
    shares = [share for _, share in alone.plants.shares]
    assert alone.number(names.index("gain")).weights[-1] == pytest.approx(shares[-1])
    assert sum(shares) == pytest.approx(1.0)
    share = f"{100 * weight:.0f} % of a plant of one element with 3 terms"
    assert share in alone.plants.sentence
    steady = next(one for one in alone.figures if one.name == "steady_state[y1]")
    own = steady.parts[-1]
    gain = alone.number(names.index("gain")).parts[-1]
    assert np.median(own) == pytest.approx(np.median(gain), rel=0.05)


@pytest.mark.slow
def test_a_stated_structure_has_none() -> None:
    made = study()
    made = replace(made, model=replace(made.model, terms=2))
    assert not loop(made, sample=False, as_stated=True).plants.richer.plants
