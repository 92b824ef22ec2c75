"""The loop: find what the residual of a fit holds, trace it to an effect, add the effect, look again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Self, final

import numpy as np

from lcopa_bayes.core.crew import WORTHWHILE, Crew
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.progress import Progress
from lcopa_bayes.core.wording import listed
from lcopa_bayes.data.agreement import Disagreement, disagreements
from lcopa_bayes.data.requirements import not_at_rest
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.acceptance import single_record
from lcopa_bayes.effectsearch.bandwidening import Widening
from lcopa_bayes.effectsearch.basefit import settled, too_smooth
from lcopa_bayes.effectsearch.basemodel import (
    Base,
    beside_effects,
    beside_unseen,
    fitted_base,
    structure_chosen,
)
from lcopa_bayes.effectsearch.candidates import offered
from lcopa_bayes.effectsearch.explained import declarable, explained_draws, explained_study
from lcopa_bayes.effectsearch.findings import Side, astray, findings_of, named_effects, predicts_better
from lcopa_bayes.effectsearch.freedconstants import released
from lcopa_bayes.effectsearch.heldouteffects import missed
from lcopa_bayes.effectsearch.integerplants import integer_dynamics
from lcopa_bayes.effectsearch.lags import lags_of, linear_dynamics
from lcopa_bayes.effectsearch.loopresult import Loop
from lcopa_bayes.effectsearch.openeffects import alternatives
from lcopa_bayes.effectsearch.outliers import NAME as OUTLIERS
from lcopa_bayes.effectsearch.outliers import Outlying, outlying
from lcopa_bayes.effectsearch.plantsbeside import PlantsBeside
from lcopa_bayes.effectsearch.resolvedmodel import moved, narrowed_for
from lcopa_bayes.effectsearch.rounds import Search, search
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.unnameddynamics import UnnamedDynamics
from lcopa_bayes.effectsearch.verdict import Verdict, beside, decide, widened
from lcopa_bayes.inference.noise import Noise
from lcopa_bayes.model.effects.effect import Effect
from lcopa_bayes.model.effects.sensor import Exposure
from lcopa_bayes.results.structure import with_least_terms
from lcopa_bayes.results.sumsoflags import Alternative as SumOfLags
from lcopa_bayes.results.sumsoflags import with_draws
from lcopa_bayes.sampling.draws import Draws

_DRAWS = 2_000
"""Chance residuals [-]; half as many of a quick loop."""
_ASTRAY = (
    "the draws of the study predict the records held out worse than its optimum does and are not used: "
    "intervals and bands are those of a Laplace approximation there"
)


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

    Unless `as_stated`, a study of one viscous term or of "auto" gets as many as the evidence asks for.
    Without `sample` intervals and bands are those of a Laplace approximation. With `quick` fewer chance
    residuals are drawn and ensembles are half as long. Unless `quiet` it says on standard error what it does
    and what it knows by then. InputError when the study does not fit its records, or uses effects already.
    """
    if study.effects.use:
        raise InputError(
            f"{study.name}: uses {', '.join(study.effects.use)} already; `loop` starts from the plant alone, "
            "so leave `use` out of [effects]"
        )
    study = with_least_terms(study)
    kinds = offered(study) if library is None else list(library)
    with (
        Progress(total=0, unit="task", quiet=quiet, desc="fitting the plant without effects") as bar,
        Crew(jobs, after=WORTHWHILE, bar=bar) as crew,
    ):
        options = _Options(crew, sample=sample, quick=quick, as_stated=as_stated)
        return _looped(study, kinds, options)


