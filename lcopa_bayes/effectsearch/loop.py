"""The loop: find what the residual of a fit holds, trace it to an effect, add the effect, look again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, cast, final

import numpy as np
from threadpoolctl import threadpool_limits

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.crew import Crew
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.progress import Progress
from lcopa_bayes.core.wording import listed
from lcopa_bayes.data.agreement import Disagreement, disagreements
from lcopa_bayes.data.requirements import not_at_rest
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.acceptance import single_record
from lcopa_bayes.effectsearch.bandwidening import Widening
from lcopa_bayes.effectsearch.basefit import BaseFit, settled, too_smooth
from lcopa_bayes.effectsearch.basemodel import Base, beside_effects, fitted_base, structure_chosen
from lcopa_bayes.effectsearch.candidates import offered
from lcopa_bayes.effectsearch.explained import coordinates_of, declarable, explained_draws, explained_study
from lcopa_bayes.effectsearch.findings import (
    Side,
    astray,
    findings_of,
    named_effects,
    predicts_better,
    unfollowed,
)
from lcopa_bayes.effectsearch.freedconstants import released
from lcopa_bayes.effectsearch.heldouteffects import missed
from lcopa_bayes.effectsearch.integerplants import integer_dynamics
from lcopa_bayes.effectsearch.lags import (
    ess_with_lags,
    figures_with_lags,
    lags_of,
    linear_dynamics,
    number_with_lags,
)
from lcopa_bayes.effectsearch.openeffects import (
    Alternative,
    Weighed,
    alternatives,
    mixture,
    step_figures,
)
from lcopa_bayes.effectsearch.outliers import NAME as OUTLIERS
from lcopa_bayes.effectsearch.outliers import Outlying, outlying
from lcopa_bayes.effectsearch.plantsbeside import PlantsBeside
from lcopa_bayes.effectsearch.rounds import Round, Search, search
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.trace import Trace
from lcopa_bayes.effectsearch.verdict import (
    Verdict,
    beside,
    decide,
    widened,
)
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.noise import Noise
from lcopa_bayes.model.effects.effect import Effect
from lcopa_bayes.results.sumsoflags import Alternative as SumOfLags
from lcopa_bayes.sampling.convergence import Grade, Level
from lcopa_bayes.sampling.draws import Draws

_WORTHWHILE = 2.0
"""Time that a search takes from which processes share it [s]."""
_ASTRAY = (
    "the draws of the study predict the records held out worse than its optimum does and are not used: "
    "intervals and bands are those of a Laplace approximation there"
)


@final
@dataclass(frozen=True, eq=False)
class Loop:
    """What the loop found in a study."""

    problem: Problem
    base: BaseFit
    enlarged: str
    """What was changed in the base model before anything was traced; empty when nothing was."""
    rounds: tuple[Round, ...]
    effects: tuple[Effect, ...]
    """Effects of the final model, perhaps linear dynamics without a name among them; none when the verdict is
    `unexplained` or `clean`."""
    groups: tuple[tuple[str, ...], ...]
    """For each effect, the names it is confounded with, its own first."""
    verdict: Verdict
    before: Side
    after: Side
    left_out: bool
    """Whether unseen errors come from leaving fit records out in turn, for want of held-out records."""

    cautions: tuple[str, ...] = ()
    """What limits the verdict."""
    draws: Draws | None = None
    """Draws of the explained study; None when none were asked for, or none could be had."""
    outliers: Outlying | None = None
    """Samples left out before anything was traced; None without any."""
    contrary: tuple[Disagreement, ...] = ()
    """Records that disagree."""
    loose: State | None = None
    """The final model under the noise that its residual has, where something significant remains and nothing
    was sampled; None elsewhere. Measured noise would give intervals of a plant known to be another."""
    open: tuple[Alternative, ...] = ()
    """Effects that the records leave open beside, or in place of, those of the final model."""
    lags: tuple[SumOfLags, ...] = ()
    """Sums of lags beside the plant of the final model, where the search chose its structure."""
    plants: PlantsBeside = field(default_factory=PlantsBeside)
    """Plants beside that of the final model, where the search chose its structure."""

    @property
    def names(self) -> tuple[str, ...]:
        """What is named: the effects, and outliers."""
        named = (effect.name for effect in self.effects if not effect.card.dynamics)
        return (*named, *([OUTLIERS] if self.outliers else []))

    @property
    def grade(self) -> Grade:
        """How far the numbers can be trusted: as far as verdict and model, and without draws no further
        than a Laplace approximation."""
        own = Grade(
            "tentative", "intervals are those of a Laplace approximation at the mode; nothing was sampled"
        )
        return Grade.worst((own if self.draws is None else self.draws.grade, self._limit))

    @cached_property
    def _limit(self) -> Grade:
        """The best grade of any number of this loop, however well it was sampled."""
        said = unfollowed(self.after.fit)
        if said:
            return Grade("unusable", said)
        if self.verdict.confidence == "tentative":
            said = "the verdict that they rest on is tentative"
        elif self.verdict.leaves and all(one.support == "plant" for one in self.lags):
            said = "the records hold something that the model they are of does not explain"
        return Grade("tentative", f"the draws are reliable, but {said}") if said else Grade("reliable", "")

    def estimate(self, k: int) -> dict[str, Any]:
        """A coordinate of the final model over the effects that are open, with unit, 90 % interval and grade,
        its standard deviations by noise and by structure, and lower end, median and upper end under the final
        model `alone`."""
        here = self.number(k)
        if self.draws is None:
            return here.as_json(ess=np.nan, grade=self.grade.level, interval="Laplace")
        own = next(one for one in self.draws.estimates() if one.name == here.name)
        alone = own.lower, own.value, own.upper
        ess = ess_with_lags(own.ess, self.lags)
        grade = Grade.worst((Grade(cast("Level", own.grade), ""), self._limit)).level
        return here.as_json(ess=ess, grade=grade, interval=own.interval) | {"alone": alone}

    def number(self, k: int) -> Weighed:
        """A coordinate [`unit`] over the final model and each that is open to it and has it."""
        state = self.after.state
        row = state.model.posterior.table.rows[state.model.columns[k]]
        pairs = zip(*self._mixture, strict=True)
        own = [(row.value_at(part[:, k]), weight) for part, weight in pairs if k < part.shape[1]]
        shares = np.array([weight for _, weight in own])
        number = Weighed(row.name, row.unit, [values for values, _ in own], shares / shares.sum())
        number = self.plants.number(number, row)
        return number_with_lags(number, row, self.lags, state.model.plant.table.layout)

    @cached_property
    def figures(self) -> tuple[Weighed, ...]:
        """Figures of the plant's response to a unit step over the longest record, its effects aside, over the
        same models."""
        own, layout = (self.figures_of(self.after.state, *self._mixture), self.problem.posterior.table.layout)
        span, unit = self.problem.scales.span, self.problem.study.time_unit
        own = self.plants.figures(own, span=span, time_unit=unit)
        return figures_with_lags(own, self.lags, layout, span=span, time_unit=unit)

    def figures_of(self, state: State, parts: Sequence[Matrix], weights: Vector) -> tuple[Weighed, ...]:
        """The same of any `mixture`."""
        span, unit = self.problem.scales.span, self.problem.study.time_unit
        return step_figures(state, parts, weights, span=span, time_unit=unit)

    @cached_property
    def _mixture(self) -> tuple[list[Matrix], Vector]:
        state = self.after.state
        if self.draws is None:
            return mixture(self.loose or state, None, self.open)
        beyond = [one for one in self.open if not one.within(self.draws.table)]
        return mixture(state, coordinates_of(state.model, self.draws), beyond)

    @property
    def study(self) -> Study:
        """The study with the effects that were found declared, outliers among them: what a fit, an audit or a
        comparison takes."""
        return explained_study(self.problem.study, self.after.state.model, self.outliers)

    @property
    def trace(self) -> Trace | None:
        """Evidence of every effect in the first residual; None when the base fit failed, or no plant follows
        the records as they are."""
        return self.rounds[0].trace if self.rounds else None


def loop(
    study: Study,
    *,
    library: Sequence[type[Effect]] | None = None,
    jobs: int = 1,
    sample: bool = True,
    quick: bool = False,
    as_stated: bool = False,
    quiet: bool = True,
) -> Loop:
    """Trace what a study's base model lacks; deterministic given the study's seed.

    Unless `as_stated`, a study with one viscous term gets as many as the evidence asks for. Without
    `sample` intervals and bands are those of a Laplace approximation. With `quick` fewer chance residuals
    are drawn and ensembles are half as long. Unless `quiet` it says on standard error what it does and what
    it knows by then. InputError when the study does not fit its records, or uses effects already.
    """
    if study.effects.use:
        raise InputError(
            f"{study.name}: uses {', '.join(study.effects.use)} already; `loop` starts from the plant alone, "
            "so leave `use` out of [effects]"
        )
    kinds = offered(study) if library is None else list(library)
    # many small products: more threads only wait for each other
    with (
        threadpool_limits(1),
        Progress(total=0, unit="task", quiet=quiet, desc="fitting the plant without effects") as bar,
        Crew(jobs, after=_WORTHWHILE, bar=bar) as crew,
    ):
        return _looped(study, kinds, crew, sample=sample, quick=quick, as_stated=as_stated)


def _looped(
    study: Study, kinds: Sequence[type[Effect]], crew: Crew, *, sample: bool, quick: bool, as_stated: bool
) -> Loop:
    draws = 1000 if quick else 2000
    chosen = structure_chosen(study, as_stated=as_stated)
    based = partial(fitted_base, as_stated=as_stated, draws=draws, crew=crew)
    base = based(study, kinds)
    outliers = outlying(study, base.fit)
    if outliers is not None:
        study, kinds = outliers.study, [kind for kind in kinds if kind.card.name != OUTLIERS]
        crew.stage("fitting the plant again, without outlying samples")
        base = based(study, kinds)
    before = Side.of(base.problem, base.start)
    crew.stage(f"without effects {before.said}; looking for what is missing")
    contrary = disagreements((*study.fit, *study.held_out), crew)
    drifting = (one.as_drift for one in not_at_rest(base.problem.study.fit, base.problem.study.held_out))
    cautions = (*map(str, contrary), *drifting, *base.fit.caution, *single_record(study))
    alone = len(study.fit) == 1 and not study.held_out
    searched, wrong = None, next((str(one) for one in contrary if one.gross), base.fit.failed)
    if not wrong or (base.fit.smooth and wrong == base.fit.failed):
        rng = np.random.default_rng([study.seed, 11])
        rounds = partial(search, library=kinds, rng=rng, draws=draws, alone=alone, crew=crew)
        searched = _searched(base, rounds)
        richer = beside_effects(base, searched) if chosen else None
        if richer is not None:
            crew.stage("searching again with a richer plant")
            base, before = richer, Side.of(richer.problem, richer.start)
            searched = _searched(base, rounds)
    problem, fit = base.problem, base.fit
    # of a residual too smooth to be judged an effect is only named where it leaves noise
    if searched is None or (wrong and too_smooth(searched.state.optimum)):
        seen = missed(study, before.fit, before.unseen, base.start)
        but = f" What remains: {seen.said}." if seen is not None and seen.far else ""
        verdict = Verdict("unexplained", "tentative", f"No effect is named, because {wrong}.{but}")
        return Loop(
            *(problem, fit, base.sentence, (), (), (), verdict, before, before, not study.held_out, cautions),
            outliers=outliers,
            contrary=contrary,
        )
    reached = Side.of(problem, searched.state)
    added = listed(named_effects(searched.state)) or "no effect"
    crew.stage(f"with {added} {reached.said}; holding other plants against it")
    lags = lags_of(searched.state, problem, crew) if chosen else ()
    chance = searched.rounds[0].trace.threshold
    dynamics = linear_dynamics(searched.state, lags, fit.noise_samples, chance)
    if dynamics is None and chosen:
        dynamics = integer_dynamics(searched.state, problem, crew)
    findings = findings_of(
        study, searched, before, reached, outliers=outliers, cautions=cautions, alone=alone
    )
    extended = searched.state.model.effects
    others = tuple(one.start for one in base.richer) if chosen else None
    plants = PlantsBeside() if extended else PlantsBeside.of(searched.state, problem, others, crew)
    lags = plants.held_against(lags, searched.state, problem)
    preferred = any(one.support == "lags" for one in lags)
    verdict = decide(replace(findings, linear=dynamics, preferred=preferred))
    if verdict.kind == "unexplained" and extended and chosen:
        lags = lags_of(before.state, problem, crew)  # beside the plant without them
    if outliers is not None:
        verdict = beside(verdict, outliers.sentence)
    named = verdict.kind in ("explained", "partly explained", "disturbance")
    before = before if extended else reached
    after = reached if named else before
    state = after.state
    if named:
        factors = state.model.wider
        wide = {name: factors[name] for name in named_effects(state) if name in factors}
        verdict = widened(verdict, wide)
    if verdict.leaves or searched.rounds[-1].alarmed:
        white = state.whitening  # something significant remains, which bands have to hold
        state = replace(state, widening=Widening.of(white.samples, state.optimum.residual, white.noise))
    drawn, sampled = None, None
    if sample and declarable(study, state.model.effects):
        crew.stage(f"{verdict.kind}; drawing from the posterior")
        crew.close()
        drawn = _drawn(problem, state, after, outliers, jobs=crew.jobs, quick=quick)
    if drawn is not None and astray(after, drawn):
        cautions = (*cautions, _ASTRAY)
    elif drawn is not None:
        after, sampled = drawn, drawn.state.sampled
        before = before if named else after
    after = Side.of(problem, state) if sampled is None and state is not after.state else after
    crew.stage(f"{verdict.kind}; weighing what else the records leave open")
    loose = None
    if sampled is None and state.widening is not None:
        optimum, white = settled(state.model, state.optimum, state.whitening)
        loose = State(state.model, optimum, white)
    # the noise of what remains holds any effect that may be open
    found = (
        alternatives(searched.state, searched.rounds)
        if verdict.kind != "unexplained" and loose is None
        else ()
    )
    if extended:
        plants = PlantsBeside.of(state, problem, others, crew)
        lags = plants.held_against(lags, state, problem)
    return Loop(
        *(problem, fit, base.sentence, searched.rounds, state.model.effects),
        groups=searched.groups if named else (),
        verdict=verdict,
        before=before,
        after=after,
        left_out=not study.held_out,
        cautions=cautions,
        draws=sampled[0] if sampled is not None else None,
        outliers=outliers,
        contrary=contrary,
        loose=loose,
        open=found,
        lags=lags,
        plants=plants,
    )


def _searched(base: Base, rounds: Callable[..., Search]) -> Search:
    """Rounds under the noise that was measured; where too few samples at rest measured it and nothing stands
    out, again under noise known from the residual alone."""
    fit = base.fit
    rounds = partial(rounds, better=partial(predicts_better, base.problem))
    found = rounds(base.start, noise_samples=fit.noise_samples, first=base.look)
    if fit.noise_known and not found.rounds[-1].trace.alarmed:
        found = found.settled
        if not all(one.firm for one in fit.noise) and not found.state.model.effects:
            # too few samples at rest leave noise plausible in which every effect drowns
            found = rounds(found.state, noise_samples=(0,) * len(fit.noise)).settled
    return replace(found, state=released(found.state))


def _drawn(
    problem: Problem, state: State, optimum: Side, outliers: Outlying | None, *, jobs: int, quick: bool
) -> Side | None:
    """A side by draws of the explained study; None where there are none."""

    def usable(draws: Draws, noise: Noise) -> bool:
        return not astray(optimum, Side.drawn(problem, state, (draws, noise)))

    explained = explained_study(problem.study, state.model, outliers)
    values = state.model.values(state.optimum.x).tolist()
    known = dict(zip(state.model.posterior.table.names, values, strict=True))
    sampled = explained_draws(explained, usable, near=known, jobs=jobs, quick=quick)
    return None if sampled is None else Side.drawn(problem, state, sampled)
