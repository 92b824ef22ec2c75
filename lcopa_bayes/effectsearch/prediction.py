"""Predictions of records that were not fitted, with what the fit leaves uncertain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.data.record import Record
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.noise import Law
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
    values, psi = model.values(x)[: len(model.plant.table.rows)], x[model.plant_size :]
    moved = carried(psi, own, there)
    mean = stacked(samples, there.responses(values, moved))
    slopes = stacked(samples, [np.moveaxis(one, 2, 0) for one in there.jacobian(values, moved)])
    mean, slopes = _with_shared_offset(problem, model, samples, mean, slopes, values)
    rows = model.plant.table.rows
    columns = model.columns[: model.plant_size]
    plant = np.array([slopes[k] * (values[k] if rows[k].log_scale else 1.0) for k in columns])
    tangents, extra = plant, np.zeros_like(mean)
    if own.effects:
        by_psi = stacked(samples, [np.moveaxis(one, 2, 0) for one in there.signature(values, moved)])
        shared, extra = _shared(own, there, by_psi, psi)
        tangents = np.vstack([plant, shared])
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


def level_of(record: Samples, axis: int, misfit: Vector, noise: Law) -> tuple[float, float, str]:
    """Level of a record that is not known from the fit, its variance and where it comes from.

    By generalised least squares from the samples that a fit takes the offset of a held-out record from.
    """
    used, source = record.level_samples(axis)
    columns = np.stack([misfit[used], np.ones(np.count_nonzero(used))])
    white, ones = noise.whiten(columns, record.axes[axis].gaps[used])
    power = float(ones @ ones)
    return float(ones @ white) / power, 1.0 / power, source