def _looped(study: Study, kinds: Sequence[type[Effect]], options: _Options) -> Loop:
    begun = _Begun.of(study, kinds, options)
    obstacle = begun.obstacle
    options.crew.stage(f"without effects {begun.before.said}; looking for what is missing")
    if not begun.searchable:
        return begun.unexplained(obstacle)
    begun, searched = begun.search(options)
    richer = None
    if begun.chosen:  # effects or unseen records may ask for it
        richer = beside_effects(begun.base, searched) or beside_unseen(begun.base, searched)
    if richer is not None:
        options.crew.stage("searching again with a richer plant")
        begun, searched = replace(begun, base=richer).search(options)
    # of a residual too smooth to be judged an effect is only named where it leaves noise
    if obstacle and too_smooth(searched.state.optimum):
        return begun.unexplained(obstacle)
    return _Judged.of(begun, searched, options.crew).sampled(options)


@final
@dataclass(frozen=True, eq=False)
class _Options:
    """How a loop works."""

    crew: Crew
    sample: bool
    quick: bool
    as_stated: bool

    @property
    def draws(self) -> int:
        """Chance residuals [-]."""
        return _DRAWS // 2 if self.quick else _DRAWS


@final
@dataclass(frozen=True, eq=False)
class _Begun:
    """A study's base fit, and what limits all that is traced from it."""

    study: Study
    """Without the outliers."""
    kinds: Sequence[type[Effect]]
    """Effects that come into question."""
    base: Base
    outliers: Outlying | None
    contrary: tuple[Disagreement, ...]
    chosen: bool
    """Whether the search chooses the structure of the plant."""

    @classmethod
    def of(cls, study: Study, kinds: Sequence[type[Effect]], options: _Options) -> Self:
        """The base fit of a study without its outlying samples."""
        chosen, crew = structure_chosen(study, as_stated=options.as_stated), options.crew
        based = partial(fitted_base, as_stated=options.as_stated, draws=options.draws, crew=crew)
        base = based(study, kinds)
        outliers = outlying(study, base.fit)
        if outliers is not None:
            study, kinds = outliers.study, [kind for kind in kinds if kind.card.name != OUTLIERS]
            crew.stage("fitting the plant again, without outlying samples")
            base = based(study, kinds)
        contrary = disagreements((*study.fit, *study.held_out), crew)
        return cls(study, kinds, base, outliers, contrary, chosen)

    @cached_property
    def cautions(self) -> tuple[str, ...]:
        """What limits a verdict from this base fit."""
        based = self.base.problem.study
        drifting = (one.as_drift for one in not_at_rest(based.fit, based.held_out))
        return (
            *map(str, self.contrary),
            *drifting,
            *self.base.fit.caution,
            *single_record(self.study),
        )

    @property
    def alone(self) -> bool:
        """Whether one record is all there is."""
        return len(self.study.fit) == 1 and not self.study.held_out

    @cached_property
    def before(self) -> Side:
        """The base model and its errors."""
        return Side.of(self.base.problem, self.base.start)

    @property
    def obstacle(self) -> str:
        """Why nothing may be named from this base fit, a clause; empty where something may."""
        gross = (str(one) for one in self.contrary if one.gross)
        return next(gross, self.base.fit.failed)

    @property
    def searchable(self) -> bool:
        """Whether an effect may follow the records yet: it may where noise alone was not told from it."""
        fit = self.base.fit
        return not self.obstacle or (fit.smooth and self.obstacle == fit.failed)

    @property
    def wider(self) -> tuple[State, ...] | None:
        """Plants that contain the chosen one; None of a structure that is stated."""
        return tuple(one.start for one in self.base.richer) if self.chosen else None

    def search(self, options: _Options) -> tuple[Self, Search]:
        """All rounds, and the base fit on blocks as narrow as the effects that these added ask for; searched
        again there where wide blocks left a part of what remains."""
        searched = self._rounds(options)
        problem, state = self.base.problem, searched.state
        if not state.model.effects:
            return self, searched
        try:
            narrow = narrowed_for(state, problem)
            if narrow is problem:
                return self, searched
            begun, state = replace(self, base=self.base.on(narrow)), moved(state, narrow)
        except ArithmeticError:  # no bounded response on narrower blocks
            return self, searched
        if not searched.left_by_blocks(state):
            return begun, replace(searched, state=state)
        options.crew.stage("searching again on narrower blocks, which the effects ask for")
        return begun.search(options)

    def _rounds(self, options: _Options) -> Search:
        """Rounds under the noise that was measured; where too few samples at rest measured it and nothing
        stands out, again under noise known from the residual alone."""
        fit, start = self.base.fit, self.base.start
        rounds = partial(
            search,
            library=self.kinds,
            rng=np.random.default_rng([self.study.seed, 11]),
            draws=options.draws,
            alone=self.alone,
            better=partial(predicts_better, self.base.problem),
            crew=options.crew,
        )
        result = rounds(start, noise_samples=fit.noise_samples, first=self.base.look)
        if not result.rounds[-1].trace.alarmed:
            result = result.settled
            if fit.noise_known and not all(one.firm for one in fit.noise) and not result.state.model.effects:
                # too few samples at rest leave noise plausible in which every effect drowns
                result = rounds(result.state, noise_samples=(0,) * len(fit.noise)).settled
        return replace(result, state=released(result.state))

    def unexplained(self, obstacle: str) -> Loop:
        """The loop that names nothing for what an obstacle says."""
        before, study = self.before, self.study
        seen = missed(study, before.fit, before.unseen, self.base.start)
        but = f" What remains: {seen.said}." if seen is not None and seen.far else ""
        verdict = Verdict("unexplained", "tentative", f"No effect is named, because {obstacle}.{but}")
        wide = Side.of(self.base.problem, _wide(self.base.start))
        return self.ending(verdict, wide, wide)

    def ending(self, verdict: Verdict, before: Side, after: Side) -> Loop:
        """A loop without rounds and draws, of one plant alone."""
        return Loop(
            problem=self.base.problem,
            base=self.base.fit,
            enlarged=self.base.sentence,
            rounds=(),
            effects=after.state.model.effects,
            groups=(),
            verdict=verdict,
            before=before,
            after=after,
            left_out=not self.study.held_out,
            cautions=self.cautions,
            outliers=self.outliers,
            contrary=self.contrary,
        )


