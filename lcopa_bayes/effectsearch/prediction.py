"""Predictions of records that were not fitted, with what the fit leaves uncertain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.data.record import Record
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.noise import Law, quiet_samples
from lcopa_bayes.effectsearch.whitening import parts, stacked
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.declared import campaign_places
from lcopa_bayes.inference.effects import Effected, carried
from lcopa_bayes.inference.observations import Samples


@final
@dataclass(frozen=True, eq=False)
class Prediction:
    """Stacked predictions of some records, their own levels not yet known."""

    samples: tuple[Samples, ...]
    mean: Vector
    """(n,) [response unit]."""
    variance: Vector
    """Of what the fit leaves uncertain, without noise, (n,) [response unit^2]."""


def predicted(
    problem: Problem, model: ExtendedModel, x: Vector, covariance: Matrix, records: Sequence[Record]
) -> Prediction:
    """Responses of `records` at coordinates `x`, linearised about them for the variance.

    Coefficients of an effect that belong to one record are unknown on another: they are zero on average and
    as large as on the fit records, which adds to the variance.
    """
    samples, forward = problem.simulated(records)
    own = model.effected
    places = campaign_places(problem.study)
    there = own.over(forward, samples, np.array([places[record.name] for record in records]))
    values, psi = model.split(x)
    moved = carried(psi, own, there)
    mean = stacked(samples, there.responses(values, moved))
    slopes = stacked(samples, [np.moveaxis(one, 2, 0) for one in there.jacobian(values, moved)])
    mean, slopes = _with_shared_offset(problem, model, samples, mean, slopes, values)
    plant = model._in_coordinates(slopes, x[: model.plant_size], values)
    tangents, extra = plant, np.zeros_like(mean)
    if own.effects:
        by_psi = stacked(samples, [np.moveaxis(one, 2, 0) for one in there.signature(values, moved)])
        shared, extra = _shared(own, there, by_psi, psi)
        tangents = np.vstack([plant, shared * model.scale[:, None]])
    variance = np.einsum("kn,kl,ln->n", tangents, covariance, tangents, optimize=True)
    return Prediction(samples, mean, np.asarray(variance + extra))


def _with_shared_offset(
    problem: Problem,
    model: ExtendedModel,
    samples: Sequence[Samples],
    mean: Vector,
    slopes: Matrix,
    values: Vector,
) -> tuple[Vector, Matrix]:
    """An offset that all records share is part of the prediction."""
    table = problem.posterior.table
    mean, slopes = mean.copy(), slopes.copy()
    for part in parts(samples):
        for k in table.of_kind("offset"):
            if table.rows[k].place == (part.axis, -1):
                mean[part.rows] += values[k]
                slopes[k, part.rows] = 1.0
    return mean, slopes


def _shared(own: Effected, there: Effected, by_psi: Matrix, psi: Vector) -> tuple[Matrix, Vector]:
    """Slopes in the coefficients of the fit (those of one record: zero), and the variance these add."""
    place = {one.name: k for k, one in enumerate(own.coefficients)}
    shared = np.zeros((psi.size, by_psi.shape[1]))
    extra = np.zeros(by_psi.shape[1])
    for k, one in enumerate(there.coefficients):
        if one.record is None:
            shared[place[one.name]] = by_psi[k]
            continue
        alike = [
            psi[j]
            for j, other in enumerate(own.coefficients)
            if other.effect == one.effect and other.coefficient.name == one.coefficient.name
        ]
        extra += np.mean(np.square(alike)) * by_psi[k] ** 2
    return shared, extra


@final
@dataclass(frozen=True)
class LevelPrior:
    """What the fit records say of the level of another record."""

    mean: float
    """[response unit]."""
    variance: float
    """Scatter of levels between records, and error of the mean [response unit^2]; infinite when nothing is
    known."""

    @classmethod
    def of(cls, model: ExtendedModel, x: Vector, covariance: Matrix, axis: int) -> LevelPrior:
        """From the fitted offsets of an axis: their mean, and their scatter beyond their errors
        (DerSimonian and
        Laird 1986, Control. Clin. Trials 7)."""
        rows, columns = model.base.posterior.table.rows, model.base.least.columns
        own = [p for p, k in enumerate(columns) if rows[k].kind == "offset" and rows[k].place.first == axis]
        if len(own) < 3:
            return cls(0.0, np.inf)
        levels, errors = x[own], np.diag(covariance)[own]
        weights = 1.0 / errors
        mean = float(weights @ levels / weights.sum())
        excess = float(weights @ (levels - mean) ** 2) - (levels.size - 1)
        between = max(0.0, excess / float(weights.sum() - (weights**2).sum() / weights.sum()))
        weights = 1.0 / (errors + between)
        mean = float(weights @ levels / weights.sum())
        return cls(mean, between + 1.0 / float(weights.sum()))


FLAT = LevelPrior(0.0, np.inf)
"""Nothing is known of the level."""


def levelled(
    record: Samples, axis: int, misfit: Vector, noise: Law, delay: float, prior: LevelPrior = FLAT
) -> tuple[float, float, str]:
    """Level of a record that is not known from the fit, its variance and where it comes from.

    From the samples before the drive can have acted, else from the whole record, by generalised least
    squares,
    and from what the levels of the fit records make likely.
    """
    count = quiet_samples(record, axis, delay)
    source = "samples before the drive acts" if count >= 3 else "the record itself"
    used = misfit[:count] if count >= 3 else misfit
    gaps = record.axes[axis].gaps[: used.size]
    white, ones = noise.whiten(np.stack([used, np.ones_like(used)]), gaps)
    power = float(ones @ ones) + 1.0 / prior.variance
    pull = float(ones @ white) + (prior.mean / prior.variance if np.isfinite(prior.variance) else 0.0)
    if np.isfinite(prior.variance):
        source += " and the levels of the fit records"
    return pull / power, 1.0 / power, source
