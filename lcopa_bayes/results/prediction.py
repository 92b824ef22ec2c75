"""Prediction of records and drives by a posterior: credible bands, held-out scores."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
import pandas as pd

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.core.estimate import attributes
from lcopa_bayes.data.record import Axis
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.noise import GaussianNoise, Noise
from lcopa_bayes.inference.observations import BEFORE_DRIVE, Observed, Samples
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.inference.simulation import Simulation
from lcopa_bayes.model.forward import ForwardModel, deflections
from lcopa_bayes.results.bands import LEVELS, POINTWISE, Bands, named
from lcopa_bayes.results.responsesurface import surfaced
from lcopa_bayes.sampling.draws import Draws

_CELLS = 2_000_000
"""Draws times samples behind the bands of one axis of one record."""
_FEWEST, _PER_WANTED = 200, 2.5
"""Draws behind a band at least, and at most over the effective draws wanted [-]: more are worth no more."""
_WITH_EFFECTS = 400
"""Draws behind a band at most where the plant has effects, which take a simulation each."""
_MOVED = 1e-9
"""Change of the response that shows that the drive acts [share of the largest]."""
_SWEEPS = 20
"""Sweeps after which a Gibbs chain of a level has forgotten its start [-]: 1e-6 of it remains at nu = 1."""


@final
@dataclass(frozen=True, eq=False)
class Band:
    """Bands of one response axis of one record, at the record's sample times, or under a new drive."""

    record: str
    axis: str
    unit: str
    held_out: bool
    time: Vector
    """(n,) [time unit]."""
    observed: Vector
    """(n,) [response unit]; NaN under a drive that nobody has measured."""
    plant: Matrix
    """5, 25, 50, 75, 95 % quantiles of the plant's response, (5, n) [response unit]: pointwise bands."""
    noisy: Matrix
    """The same with noise, (5, n) [response unit]."""
    plant_simultaneous: Matrix
    """Lower end at 90 and 50 %, upper end at 50 and 90 % of the bands that hold the plant's whole response on
    this axis, (4, n) [response unit]."""
    noisy_simultaneous: Matrix
    """The same with noise, (4, n) [response unit]."""
    offset_from: str
    """Where the record's offset comes from."""
    offset_samples: int
    """Samples of a held-out record that its own offset was taken from [-]; 0 for an offset of the fit."""
    draws: int
    """Draws behind the quantiles."""
    p_inside: float
    """Share of simulated responses, plant and noise of one draw each, that have no more samples in the
    pointwise 90 % band than were observed there [-]."""

    def table(self) -> pd.DataFrame:
        """One row per time: what was observed, and the ends of the bands by kind [`unit`]."""
        columns: dict[str, Any] = attributes(self, "record", "axis", "unit", "held_out", "time", "observed")
        columns |= named("plant", Bands(self.plant, self.plant_simultaneous))
        return pd.DataFrame(columns | named("noisy", Bands(self.noisy, self.noisy_simultaneous)))

    @property
    def own_offset(self) -> bool:
        """Whether every sample that is scored has served to set the offset: a constant error cannot show."""
        return self.offset_samples == self.time.size

    @property
    def rmse(self) -> float:
        """Root mean square of observed minus median [response unit]."""
        return float(np.sqrt(np.mean((self.observed - self.plant[2]) ** 2)))

    def coverage(self, level: float) -> float:
        """Share of the samples inside the band with noise [-]."""
        low, high = (self.noisy[0], self.noisy[4]) if level == LEVELS[1] else (self.noisy[1], self.noisy[3])
        return float(np.mean((self.observed >= low) & (self.observed <= high)))

    def score(self) -> dict[str, Any]:
        """Error and coverage as plain values."""
        return {
            **attributes(self, "record", "axis", "unit", "rmse"),
            "coverage_50": self.coverage(LEVELS[0]),
            "coverage_90": self.coverage(LEVELS[1]),
            "bands": POINTWISE,
            "samples": self.time.size,
            **attributes(self, "offset_from", "offset_samples", "draws"),
        }


def responses(table: ParameterTable, model: ForwardModel, values: Matrix) -> list[Array]:
    """Plant responses without offsets, per experiment (axes, batch, samples) [response unit].

    With effects NaN for plants without a bounded response; what differs from record to record is 0 on records
    that were not fitted.
    """
    if model.effects is not None:
        return Simulation(table, model).responses(values)
    gains, units = table.gains(values), model.unit_responses(table.dynamics(values))
    return [
        deflections(table.layout, experiment.rest, gains, own)
        for experiment, own in zip(model.experiments, units, strict=True)
    ]


