"""Least squares from many starts: the modes of the posterior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.covariance import covariance_of
from lcopa_bayes.core.crew import ALONE
from lcopa_bayes.core.parallel import Workers
from lcopa_bayes.inference.effectstarts import effect_starts
from lcopa_bayes.inference.halfperiods import half_a_period_away
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.inference.pathstarts import beside_each_other
from lcopa_bayes.inference.plantdescents import PlantDescents
from lcopa_bayes.inference.poles import regressed
from lcopa_bayes.inference.posterior import Posterior, portions
from lcopa_bayes.inference.precision import refuse_unresolved
from lcopa_bayes.inference.spareterms import beside_spare_terms
from lcopa_bayes.model.effects.effect import UnstableError

_AT_ONCE = 8
"""Starts of a plant without effects that are descended from together, whatever the number of workers [-]."""
_SCREENED, _FEWER = 1024, 512
"""Prior draws whose misfit is looked at, and of them beside starts that are known."""
_FURTHER_STARTS = 2
"""Most starts of several paths by draws beside each other, and by poles of a regression however unlikely
these are, each half as many as of draws [-]: few descents from draws end in a resonance."""
_SAME = 1e-2
"""Optima closer than this in every sampled coordinate are one [natural log, or sd of the prior]."""
_WEIGHTLESS = 30.0
"""Log density below the best from which an optimum has no weight [nat]."""
_HOPELESS = 300.0
"""The same of a start that slopes of the plant alone led to, which end some nats below the optimum [nat]."""
_DISTINCT = 0.5
"""Starts closer than this in every sampled coordinate count as one [natural log, or sd of the prior]."""
_DESCENT, _LAST = ((15, 1e-2), (60, 1e-4)), (200, 1e-8)
"""Most responses of each round of a descent, and relative gain of the sum of squares that ends it [-]; of the
last one, which the best optimum alone has: what a start leads to shows long before its digits do."""
_BESIDE_START = 2.0
"""Move of an optimum up to which it has the slopes of where a descent to it began [linearised sd]."""
_FIRST, _FURTHER, _FINE = 1.5, 1.5, 1e-3
"""First step along an order [linearised sd], factor from one to the next [-], and least distance of an order
from the ends of its prior, and sd [-]."""
_SHORTER, _LEAST_FIRST = 0.25, 0.1
"""Factor on a first step that leads too far down, and least of it that is tried [-]."""
_SWINGS = 4
"""Half periods by which delays of a plant that rings are moved, at most [-]."""
_SECTION, _WITHIN = (15, 1e-4), 10.0
"""Limits of a descent at a held order, as of `_DESCENT`, and log density below the best that ends them [nat].
"""


@final
@dataclass(frozen=True, eq=False)
class Optimum:
    """A local least-squares solution."""

    values: Vector
    """Canonical table values, noise parameters estimated from the residual, (rows,)."""
    covariance: Matrix
    """Linearised covariance of the sampled coordinates, (dimension, dimension)."""
    log_density: float
    """Log posterior density of the sampled coordinates there [nat]."""


def find_optima(
    posterior: Posterior,
    rng: np.random.Generator,
    *,
    starts: int = 12,
    near: Sequence[Vector] = (),
    crew: Workers[Posterior] | None = None,
) -> tuple[Optimum, ...]:
    """Local optima from the best of many prior draws and of poles from a regression, best first, duplicates
    removed; the likeliest of further table values `near`, (rows,), is a start of its own. A `crew` that
    shares the posterior screens draws and descends from several starts at once.

    Screening and a first solve treat the residual as nearly white; a second solve uses the noise model with
    its parameters estimated from the first residual. With effects the plant alone is searched first, and its
    best optima are the starts (`with_effects`). InputError where no plant is likely enough for numbers of
    double precision (`precision`).
    """
    table = posterior.table
    if posterior.simulation is not None:
        alone = find_optima(posterior.without_effects, rng, starts=starts)
        return optima_near(posterior, effect_starts(posterior, [one.values for one in alone], rng))
    drawn = table.draw(_FEWER if len(near) else _SCREENED, rng)
    poles = regressed(posterior, drawn)
    # parameters that only another noise model has are not estimated: they stay, perhaps outside their prior
    noise = np.array([row.free and row.noise for row in table.rows])
    near = [np.where(noise, drawn[0], values) for values in near]
    drawn = nearly_white(posterior, np.vstack([poles, drawn, *near]))
    crew = crew or ALONE.sharing(posterior)
    each = _screened(crew, drawn)
    likelihood = each.sum(axis=0)
    if np.isnan(likelihood).any():
        posterior.log_density(posterior.coordinates(drawn[np.isnan(likelihood)]))  # raises and says where
    own = len(drawn) - len(near)
    ranked = _ranked(table, drawn[:own], each[:, :own])
    begun = _distinct(posterior, ranked, starts)
    count = min(_FURTHER_STARTS, max(1, starts // 2))
    likely = drawn[: len(poles)][np.argsort(-likelihood[: len(poles)], kind="stable")]
    further = [_of_several_paths(posterior, one, starts, crew)[:count] for one in (ranked, likely)]
    begun = _distinct(posterior, np.vstack([*begun, *further]), starts + 2 * count)
    if len(near):
        begun.append(drawn[own + int(likelihood[own:].argmax())])
    found = _recombined(posterior, _kept(posterior, _descended(posterior, begun, crew=crew)))
    if found:
        refuse_unresolved(posterior, found[0].values, found[0].log_density)
    spare = beside_spare_terms(posterior, np.array(_weighty(found))) if found else []
    if spare:
        found = _kept(posterior, [*found, *_descended(posterior, spare, crew=crew)])
        found = _recombined(posterior, found)
    return _to_its_digits(posterior, _beside_half_periods(posterior, found, crew))


def _beside_half_periods(
    posterior: Posterior, found: tuple[Optimum, ...], crew: Workers[Posterior]
) -> tuple[Optimum, ...]:
    """Optima with those half a period from the best, as long as one of these is better."""
    for _ in range(_SWINGS if found else 0):
        beside = half_a_period_away(posterior, found[0].values)
        if not beside:
            break
        best = found[0].log_density
        found = _kept(posterior, [*found, *_descended(posterior, beside, crew=crew)])
        if found[0].log_density <= best:
            break
        found = _recombined(posterior, found)
    return found


def _screened(crew: Workers[Posterior], values: Matrix) -> Matrix:
    """Log likelihoods of table values, (axes, batch), by a crew that shares the posterior."""
    return np.concatenate(list(crew.each(Posterior.log_likelihoods, portions(values))), axis=1)


def _of_several_paths(posterior: Posterior, drawn: Matrix, starts: int, crew: Workers[Posterior]) -> Matrix:
    """Starts in which paths have draws of their own, likeliest first; none where all share."""
    found = beside_each_other(posterior, drawn, starts)
    return _ranked(posterior.table, found, _screened(crew, found)) if len(found) else found


def _ranked(table: ParameterTable, values: Matrix, likelihoods: Matrix) -> Matrix:
    """Table values, (batch, rows), likeliest first, from log likelihoods of each response, (axes, batch).

    Responses that share no free parameter are ranked apart, and the k-th of each stand together: no draw of
    the paths of all of them is as likely as that.
    """
    out, groups = values.copy(), list[set[int]]()
    acting = [set(table.acting_on(k)) for k in range(len(table.rows))]
    for own, row in zip(acting, table.rows, strict=True):
        if row.free and own:
            groups = [own.union(*(g for g in groups if g & own)), *(g for g in groups if not g & own)]
    for group in groups:
        order = np.argsort(-likelihoods[sorted(group)].sum(axis=0), kind="stable")
        rows = [k for k, own in enumerate(acting) if own & group]
        out[:, rows] = values[order][:, rows]
    return out


def _recombined(posterior: Posterior, found: tuple[Optimum, ...]) -> tuple[Optimum, ...]:
    """Optima with the one that has the best of them in every response, where the best of all has not."""
    if len(found) < 2:
        return found
    values = np.stack([one.values for one in found])
    best = _ranked(posterior.table, values, posterior.log_likelihoods(values))[0]
    if min(_apart(posterior, best, one) for one in values) < _SAME:
        return found
    return _kept(posterior, [*found, *_descended(posterior, [best])])


def again(
    posterior: Posterior,
    optima: Sequence[Optimum],
    crew: Workers[Posterior] | None = None,
    *,
    begun: bool = False,
) -> tuple[Optimum, ...]:
    """Optima of a posterior that hardly differs from the one whose `optima` are given, as on other blocks;
    without those of no weight. `begun` as `LeastSquares`."""
    found = _kept(posterior, _descended(posterior, _weighty(optima), rounds=1, crew=crew, begun=begun))
    return _to_its_digits(posterior, found)


def _weighty(optima: Sequence[Optimum]) -> list[Vector]:
    """Table values of optima that have a weight beside the best."""
    best = max((one.log_density for one in optima), default=0.0)
    return [one.values for one in optima if best - one.log_density < _WEIGHTLESS]


def along_orders(posterior: Posterior, best: Optimum) -> list[Optimum]:
    """Optima of everything else where one order after another is held, ever further to both sides of the
    best one: a posterior that is curved along its orders has long arms, which a Gaussian at its optimum does
    not reach. They end at the prior's, or where hardly a posterior mass is beyond."""
    problem, out = LeastSquares(posterior), list[Optimum]()
    for position, k in enumerate(posterior.sampled):
        row = posterior.table.rows[k]
        low, high = row.sampled_domain
        first = _FIRST * max(float(np.sqrt(best.covariance[position, position])), _FINE)
        for side in (1.0, -1.0) if row.kind == "order" else ():
            values, z, step, begun = best.values, float(row.coordinate(best.values[k])), side * first, False
            while low + _FINE < z + step < high - _FINE:
                there = _held_at(posterior, problem, k, float(row.value_at(z + step)), values)
                if there is not None and best.log_density - there.log_density < _WITHIN:
                    values, z, step, begun = there.values, z + step, _FURTHER * step, True
                    out.append(there)
                elif begun or abs(step) < _LEAST_FIRST * first:
                    break
                else:
                    step *= _SHORTER
    return out


