"""From a study to its posterior, and from records to what simulates them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import final

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.record import Driven, Record
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.defaultpriors import Scales
from lcopa_bayes.inference.noise import NOISES
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.inference.parameters import parameter_table
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.model.forward import ForwardModel, forward_model
from lcopa_bayes.model.layout import Layout


@final
@dataclass(frozen=True, eq=False)
class Problem:
    """A study made ready for inference."""

    study: Study
    posterior: Posterior
    scales: Scales
    refinement: int = 1
    """Blocks are narrower by this factor than the study's settings make them [-]."""

    def simulated(self, records: Sequence[Record]) -> tuple[tuple[Samples, ...], ForwardModel]:
        """Samples of other records of the same axes, and the model that simulates them."""
        layout, period = self.posterior.table.layout, self.scales.period
        return prepared(self.study, layout, records, period, refinement=self.refinement)

    def driven(self, drive: Driven, times: Vector) -> ForwardModel:
        """The model that simulates a drive, read at `times` [time unit]."""
        wanted, layout = self.study.model, self.posterior.table.layout
        return forward_model(
            layout,
            [drive],
            [times],
            blocks=wanted.blocks,
            exposure=wanted.exposure,
            refinement=self.refinement,
        )

    def refined(self, factor: int) -> Problem:
        """The same problem on blocks narrower by a further factor."""
        problem = replace(self, refinement=self.refinement * factor)
        _, model = problem.simulated(self.study.fit)
        return replace(problem, posterior=replace(self.posterior, model=model))


def problem_of(study: Study) -> Problem:
    """Posterior of a study; InputError when model, priors and records do not fit together."""
    layout = Layout.of(study.drive_axes, study.response_axes, study.model)
    scales = Scales.of(study.fit)
    table = parameter_table(
        layout,
        scales,
        [record.name for record in study.fit],
        time_unit=study.time_unit,
        model=study.model,
        noise=study.noise.kind,
        priors=study.priors,
    )
    samples, model = prepared(study, layout, study.fit, scales.period)
    posterior = Posterior(table, model, samples, NOISES[study.noise.kind]())
    free = sum(row.free for row in table.rows)
    if posterior.size < free:
        raise InputError(
            f"{study.name}: {posterior.size} samples cannot determine {free} free parameters; "
            "give more samples, fix parameters under [priors], or choose fewer terms under [model]"
        )
    if posterior.dimension == 0:
        raise InputError(f"{study.name}: every parameter is fixed or linear; leave at least one free")
    table.log_support  # noqa: B018 - raises when no prior mass has decreasing orders
    return Problem(study, posterior, scales)


def prepared(
    study: Study, layout: Layout, records: Sequence[Record], period: float, *, refinement: int = 1
) -> tuple[tuple[Samples, ...], ForwardModel]:
    """Samples of records and the model that simulates them with a study's settings."""
    samples = tuple(Samples.of(record, period) for record in records)
    model = forward_model(
        layout,
        records,
        [one.times for one in samples],
        blocks=study.model.blocks,
        exposure=study.model.exposure,
        refinement=refinement,
    )
    return samples, model
