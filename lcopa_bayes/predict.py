"""What the posterior says a record looks like: credible bands, held-out scores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from lcopa_bayes.arrays import Array, Matrix, Vector
from lcopa_bayes.inference.data import Observed, Samples
from lcopa_bayes.inference.draws import Draws
from lcopa_bayes.inference.noise import GaussianNoise, Noise, White
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.plant.forward import ForwardModel

LEVELS = (0.5, 0.9)
"""Probabilities inside the bands [-]."""
_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
_CELLS = 2_000_000
"""Draws times samples behind the bands of one axis of one record."""
_FEWEST = 200
"""Draws behind a band at least."""


@final
@dataclass(frozen=True, eq=False)
class Band:
    """Bands of one response axis of one record, at the record's sample times."""

    record: str
    axis: str
    unit: str
    held_out: bool
    time: Vector
    """(n,) [time unit]."""
    observed: Vector
    """(n,) [response unit]."""
    plant: Matrix
    """5, 25, 50, 75, 95 % quantiles of the plant's response, (5, n) [response unit]."""
    noisy: Matrix
    """The same with noise, (5, n) [response unit]."""
    offset_from: str
    """Where the record's offset comes from."""
    draws: int
    """Draws behind the quantiles."""

    @property
    def rmse(self) -> float:
        """Root mean square of observed minus median [response unit]."""
        return float(np.sqrt(np.mean((self.observed - self.plant[2]) ** 2)))

    def coverage(self, level: float) -> float:
        """Share of the samples inside the band with noise [-]."""
        low, high = (self.noisy[0], self.noisy[4]) if level == LEVELS[1] else (self.noisy[1], self.noisy[3])
        return float(np.mean((self.observed >= low) & (self.observed <= high)))


def responses(table: ParameterTable, model: ForwardModel, values: Matrix) -> list[Array]:
    """Plant responses without offsets, per experiment (axes, batch, samples) [response unit]."""
    gains, layout, out = table.gains(values), table.layout, []
    unit_responses = model.unit_responses(table.dynamics(values))
    for experiment, units in zip(model.experiments, unit_responses, strict=True):
        total = np.zeros((len(layout.responses), values.shape[0], units.shape[2]))
        for i, row in enumerate(layout.unit_of):
            for j, unit in enumerate(row):
                total[i] += gains[:, i, j, None] * (experiment.rest[j] + units[unit])
        out.append(total)
    return out


def bands(
    draws: Draws,
    model: ForwardModel,
    samples: Sequence[Samples],
    noise: Noise,
    *,
    held_out: bool,
    rng: np.random.Generator,
) -> list[Band]:
    """50 and 90 % bands of every axis of every record, for the plant alone and with noise.

    `model` simulates the records of `samples` at their sample times. An offset per record is not
    known for a held-out record: it is taken from the samples before the drive can have acted, else
    from the record itself (integrated out given its samples), and the band says which.
    """
    out = []
    for r, record in enumerate(samples):
        one = ForwardModel(model.layout, (model.experiments[r],))
        values = draws.thinned(max(_FEWEST, _CELLS // record.times.size))
        parts = np.array_split(values, max(1, values.shape[0] * record.times.size // _CELLS * 4))
        plant = np.concatenate([responses(draws.table, one, part)[0] for part in parts], axis=1)
        for axis, observed in enumerate(record.axes):
            if observed.values.size == 0:
                continue
            response = plant[axis][:, observed.index]
            parameters = values[:, [draws.table.at(name, axis) for name in noise.names]]
            offset, source = offset_draws(
                draws.table, values, axis, r, record, response, noise, held_out=held_out, rng=rng
            )
            response = response + offset[:, None]
            noisy = response + noise.draw(parameters, observed.gaps, rng)
            response_axis = record.record.response_axes[axis]
            out.append(
                Band(
                    record.record.name,
                    response_axis.name,
                    response_axis.unit,
                    held_out,
                    record.times[observed.index],
                    observed.values,
                    np.quantile(response, _QUANTILES, axis=0),
                    np.quantile(noisy, _QUANTILES, axis=0),
                    source,
                    values.shape[0],
                )
            )
    return out


def offset_draws(
    table: ParameterTable,
    values: Matrix,
    axis: int,
    r: int,
    record: Samples,
    response: Matrix,
    noise: Noise,
    *,
    held_out: bool,
    rng: np.random.Generator,
) -> tuple[Vector, str]:
    """Offset of a record for each draw, and where it comes from."""
    places = {(table.rows[k].place.first, table.rows[k].place.second): k for k in table.of_kind("offset")}
    if not places:
        return np.zeros(values.shape[0]), "no offset"
    if (axis, -1) in places:
        return values[:, places[axis, -1]], "shared with the fit records"
    if not held_out:
        return values[:, places[axis, r]], "fitted"
    observed = record.axes[axis]
    quiet = record.times[observed.index] <= record.first_change
    if quiet.any():
        return (
            _given(observed, quiet, response, noise, table, values, axis, rng),
            "samples before the drive acts",
        )
    everything = np.ones_like(quiet)
    return (
        _given(observed, everything, response, noise, table, values, axis, rng),
        "integrated out given the held-out record itself",
    )


def _given(
    observed: Observed,
    used: np.ndarray[tuple[int], np.dtype[np.bool_]],
    response: Matrix,
    noise: Noise,
    table: ParameterTable,
    values: Matrix,
    axis: int,
    rng: np.random.Generator,
) -> Vector:
    """Draws of an offset from its Gaussian conditional (flat prior) given some samples."""
    gaussian = noise if isinstance(noise, GaussianNoise) else White()
    parameters = values[:, [table.at(name, axis) for name in gaussian.names]]
    misfit = (observed.values - response)[:, used]
    columns = np.stack([np.ones_like(misfit), misfit], axis=1)
    white, _ = gaussian.whiten(columns, parameters, observed.gaps[used])
    precision = np.einsum("bn,bn->b", white[:, 0], white[:, 0])
    mean = np.einsum("bn,bn->b", white[:, 0], white[:, 1]) / precision
    return np.asarray(mean + rng.standard_normal(mean.size) / np.sqrt(precision))
