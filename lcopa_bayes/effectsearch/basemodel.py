"""What the base model needs before anything is missing: what a study does not state (`mendedstudy`), and as
many viscous terms, elements and delays as the records ask for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple, final

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.crew import ALONE, Crew
from lcopa_bayes.core.errors import InputError, refuse_if
from lcopa_bayes.data.requirements import unmet_apart_from_rest, unmet_rest
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.basefit import STARTS, BaseFit, base_fit, exceeds_noise, too_smooth
from lcopa_bayes.effectsearch.candidates import refitted
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.mendedstudy import longer_delays, started
from lcopa_bayes.effectsearch.refits import Refit, log_bayes_factor
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.rounds import leading, named_of
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.trace import trace
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.declared import campaign_places
from lcopa_bayes.inference.nestedmodels import lifted
from lcopa_bayes.model.effects.effect import Effect
from lcopa_bayes.results.discretisation import FACTORS, largest_shift, narrowed

_MOST = 3
_GAIN = 10.0
"""Log evidence that one more viscous term must bring [nat]: it is an assumption of the user's that
changes."""
_MORE_STARTS = 3 * STARTS
"""Starts of the search for the optimum of a richer model [-], as many as a fit has: with a third of them one
search in four for a second term ended where that has no part."""
_COPIES = 6
"""Starts in which the terms that a smaller model lacks are added to its optimum [-]."""
_BELOW = 0.5
"""Log likelihood by which a fit may stay below that of a model it contains [nat]."""


@final
class Base(NamedTuple):
    """A study's base fit, perhaps with more viscous terms than it states."""

    problem: Problem
    fit: BaseFit
    start: State
    sentence: str
    """What was changed; empty when nothing was."""
    richer: tuple[State, ...] = ()
    """Plants that contain it and were not chosen."""


def structure_chosen(study: Study, *, as_stated: bool) -> bool:
    """Whether the search chooses the number of terms of a study, and what its paths share."""
    return not as_stated and study.model.terms == 1 and study.model.orders == "free"


def fitted_base(
    study: Study, library: Sequence[type[Effect]], *, as_stated: bool, draws: int, crew: Crew = ALONE
) -> Base:
    """The base fit; with one free viscous term stated and not `as_stated`, of the number the evidence asks
    for and its paths with elements and delays of their own where it asks for these.

    A plant with too few terms is no undeclared effect, and would be named as one; one with a term too many
    may imitate an effect. So a further term is a candidate like any other: it is added when it is worth more
    than the best named effect, or more together with what it leaves to be named. So it is where by itself it
    is worth nothing and the plant leaves more than noise: a limit that clips a ringing response hides that it
    rings. InputError when a record moves before its drive does, no drive before the first row explains that,
    and it is not a line that an effect which goes on at rest may follow.
    """
    refuse_if(unmet_apart_from_rest(study))
    alone = structure_chosen(study, as_stated=as_stated)
    # a structure that is chosen has richer plants, which are searched for from more starts anyway
    based = partial(_based, again=not alone, crew=crew)
    base = based(study)
    separate = _apart(study, base, crew) if alone else (base, study)
    # paths that share too much look like a plant that did not rest
    mended = started(separate[1], separate[0].fit)
    rival = np.inf  # a sensor that drifts looks like a plant that did not rest, or has a slow term
    if mended is not None or separate[0].fit.smooth:
        rival = _explained(separate[0], library, np.random.default_rng([study.seed, 14]), draws, crew)
        mended = mended if mended is None or mended.power < rival else None
    if mended is None:
        refuse_if(unmet_rest(study, described=any(kind.card.resting for kind in library)))
    else:
        study = replace(mended.study, model=study.model)
        base = based(study)._replace(sentence=mended.sentence)
    later = longer_delays(study, base.fit)
    if later is not None:
        study = later.study
        base = based(study)._replace(sentence=f"{base.sentence} {later.sentence}".strip())
    if not alone:
        return base
    base, study = separate if mended is None and later is None else _apart(study, base, crew)
    for terms in range(2, _MOST + 1):
        try:
            wider = _wider(replace(study, model=replace(study.model, terms=terms)), base, terms, crew)
        except (ArithmeticError, InputError):  # not simulated, or more parameters than samples
            break
        gain = _gain(base, wider)
        if base.fit.smooth and rival < wider.fit.optimum.power:
            break
        if wider.fit.failed or not gain > _GAIN:
            if base.fit.failed:
                continue
            hidden = _hidden(base, wider, library, [study.seed, 12, terms], draws, crew)
            if hidden is None:
                base = _beside(base, wider)
                break
            said = (
                f"The base model has {terms} viscous terms instead of {terms - 1}: the last one is worth more "
                f"than {_GAIN:.0f} nat beside {hidden}, though nothing without it."
            )
        elif base.fit.failed:
            said = f"The base model has {terms} viscous terms, because with fewer {base.fit.failed}."
        else:
            rng = np.random.default_rng([study.seed, 12, terms])
            named = _named(base, library, rng, draws, crew)
            if named is not None and named.log_bayes_factor >= gain:
                richer = _named(wider, library, rng, draws, crew)
                if not _gain(base, wider, named, richer) > _GAIN:
                    base = _beside(base, wider)
                    break
            said = (
                f"The base model has {terms} viscous terms instead of {terms - 1}: the last one is worth "
                f"{gain:.0f} nat, and explains more, alone or beside an effect, than an effect in its place."
            )
        base = wider._replace(sentence=f"{base.sentence} {said}".strip())
    return base


