"""Samples far outside the noise, found by their neighbours and left out before anything is traced.

An effect of the device is smooth from sample to sample, a lost centroid is not. Samples are held against the
median of the four around them; what stands out must do so as often where no signal is as where the device
moves, or it is taken for a misfit and left alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from lcopa_bayes.core.arrays import Flags, Vector
from lcopa_bayes.data.record import Record
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.basefit import BaseFit
from lcopa_bayes.effectsearch.noise import quiet_samples, scatter_evidence
from lcopa_bayes.effectsearch.scores import Score
from lcopa_bayes.effectsearch.whitening import parts
from lcopa_bayes.inference.observations import Samples

NAME = "outliers"
"""Name of the effect of the catalogue."""
_FAR = 4.5
"""Distance from the median of the neighbours, over the noise, from which a sample is an outlier [-]."""
_BESIDE = 2
"""Neighbours on either side [-]."""
_FEWEST = 5
"""Outliers among the quiet samples from which they belong to the noise [-]."""
_ALIKE = 3.0
"""Largest share of outliers where the device moves over that where it rests [-]."""
_NORMAL = 0.6744897501960817
"""Median of the magnitude of a standard normal deviate."""


@final
@dataclass(frozen=True, eq=False)
class Outlying:
    """Outliers of a study, and the study without them."""

    study: Study
    """The study without them."""
    original: tuple[Record, ...]
    """Fit records with them."""
    count: int
    """Outliers among the fit samples [-]."""
    share: float
    """Of all fit samples [-]."""
    width: float
    """Root mean square of the outliers over the noise [-]."""
    log_bayes_factor: float
    """Of rare wide outliers against normal noise, in the residual of the base fit [nat]."""

    def returned(self, study: Study) -> Study:
        """A study of these records, perhaps with rows before their first, with the outliers in place."""
        out = []
        for record, whole in zip(study.fit, self.original, strict=True):
            response = record.response.copy()
            response[np.searchsorted(record.time, whole.time)] = whole.response
            out.append(replace(record, response=response))
        return replace(study, fit=tuple(out))

    @property
    def sentence(self) -> str:
        """In words."""
        return (
            f"{self.count} samples ({100 * self.share:.2g} %) are outliers of about {self.width:.0f} times "
            "the noise, as often where nothing moves as elsewhere; they were left out of the fit."
        )


def outlying(study: Study, fit: BaseFit) -> Outlying | None:
    """Outliers in the residual of a base fit; None where there are none that belong to the noise."""
    posterior, residual = fit.model.plant, fit.optimum.residual
    samples = posterior.samples
    delay = fit.model.dead_time(fit.optimum.x)
    far: dict[tuple[int, int], Flags] = {}
    sizes: list[Vector] = []
    counts = np.zeros((2, 2))  # rows: at rest, moving; columns: samples, outliers
    for axis in range(len(samples[0].axes)):
        own = parts(samples, axis)
        apart = [_apart(residual[part.rows]) for part in own]
        core = _core(apart, [part.samples.record.response[:, axis] for part in own])
        for part, distance in zip(own, apart, strict=True):
            flags = np.abs(distance) > _FAR * core
            rest = quiet_samples(part.samples, axis, delay)
            counts[0] += rest, flags[:rest].sum()
            counts[1] += flags.size - rest, flags[rest:].sum()
            far[part.record, axis] = flags
            sizes.append(np.abs(distance[flags]) / max(core, 1e-300))
    shares = counts[:, 1] / np.maximum(counts[:, 0], 1)
    if counts[0, 1] < _FEWEST or shares[1] > _ALIKE * shares[0]:
        return None
    widths = np.concatenate(sizes)
    return Outlying(
        replace(study, fit=tuple(_without(one, number, far) for number, one in enumerate(samples))),
        study.fit,
        widths.size,
        float(widths.size / counts[:, 0].sum()),
        float(np.sqrt(np.mean(widths**2))),
        scatter_evidence(fit.optimum.white),
    )


def without_outliers(
    before: Sequence[Score], after: Sequence[Score]
) -> tuple[tuple[Score, ...], tuple[Score, ...]]:
    """Scores of one set of records by two models where the noise has outliers, without the samples that lie
    as far from their neighbours in either."""
    pairs = [(one, other, _near(one) & _near(other)) for one, other in zip(before, after, strict=True)]
    kept = [(_only(one, near), _only(other, near)) for one, other, near in pairs]
    return tuple(one for one, _ in kept), tuple(other for _, other in kept)


def _near(one: Score) -> Flags:
    distance = _apart(one.observed - one.predicted)
    return np.asarray(np.abs(distance) <= _FAR * _core([distance], [one.observed]))


def _only(one: Score, near: Flags) -> Score:
    arrays = {name: getattr(one, name)[near] for name in ("time", "observed", "predicted", "variance")}
    return replace(one, **arrays, draws=None if one.draws is None else one.draws[:, near])


def _apart(residual: Vector) -> Vector:
    """Distance of every sample from the median of its neighbours, two on either side."""
    padded = np.pad(residual, _BESIDE, mode="reflect" if residual.size > _BESIDE else "edge")
    around = sliding_window_view(padded, 2 * _BESIDE + 1)
    return np.asarray(residual - np.median(np.delete(around, _BESIDE, axis=1), axis=1))


def _core(apart: Sequence[Vector], responses: Sequence[Vector]) -> float:
    """Noise by the distances of samples from their neighbours, at least what the steps of the sensor leave
    [response unit]."""
    spread = float(np.median(np.abs(np.concatenate(apart)))) / _NORMAL
    return max(spread, _step(responses) / float(np.sqrt(12)))


def _step(responses: Sequence[Vector]) -> float:
    """Between the values of a sensor [response unit], whose rounding error has a standard deviation of a step
    over the square root of 12; of one that does not round less than its noise, by the number of samples."""
    values = np.concatenate(responses)
    apart = np.diff(np.unique(values[np.isfinite(values)]))
    return float(np.median(apart)) if apart.size else 0.0


def _without(samples: Samples, number: int, far: Mapping[tuple[int, int], Flags]) -> Record:
    """The record with the outliers taken for samples that were not."""
    record = samples.record
    response = record.response.copy()
    rows = np.searchsorted(record.time, samples.times)
    for axis, observed in enumerate(samples.axes):
        if (number, axis) in far:
            response[rows[observed.index[far[number, axis]]], axis] = np.nan
    return replace(record, response=response)
