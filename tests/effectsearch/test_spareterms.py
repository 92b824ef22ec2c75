"""Every element of a plant has as many terms as the records ask of it, and not as many as another needs."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from small import ONE, TWO, path, record, study

from lcopa_bayes.bench.command import on_off, staircase
from lcopa_bayes.bench.device import Device
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.basefit import BaseFit, base_fit
from lcopa_bayes.effectsearch.basemodel import Base, fitted_base
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.spareterms import (
    static_elements,
    without_spare_terms,
    without_static_terms,
)
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.elementterms import terms_in_words
from lcopa_bayes.model.path import TransferPath

RESPONSES = TWO.response_axes
TWO_TERMS, ONE_TERM = path(1.0, 0.5, (1.0, 2.0), (1.9, 0.7)), path(1.0, 0.5, (1.5,), (0.9,))
UNEQUAL = Device(((TWO_TERMS,), (ONE_TERM,)), ONE.drive_axes, RESPONSES, (0.0, 0.0))
"""One drive, two responses, of which the first rings and creeps."""
OWN = {"share": "none", "delay": "path"}


def campaign(device: Device, **settings: object) -> Study:
    moves = (on_off(1.0, hold=9.0, at=0.5), staircase([0.5, 1.0, 0.2], hold=6.0, start=0.5))
    if len(device.drive_axes) > 1:
        moves = tuple(on_off(to, hold=6.0, at=0.5, rest=0.0) for to in ((1.0, 0.3), (-0.4, 1.0)))
    records = [
        record(k, device=device, command=move, camera=0.25, duration=20.0, noise_sd=0.004, name=f"r{k}")
        for k, move in enumerate(moves)
    ]
    return replace(study(*records), model=ModelSettings(**settings))


def fitted(one: Study, terms: object, **settings: object) -> tuple[Problem, BaseFit]:
    problem = problem_of(replace(one, model=replace(one.model, terms=terms, **settings)))
    return problem, base_fit(ExtendedModel(problem.posterior), np.random.default_rng(1), starts=2)


@cache
def unequal() -> tuple[Study, tuple[Problem, BaseFit], tuple[Problem, BaseFit]]:
    """A campaign, its plant with one term in each path, and with two."""
    one = campaign(UNEQUAL, **OWN)
    return one, fitted(one, 1), fitted(one, 2)


def test_the_term_that_no_record_asks_for_is_taken_out() -> None:
    one, (_, smaller), (problem, larger) = unequal()
    thinned, fit = without_spare_terms(problem, larger, smaller)
    assert fit.model.plant.table.layout.terms == {"x_u": 2, "y_u": 1} == thinned.study.model.terms
    assert fit.optimum.log_evidence > max(larger.optimum.log_evidence, smaller.optimum.log_evidence)
    # from starts of its own, with noise of its own, that plant is fitted as well and no better
    _, again = fitted(one, {"x_u": 2, "y_u": 1})
    missed = [float((at.optimum.residual**2).sum()) for at in (fit, again)]
    assert missed[0] == pytest.approx(missed[1], rel=2e-3)
    values = dict(zip(fit.model.names, fit.model.values(fit.optimum.x), strict=False))
    assert values["gain_y_u"] == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(
    ("own", "kept"), [pytest.param(TWO_TERMS, 2, marks=pytest.mark.slow), (ONE_TERM, 1)], ids=["all", "none"]
)
def test_a_plant_of_equal_elements_keeps_them_all_or_none(own: TransferPath, kept: int) -> None:
    device = replace(UNEQUAL, paths=((own,), (replace(own, gain=-0.8),)))
    one = campaign(device, **OWN)
    (_, smaller), (problem, larger) = fitted(one, 1), fitted(one, 2)
    _, fit = without_spare_terms(problem, larger, smaller)
    assert set(fit.model.plant.table.layout.terms.values()) == {kept}


def test_what_paths_share_is_kept_beside_a_term_that_is_taken_out() -> None:
    """Direct paths have two terms and cross paths one, with one delay for all."""
    one = campaign(TWO, share="paper", delay="shared")
    (_, smaller), (problem, larger) = fitted(one, 1), fitted(one, 2)
    thinned, fit = without_spare_terms(problem, larger, smaller)
    assert fit.model.plant.table.layout.terms == {"direct": 2, "cross": 1}
    assert (thinned.study.model.share, thinned.study.model.delay) == ("paper", "shared")
    assert fit.model.names.count("delay") == 1


def test_a_static_term_is_taken_out_and_a_plant_of_one_element_is_left_as_it_is() -> None:
    _, (_, smaller), (problem, larger) = unequal()
    table = larger.model.plant.table
    values = larger.model.values(larger.optimum.x)
    values[table.terms[1].orders[-1]] = 0.01
    static = replace(larger, optimum=replace(larger.optimum, x=larger.model.coordinates(values)))
    assert static_elements(static.model, static.optimum.x) == {"y_u"}
    _, fit = without_static_terms(problem, static, smaller)
    assert fit.model.plant.table.layout.terms == {"x_u": 2, "y_u": 1}
    assert not static_elements(fit.model, fit.optimum.x)
    alone = campaign(replace(ONE, paths=((ONE_TERM,),)))
    (_, small), (problem, large) = fitted(alone, 1), fitted(alone, 2)
    assert without_spare_terms(problem, large, small) == (problem, large)


def test_a_loop_chooses_the_terms_of_each_element() -> None:
    one, _, _ = unequal()
    base: Base = fitted_base(replace(one, model=ModelSettings(terms=1)), (), as_stated=False, draws=50)
    assert base.counts == {"x_u": 2, "y_u": 1}
    assert "2 terms in x_u, and 1 in the others" in base.sentence
    for wider in base.richer:
        assert wider.counts != base.counts
        assert all(wider.counts[name] >= terms for name, terms in base.counts.items())


@pytest.mark.parametrize(
    ("counts", "words"),
    [
        ({"": 1}, "1 term"),
        ({"a": 2, "b": 2}, "2 terms"),
        ({"a": 2, "b": 1, "c": 2}, "2 terms in a, c, and 1 in the others"),
        ({"a": 3, "b": 1, "c": 2}, "3 terms in a, and 1 or 2 in the others"),
    ],
)
def test_terms_in_words(counts: dict[str, int], words: str) -> None:
    assert terms_in_words(counts) == words