def _apart(study: Study, base: Base, crew: Crew) -> tuple[Base, Study]:
    """Base fit and study with an element and a delay of each path, where that is worth 10 nat."""
    layout = base.problem.posterior.table.layout
    if len(layout.paths) == len(layout.elements) == len(layout.delays):
        return base, study
    apart = replace(study, model=replace(study.model, share="none", delay="path"))
    try:
        wider = _wider(apart, base, 0, crew)
    except (ArithmeticError, InputError):
        return base, study
    gain = _gain(base, wider)
    if wider.fit.failed or not (gain > _GAIN or base.fit.failed):
        return _beside(base, wider), study
    said = f"Every path has an element and a delay of its own, which is worth {gain:.0f} nat."
    return wider._replace(sentence=f"{base.sentence} {said}".strip()), apart


def _beside(base: Base, wider: Base) -> Base:
    """A base fit with a wider one that it is preferred to, unless that has failed."""
    return base if wider.fit.failed else base._replace(richer=(*base.richer, wider.start))


def _wider(study: Study, base: Base, terms: int, crew: Crew = ALONE) -> Base:
    """The base fit of a study that contains that of another, also from the optimum of the latter.

    Where it stays less likely than that, it has failed. `terms` separates its random numbers from others'.
    """
    wider = _based(study, terms, contained=base, crew=crew)
    regression = wider.fit.regression
    inner = Regression(base.fit.model, regression.whitening).descend(base.fit.optimum.x)
    if wider.fit.optimum.cost <= inner.cost + _BELOW:
        return wider
    starts = _lifted(wider.fit.model, base, np.random.default_rng([study.seed, 13, terms]))
    optimum = regression.best([wider.fit.optimum.x, *starts], crew)
    short = optimum.cost - inner.cost
    failed = wider.fit.failed
    if short > _BELOW:
        failed = failed or (
            f"the fit of {terms} viscous terms is {short:.1f} nat less likely than that of fewer, which it "
            "contains"
        )
    fit = replace(wider.fit, optimum=optimum, failed=failed)
    return wider._replace(fit=fit, start=_state(study, fit))


def _lifted(model: ExtendedModel, base: Base, rng: np.random.Generator) -> list[Vector]:
    """Coordinates of a wider model at which it is close to the optimum of a base fit that it contains."""
    values = np.repeat(base.fit.model.values(base.fit.optimum.x)[None], _COPIES, axis=0)
    starts = lifted(values, base.problem.posterior, model.plant, rng)
    return [] if starts is None else [model.coordinates(each) for each in starts]


def _based(
    study: Study,
    *key: int,
    contained: Base | None = None,
    again: bool = False,
    crew: Crew = ALONE,
) -> Base:
    """A study's base fit as stated; `key` separates its random numbers from others'. It starts from the
    optimum of a `contained` model too, and `again` from more starts where its residual stands out."""
    problem = problem_of(study)
    fit = _fit(problem, key, contained, again, crew)
    narrow = narrowed(problem, partial(_shift, fit))
    if narrow is not problem:
        problem = narrow
        fit = _fit(problem, key, contained, again, crew)
    return Base(problem, fit, _state(study, fit), "")


