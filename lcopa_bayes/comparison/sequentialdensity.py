"""Predictive densities of a record sample by sample, each given those before it.

``p(y_i | y_1 .. y_i-1, theta)`` are the factors of the joint density of a record: their logarithms may be
added, and a total is that of one forecast of the whole record, however its samples correlate. What belongs
to the record alone follows its earlier samples exactly: the state of the noise, and the level where the
model gives every record one of its own. The parameters that records share do not follow.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, final

import numpy as np
from scipy.special import logsumexp

from lcopa_bayes.comparison.folds import Part
from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.inference.noise import LOG_2PI, GaussianNoise, Noise
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.inference.parameters import ParameterTable

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
    places = {
        table.rows[k].place.second: k for k in table.of_kind("offset") if table.rows[k].place.first == axis
    }
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
