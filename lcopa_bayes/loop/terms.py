"""How many viscous terms the base model needs before anything is called missing."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.loop.basefit import BaseFit, base_fit
from lcopa_bayes.loop.basemodel import BaseModel
from lcopa_bayes.loop.confirm import log_bayes_factor
from lcopa_bayes.loop.regression import Regression
from lcopa_bayes.study import Study

_MOST = 3
_GAIN = 10.0
"""Log evidence that one more viscous term must bring [nat]: it is an assumption of the user's that
changes."""


class Base(NamedTuple):
    """A study's base fit, perhaps with more viscous terms than it states."""

    problem: Problem
    fit: BaseFit
    sentence: str
    """What was changed; empty when nothing was."""


def fitted_base(study: Study, *, as_stated: bool) -> Base:
    """The base fit; with one free viscous term stated and not `as_stated`, of the number the evidence asks
    for.

    A plant with too few terms is no undeclared effect, and would be named as one.
    """
    problem = problem_of(study)
    fit = base_fit(BaseModel(problem.posterior), np.random.default_rng([study.seed, 10]))
    sentence = ""
    if as_stated or study.model.terms != 1 or study.model.orders != "free":
        return Base(problem, fit, sentence)
    for terms in range(2, _MOST + 1):
        larger = problem_of(replace(study, model=replace(study.model, terms=terms)))
        try:
            other = base_fit(BaseModel(larger.posterior), np.random.default_rng([study.seed, 10, terms]))
        except ArithmeticError:
            break
        quiet = float(sum(one.samples for one in other.noise if one.known))
        same = Regression(fit.model, other.regression.whitening).descend(fit.optimum.x)
        gain = log_bayes_factor(same, other.optimum, quiet)
        if other.failed or not gain > _GAIN:
            break
        problem, fit = larger, other
        sentence = (
            f"The base model has {terms} viscous terms: one more than {terms - 1} is worth {gain:.0f} nat."
        )
    return Base(problem, fit, sentence)
