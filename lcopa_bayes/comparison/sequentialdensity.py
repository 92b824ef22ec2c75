"""Predictive densities of a record sample by sample, each given those before it.

``p(y_i | y_1 .. y_i-1, theta)`` are the factors of the joint density of a record: their logarithms may be
added, and a total is that of one forecast of the whole record, however its samples correlate. What belongs
to the record alone follows its earlier samples exactly: the state of the noise, and the level where the
model gives every record one of its own. The parameters that records share do not follow.

Given orders, times, delays and the noise, a record is linear in gains and levels: what is known of them from
other records is a normal law, and every sample of the predicted record sharpens it before the next is
predicted (recursive least squares, `linear_densities`). So a gain that only the predicted record determines
costs a few nats, as many as its prior is wide, and no draw of it has to come near.

What is predicted from the rest: whole records, or the future of the only one.

Points inside a record are correlated through the plant's memory and the noise: leaving out single points
would measure how well a model fills gaps, not how well it predicts, and is not offered.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, final

import numpy as np
from scipy.special import logsumexp

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector
from lcopa_bayes.inference.noise import LOG_2PI, GaussianNoise, Noise
from lcopa_bayes.inference.observations import Observed, Samples
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.inference.posterior import NormalEquations, Posterior, Units
from lcopa_bayes.model.forward import ForwardModel

Kind = Literal["held-out record", "record left out", "future of the record"]

CUTS = (0.5, 0.625, 0.75, 0.875)
"""Shares of a single record that are known when what follows is predicted [-]."""


@final
@dataclass(frozen=True, eq=False)
class Part:
    """Samples predicted from others."""

    name: str
    kind: Kind
    record: int
    """Number among the fit records, or among the held-out ones."""
    known: int
    """Time points of the record that are known [-]; 0 where the whole record is predicted."""
    until: int
    """First time point no longer predicted [-]."""


def parts_of(posterior: Posterior, held_out: Sequence[str]) -> tuple[Part, ...]:
    """Every record in turn from the others; of a single record the stretches after each cut; and the
    held-out records from all that were fitted."""
    records = posterior.samples
    out = [
        Part(name, "held-out record", number, 0, np.iinfo(np.intp).max)
        for number, name in enumerate(held_out)
    ]
    if len(records) > 1:
        out += [
            Part(one.record.name, "record left out", number, 0, one.times.size)
            for number, one in enumerate(records)
        ]
        return tuple(out)
    count = records[0].times.size
    ends = [round(share * count) for share in (*CUTS, 1.0)]
    out += [
        Part(f"{records[0].record.name} after {100 * share:g} %", "future of the record", 0, first, last)
        for share, first, last in zip(reversed(CUTS), reversed(ends[:-1]), reversed(ends[1:]), strict=True)
        if last > first
    ]
    return tuple(out)


def without(posterior: Posterior, part: Part) -> Posterior:
    """The posterior given the samples that are known when the part is predicted; the priors stay."""
    samples = list(posterior.samples)
    own = samples[part.record]
    samples[part.record] = Samples(
        own.record, own.times, tuple(_first(axis, axis.index < part.known) for axis in own.axes)
    )
    return replace(posterior, samples=tuple(samples))


def _first(observed: Observed, known: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> Observed:
    return Observed(observed.index[known], observed.values[known], observed.gaps[known])


def predicted(observed: Observed, part: Part) -> Index:
    """Positions among an axis' samples that are predicted."""
    return np.flatnonzero((observed.index >= part.known) & (observed.index < part.until))


_NODES = 241
"""Levels at which a density that is not Gaussian is integrated, about each of two centres [-]."""
_REACH = 11.0
"""Farthest node: sinh of this, in units of the width of the level [-]."""
_PORTION = 16
"""Draws integrated at a time."""

LevelFrom = Literal[
    "no level in the model", "shared with the fitted records", "fixed by the study", "the known part of it",
    "its samples at rest, then each one as it has been predicted",
    "its first sample, then each one as it has been predicted: it has none at rest",
]  # fmt: skip
"""Where the level of a predicted record comes from."""


def known_before(samples: Samples, axis: int, part: Part) -> int:
    """Samples of an axis that are known when the first of a part is predicted [-].

    Of a whole record those at rest, up to the first change of any drive, and one at least: they set its
    level. The record alone decides, not the model, so that all candidates predict the same samples.
    """
    observed = samples.axes[axis]
    if part.known:
        return int(np.count_nonzero(observed.index < part.known))
    return _resting(samples, axis) or min(1, observed.values.size)


