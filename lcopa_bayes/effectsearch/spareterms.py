"""Terms of single elements that the records do not ask for are taken out of a plant again.

A further term of every element costs what all of them cost, though the records may ask for that of one
element alone: six paths of which one needs a second term would otherwise keep none, or all.
"""

from __future__ import annotations

from collections.abc import Collection

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.effectsearch.basefit import BaseFit
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.refits import log_bayes_factor
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.elementterms import further, reduced

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
        _, model, x = _with_fewer(problem, fit, smaller, {name})
        return Regression(model, fit.regression.whitening).cost(x)

    for name in sorted(further(fit.model.plant.table, smaller.model.plant.table), key=missed):
        fewer, model, x = _with_fewer(problem, fit, smaller, {name})
        own = fit.with_plant(model, x)
        ordering = fit.model.plant.table.log_support - model.plant.table.log_support
        quiet = float(sum(fit.noise_samples))
        if log_bayes_factor(own.optimum, fit.optimum, quiet) + ordering <= 0.0:
            problem, fit = fewer, own
    return problem, fit


def without_static_terms(problem: Problem, fit: BaseFit, smaller: BaseFit) -> tuple[Problem, BaseFit]:
    """The same without the further terms that are gains to any record."""
    least = smaller.model.plant.table
    while static := further(fit.model.plant.table, least) & static_elements(fit.model, fit.optimum.x):
        problem, model, x = _with_fewer(problem, fit, smaller, static)
        fit = fit.with_plant(model, x)
    return problem, fit


def static_elements(model: ExtendedModel, x: Vector) -> set[str]:
    """Names of the elements of a plant of which a term is a gain to any record."""
    table, values = model.plant.table, model.values(x)
    slots = zip(table.layout.elements, table.terms, strict=True)
    return {slot.name for slot, terms in slots if values[list(terms.orders)].min() < STATIC}


def _with_fewer(
    problem: Problem, fit: BaseFit, smaller: BaseFit, elements: Collection[str]
) -> tuple[Problem, ExtendedModel, Vector]:
    """Problem and model with the terms of the smaller fit in some elements, and coordinates near both."""
    values, theirs = (one.model.values(one.optimum.x) for one in (fit, smaller))
    fewer, start = reduced(problem, values, smaller.model.plant.table, theirs, elements)
    model = ExtendedModel(fewer.posterior)
    return fewer, model, model.coordinates(start)
