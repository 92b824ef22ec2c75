"""Terms of single elements that the records do not ask for are taken out of a plant again.

A further term of every element costs what all of them cost, though the records may ask for that of one
element alone: six paths of which one needs a second term would otherwise keep none, or all.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.wording import listed
from lcopa_bayes.effectsearch.basefit import BaseFit
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.refits import log_bayes_factor
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.parameters import ParameterTable

STATIC = 0.1
"""Order below which a further term is a gain to any record: over three decades of time it changes by a factor
of two. The steady value is then a matter of words: over such plants the rise of 20 of 36 paths of plants
outside the family was open, without them of 11, and as many hold the true one [-]."""


def without_spare_terms(problem: Problem, fit: BaseFit, smaller: BaseFit) -> tuple[Problem, BaseFit]:
    """The plant of a fit with those further terms alone, beside the ones of a `smaller` fit, that each add to
    the evidence beside the others: with as many terms as the smaller plant where none does.

    Both have equal elements and delays but for numbers of terms. The terms that are missed least are taken
    out first, and noise is that of the fit.
    """

    def missed(name: str) -> float:
        _, model, x = _reduced(problem, fit, smaller, {name})
        return Regression(model, fit.regression.whitening).cost(x)

    for name in sorted(_further(fit, smaller), key=missed):
        fewer, model, x = _reduced(problem, fit, smaller, {name})
        own = fit.with_plant(model, x)
        ordering = fit.model.plant.table.log_support - model.plant.table.log_support
        quiet = float(sum(fit.noise_samples))
        if log_bayes_factor(own.optimum, fit.optimum, quiet) + ordering <= 0.0:
            problem, fit = fewer, own
    return problem, fit


def without_static_terms(problem: Problem, fit: BaseFit, smaller: BaseFit) -> tuple[Problem, BaseFit]:
    """The same without the further terms that are gains to any record."""
    while static := _further(fit, smaller) & static_elements(fit.model, fit.optimum.x):
        problem, model, x = _reduced(problem, fit, smaller, static)
        fit = fit.with_plant(model, x)
    return problem, fit


def static_elements(model: ExtendedModel, x: Vector) -> set[str]:
    """Names of the elements of a plant of which a term is a gain to any record."""
    table, values = model.plant.table, model.values(x)
    slots = zip(table.layout.elements, table.terms, strict=True)
    return {slot.name for slot, terms in slots if values[list(terms.orders)].min() < STATIC}


def counts_of(table: ParameterTable) -> dict[str, int]:
    """Number of terms of each element [-], by name."""
    return {slot.name: slot.terms for slot in table.layout.elements}


def terms_in_words(counts: Mapping[str, int]) -> str:
    """Numbers of terms [-] of elements by name, as in "2 viscous terms in a, b, and 1 in the others"."""
    most = max(counts.values())
    richest = [name for name, terms in counts.items() if terms == most]
    said = f"{most} viscous term{'s' * (most > 1)}"
    if len(richest) == len(counts):
        return said
    fewer = sorted({terms for terms in counts.values() if terms < most})
    return f"{said} in {listed(richest)}, and {' or '.join(map(str, fewer))} in the others"


def _further(fit: BaseFit, smaller: BaseFit) -> set[str]:
    """Names of the elements that have more terms than in a smaller fit; none of a plant of one element, whose
    plant with fewer terms is the smaller fit itself."""
    counts, least = (counts_of(one.model.plant.table) for one in (fit, smaller))
    return {name for name in counts if counts[name] > least[name]} if len(counts) > 1 else set()


def _reduced(
    problem: Problem, fit: BaseFit, smaller: BaseFit, elements: Collection[str]
) -> tuple[Problem, ExtendedModel, Vector]:
    """Problem and model with the terms of a smaller fit in some elements, and coordinates: these elements,
    with gains and delays of their paths, as in the smaller fit, all else as in the fit."""
    table, inner = fit.model.plant.table, smaller.model.plant.table
    counts = counts_of(table) | {name: counts_of(inner)[name] for name in elements}
    settings = problem.study.model.for_plant(len(table.layout.drives), len(table.layout.responses))
    study = replace(problem.study, model=replace(settings, terms=counts))
    fewer = problem_of(study).at_least(problem.refinement)
    model = ExtendedModel(fewer.posterior)
    known = _named(table, fit.model.values(fit.optimum.x))
    theirs = _named(inner, smaller.model.values(smaller.optimum.x))
    known |= {name: theirs[name] for element in elements for name in _rows(inner, element)}
    return fewer, model, model.coordinates(np.array([known[row.name] for row in model.plant.table.rows]))


def _named(table: ParameterTable, values: Vector) -> dict[str, float]:
    return dict(zip((row.name for row in table.rows), values.tolist(), strict=True))


def _rows(table: ParameterTable, element: str) -> list[str]:
    """Names of the parameters of an element, of the gains of its paths, and of the delays that no other path
    has."""
    layout = table.layout
    own = [slot.name for slot in layout.elements].index(element)
    places = [(path.response, path.drive) for path in layout.paths]
    paths = [(i, j) for i, j in places if layout.element_of[i][j] == own]
    others = {layout.delay_of[i][j] for i, j in places if (i, j) not in paths}
    delays = {layout.delay_of[i][j] for i, j in paths} - others
    rows = [*table.terms[own].times, *table.terms[own].orders]
    rows += [table.at("gain", i, j) for i, j in paths] + [table.at("delay", slot) for slot in delays]
    return [table.rows[k].name for k in rows]
