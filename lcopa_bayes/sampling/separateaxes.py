"""Posteriors of plants whose response axes share nothing: a product with a factor for each axis.

Where no element, delay, offset or noise parameter belongs to paths of two response axes, the joint posterior
of all axes is the product of theirs. Each is sampled by itself, in a fraction of the dimensions and by what
suits it, and independent draws of all of them are draws of the whole; log evidences add up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from lcopa_bayes.core.arrays import Index, Vector
from lcopa_bayes.inference.observations import Observed, Samples
from lcopa_bayes.inference.optimum import Optimum
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.coordinates import spread
from lcopa_bayes.sampling.ensemble import Ensemble
from lcopa_bayes.sampling.weighted import BATCHES, Weighted, resampled

_NOTHING = Observed(np.empty(0, dtype=int), np.empty(0), np.empty(0))


Drawn: TypeAlias = tuple[tuple[Ensemble, ...], Weighted | None]
"""Ensembles of a posterior, and importance draws, which stand for it where there are any."""


def by_axis(
    posterior: Posterior,
    optima: Sequence[Optimum],
    sampled: Callable[[Posterior, Sequence[Optimum], int, float], Drawn],
    count: int,
    seed: int,
) -> Drawn | None:
    """Draws of all axes: importance draws, `count` of each batch, where every axis has some, or ensembles;
    None where axes share something.

    Parameters: `optima` of the posterior, best first; `sampled` gives draws of a factor from its optima, a
    seed, and its share of the time that is left.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1_002,)))
    values = optima[0].values if optima else posterior.table.draw(1, rng)[0]
    factors = separated(posterior, values)
    if not factors:
        return None
    drawn, weighted = list[Drawn](), list[Weighted]()
    for number, factor in enumerate(factors):
        own, share = of_factor(factor, posterior, optima), 1 / (len(factors) - number)
        drawn.append(sampled(factor, own, int(rng.integers(2**31)), share))
        weighted += [one for one in drawn[-1][1:] if one is not None]
    if len(weighted) == len(factors):
        return (), joined(posterior, factors, weighted, count, rng)
    return side_by_side(posterior, factors, drawn, rng), None


def importance_by_axis(
    posterior: Posterior,
    optima: Sequence[Optimum],
    drawn: Callable[[Posterior, Sequence[Optimum], float], Weighted | None],
    count: int,
    rng: np.random.Generator,
) -> Weighted | None:
    """Importance draws from optima, one or more: `count` of each batch of all axes where these share nothing
    and `drawn` gives some of every factor, in its share of the time that is left; else what that gives of the
    whole."""
    factors, each = separated(posterior, optima[0].values), list[Weighted]()
    for number, factor in enumerate(factors):
        weighted = drawn(factor, of_factor(factor, posterior, optima), 1 / (len(factors) - number))
        if weighted is None:
            return None
        each.append(weighted)
    return joined(posterior, factors, each, count, rng) if factors else drawn(posterior, optima, 1.0)


def separated(posterior: Posterior, values: Vector) -> tuple[Posterior, ...]:
    """The factor of each response axis; none where axes share a parameter, or some are without samples.

    In each of them the parameters of the others are fixed at those of table `values`, (rows,), which it does
    not depend on, and their samples are left out, as are their responses.
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
        model = replace(posterior.model, axis=axis)
        out.append(replace(posterior, table=replace(table, rows=rows), samples=samples, model=model))
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
    density = spread(whole, coordinates, map)
    return Weighted.product(whole, coordinates, density, raw, tuple(zip(drawn, columns, strict=True)))


def side_by_side(
    whole: Posterior, factors: Sequence[Posterior], drawn: Sequence[Drawn], rng: np.random.Generator
) -> tuple[Ensemble, ...]:
    """Ensembles of the whole: walkers of independent factors side by side are walkers of their product.

    Importance draws of a factor take the places of walkers that stay so long at each of them that they are
    worth no more than before.
    """
    held = [ensembles for ensembles, weighted in drawn if weighted is None]
    length, walkers = (min(one.chain.shape[k] for own in held for one in own) for k in (0, 1))
    out = []
    for number, alike in enumerate(zip(*held, strict=True)):
        chain = np.empty((length, walkers, whole.dimension))
        for factor, (ensembles, weighted) in zip(factors, drawn, strict=True):
            if weighted is None:
                own = ensembles[number].chain[-length:, :walkers]
            else:
                part = weighted.parts[number % BATCHES]
                stays = int(np.clip(weighted.smallest_ess / BATCHES / walkers, 1, length))
                chosen = resampled(weighted.log_weights[part], stays * walkers, rng).reshape(stays, walkers)
                own = weighted.coordinates[part.start + chosen[np.arange(length) * stays // length]]
            chain[..., _columns(factor, whole)] = own
        density = spread(whole, chain.reshape(-1, whole.dimension), map).reshape(length, walkers)
        accepted = np.full(walkers, length * float(np.mean([one.acceptance for one in alike])))
        joint = replace(alike[0], chain=chain, log_density=density, accepted=accepted, trail=chain[-1])
        longest = max(one.tempering_moves for one in alike)
        last = replace(joint, position=chain[-1], position_log_density=density[-1], tempering_moves=longest)
        out.append(replace(last, near=any(one.near for one in alike)))
    return tuple(out)