def _resting(samples: Samples, axis: int) -> int:
    """Samples of an axis before any drive changes; 0 where none ever does [-]."""
    return samples.quiet(axis).values.size if np.isfinite(samples.first_change) else 0


@final
@dataclass(frozen=True, eq=False)
class Level:
    """Level of one axis of a predicted record."""

    value: Vector | None
    """Of each draw, (draws,) [response unit]; None where it follows the record's own samples."""
    source: LevelFrom


def level_of(table: ParameterTable, values: Matrix, axis: int, part: Part, samples: Samples) -> Level:
    """Level of an axis under draws (draws, rows) of what is known when a part is predicted."""
    places = table.offsets(axis)
    if not places:
        return Level(np.zeros(len(values)), "no level in the model")
    if -1 in places:
        return Level(values[:, places[-1]], "shared with the fitted records")
    if part.known:
        return Level(values[:, places[part.record]], "the known part of it")
    row = places.get(part.record) if part.kind == "record left out" else None
    if row is not None and not table.rows[row].free:
        return Level(values[:, row], "fixed by the study")
    if _resting(samples, axis):
        return Level(None, "its samples at rest, then each one as it has been predicted")
    return Level(None, "its first sample, then each one as it has been predicted: it has none at rest")


def log_densities(
    noise: Noise, residual: Matrix, parameters: Matrix, gaps: Vector, level: Vector | None, known: int
) -> Matrix:
    """Log density of each sample from the `known`-th on given all before it, (draws, n - known) [nat].

    `residual` (draws, n) is without the level. Where that is None it is integrated out given the samples
    before each one, under a flat prior: exactly for Gaussian noise, on `_NODES` levels otherwise. `known`
    is then 1 at least; ValueError if not.
    """
    if level is not None:
        return noise.pointwise(residual - level[:, None], parameters, gaps)[:, known:]
    if known < 1:
        raise ValueError("a level of the record's own needs a known sample; got none")
    if isinstance(noise, GaussianNoise):
        return _followed(noise, residual, parameters, gaps)[:, known:]
    pieces = np.array_split(np.arange(len(residual)), max(1, len(residual) // _PORTION))
    return np.concatenate([_integrated(noise, residual[p], parameters[p], gaps, known) for p in pieces])


def _followed(noise: GaussianNoise, residual: Matrix, parameters: Matrix, gaps: Vector) -> Matrix:
    """Recursive least squares of the level in whitened samples; the first column is NaN."""
    white, _ = noise.whiten(np.stack([np.ones_like(residual), residual], axis=1), parameters, gaps)
    slope, seen = white[:, 0], white[:, 1]
    precision = np.cumsum(slope**2, axis=1)
    mean = np.cumsum(slope * seen, axis=1) / precision
    out = np.full(residual.shape, np.nan)
    variance = 1 + slope[:, 1:] ** 2 / precision[:, :-1]
    apart = seen[:, 1:] - slope[:, 1:] * mean[:, :-1]
    scales = np.broadcast_to(noise.log_scales(parameters, gaps), residual.shape)[:, 1:]
    out[:, 1:] = -0.5 * (apart**2 / variance + np.log(variance) + LOG_2PI) - scales
    return out


def _integrated(noise: Noise, residual: Matrix, parameters: Matrix, gaps: Vector, known: int) -> Matrix:
    """The level integrated numerically: nodes dense about the median of what is known and of everything."""
    draws, n = residual.shape
    sigma, unit = parameters[:, :1], np.sinh(np.linspace(-_REACH, _REACH, _NODES))
    centres = [np.median(part, axis=1, keepdims=True) for part in (residual[:, :known], residual)]
    counts = (known, n)
    nodes = np.sort(
        np.concatenate([c + sigma / np.sqrt(m) * unit for c, m in zip(centres, counts, strict=True)], axis=1)
    )
    widths = np.gradient(nodes, axis=1)
    left = (residual[:, None, :] - nodes[:, :, None]).reshape(-1, n)
    each = noise.pointwise(left, np.repeat(parameters, nodes.shape[1], axis=0), gaps)
    with np.errstate(divide="ignore"):  # nodes may coincide
        total = np.cumsum(each.reshape(draws, -1, n), axis=2) + np.log(widths)[:, :, None]
    joint = logsumexp(total, axis=1)
    return np.asarray(np.diff(joint, axis=1)[:, known - 1 :])


def applies(posterior: Posterior) -> bool:
    """Whether some parameter is linear, so that it can be integrated out."""
    return isinstance(posterior.noise, GaussianNoise) and bool(posterior.linear)


def linear_densities(
    known: Posterior, part: Part, samples: Samples, model: ForwardModel, values: Matrix, first: Sequence[int]
) -> list[Matrix]:
    """Log density of each predicted sample of every axis given all before it, (draws, predicted) [nat].

    `known` is the posterior without what is predicted; of `values` (draws, rows) linear parameters do not
    count. `model` simulates the record of `samples` alone, each axis from its `first` sample predicted. A
    level that no known record shares has the prior of the others'.
    """
    units = known.responses(values)
    own = replace(known, model=model, surrogate=None).responses(values)[0]
    r, joined = part.record, known
    if part.kind == "held-out record":
        r = len(known.samples)
        joined = replace(known, model=known.model.joined(model), samples=(*known.samples, samples))
    out = []
    for axis, start in enumerate(first):
        equations, _, _ = known.equations(axis, values, units)
        level = _prior_level(known, part, axis)
        stacked = _columns(joined, samples, values, own, axis=axis, record=r)
        if level is not None:
            column = np.full_like(stacked[:, :1], level[1])
            stacked = np.concatenate([stacked[:, :-1], column, stacked[:, -1:] - level[0]], axis=1)
        out.append(_sequential(known, part, samples, values, equations, stacked, axis=axis)[:, start:])
    return out


def _sequential(
    known: Posterior,
    part: Part,
    samples: Samples,
    values: Matrix,
    equations: NormalEquations,
    stacked: Array,
    *,
    axis: int,
) -> Matrix:
    """Recursive least squares of the linear parameters over the samples of a record, `stacked` their columns
    and last what is predicted; NaN for what is known (draws, n)."""
    noise, observed = known.noise, samples.axes[axis]
    assert isinstance(noise, GaussianNoise)
    last = int(np.count_nonzero(observed.index < part.until))
    parameters = known.noise_parameters(values, axis)
    white, _ = noise.whiten(stacked[..., :last], parameters, observed.gaps[:last])
    scales = np.broadcast_to(noise.log_scales(parameters, observed.gaps[:last]), (len(values), last))
    size, wide = equations.gram.shape[1], stacked.shape[1] - 1
    covariance = np.tile(np.eye(wide), (len(values), 1, 1))
    covariance[:, :size, :size] = np.linalg.inv(equations.gram)
    mean = np.zeros((len(values), wide))
    mean[:, :size] = equations.mean()
    out = np.full((len(values), last), np.nan)
    # what is known of the record is in the equations
    for k in range(known_before(samples, axis, part) if part.known else 0, last):
        slope = white[:, :-1, k]
        bent = np.einsum("bij,bj->bi", covariance, slope)
        variance = 1 + np.einsum("bi,bi->b", slope, bent)
        apart = white[:, -1, k] - np.einsum("bi,bi->b", slope, mean)
        out[:, k] = -0.5 * (apart**2 / variance + np.log(variance) + LOG_2PI) - scales[:, k]
        mean = mean + bent * (apart / variance)[:, None]
        covariance = covariance - bent[:, :, None] * (bent / variance[:, None])[:, None, :]
    return out


def _columns(
    posterior: Posterior, samples: Samples, values: Matrix, units: Units, *, axis: int, record: int
) -> Array:
    """What a prior standard deviation of every linear parameter adds to a record of the posterior, and last
    what it leaves at their prior means, (draws, parameters + 1, n)."""
    observed = samples.axes[axis]
    mean, sd = posterior.scaled[axis]
    block = posterior.blocks[axis]
    centre = values.copy()
    centre[:, block] = mean
    acting = [posterior.column(k, axis, record, observed, units) for k in block]
    shape = (len(values), observed.values.size)
    columns = [
        np.zeros(shape) if column is None else np.broadcast_to(sd[p] * column, shape)
        for p, column in enumerate(acting)
    ]
    return np.stack([*columns, posterior.residual(axis, record, observed, centre, units)], axis=1)


def _prior_level(known: Posterior, part: Part, axis: int) -> tuple[float, float] | None:
    """Mean and standard deviation of the level of a held-out record; None where the model gives it none of
    its own."""
    rows = [known.table.rows[k] for k in known.table.of_kind("offset")]
    own = [row for row in rows if row.place.first == axis and row.place.second >= 0]
    if part.kind != "held-out record" or not own:
        return None
    prior = next((row.prior for row in own if row.prior is not None), None)
    if prior is None:  # every level is fixed: that of another record tells nothing
        return 0.0, float(np.ptp(known.samples[0].axes[axis].values)) * 10 or 1.0
    return float(prior.frozen.mean()), float(prior.frozen.std())