def bands(
    draws: Draws, model: ForwardModel, samples: Sequence[Samples], noise: Noise, *, held_out: bool, seed: int
) -> list[Band]:
    """50 and 90 % bands of every axis of every record, for the plant alone and with noise.

    `model` simulates the records of `samples` at their sample times. An offset per record is not
    known for a held-out record: it is taken from the samples before the drive can have acted, else
    from the record itself (integrated out given its samples), and the band states which and from how many.
    Effects that differ from record to record count as noise on a held-out record, as large as on the others.
    What is drawn depends on `seed` and the record's name alone, not on the other records.
    """
    drawn = record_draws(draws, model, samples, noise, held_out=held_out, seed=seed)
    return [band_of(*one) for one in drawn]


def study_bands(problem: Problem, draws: Draws) -> list[Band]:
    """`bands` of all records of a study, held-out ones last."""
    posterior, study = problem.posterior, problem.study
    noise, seed = posterior.noise, study.seed
    shown = bands(draws, posterior.model, posterior.samples, noise, held_out=False, seed=seed)
    if study.held_out:
        samples, model = problem.simulated(study.held_out)
        shown += bands(draws, model, samples, noise, held_out=True, seed=seed)
    return shown


def record_draws(
    draws: Draws, model: ForwardModel, samples: Sequence[Samples], noise: Noise, *, held_out: bool, seed: int
) -> Iterator[tuple[tuple[str, Axis, bool], Vector, Vector, Matrix, Matrix, tuple[Vector, str, int]]]:
    """The draws behind `bands`, axis by axis of every record: arguments of `band_of`."""
    drawn = axis_draws(draws, model, samples, noise, held_out=held_out, seed=seed)
    for record, axis, values, response, seen, offset, rng in drawn:
        observed = record.axes[axis]
        parameters = values[:, [draws.table.at(name, axis) for name in noise.names]]
        noises = noise.draw(parameters, observed.gaps, rng)
        if seen is not response:
            noises += seen - response
        one = (record.record.name, record.record.response_axes[axis], held_out)
        yield one, record.times[observed.index], observed.values, response, noises, offset


def axis_draws(
    draws: Draws, model: ForwardModel, samples: Sequence[Samples], noise: Noise, *, held_out: bool, seed: int
) -> Iterator[tuple[Samples, int, Matrix, Matrix, Matrix, tuple[Vector, str, int], np.random.Generator]]:
    """Of every record and axis with samples: table values (draws, rows); responses at the samples without
    offset, of the plant and with what differs from record to record, (draws, n) [response unit]; the offset
    as `offset_draws` gives it; random numbers for what else is drawn."""
    for r, record in enumerate(samples):
        rng, alone = named_rng(seed, record.record.name), model.only(r)
        values, plant = plant_draws(draws, alone, seed)
        apart = disturbances(draws.table, alone, values, plant, rng) if held_out else None
        for axis, observed in enumerate(record.axes):
            if observed.values.size == 0:
                continue
            response = plant[axis][:, observed.index]
            seen = response if apart is None else response + apart[axis][:, observed.index]
            offset = offset_draws(
                draws.table, values, axis, r, record, seen, noise, held_out=held_out, rng=rng
            )
            yield record, axis, values, response, seen, offset, rng


def disturbances(
    table: ParameterTable, model: ForwardModel, values: Matrix, plant: Array, rng: np.random.Generator
) -> Array | None:
    """What effects that differ from record to record add to one that was not fitted, as large as on those
    that were, (axes, draws, samples) [response unit]; None without such effects. `plant` is without."""
    if model.effects is None or not model.effects.per_record:
        return None
    return np.asarray(Simulation(table, model).disturbed(values, rng)[0] - plant)


def named_rng(seed: int, name: str) -> np.random.Generator:
    """Random numbers of the bands of one record or drive, whatever else is predicted beside it."""
    return np.random.default_rng([seed, 2, *name.encode()])