def _held_at(
    posterior: Posterior, problem: LeastSquares, k: int, value: float, values: Vector
) -> Optimum | None:
    """Optimum of everything beside table row `k`; None without room between the orders beside it."""
    rows, start = list(posterior.table.rows), values.copy()
    rows[k], start[k] = replace(rows[k], prior=None, value=value), value
    held = LeastSquares(replace(posterior, table=replace(posterior.table, rows=tuple(rows))))
    if not np.less(*held.bounds_around(start)).all():
        return None
    reached = held.solve(start, evaluations=_SECTION[0], enough=_SECTION[1])[0]
    there = posterior.table.canonical(problem.with_noise(reached)[None])[0]
    return _describe(posterior, problem, there)


def known_optimum(posterior: Posterior, values: Vector) -> Optimum | None:
    """The optimum that table values, (rows,), are known to be, with noise fitted to its residual; None where
    they have no density. What lies beyond an end of its prior is at that end."""
    problem = LeastSquares(posterior)
    inside = np.clip(problem.coordinates(values), *problem.bounds_around(values))
    values = posterior.table.canonical(problem.values(inside, values)[None])[0]
    values = posterior.complete(posterior.coordinates(values[None]), None)[0]
    try:
        there = _describe(posterior, problem, problem.with_noise(values))
    except UnstableError:
        return None
    return there if np.isfinite(there.log_density) else None