def _wide(state: State) -> State:
    """A state with bands that hold what remains."""
    white = state.whitening
    return replace(state, widening=Widening.of(white.samples, state.optimum.residual, white.noise))


@final
@dataclass(frozen=True, eq=False)
class _Judged:
    """A search and its verdict."""

    begun: _Begun
    searched: Search
    verdict: Verdict
    before: Side
    """The plant without effects, under the noise that the search ended with where it added none."""
    after: Side
    """The model with the effects that the verdict names."""
    lags: tuple[SumOfLags, ...]
    plants: PlantsBeside

    @classmethod
    def of(cls, begun: _Begun, searched: Search, crew: Crew) -> Self:
        """A verdict over all plants that may stand for the same residual as an effect."""
        study, problem, before = begun.study, begun.base.problem, begun.before
        reached, extended = Side.of(problem, searched.state), bool(searched.state.model.effects)
        added = listed(named_effects(searched.state)) or "no effect"
        crew.stage(f"with {added} {reached.said}; holding other plants against it")
        lags = lags_of(searched.state, problem, crew) if begun.chosen else ()
        chance = searched.rounds[0].trace.threshold
        dynamics = linear_dynamics(searched.state, lags, begun.base.fit.noise_samples, chance)
        if dynamics is None and begun.chosen:
            dynamics = integer_dynamics(searched.state, problem, crew)
        # beside effects they are looked for once the verdict names these
        plants = PlantsBeside() if extended else PlantsBeside.of(searched.state, problem, begun.wider, crew)
        lags = plants.held_against(lags, searched.state, problem)
        outliers, cautions = begun.outliers, begun.cautions
        findings = findings_of(
            study, searched, before, reached, outliers=outliers, cautions=cautions, alone=begun.alone
        )
        preferred = any(one.support == "lags" for one in lags)
        verdict = decide(replace(findings, linear=dynamics, preferred=preferred))
        if verdict.kind == "unexplained" and named_effects(searched.state) and begun.chosen:
            lags = lags_of(before.state, problem, crew)  # beside the plant without them
        if outliers is not None:
            verdict = beside(verdict, outliers.sentence)
        before = before if extended else reached
        if not verdict.names:
            return cls(begun, searched, verdict, before, before, lags, plants)
        factors = reached.state.model.wider
        wide = {name: factors[name] for name in named_effects(reached.state) if name in factors}
        return cls(begun, searched, widened(verdict, wide), before, reached, lags, plants)

    @cached_property
    def state(self) -> State:
        """The final model; where something significant remains its bands hold that too."""
        state = self.after.state
        if not (self.verdict.leaves or self.searched.rounds[-1].alarmed):
            return state
        return _wide(state)

    def sampled(self, options: _Options) -> Loop:
        """The loop, by draws of the explained study where there are any that predict as its optimum does."""
        crew, cautions = options.crew, self.begun.cautions
        drawn = None
        if options.sample and declarable(self.begun.study, self.state.model.effects):
            crew.stage(f"{self.verdict.kind}; drawing from the posterior")
            crew.rest()
            drawn = self._drawn(jobs=crew.jobs, quick=options.quick)
        if drawn is not None and astray(self.after, drawn):
            drawn, cautions = None, (*cautions, _ASTRAY)
        crew.stage(f"{self.verdict.kind}; weighing what else the records leave open")
        problem = self.begun.base.problem
        after = drawn or (self.after if self.state is self.after.state else Side.of(problem, self.state))
        loop = self.begun.ending(self.verdict, self.before if self.verdict.names else after, after)
        return self._weighed(replace(loop, cautions=cautions), options)

    def _drawn(self, *, jobs: int, quick: bool) -> Side | None:
        """The final model by draws of the explained study; None where there are none."""
        problem, state = self.begun.base.problem, self.state

        def usable(draws: Draws, noise: Noise) -> bool:
            return not astray(self.after, Side.drawn(problem, state, (draws, noise)))

        explained = explained_study(problem.study, state.model, self.begun.outliers)
        points = [state.optimum.x, *(state.valley.aside(state.optimum) if state.valley else ())]
        names = state.model.posterior.table.names
        known, *along = (dict(zip(names, state.model.values(x).tolist(), strict=True)) for x in points)
        draws = explained_draws(explained, usable, near=known, along=along, jobs=jobs, quick=quick)
        return None if draws is None else Side.drawn(problem, state, draws)

    def _weighed(self, loop: Loop, options: _Options) -> Loop:
        """A loop with all that the records leave open beside its model."""
        state, problem, crew = self.state, loop.problem, options.crew
        sampled, loose = loop.after.state.sampled, None
        if sampled is None and state.widening is not None:
            optimum, white = settled(state.model, state.optimum, state.whitening)
            loose = State(state.model, optimum, white)
        plants, lags = self.plants, self.lags
        if self.searched.state.model.effects:
            plants = PlantsBeside.of(state, problem, self.begun.wider, crew)
            if not (self.verdict.names or named_effects(self.searched.state)):
                plants = replace(plants, unnamed=UnnamedDynamics.of(self.searched))
            lags = plants.held_against(lags, state, problem)
        # the noise of what remains holds any effect that may be open
        weighs = self.verdict.kind != "unexplained" and loose is None
        known = Exposure.card.name if problem.study.exposure else ""
        return replace(
            loop,
            rounds=self.searched.rounds,
            groups=self.searched.groups if self.verdict.names else (),
            draws=None if sampled is None else sampled[0],
            loose=loose,
            open=alternatives(self.searched.state, self.searched.rounds, known) if weighs else (),
            lags=with_draws(lags, crew) if options.sample else lags,
            plants=plants,
        )
