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
from lcopa_bayes.core.wording import listed
from lcopa_bayes.data.requirements import unmet_apart_from_rest, unmet_rest
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.basefit import STARTS, BaseFit, base_fit, too_smooth
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.findings import Side
from lcopa_bayes.effectsearch.heldouteffects import missed
from lcopa_bayes.effectsearch.mendedstudy import longer_delays, started
from lcopa_bayes.effectsearch.refits import Refit, log_bayes_factor, paid, refit
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.resolvedmodel import moved, on, shift_by_width
from lcopa_bayes.effectsearch.rounds import Round, Search
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.spareterms import without_spare_terms, without_static_terms
from lcopa_bayes.effectsearch.trace import trace
from lcopa_bayes.effectsearch.verdict import Miss
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.declared import campaign_places
from lcopa_bayes.inference.elementterms import terms_in_words
from lcopa_bayes.inference.nestedmodels import lifted
from lcopa_bayes.model.effects.effect import Effect
from lcopa_bayes.results.discretisation import narrowed

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
    richer: tuple[Base, ...] = ()
    """Plants that contain it and were not chosen."""
    look: Round | None = None
    """What it leaves; None where nobody looked yet."""

    @property
    def counts(self) -> dict[str, int]:
        """Number of terms of each element [-], by name."""
        return self.problem.posterior.table.layout.terms

    def of(self, problem: Problem, fit: BaseFit) -> Base:
        """With another plant of its records; itself where the fit is its own."""
        return self if fit is self.fit else Base(problem, fit, _state(problem.study, fit), self.sentence)

    def on(self, problem: Problem) -> Base:
        """The same on the blocks of a problem where these are narrower; nobody looked at what it leaves
        there. ArithmeticError where a response there is not bounded."""
        richer = tuple(one.on(one.problem.at_least(problem.refinement)) for one in self.richer)
        if problem.refinement <= self.problem.refinement:
            return self._replace(richer=richer)
        start = moved(self.start, problem)
        model = on(self.fit.model, problem)
        regression = Regression(model, start.whitening)
        fit = replace(self.fit, model=model, regression=regression, optimum=start.optimum)
        return self._replace(problem=problem, fit=fit, start=start, richer=richer, look=None)


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
    than the best named effect, or more together with what it leaves to be named. InputError when a record
    moves before its drive does, no drive before the first row explains that, and it is not a line that an
    effect which goes on at rest may follow.
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
            every = _wider(_with_terms(base, terms), base, terms, crew)
            wider = every.of(*without_spare_terms(every.problem, every.fit, base.fit))
            dynamic = every.of(*without_static_terms(every.problem, every.fit, base.fit))
        except (ArithmeticError, InputError):  # not simulated, or more parameters than samples
            break
        wider = every if wider.fit.failed else wider
        larger = wider, dynamic, every
        gain = _gain(base, wider)
        if base.fit.smooth and rival < wider.fit.optimum.power:
            break
        if wider.fit.failed or not gain > _GAIN:
            if base.fit.failed:
                continue
            base = _beside(base, *larger)
            break
        counts = terms_in_words(wider.counts)
        if base.fit.failed:
            said = f"The base model has {counts}, because with fewer {base.fit.failed}."
        else:
            rng = np.random.default_rng([study.seed, 12, terms])
            base, named = _named(base, library, rng, draws, crew, rival=gain)
            if named is not None and named.log_bayes_factor >= gain:
                wider, richer = _named(wider, library, rng, draws, crew)
                if not _gain(base, wider, named, richer) > _GAIN:
                    base = _beside(base, *larger)
                    break
            said = (
                f"The base model has {counts}: with fewer it is worth {gain:.0f} nat less, and what is added "
                "explains more, alone or beside an effect, than an effect in its place."
            )
        base = _beside(wider._replace(sentence=f"{base.sentence} {said}".strip()), *larger)
    return base


def beside_effects(base: Base, searched: Search) -> Base | None:
    """The richer base model that, with the effects of a search which leaves something, or with the best one
    where it named none, is worth 10 nat more than the base model with them; None without any.

    An effect may hide a term: a response that rings to a limit hardly rings.
    """
    chosen = searched.best
    if chosen is None or not searched.rounds[-1].alarmed:
        return None
    best, worth, sizes = None, _GAIN, chosen.model.sizes(chosen.optimum.x)
    for wider in base.richer:
        start = wider.start
        try:
            richer = refit(start.model, start.optimum, start.whitening, sizes, chosen.quiet)
            gain = _gain(base, wider, chosen, richer)
        except ArithmeticError:
            continue
        if gain > worth:
            best, worth = wider, gain
    if best is None:
        return None
    terms, before = (terms_in_words(one.counts) for one in (best, base))
    said = "Every path has an element and a delay of its own"
    said = said if terms == before else f"The base model has {terms}"
    names = listed([effect.name for effect in chosen.model.effects])
    said += f": beside {names} what is added is worth {worth:.0f} nat, though not without."
    return best._replace(sentence=f"{base.sentence} {said}".strip())


