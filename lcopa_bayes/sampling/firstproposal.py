"""The proposal that a search begins with, and the optima from which its points start."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from lcopa_bayes.core.arrays import Index, Matrix, Vector
from lcopa_bayes.core.parallel import Workers
from lcopa_bayes.inference.conditional import Conditional
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.optimum import Optimum, again, find_optima, nearly_white
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.importanceweights import tempered
from lcopa_bayes.sampling.mixture import Mixture
from lcopa_bayes.sampling.outer import Optima, Outer, PriorOrders
from lcopa_bayes.sampling.proposal import Blend, Product, Proposal, weighty

Done = Callable[[Optima, Matrix, Matrix | None], list[Matrix]]

_PILOT = 128
"""Points from the prior at which delays and noise are estimated."""
_PICKED, _HOPELESS = 16, 60.0
"""Points of the pilot that the first proposal is placed at, and by how much less likely others are omitted
[nat]."""
_SPREAD = 2.0
"""Width of the first proposal over that of the conditional posterior [-]."""
_OVERALL = 0.3
"""Share of the first proposal that spans all points picked [-]."""
_OPTIMA, _AGAIN, _STILL = 4, 4, 0.1
"""Further starts of the search for optima, most descents from those that have a mass, and change of the log
density that ends these [nat]."""
_AROUND, _WIDER = 0.3, 2.5
"""Share of the first proposal around optima, and widening of half of it [-]."""
NEIGHBOURS = 6
"""Nearest points among which that of the best optimum gives the start."""


def first_proposal(
    outer: Outer,
    rng: np.random.Generator,
    done: Done,
    crew: Workers[Posterior],
    known: Sequence[Optimum] = (),
) -> tuple[Product, Matrix, Sequence[Optimum]]:
    """A proposal from the prior of the orders and estimates of delays and noise, in part around
    least-squares optima; table values of points to start from; and these optima. `done` performs a task at
    table values from others, as the `crew` that shares the posterior does; `known` are optima that are
    known already."""
    posterior = outer.posterior
    values = nearly_white(posterior, posterior.table.draw(_PILOT, rng))
    pilot = Optima(pilot=True)
    values, objective, _ = done(pilot, values, None)
    if outer.orders.any():
        orders = outer.y(values)[:, outer.orders]
        begin = values[best_near(orders, orders, objective)]
        values, objective, _ = done(pilot, values, begin)
    rest: Mixture | None = None
    if not outer.orders.all():
        rest, chosen = _rest(outer, rng, done, values, objective)
        values = np.concatenate([values, chosen])
    optima: Sequence[Optimum] = weighty(
        [*known, *find_optima(posterior, rng, starts=_OPTIMA, near=list(values), crew=crew)]
    )
    for _ in range(_AGAIN):  # plant and correlated noise, found in turn, draw each other along
        before = [one.log_density for one in optima]
        optima = again(posterior, optima, crew)
        if np.allclose(sorted(before)[-len(optima) :], sorted(one.log_density for one in optima), 0, _STILL):
            break
    at = np.array([one.values for one in optima]).reshape(-1, values.shape[1])
    shapes = np.array([one.covariance[np.ix_(outer.places, outer.places)] for one in optima])
    parts = list[Proposal]()
    for group in outer.groups:
        others = np.flatnonzero(np.isin(np.flatnonzero(~outer.orders), group))
        own = rest.of(others) if rest is not None and others.size else None
        part: Proposal = PriorOrders(outer, group, own)
        if len(optima):
            inside = shapes[:, group[:, None], group]
            size = np.diagonal(inside, axis1=1, axis2=2)
            factors = np.asarray(
                np.linalg.cholesky(inside + 1e-9 * size[:, None, :] * np.eye(len(group))), dtype=float
            )
            equal = np.full(len(optima), 1 / len(optima))
            around = Mixture(equal, outer.y(at)[:, group], factors)
            wider = replace(around, factors=_WIDER * around.factors)
            part = Blend(part, around.blended(wider, 0.5), _AROUND)
        parts.append(part)
    return Product(outer.groups, tuple(parts)), np.concatenate([values, at]), optima


def _rest(
    outer: Outer, rng: np.random.Generator, done: Done, values: Matrix, objective: Vector
) -> tuple[Mixture, Matrix]:
    """Delays and noise estimated at some of the points of the pilot, and these points."""
    posterior = outer.posterior
    weights = tempered(objective, _PICKED)
    chosen = values[np.unique(rng.choice(len(values), _PICKED, p=weights))]
    for _ in range(2):
        chosen, noise = _with_noise(outer, chosen)
        chosen, reached, natural = done(Optima(pilot=True), chosen, chosen)
    good = np.isfinite(reached) & (reached >= reached.max() - _HOPELESS)
    chosen, noise, natural = chosen[good], noise[good], natural[good]
    own = ~outer.orders
    fitted = Conditional(posterior, delays=True).columns
    width = _SPREAD * np.column_stack(
        [
            natural[:, fitted.index(k)] if k in fitted else noise[:, column]
            for column, k in enumerate(outer.columns)
        ]
    )
    at, width = outer.y(chosen)[:, own], width[:, own]
    spread = np.hypot(at.std(axis=0), width.mean(axis=0))
    rest = Mixture(
        np.append(np.full(len(at), (1 - _OVERALL) / len(at)), _OVERALL),
        np.concatenate([at, at.mean(axis=0)[None]]),
        np.concatenate([[np.diag(one) for one in width], [np.diag(spread)]]),
    )
    return rest, chosen


def _with_noise(outer: Outer, values: Matrix) -> tuple[Matrix, Matrix]:
    """With noise fitted to each residual, and its widths in the sampled coordinates, (batch, size)."""
    posterior, out = outer.posterior, values.copy()
    widths, problem = np.zeros((len(values), len(outer.columns))), LeastSquares(posterior)
    every = posterior.complete(posterior.coordinates(out), None)
    for row, (one, full, fits) in enumerate(zip(out, every, problem.noise_fits_of(every), strict=True)):
        for axis, fit in enumerate(fits):
            where = [posterior.table.at(name, axis) for name in posterior.noise.names]
            if not fit.free:
                continue
            one[where] = fit.best(full[where])
            variance = np.diag(fit.covariance(one[where]))
            for k, size in zip(fit.free, variance, strict=True):
                widths[row, outer.columns.index(where[k])] = np.sqrt(size)
    return out, widths


def nearest(y: Matrix, known: Matrix, count: int) -> Index:
    """Positions of the nearest of some known points, (batch, count)."""
    scale = np.where(np.ptp(y, axis=0) > 0, y.std(axis=0), 1.0)
    near = cKDTree(known / scale).query(y / scale, k=min(count, len(known)))[1]
    return np.asarray(near).reshape(len(y), -1)


def best_near(y: Matrix, known: Matrix, objective: Vector) -> Index:
    """Position of the best among the nearest of some known points, (batch,)."""
    near = nearest(y, known, NEIGHBOURS)
    return np.asarray(near[np.arange(len(y)), np.argmax(objective[near], axis=1)])
