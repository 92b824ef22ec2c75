"""The study that a loop ends with: its effects declared, so that everything else can be asked of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from lcopa_bayes.core.arrays import Matrix
from lcopa_bayes.data.settings import PriorSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.outliers import NAME, Outlying
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.declared import coefficient_prior
from lcopa_bayes.model.effects.catalogue import catalogue
from lcopa_bayes.model.effects.effect import Effect
from lcopa_bayes.model.effects.records import Outliers
from lcopa_bayes.results.fit import plan_of, weighted_fit
from lcopa_bayes.sampling.draws import Draws


def explained_study(study: Study, model: ExtendedModel, outliers: Outlying | None = None) -> Study:
    """The study with the effects of a model declared, named as the study and ``-explained``.

    Scales and priors of the effects are stated as the loop used them; their internal constants, which it
    chose from a list and moved, are held where they came to lie. With `outliers` the samples that were left
    out return, and the noise is declared to hold them, unless the study states such noise already.
    """
    ranges, effects = model.effected.ranges, model.effects
    priors: dict[str, PriorSettings] = {}
    for effect in effects:
        for one in effect.coefficients(ranges):
            prior, name = coefficient_prior(one), f"{effect.name}.{one.name}"
            priors[name] = PriorSettings(name, dist=prior.dist, parameters=prior.parameters)
        for key, value in effect.constants.items():
            name = f"{effect.name}.{key}"
            priors[name] = PriorSettings(name, fixed=float(value))
    names = tuple(effect.name for effect in effects)
    if outliers is not None:
        study = outliers.returned(study)
        names += (NAME,) if study.noise.kind != Outliers.noise else ()
    declared = replace(
        study.effects,
        use=names,
        deflection=dict(zip(ranges.names, ranges.response.tolist(), strict=True)) if effects else {},
        speed=ranges.speed if effects else None,
    )
    own = {name: prior for name, prior in study.priors.items() if "." not in name}
    name = study.name.removesuffix("-explained") + "-explained"
    return replace(study, name=name, effects=declared, priors=own | priors)


def declarable(study: Study, effects: Sequence[Effect]) -> bool:
    """Whether a study can name the effects: those of the catalogue and of its own files."""
    known = catalogue(study.effects.add, study.folder)
    return all(known.get(effect.name) is type(effect) for effect in effects)


def explained_draws(study: Study, *, jobs: int = 1, quick: bool = False) -> Draws | None:
    """Draws of an explained study, the same that a fit of it gives; None where importance sampling does not
    hold, and a fit takes ensembles from the prior."""
    problem = problem_of(study)
    _, result = weighted_fit(problem, plan_of(problem, quick=False), jobs=jobs, quick=quick)
    return None if result is None else result[1]


def coordinates_of(model: ExtendedModel, draws: Draws) -> Matrix:
    """Draws in the coordinates of a model, (draws, coordinates): logarithms as there, coefficients over their
    prior sd."""
    rows, base = model.base.posterior.table.rows, model.base
    columns = []
    for name, k in zip(base.names, base.least.columns, strict=True):
        column = draws.column(name)
        columns.append(np.log(column) if rows[k].log_scale else column)
    for one, scale in zip(model.effected.coefficients, model.scale, strict=True):
        columns.append(draws.column(_named(one.name, draws)) / scale)
    return np.stack(columns, axis=1)


def _named(name: str, draws: Draws) -> str:
    """Name of a coefficient among draws: with one record it goes without the record's."""
    return name if name in draws.table.names else name.partition("[")[0]


def unit_of(model: ExtendedModel, k: int) -> tuple[str, str, float]:
    """Name and unit of a coordinate, and the factor from the coordinate to it (before any logarithm)."""
    if k < model.plant_size:
        row = model.base.posterior.table.rows[model.base.least.columns[k]]
        return row.name, row.unit, 1.0
    placed = model.effected.coefficients[k - model.plant_size]
    layout = model.base.posterior.table.layout
    units: Mapping[str, str] = {"time": model.base.time_unit, "response": layout.responses[0].unit}
    unit = units.get(placed.coefficient.unit, placed.coefficient.unit)
    return placed.name, unit, placed.coefficient.scale


def estimate_name(model: ExtendedModel, draws: Draws, k: int) -> str:
    """Name of a coordinate among draws."""
    return _named(unit_of(model, k)[0], draws)