def _fit(problem: Problem, key: Sequence[int], contained: Base | None, again: bool, crew: Crew) -> BaseFit:
    model, seed = ExtendedModel(problem.posterior), [problem.study.seed, 10, *key]
    if contained is not None:
        near = _lifted(model, contained, np.random.default_rng([*seed, 1]))
    else:
        fit = base_fit(model, np.random.default_rng(seed), crew=crew)
        if not (again and fit.stands_out):
            return fit
        near = [fit.optimum.x]
    return base_fit(model, np.random.default_rng(seed), starts=_MORE_STARTS, near=near, crew=crew)


def _state(study: Study, fit: BaseFit) -> State:
    model = fit.model.at_scales(fit.optimum.x, campaign_places(study))
    return State(model, fit.optimum, fit.regression.whitening)


def _shift(fit: BaseFit, problem: Problem) -> float:
    """Largest shift of the base fit's parameters on narrower blocks than the problem's [posterior sd]."""
    model, x, white = ExtendedModel(problem.posterior), fit.optimum.x, fit.regression.whitening
    here, tangents = model.tangents(x)
    finer = [ExtendedModel(problem.refined(factor).posterior) for factor in FACTORS]
    changes = [white(each.predict(x) - here) for each in finer]
    return largest_shift(fit.optimum.covariance, white(tangents.T).T, changes)


def _gain(base: Base, wider: Base, named: Refit | None = None, richer: Refit | None = None) -> float:
    """Log evidence of the wider model over the other under the wider one's noise [nat]; of either with its
    best effect, where that is given.

    A base fit without an effect that is there takes some of it for noise, each as much as it leaves: what an
    effect brings to one of them says nothing of what it brings to the other.
    """
    quiet = float(sum(wider.fit.noise_samples))
    smaller = named.state if named else base.start
    larger = richer.state if richer else wider.start
    same = Regression(smaller.model, larger.whitening).descend(smaller.optimum.x)
    ordering = wider.fit.model.plant.table.log_support - base.fit.model.plant.table.log_support
    paid = (richer.paid if richer else 0.0) - (named.paid if named else 0.0)
    return log_bayes_factor(same, larger.optimum, quiet) + ordering + paid


def _named(
    base: Base, library: Sequence[type[Effect]], rng: np.random.Generator, draws: int, crew: Crew
) -> Refit | None:
    """The best named effect beside a base fit."""
    return _best(base, library, rng, draws, crew)[0]


def _best(
    base: Base, library: Sequence[type[Effect]], rng: np.random.Generator, draws: int, crew: Crew
) -> tuple[Refit | None, Refit | None]:
    """The best effect beside a base fit that can be named, and the best of all that were refitted."""
    quiet = base.fit.noise_samples
    seen = trace(base.start, library, rng, noise_samples=quiet, draws=draws, crew=crew)
    if not seen.alarmed:
        return None, None
    refits = refitted(base.start, seen, crew)[0]
    every = (one for one in refits if not one.dynamics)
    return named_of(refits, seen), next(every, None)


def _hidden(
    base: Base,
    wider: Base,
    library: Sequence[type[Effect]],
    key: Sequence[int],
    draws: int,
    crew: Crew,
) -> str | None:
    """The effect beside which a wider model is worth more than a base model beside any, where this leaves
    more than noise; None without one."""
    if wider.fit.failed or not (base.fit.noise_known and base.fit.stands_out):
        return None
    rng = np.random.default_rng(key)
    named, best = _best(base, library, rng, draws, crew)
    if named is not None and not exceeds_noise(named.optimum):
        return None
    richer = _named(wider, library, rng, draws, crew)
    if richer is None or not _gain(base, wider, best, richer) > _GAIN:
        return None
    return richer.added[0]


def _explained(
    base: Base, library: Sequence[type[Effect]], rng: np.random.Generator, draws: int, crew: Crew
) -> float:
    """Squared residual that the best named effect leaves of a base fit [response unit^2]; infinite without
    one that leaves noise."""
    quiet = base.fit.noise_samples
    seen = trace(base.start, library, rng, noise_samples=quiet, draws=draws, crew=crew)
    best = leading(base.start, seen, crew)
    return np.inf if best is None or too_smooth(best.optimum) else best.optimum.power
