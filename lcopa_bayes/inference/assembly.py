"""From a study to its posterior, and from records to what simulates them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.errors import InputError, refuse_if
from lcopa_bayes.core.parallel import keep_freed_memory
from lcopa_bayes.data.record import Driven, Record
from lcopa_bayes.data.settings import EffectsSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.declared import declared, effect_rows, noise_of, record_ranges, unused, used_kinds
from lcopa_bayes.inference.defaultpriors import Scales
from lcopa_bayes.inference.noise import NOISES
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.inference.parameters import ParameterTable, parameter_table
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.model.effects.effect import Effect, Ranges, ScatterEffect
from lcopa_bayes.model.forward import ForwardModel, forward_model
from lcopa_bayes.model.layout import Layout

_WIDER = 4
"""Most by which the blocks of a search are wider [-]: draws of a dryer's posterior on blocks four times wider
are worth 0.96 of as many of its own, on blocks eight times wider 0.2."""
_COARSER, _LONGEST = 2.0, 1_000_000
"""Most by which blocks of other records are wider than those of the fit, and most of them in a record [-]."""


@final
@dataclass(frozen=True, eq=False)
class Problem:
    """A study made ready for inference."""

    study: Study
    posterior: Posterior
    scales: Scales
    refinement: int = 1
    """Blocks are narrower by this factor than the study's settings make them [-]."""
    kinds: tuple[type[Effect], ...] = ()
    """Effects of the study."""
    ranges: Ranges | None = None
    """Their scales; None without any."""

    def simulated(self, records: Sequence[Record]) -> tuple[tuple[Samples, ...], ForwardModel]:
        """Samples of other records of the same axes, and the model that simulates them: on blocks hardly
        wider than those of the fit, which resolve the plants that it left.

        InputError for records that would take more than a million.
        """
        return self._simulated(records, self._resolved(records))

    def _resolved(self, records: Sequence[Driven]) -> float:
        """Width of blocks [time unit] up to which they resolve what those of the fit do; InputError for
        records that would take too many of them."""
        moving = (one for one in self.posterior.model.experiments if any(one.phases))
        widest = _COARSER * max((one.mesh.lattice.step for one in moving), default=np.inf)
        refuse_if(
            [
                f"{one.name}: lasts {np.ptp(one.time):.3g} {self.study.time_unit}, where the fit resolves "
                f"{widest:.3g} {self.study.time_unit}, and at most {_LONGEST} times that can be simulated; "
                "give a part of it"
                for one in records
                if np.ptp(one.time) > _LONGEST * widest
            ]
        )
        return widest

    def _simulated(
        self, records: Sequence[Record], widest: float = np.inf
    ) -> tuple[tuple[Samples, ...], ForwardModel]:
        layout, period, fine = self.posterior.table.layout, self.scales.period, self.refinement
        samples, model = prepared(self.study, layout, records, period, refinement=fine, widest=widest)
        if self.ranges is None:
            return samples, model
        return samples, replace(model, effects=declared(self.study, self.kinds, self.ranges, records))

    @property
    def stated_effects(self) -> EffectsSettings:
        """The study's effects with their scales stated, so that other records do not change these."""
        if self.ranges is None:
            return self.study.effects
        deflections = dict(zip(self.ranges.names, self.ranges.response.tolist(), strict=True))
        return replace(self.study.effects, deflection=deflections, speed=self.ranges.speed)

    def driven(self, drive: Driven, times: Vector) -> ForwardModel:
        """The model that simulates a drive, read at `times` [time unit], in the middle of the campaign; its
        blocks and InputError are as in `simulated`."""
        wanted, layout = self.study.model, self.posterior.table.layout
        own = self.posterior.table.effects
        model = forward_model(
            layout,
            [drive],
            [times],
            blocks=wanted.blocks,
            exposure=self.study.exposure,
            refinement=self.refinement,
            widest=self._resolved([drive]),
        )
        if own is None:
            return model
        return replace(model, effects=replace(own, epochs=np.zeros(1), times=(times,), fitted=(None,)))

    def refined(self, factor: int) -> Problem:
        """The same problem on blocks narrower by a further factor."""
        problem = replace(self, refinement=self.refinement * factor)
        _, model = problem._simulated(self.study.fit)
        return replace(problem, posterior=replace(self.posterior, model=model))

    def at_least(self, refinement: int) -> Problem:
        """The same problem on blocks narrower by so much than the study's settings make them, or by more
        where they are."""
        return self if refinement <= self.refinement else self.refined(refinement // self.refinement)

    @cached_property
    def rough(self) -> Posterior:
        """The posterior on blocks up to four times wider, if those in use are narrower than the study's
        settings make them: to search in, where what is found is weighted by the posterior itself."""
        wider = max(1, self.refinement // _WIDER)
        if wider == self.refinement:
            return self.posterior
        return replace(self, refinement=wider).refined(1).posterior

    @cached_property
    def thrifty(self) -> Problem:
        """With effects, whose simulation takes as many times longer, the problem on blocks as wide as the
        study's settings make them: for questions that narrower ones do not answer otherwise."""
        if self.ranges is None or self.refinement == 1:
            return self
        return replace(self, refinement=1).refined(1)


def problem_of(study: Study) -> Problem:
    """Posterior of a study; InputError when model, effects, priors and records do not fit together."""
    with study.located():
        return _assembled(study)


def _assembled(study: Study) -> Problem:
    keep_freed_memory()  # what follows evaluates many responses, wherever it is called from
    layout = Layout.of(study.drive_axes, study.response_axes, study.model)
    scales = Scales.of(study.fit)
    kinds, ranges, table = table_of(study, layout, scales)
    samples, model = prepared(study, layout, study.fit, scales.period)
    if ranges is not None:
        model = replace(model, effects=declared(study, kinds, ranges, study.fit))
    posterior = Posterior(table, model, samples, NOISES[noise_of(kinds, study.noise.kind)]())
    free = sum(row.free for row in table.rows)
    if posterior.size < free:
        raise InputError(
            f"{study.name}: {posterior.size} samples cannot determine {free} free parameters; "
            "give more samples, fix parameters under [priors], or choose fewer terms under [model]"
        )
    if posterior.dimension == 0:
        raise InputError(f"{study.name}: every parameter is fixed or linear; leave at least one free")
    table.log_support  # noqa: B018 - raises when no prior mass has decreasing orders
    return Problem(study, posterior, scales, kinds=kinds, ranges=ranges)


def table_of(
    study: Study, layout: Layout, scales: Scales
) -> tuple[tuple[type[Effect], ...], Ranges | None, ParameterTable]:
    """Effects of a study, their scales, and its parameter table; InputError with all that is wrong."""
    with study.located():
        return _tabled(study, layout, scales)


def _tabled(
    study: Study, layout: Layout, scales: Scales
) -> tuple[tuple[type[Effect], ...], Ranges | None, ParameterTable]:
    kinds, problems = used_kinds(study, layout)
    ranges = record_ranges(study, layout, scales) if kinds and not problems else None
    records = [record.name for record in study.fit]
    foreign = {key: said for key in study.priors if (said := unused(key, study)) is not None}
    scatter = [kind.card.name for kind in kinds if issubclass(kind, ScatterEffect)]
    named = {name: prior for name, prior in study.priors.items() if name not in foreign}
    if problems:  # the parameters of effects are not known: their priors are not judged
        named = {name: prior for name, prior in named.items() if "." not in name}
    table = parameter_table(
        layout,
        scales,
        records,
        time_unit=study.time_unit,
        model=study.model,
        noise=noise_of(kinds, study.noise.kind),
        priors=named,
        effects=declared(study, kinds, ranges, ()) if ranges else None,
        effect_rows=effect_rows(kinds, ranges, records, layout, study.time_unit) if ranges else (),
        noise_effect=scatter[0] if scatter else "",
        problems=[*problems, *foreign.values()],
    )
    return kinds, ranges, table


def prepared(
    study: Study,
    layout: Layout,
    records: Sequence[Record],
    period: float,
    *,
    refinement: int = 1,
    widest: float = np.inf,
) -> tuple[tuple[Samples, ...], ForwardModel]:
    """Samples of records and the model that simulates them with a study's settings."""
    samples = tuple(Samples.of(record, period) for record in records)
    model = forward_model(
        layout,
        records,
        [one.times for one in samples],
        blocks=study.model.blocks,
        exposure=study.exposure,
        refinement=refinement,
        widest=widest,
    )
    return samples, model