def optima_near(posterior: Posterior, starts: Sequence[Vector]) -> tuple[Optimum, ...]:
    """Optima of a posterior that table values `starts`, (rows,) each, lead to, best first, duplicates
    removed; with effects from where slopes of the plant alone lead (`_near`)."""
    near = starts if posterior.simulation is None else _near(posterior, starts)
    return _kept(posterior, _descended(posterior, near))


def _near(posterior: Posterior, starts: Sequence[Vector]) -> list[Vector]:
    """Table values to which effects and plant descend by slopes of the plant alone, fifty times cheaper than
    those with the effects in place; duplicates removed, and those far below the best."""
    rough, kept = LeastSquares(posterior, exact=False), list[Vector]()
    for start in starts:
        values = posterior.complete(posterior.coordinates(start[None]), None)[0]
        try:
            values = rough.with_noise(rough.solve(values)[0])
        except UnstableError:
            continue
        if all(_apart(posterior, values, other) > _SAME for other in kept):
            kept.append(values)
    density = [float(posterior.log_density(posterior.coordinates(v[None]))[0]) for v in kept]
    best = max(density, default=0.0)
    return [v for v, level in zip(kept, density, strict=True) if level >= best - _HOPELESS]


def _descended(
    posterior: Posterior,
    starts: Sequence[Vector],
    *,
    rounds: int = 2,
    crew: Workers[Posterior] | None = None,
    begun: bool = False,
) -> list[Optimum]:
    """Optima from table values; a start from which effects leave no bounded response gives none."""
    problem, reached = LeastSquares(posterior), list[tuple[Vector, Matrix | None]]()
    crew = crew or ALONE.sharing(posterior)
    if posterior.simulation is None:
        groups = np.array_split(starts, -(-len(starts) // _AT_ONCE)) if len(starts) else []
        together = crew.each(partial(_together, rounds), groups)
        reached += [(values, None) for ends in together for values in ends]
    else:
        alone = crew.each(partial(_descent, rounds, begun), starts)
        reached += [end for end in alone if end is not None]
    return [_describe(posterior, problem, values, jacobian) for values, jacobian in reached]


def _to_its_digits(posterior: Posterior, found: tuple[Optimum, ...]) -> tuple[Optimum, ...]:
    """Optima, the best of them to its digits where it has no effects."""
    if not found or posterior.simulation is not None:
        return found
    problem, (evaluations, enough) = LeastSquares(posterior), _LAST
    values = problem.solve(found[0].values, evaluations=evaluations, enough=enough)[0]
    best = _describe(posterior, problem, problem.with_noise(values))
    return _kept(posterior, [best, *found[1:]])


def _together(rounds: int, posterior: Posterior, values: Matrix) -> Matrix:
    """Table values where descents of a plant without effects from others end, (batch, rows)."""
    problem, descents = LeastSquares(posterior), PlantDescents(posterior)
    values = posterior.complete(posterior.coordinates(values), None)
    for steps, enough in _DESCENT[-rounds:]:
        values = descents.solve(values, steps=steps, enough=enough)
        values = problem.with_noise_of(posterior.complete(posterior.coordinates(values), None))
    return values


def _descent(
    rounds: int, begun: bool, posterior: Posterior, values: Vector
) -> tuple[Vector, Matrix | None] | None:
    """Table values where a descent with effects from others ends, and the slopes that it began with if these
    hold there; None where there is no bounded response."""
    problem = LeastSquares(posterior, begun=begun)
    values = posterior.complete(posterior.coordinates(values[None]), None)[0]
    try:
        for evaluations, enough in _DESCENT[-rounds:]:
            start = problem.coordinates(values)
            values, slopes = problem.solve(values, evaluations=evaluations, enough=enough)
            values = problem.with_noise(values)
    except UnstableError:
        return None
    moved = float(np.linalg.norm(slopes @ (problem.coordinates(values) - start)))
    return values, slopes if begun and moved < _BESIDE_START else None


def _kept(posterior: Posterior, optima: list[Optimum]) -> tuple[Optimum, ...]:
    """Optima of positive density, best first, duplicates removed."""
    optima.sort(key=lambda optimum: -optimum.log_density)
    kept: list[Optimum] = []
    for optimum in optima:
        alone = all(_apart(posterior, optimum.values, other.values) >= _SAME for other in kept)
        if np.isfinite(optimum.log_density) and alone:
            kept.append(optimum)
    return tuple(kept)


def _apart(posterior: Posterior, one: Vector, other: Vector) -> float:
    """Largest difference between table values in a sampled coordinate [natural log, or sd of the prior]."""
    first, second = posterior.coordinates(np.stack((one, other)))
    sizes = [posterior.table.rows[k].breadth for k in posterior.sampled]
    return float((np.abs(first - second) / np.array(sizes)).max(initial=0.0))


def nearly_white(posterior: Posterior, values: Matrix) -> Matrix:
    """Table values (batch, rows) with nearly white noise of a twentieth of the responses' standard deviation
    where the noise is free."""
    table, out = posterior.table, values.copy()
    for axis in range(len(table.layout.responses)):
        pooled = np.concatenate([one.axes[axis].values for one in posterior.samples])
        spread = (float(pooled.std()) if pooled.size else 0.0) or 1.0
        for name, value in posterior.noise.nearly_white(0.05 * spread).items():
            if table.rows[table.at(name, axis)].free:
                out[:, table.at(name, axis)] = value
    return out


def _distinct(posterior: Posterior, ranked: Matrix, count: int) -> list[Vector]:
    """The first `count` rows that differ from each other."""
    kept: list[Vector] = []
    for values in ranked:
        if all(_apart(posterior, values, other) > _DISTINCT for other in kept):
            kept.append(values)
        if len(kept) == count:
            break
    return kept


def _describe(
    posterior: Posterior, problem: LeastSquares, values: Vector, jacobian: Matrix | None = None
) -> Optimum:
    """Optimum with the covariance of the sampled coordinates: the plant's at this noise, the noise's at this
    plant; with other slopes than those there where they are given."""
    if jacobian is None:
        _, jacobian = problem.residual(problem.coordinates(values), values)
    coordinates = posterior.coordinates(values[None])
    information = jacobian.T @ jacobian + np.diag(problem.prior_precision)
    blocks = [(problem.columns, covariance_of(information))]
    for axis, fit in enumerate(problem.noise_fits(values)):
        where = [posterior.table.at(name, axis) for name in posterior.noise.names]
        if fit.free:
            blocks.append(([where[k] for k in fit.free], fit.covariance(values[where])))
    covariance = np.zeros((posterior.dimension, posterior.dimension))
    for columns, block in blocks:
        shared = [k for k in columns if k in posterior.sampled]
        inside = [columns.index(k) for k in shared]
        at = [posterior.sampled.index(k) for k in shared]
        covariance[np.ix_(at, at)] = block[np.ix_(inside, inside)]
    return Optimum(values, covariance, float(posterior.log_density(coordinates)[0]))
