"""Second-order expansions of the log likelihood about many parameter sets, linear ones integrated out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, final

import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.inference.noise import LOG_2PI, GaussianNoise
from lcopa_bayes.inference.posterior import Posterior

_PORTION, _CELLS = 64, 1 << 16
"""Parameter sets expanded at once at least, and at most so many times their samples: more leave the cache."""


@final
class Expansion(NamedTuple):
    """``log_likelihood + gradient x - x' information x / 2`` for small x, for a batch."""

    log_likelihood: Vector
    """(batch,) [nat]."""
    gradient: Matrix
    """(batch, columns)."""
    information: Array
    """(batch, columns, columns), positive semidefinite."""


def expanded(posterior: Posterior, values: Matrix, columns: Sequence[int]) -> Expansion:
    """Expansion about canonical table values (batch, rows) in table rows `columns`, times by their logarithm.

    Times, delays, and gains and offsets that are sampled may be columns; what is integrated out follows. The
    information is that of least squares (Gauss and Newton), for Student noise by its weights (Lange, Little
    and Taylor 1989, J. Am. Stat. Assoc. 84); the slope of the normalisation of what is integrated out is
    neglected. Of a plant without effects.
    """
    portion = max(_PORTION, _CELLS // max(posterior.size, 1))
    if len(values) > portion:
        portions = np.array_split(values, -(-len(values) // portion))
        parts = [expanded(posterior, part, columns) for part in portions]
        return Expansion(*(np.concatenate(each) for each in zip(*parts, strict=True)))
    table, batch, size = posterior.table, len(values), len(columns)
    in_orders = any(table.rows[k].kind == "order" for k in columns)
    slopes = posterior.model.unit_slopes(table.dynamics(values), in_orders=in_orders)
    units = [unit for unit, _ in slopes]
    total, gradient = np.zeros(batch), np.zeros((batch, size))
    information = np.zeros((batch, size, size))
    for axis in range(len(table.layout.responses)):
        block = posterior.blocks[axis]
        mean, sd = posterior.scaled[axis]
        centre = values.copy()
        centre[:, block] = mean
        series = _series(posterior, axis, columns)
        count = len(block) + len(series) + 1
        normal = np.zeros((batch, count, count))
        normal[:, range(len(block)), range(len(block))] = 1.0
        noise, weights = posterior.noise_parameters(values, axis), np.append(sd, np.ones(len(series)))
        for r, samples in enumerate(posterior.samples):
            observed = samples.axes[axis]
            if observed.values.size == 0:
                continue
            found = _acting(posterior, axis, r, series, units[r], slopes[r][1])
            acting = [*found, count - 1]
            stacked = np.empty((batch, len(acting), observed.values.size))
            for slot, (position, column) in enumerate(found.items()):
                np.multiply(weights[position], column, out=stacked[:, slot])
            stacked[:, -1] = residual = posterior.residual(axis, r, observed, centre, units[r])
            if isinstance(posterior.noise, GaussianNoise):
                products, scale = posterior.noise.products(stacked, noise, observed.gaps)
                total -= scale + 0.5 * observed.values.size * LOG_2PI
            else:
                total += posterior.noise.pointwise(residual, noise, observed.gaps).sum(axis=1)
                sigma, nu = noise[:, 0, None, None], noise[:, 1, None]
                weight = np.sqrt((nu + 1) / (nu + (residual / sigma[:, 0]) ** 2))
                white = stacked / sigma * weight[:, None, :]
                products = white @ white.swapaxes(1, 2)
            normal[:, np.array(acting)[:, None], acting] += products
        combine = np.zeros((batch, len(series), size))
        if block:
            inner, rest = normal[:, : len(block), : len(block)], normal[:, : len(block), len(block) :]
            solved = np.linalg.solve(inner, rest)
            total -= np.log(np.diagonal(np.linalg.cholesky(inner), axis1=1, axis2=2)).sum(axis=1)
            reduced = normal[:, len(block) :, len(block) :] - rest.swapaxes(1, 2) @ solved
            centre[:, block] = mean + sd * solved[:, :, -1]
        else:
            reduced = normal
        for slot, one in enumerate(series):
            factor = 1.0 if one.drive < 0 else centre[:, table.at("gain", axis, one.drive)]
            combine[:, slot, columns.index(one.row)] = factor
        if isinstance(posterior.noise, GaussianNoise):
            total -= 0.5 * reduced[:, -1, -1]
        gradient += (combine.swapaxes(1, 2) @ reduced[:, :-1, -1:])[..., 0]
        information += combine.swapaxes(1, 2) @ reduced[:, :-1, :-1] @ combine
    return Expansion(total, gradient, information)


@final
class _Series(NamedTuple):
    """A derivative of a response axis, or what a unit of a gain or an offset adds to it."""

    row: int
    """Table row."""
    drive: int = -1
    """Drive whose gain scales the derivative; -1: a gain or an offset, whose series no gain scales."""
    unit: int = -1
    """Unit response of the derivative."""
    position: int = -1
    """Place of the derivative among those of the unit response."""


def _series(posterior: Posterior, axis: int, columns: Sequence[int]) -> list[_Series]:
    """What `columns` change of a response axis."""
    table = posterior.table
    out = []
    for drive, unit in enumerate(table.layout.unit_of[axis]):
        out += [_Series(k, drive, unit, position) for position, k in enumerate(table.shaping(unit))]
    out += [_Series(k) for k in posterior.acting[axis]]
    return [one for one in out if one.row in columns]


def _acting(
    posterior: Posterior,
    axis: int,
    r: int,
    series: Sequence[_Series],
    units: Array,
    slopes: Sequence[Array],
) -> dict[int, Array]:
    """Columns of what is integrated out and of the `series` behind it that act on a record, by their
    places, (batch or 1, samples); most offsets and the paths of drives at rest do not."""
    block, observed = posterior.blocks[axis], posterior.samples[r].axes[axis]
    out = {p: posterior.column(k, axis, r, observed, units) for p, k in enumerate(block)}
    for position, one in enumerate(series, start=len(block)):
        if one.drive < 0:
            out[position] = posterior.column(one.row, axis, r, observed, units)
        elif posterior.model.experiments[r].drives[one.drive].moves:
            out[position] = slopes[one.unit][one.position][:, observed.chosen]
    return {position: column for position, column in out.items() if column is not None}
