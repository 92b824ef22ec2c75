"""What a loop ends with: a model, its verdict, and every number over all that the records leave open."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, cast, final

import numpy as np

from lcopa_bayes.data.agreement import Disagreement
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.basefit import BaseFit
from lcopa_bayes.effectsearch.explained import coordinates_of, explained_study
from lcopa_bayes.effectsearch.extrapolation import Extrapolated
from lcopa_bayes.effectsearch.findings import Side, unfollowed
from lcopa_bayes.effectsearch.lags import at_noise, ess_with_lags, figures_with_lags, number_with_lags
from lcopa_bayes.effectsearch.openeffects import Alternative, Mixture, Weighed, mixture, step_figures
from lcopa_bayes.effectsearch.outliers import NAME as OUTLIERS
from lcopa_bayes.effectsearch.outliers import Outlying
from lcopa_bayes.effectsearch.plantsbeside import PlantsBeside
from lcopa_bayes.effectsearch.rounds import Round
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.trace import Trace
from lcopa_bayes.effectsearch.verdict import Verdict
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.parameter import Parameter
from lcopa_bayes.model.effects.effect import Effect
from lcopa_bayes.results.sumsoflags import Alternative as SumOfLags
from lcopa_bayes.sampling.convergence import Grade, Level
from lcopa_bayes.sampling.draws import Draws


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
        elif self._lacking:
            said = "the records hold something that the model they are of does not explain"
        return Grade("tentative", f"the draws are reliable, but {said}") if said else Grade("reliable", "")

    @cached_property
    def _lacking(self) -> bool:
        """Whether something remains that sums of lags, which the numbers are over too, do not follow."""
        supported = any(one.support != "plant" for one in self.lags)
        return self.verdict.leaves and not (supported and at_noise(self.lags, self.base.noise_samples))

    @cached_property
    def extrapolated(self) -> Extrapolated:
        """Paths whose steady value rests on a model that lacks something, not on the records."""
        layout = self.problem.posterior.table.layout
        return Extrapolated.of(self.figures if self._lacking else (), layout)

    def estimate(self, k: int) -> dict[str, Any]:
        """A coordinate of the final model over the effects that are open, with unit, 90 % interval and grade,
        its standard deviations by noise and by structure, and lower end, median and upper end under the final
        model `alone`."""
        here, row, limit = self.number(k), self._row(k), self._limit
        if row.kind == "gain" and (said := self.extrapolated.gain(*row.place)):
            here, limit = replace(here, note=said), Grade("unusable", said)
        if self.draws is None:
            grade = Grade.worst((self.grade, limit)).level
            return here.as_json(ess=np.nan, grade=grade, interval="Laplace")
        own = next(one for one in self.draws.estimates() if one.name == here.name)
        alone = own.lower, own.value, own.upper
        ess = min(ess_with_lags(own.ess, self.lags), self.plants.unnamed.ess)
        grade = Grade.worst((Grade(cast("Level", own.grade), ""), limit)).level
        return here.as_json(ess=ess, grade=grade, interval=own.interval) | {"alone": alone}

    def _row(self, k: int) -> Parameter:
        """The parameter that is a coordinate of the final model."""
        model = self.after.state.model
        return model.posterior.table.rows[model.columns[k]]

    def number(self, k: int) -> Weighed:
        """A coordinate [`unit`] over the final model and each that is open to it and has it; of a gain the
        steady value of the response where that has linear dynamics without a name."""
        row, figure = self._row(k), self._steady(k)
        if figure is not None:
            return replace(figure, name=row.name)
        having = [place for place, part in enumerate(self._mixture.parts) if k < part.shape[1]]
        parts, weights, rivals = self._mixture.only(having)
        values = [row.value_at(part[:, k]) for part in parts]
        number = Weighed(row.name, row.unit, values, weights, rivals=rivals)
        number = self.plants.number(number, row)
        return number_with_lags(number, row, self.lags, self.after.state.model.plant.table.layout)

    def _steady(self, k: int) -> Weighed | None:
        """The steady value of a path whose gain is a coordinate and is not all of it; None elsewhere."""
        row, layout = self._row(k), self.problem.posterior.table.layout
        dynamics = self.plants.unnamed.plants or any(effect.card.dynamics for effect in self.effects)
        if row.kind != "gain" or not dynamics:
            return None
        own = {f"steady_state[{path.name}]": (path.response, path.drive) for path in layout.paths}
        return next((one for one in self.figures if own.get(one.name) == row.place), None)

    @cached_property
    def figures(self) -> tuple[Weighed, ...]:
        """Figures of the plant's response to a unit step over the longest record, its effects aside but for
        linear dynamics without a name, over the same models."""
        own, layout = self.figures_of(self.after.state, self._mixture), self.problem.posterior.table.layout
        span, unit = self.problem.scales.span, self.problem.study.time_unit
        own = self.plants.figures(own, span=span, time_unit=unit)
        return figures_with_lags(own, self.lags, layout, span=span, time_unit=unit)

    def figures_of(self, state: State, drawn: Mixture) -> tuple[Weighed, ...]:
        """The same of any mixture."""
        return step_figures(
            state, drawn, span=self.problem.scales.span, time_unit=self.problem.study.time_unit
        )

    @cached_property
    def _mixture(self) -> Mixture:
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