def beside_unseen(base: Base, searched: Search) -> Base | None:
    """The richer base model whose errors on unseen records chance explains best, where it does not explain
    those of the base model, of which a search finds nothing else; None where it does, or explains none.

    Fitted records may not show a term that another drive shows: what they leave open, others decide.
    """
    if not base.richer or searched.state.model.effects or searched.rounds[-1].alarmed:
        return None
    own = _missed(base, searched.state)
    if own is None or not own.significant:
        return None
    others = [(one, _missed(one, one.start)) for one in base.richer]
    explained = [(one, miss) for one, miss in others if miss is not None and not miss.significant]
    if not explained:
        return None
    best, miss = max(explained, key=lambda pair: pair[1].p)
    what = "elements and delays of its own for every path"
    what = what if best.counts == base.counts else terms_in_words(best.counts)
    said = (
        f"The base model has {what}: the fitted records ask for less, but unseen ones, which had a part in "
        f"this choice, are missed by {own.ratio:.3g} times the noise then, and by {miss.ratio:.3g} with it."
    )
    return best._replace(sentence=f"{base.sentence} {said}".strip())


def _missed(base: Base, state: State) -> Miss | None:
    """Errors of a state of a base fit on unseen records beside what chance gives."""
    side = Side.of(base.problem, state)
    return missed(base.problem.study, side.fit, side.unseen, state)


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


def _beside(base: Base, *wider: Base) -> Base:
    """A base fit with wider ones that it is preferred to, of those that have not failed, each once."""
    kept = [*base.richer]
    for one in wider:
        if not one.fit.failed and all(one.counts != other.counts for other in (base, *kept)):
            kept.append(one)
    return base._replace(richer=tuple(kept))


def _with_terms(base: Base, terms: int) -> Study:
    """The study of a base fit with so many terms in the elements that have the most."""
    study, most = base.problem.study, max(base.counts.values())
    if len(set(base.counts.values())) == 1:
        return replace(study, model=replace(study.model, terms=terms))
    counts = {name: terms if own == most else own for name, own in base.counts.items()}
    return replace(study, model=replace(study.model, terms=counts))


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
    problem, seed = problem_of(study), (study.seed, 10, *key)
    fit = _fit(problem, seed, contained, again, crew)
    narrow = narrowed(problem, partial(_shift, fit))
    if narrow is not problem:
        problem, near = narrow, [fit.optimum.x]  # of the same mode, or of one beside it
        model = ExtendedModel(narrow.posterior)
        fit = base_fit(model, np.random.default_rng(seed), starts=1, near=near, crew=crew)
    return Base(problem, fit, _state(study, fit), "")


def _fit(problem: Problem, seed: Sequence[int], contained: Base | None, again: bool, crew: Crew) -> BaseFit:
    model = ExtendedModel(problem.posterior)
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
    optimum, white = fit.optimum, fit.regression.whitening
    return shift_by_width(
        lambda one: ExtendedModel(one.posterior), problem, optimum.x, optimum.covariance, white
    )


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
    ordering += paid(larger.model) - paid(smaller.model)
    return log_bayes_factor(same, larger.optimum, quiet) + ordering


def _named(
    base: Base,
    library: Sequence[type[Effect]],
    rng: np.random.Generator,
    draws: int,
    crew: Crew,
    rival: float = -np.inf,
) -> tuple[Base, Refit | None]:
    """A base fit that has been looked at, and the best named effect beside it, if that may reach a `rival`
    [nat]."""
    look = base.look or _look(base, library, rng, draws, crew)
    if look.trace.alarmed:
        look = look.refitted(crew, rival)
    return base._replace(look=look), look.leading if look.trace.alarmed else None


def _look(
    base: Base, library: Sequence[type[Effect]], rng: np.random.Generator, draws: int, crew: Crew
) -> Round:
    quiet = base.fit.noise_samples
    return Round(base.start, trace(base.start, library, rng, noise_samples=quiet, draws=draws, crew=crew))


def _explained(
    base: Base, library: Sequence[type[Effect]], rng: np.random.Generator, draws: int, crew: Crew
) -> float:
    """Squared residual that the best named effect leaves of a base fit [response unit^2]; infinite without
    one that leaves noise."""
    best = _look(base, library, rng, draws, crew).refitted(crew).leading
    return np.inf if best is None or too_smooth(best.optimum) else best.optimum.power
