"""Posteriors of plants whose response axes share nothing: a product with a factor for each axis.

Where no element, delay, offset or noise parameter belongs to paths of two response axes, the joint posterior
of all axes is the product of theirs. Each is sampled by itself, in a fraction of the dimensions, and
independent draws of all of them are draws of the whole; log evidences add up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from lcopa_bayes.core.arrays import Index, Vector
from lcopa_bayes.inference.observations import Observed, Samples
from lcopa_bayes.inference.optimum import Optimum
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.weighted import BATCHES, Weighted

_PORTION = 256
"""Draws whose density is computed at once [-]."""
_NOTHING = Observed(np.empty(0, dtype=int), np.empty(0), np.empty(0))


def by_axis(
    posterior: Posterior,
    optima: Sequence[Optimum],
    sampled: Callable[[Posterior, Sequence[Optimum], int], tuple[Weighted | None, bool]],
    count: int,
    seed: int,
) -> tuple[Weighted, bool] | None:
    """Importance draws, `count` of each batch, and whether a budget ended any of them; None where axes share
    something, or one has no importance draws.

    Parameters: `optima` of the posterior, best first; `sampled` gives the same of a factor from its optima
    and a seed.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1_002,)))
    values = optima[0].values if optima else posterior.table.draw(1, rng)[0]
    factors, drawn, unfinished = separated(posterior, values), list[Weighted](), False
    for factor in factors:
        own, stopped = sampled(factor, of_factor(factor, posterior, optima), int(rng.integers(2**31)))
        if own is None:
            return None
        drawn.append(own)
        unfinished |= stopped
    if not factors:
        return None
    return joined(posterior, factors, drawn, count, rng), unfinished


def separated(posterior: Posterior, values: Vector) -> tuple[Posterior, ...]:
    """The factor of each response axis; none where axes share a parameter, or some are without samples.

    In each of them the parameters of the others are fixed at those of table `values`, (rows,), which it does
    not depend on, and their samples are left out.
    """
    table = posterior.table
    acting = [table.acting_on(k) for k in range(len(table.rows))]
    axes = range(len(table.layout.responses))
    shared = any(row.free and len(own) != 1 for row, own in zip(table.rows, acting, strict=True))
    seen = all(any(one.axes[axis].values.size for one in posterior.samples) for axis in axes)
    if posterior.simulation is not None or shared or not seen or len(axes) == 1:
        return ()
    out = []
    for axis in axes:
        rows = tuple(
            replace(row, prior=None, value=float(value)) if row.free and axis not in own else row
            for row, own, value in zip(table.rows, acting, values, strict=True)
        )
        samples = tuple(_of_axis(one, axis) for one in posterior.samples)
        out.append(replace(posterior, table=replace(table, rows=rows), samples=samples))
    return tuple(out)


def _of_axis(samples: Samples, axis: int) -> Samples:
    """Samples of one axis alone."""
    return replace(samples, axes=tuple(one if k == axis else _NOTHING for k, one in enumerate(samples.axes)))


def of_factor(factor: Posterior, whole: Posterior, optima: Sequence[Optimum]) -> list[Optimum]:
    """Optima of the whole posterior as those of a factor."""
    at = _columns(factor, whole)
    out = []
    for one in optima:
        fixed = np.array([row.value for row in factor.table.rows])
        values = np.where([row.free for row in factor.table.rows], one.values, fixed)
        log_density = float(factor.log_density(factor.coordinates(values[None]))[0])
        out.append(Optimum(values, one.covariance[np.ix_(at, at)], log_density))
    return out


def _columns(factor: Posterior, whole: Posterior) -> Index:
    """Sampled coordinates of the whole that a factor has, (dimension,)."""
    return np.array([whole.sampled.index(k) for k in factor.sampled], dtype=int)


def joined(
    whole: Posterior,
    factors: Sequence[Posterior],
    drawn: Sequence[Weighted],
    count: int,
    rng: np.random.Generator,
) -> Weighted:
    """Draws of the whole, `count` of each batch, from those of its factors.

    Every batch pairs resampled draws of the same batch of all factors. Accuracies are those of the factors.
    """
    coordinates = np.empty((BATCHES * count, whole.dimension))
    raw = np.zeros(BATCHES * count)
    columns = [_columns(factor, whole) for factor in factors]
    for one, own in zip(drawn, columns, strict=True):
        chosen = one.batches(count, rng)
        coordinates[:, own] = one.coordinates[chosen.ravel()]
        raw += np.repeat(one.batch_evidence, count)
    portions = np.array_split(coordinates, max(1, len(raw) // _PORTION))
    density = np.concatenate([whole.log_density(part) for part in portions])
    return Weighted.product(whole, coordinates, density, raw, tuple(zip(drawn, columns, strict=True)))