def plant_draws(draws: Draws, model: ForwardModel, seed: int) -> tuple[Matrix, Array]:
    """Table values behind the bands of a model's one experiment, (draws, rows), and the plant's responses
    without offsets, (axes, draws, samples) [response unit]; with effects as `surfaced` gives them."""
    size = model.experiments[0].mesh.reading.samples
    most = max(_FEWEST, min(_CELLS // size, int(_PER_WANTED * draws.target_ess)))
    values = draws.thinned(most if model.effects is None else min(most, _WITH_EFFECTS))

    def simulated(own: Matrix) -> Array:
        parts = np.array_split(own, max(1, own.shape[0] * size // _CELLS * 4))
        return np.concatenate([responses(draws.table, model, part)[0] for part in parts], axis=1)

    if model.effects is None:
        return values, simulated(values)
    moving = [k for k, row in enumerate(draws.table.rows) if not row.noise and row.kind != "offset"]
    return values, surfaced(simulated, values, values[:, moving], np.random.default_rng(seed))


def band_of(
    one: tuple[str, Axis, bool],
    times: Vector,
    observed: Vector,
    response: Matrix,
    noises: Matrix,
    offset: tuple[Vector, str, int],
) -> Band:
    """Band from draws of the response and of the noise, both (draws, n), and of the offset with its source.

    `one` is the record, its response axis and whether it was held out.
    """
    name, axis, held_out = one
    level, source, used = offset
    response = response + level[:, None]
    noisy = response + noises
    plant, with_noise = Bands.of(response), Bands.of(noisy)
    low, high = with_noise.pointwise[0], with_noise.pointwise[4]
    shares = np.mean((noisy >= low) & (noisy <= high), axis=1)
    share = np.mean((observed >= low) & (observed <= high))
    return Band(
        record=name,
        axis=axis.name,
        unit=axis.unit,
        held_out=held_out,
        time=times,
        observed=observed,
        plant=plant.pointwise,
        noisy=with_noise.pointwise,
        plant_simultaneous=plant.simultaneous,
        noisy_simultaneous=with_noise.simultaneous,
        offset_from=source,
        offset_samples=used,
        draws=response.shape[0],
        p_inside=float((1 + np.count_nonzero(shares <= share)) / (1 + shares.size)),
    )


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
) -> tuple[Vector, str, int]:
    """Offset of a record for each draw, where it comes from, and from how many samples of the record."""
    places = table.offsets(axis)
    if not places:
        return np.zeros(values.shape[0]), "no offset", 0
    if -1 in places:
        return values[:, places[-1]], "shared with the fit records", 0
    if not held_out:
        return values[:, places[r]], "fitted", 0
    used, source = record.level_samples(axis)
    if source == BEFORE_DRIVE:  # nor has it acted while it is delayed, whichever draw is right
        moved = np.abs(response - response[:, :1]).max(axis=0) > _MOVED * np.abs(response).max()
        used |= ~np.logical_or.accumulate(moved)
    offset = _given(record.axes[axis], used, response, noise, table, values, axis, rng)
    return offset, source, int(used.sum())


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
    """Draws of an offset given some samples, under a flat prior."""
    parameters = values[:, [table.at(name, axis) for name in noise.names]]
    misfit = (observed.values - response)[:, used]
    if not isinstance(noise, GaussianNoise):
        return _student_levels(misfit, parameters, rng)
    columns = np.stack([np.ones_like(misfit), misfit], axis=1)
    white, _ = noise.whiten(columns, parameters, observed.gaps[used])
    precision = np.einsum("bn,bn->b", white[:, 0], white[:, 0])
    mean = np.einsum("bn,bn->b", white[:, 0], white[:, 1]) / precision
    return np.asarray(mean + rng.standard_normal(mean.size) / np.sqrt(precision))


def _student_levels(misfit: Matrix, parameters: Matrix, rng: np.random.Generator) -> Vector:
    """One draw of the level of every row of `misfit` (batch, n) [response unit] under Student noise.

    Gibbs sampling of a Student law as normal laws whose precisions are Gamma distributed (Andrews and
    Mallows 1974, J. R. Stat. Soc. B 36). A sweep forgets at the share of the information that the unknown
    precisions hide, ``2 / (nu + 3)``; rows are chains of their own, and only their last state is kept.
    """
    sigma, nu = parameters[:, :1], parameters[:, 1:2]
    level = np.median(misfit, axis=1)
    for _ in range(_SWEEPS):
        power = ((misfit - level[:, None]) / sigma) ** 2
        precision = rng.gamma((nu + 1) / 2, 2 / (nu + power)) / sigma**2
        total = precision.sum(axis=1)
        mean = np.einsum("bn,bn->b", precision, misfit) / total
        level = mean + rng.standard_normal(mean.size) / np.sqrt(total)
    return np.asarray(level)
