"""How many viscous terms the base model needs before anything is called missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.loop.basefit import BaseFit, base_fit
from lcopa_bayes.loop.basemodel import BaseModel
from lcopa_bayes.loop.confirm import log_bayes_factor
from lcopa_bayes.loop.extended import ExtendedModel
from lcopa_bayes.loop.prediction import taken
from lcopa_bayes.loop.regression import Regression
from lcopa_bayes.loop.rounds import leading
from lcopa_bayes.loop.scores import State
from lcopa_bayes.loop.trace import trace
from lcopa_bayes.plant.effects.effect import Effect
from lcopa_bayes.settings import PriorSettings
from lcopa_bayes.study import Study

_MOST = 3
_GAIN = 10.0
"""Log evidence that one more viscous term must bring [nat]: it is an assumption of the user's that
changes."""
_LONGER = 2.0
"""Factor on the default prior of a delay that ends at it: 0.4 becomes 0.8 of the records' span [-]."""
_AT_END = 1e-2
"""Closer to the end of its prior than this share, a delay stands at it [-]."""


class Base(NamedTuple):
    """A study's base fit, perhaps with more viscous terms than it states."""

    problem: Problem
    fit: BaseFit
    start: State
    sentence: str
    """What was changed; empty when nothing was."""


def fitted_base(study: Study, library: Sequence[type[Effect]], *, as_stated: bool, draws: int) -> Base:
    """The base fit; with one free viscous term stated and not `as_stated`, of the number the evidence asks
    for.

    A plant with too few terms is no undeclared effect, and would be named as one; one with a term too many
    may imitate an effect. So a further term is a candidate like any other: it is added when it is worth more
    than the best named effect.
    """
    problem = problem_of(study)
    fit = base_fit(BaseModel(problem.posterior), np.random.default_rng([study.seed, 10]))
    later, said = _later(study, fit), ""
    if later is not None:
        study, said = later
        problem = problem_of(study)
        fit = base_fit(BaseModel(problem.posterior), np.random.default_rng([study.seed, 10]))
    base = Base(problem, fit, _start(fit, study), said)
    if as_stated or study.model.terms != 1 or study.model.orders != "free":
        return base
    for terms in range(2, _MOST + 1):
        larger = problem_of(replace(study, model=replace(study.model, terms=terms)))
        try:
            other = base_fit(BaseModel(larger.posterior), np.random.default_rng([study.seed, 10, terms]))
        except ArithmeticError:
            break
        quiet = float(sum(one.samples for one in other.noise if one.known))
        same = Regression(base.fit.model, other.regression.whitening).descend(base.fit.optimum.x)
        gain = log_bayes_factor(same, other.optimum, quiet)
        if base.fit.failed and terms < _MOST and (other.failed or not gain > _GAIN):
            continue
        if other.failed or not gain > _GAIN:
            break
        if base.fit.failed:
            told = f"The base model has {terms} viscous terms, because with fewer {base.fit.failed}."
            base = Base(larger, other, _start(other, study), " ".join([said, told]).strip())
            continue
        state, noise = base.start, base.fit.noise
        counts = [one.samples if one.known else 0 for one in noise]
        rng = np.random.default_rng([study.seed, 12, terms])
        seen = trace(
            state.model, state.optimum, state.whitening, library, rng, noise_samples=counts, draws=draws
        )
        named = leading(state, seen) if seen.alarmed else 0.0
        if named >= gain:
            after = trace(
                (wider := _start(other, study)).model,
                wider.optimum,
                wider.whitening,
                library,
                rng,
                noise_samples=[one.samples if one.known else 0 for one in other.noise],
                draws=draws,
            )
            if not gain + (leading(wider, after) if after.alarmed else 0.0) > named + _GAIN:
                break
        told = f"The base model has {terms} viscous terms: one more than {terms - 1} is worth {gain:.0f} nat"
        told = f"{told}, with the effects that each leaves to be named."
        base = Base(larger, other, _start(other, study), " ".join([said, told]).strip())
    return base


def _later(study: Study, fit: BaseFit) -> tuple[Study, str] | None:
    """The study with a longer default prior of its delays, where one stands at the end of it; else None."""
    model = fit.model
    stuck = []
    for position, k in enumerate(model.least.columns):
        row = model.posterior.table.rows[k]
        late = fit.optimum.x[position] > (1 - _AT_END) * model.bounds[1][position]
        if row.kind == "delay" and row.default and late and not row.log_scale:
            stuck.append((row.name, row.domain[1]))
    if not stuck:
        return None
    longer = {
        name: PriorSettings(name, dist="uniform", parameters={"loc": 0.0, "scale": _LONGER * end})
        for name, end in stuck
    }
    names = ", ".join(f"{name} (ends at {end:.4g} {model.time_unit})" for name, end in stuck)
    return replace(study, priors={**study.priors, **longer}), (
        f"The default prior of {names} is too short for these records and was made twice as long."
    )


def _start(fit: BaseFit, study: Study) -> State:
    """The plant alone, with the scales of the effects taken from it."""
    model = ExtendedModel.of(fit.model, fit.optimum.x, taken=taken(study))
    return State(model, fit.optimum, fit.regression.whitening, fit.optimum.covariance)
