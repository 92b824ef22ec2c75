"""Importance sampling over orders, delays and noise, the rest of a plant integrated out at each point.

What makes such posteriors hard are the orders: along them a response hardly changes while times and gains
follow, and a narrow mode may hold a tenth of the mass. Given them the rest is nearly Gaussian
(`conditional`), so that only orders, delays and noise are searched. Points from their prior, each with
the optimum of the rest, give a map of the marginal posterior that omits no region; a mixture fitted to the
weighted points is the next proposal, and so on (Cornuet, Marin, Mira and Robert 2012, Scand. J. Statist. 39).
Draws of a last proposal, which knows nothing of them, give the result: their weights are those of whole
parameter sets, exact whatever the approximations that led to the proposal. It is the last one once it covers
all points that were ever seen, and none of its draws is taken away, however many are needed: to stop where
draws look good would take a mode that was not met for none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import ceil
from typing import NamedTuple, final

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import logsumexp

from lcopa_bayes.core.arrays import Index, Matrix, Vector
from lcopa_bayes.core.parallel import Progress, Workers
from lcopa_bayes.inference.conditional import Conditional
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.optimum import Optimum, again, find_optima
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.ensemble import Ensemble, advance
from lcopa_bayes.sampling.importanceweights import effective, usable_k
from lcopa_bayes.sampling.mixture import Mixture, spread_evenly
from lcopa_bayes.sampling.mixturemoves import learned
from lcopa_bayes.sampling.outer import Draw, Optima, Outer, PriorOrders
from lcopa_bayes.sampling.proposal import (
    Blend,
    Proposal,
    Seen,
    adapted,
    clustered,
    paraboloid,
    tempered,
    weighty,
)
from lcopa_bayes.sampling.weighted import Weighted, resampled

_PILOT = 128
"""Points from the prior at which delays and noise are estimated."""
_NEIGHBOURS = 6
"""Nearest points among which that of the best optimum gives the start."""
_PICKED, _HOPELESS = 16, 60.0
"""Points of the pilot that the first proposal is placed at, and by how much less likely others are omitted
[nat]."""
_SPREAD = 2.0
"""Width of the first proposal over that of the conditional posterior [-]."""
_OVERALL = 0.3
"""Share of the first proposal that spans all points picked [-]."""
_LEARNING = 768
"""Points of a round that improves the proposal."""
_TRIES = (64, 256)
"""Draws of the rest per point, least and most: more where few of them count."""
_EFFECTIVE_TRIES = 5.0
"""Effective draws among them that are aimed at."""
_OPTIMA, _AGAIN = 2, 4
"""Starts of the search for optima, and descents from those that have a mass."""
_AROUND, _WIDER = 0.3, 2.5
"""Share of the first proposal around optima, and widening of half of it [-]."""
_ROUNDS, _FAILURES = 18, 3
"""Most rounds that improve the proposal, and most times that draws of it do not give what is wanted."""
_HELPFUL = 0.1
"""Effective draws per draw, by the last round and by all points, from which a proposal is the last [-]."""
_FEW, _SINGLE = 20.0, (0.2, 0.6)
"""Effective draws of all points below which these say little of the shape of a posterior, and share of a
single normal mode where they are more and fewer [-]."""
_FIRST, _WALKED = 0.1, 0.3
"""Shares of the first proposal in all others, and of where walkers went in the last one [-]."""
_MOST = 24.0
"""Most draws of the last proposal over the effective draws wanted [-]."""
_VISITED = 6_000
"""Most points that a first proposal is learned from."""
_TEACHING, _WALKERS, _WALK = 3_000, 128, (20, 5)
"""Draws that the moves of walkers are learned from, walkers, and draws kept of each and steps per draw."""
_LOOKED_AT, _HEAVIER = 1_000, 1.5
"""Points of theirs that are weighted, and factor on the expected mean weight that shows a missed region."""
_POPULATION = 50.0
"""Effective draws of all points at which ensembles may start from them."""
_SPARE = 1.15
"""Factor on the estimated number of draws needed [-]."""
_TASK = 64
"""Points of a task."""


@final
class _Point(NamedTuple):
    """What is known at each of a batch of points."""

    y: Matrix
    """Sampled coordinates of orders, delays and noise."""
    values: Matrix
    """Table values of the optimum there."""
    objective: Vector
    """Of the optimum [nat]."""
    coordinates: Matrix
    """Sampled coordinates of the draw kept; NaN without one."""
    log_density: Vector
    """Log posterior density of the draw [nat]."""
    log_marginal: Vector
    """Log of prior times likelihood, the rest integrated out, estimated [nat]; -inf without a draw."""
    efficiency: Vector
    """Effective share of the draws tried [-]."""


@final
class Search:
    """Points, proposals and weights of a search; deterministic given its arguments and what it is asked.

    `bar` counts points and names what is being done; `optima` are least-squares optima to begin with, by
    default those of a few searches. Once it is `late` a search ends with the draws it has.
    """

    def __init__(
        self,
        posterior: Posterior,
        seed: int,
        crew: Workers[Posterior],
        bar: Progress,
        optima: Sequence[Optimum] = (),
        late: Callable[[], bool] = lambda: False,
    ) -> None:
        self.posterior = posterior
        self._late = late
        self._optima = tuple(optima)
        self._bar = bar
        self.outer = Outer(posterior)
        self._crew = crew
        self._seeds = np.random.SeedSequence(seed, spawn_key=(7_000,))
        self._rng = np.random.default_rng(self._seeds.spawn(1)[0])
        self._seen = Seen()
        self._points: list[_Point] = []

    def run(self, wanted: float) -> Weighted | None:
        """Weighted draws equivalent to `wanted` independent ones for the centre, the tails and the shares of
        modes of every sampled parameter, from a search of the whole prior; None where no number of draws in
        reach gives them: ensembles may then start from the `population`."""
        return self._improved(*self._first(), wanted)

    def around(self, z: Matrix, wanted: float) -> Weighted | None:
        """The same from points (n, dimension) of the sampled coordinates where ensembles have been."""
        values = self.posterior.values(spread_evenly(z, _VISITED))
        y = self.outer.y(values)
        proposal = clustered(y, np.zeros(len(y)), int(self._rng.integers(2**31)))
        return self._improved(proposal, values, wanted)

    def population(self, parts: int, count: int) -> list[tuple[Matrix, Vector]]:
        """Draws of equal weight and their log densities, `count` from each of so many independent parts of
        all points; none where few of them have any weight."""
        weights: Vector = self._seen.log_weights() if self._points else np.empty(0)
        if not np.isfinite(weights).any() or effective(weights - logsumexp(weights)) < _POPULATION:
            return []
        z = np.concatenate([point.coordinates for point in self._points])
        density, out = np.concatenate([point.log_density for point in self._points]), []
        for part in range(parts):
            own = np.arange(part, len(weights), parts)
            own = own[np.isfinite(weights[own])]
            chosen = own[resampled(weights[own], count, self._rng)]
            out.append((z[chosen], density[chosen]))
        return out

    def _improved(self, first: Proposal, starts: Matrix, wanted: float) -> Weighted | None:
        """The same from a first proposal, whose points begin at the nearest of the table values `starts`."""
        proposal, count, failed = first, _LEARNING * self._difficulty, 0
        for number in range(_ROUNDS):
            if self._late():
                return None
            self._bar.set_description(f"searching for modes, round {number + 1}")
            own = self._round(proposal, count, starts if number == 0 else None)
            log_weights = self._seen.log_weights() if own is not None else np.empty(0)
            if own is None or not np.isfinite(log_weights).any():
                return None
            proposal = self._adapted(first, log_weights)
            share = self._seen.efficiency(proposal, log_weights)
            if min(own.ess / count, share) >= _HELPFUL:
                weighted = self._last(proposal, log_weights, share, wanted)
                if weighted is not None:
                    return weighted
                failed += 1
                if failed == _FAILURES:
                    return None
                proposal = self._adapted(first, self._seen.log_weights())
            count = _LEARNING
        return None

    @property
    def _difficulty(self) -> int:
        """Orders that a first round explores, at most three [-]."""
        orders = int(np.count_nonzero(self.outer.orders))
        return orders if 1 <= orders <= 3 else 1

    def _adapted(self, first: Proposal, log_weights: Vector) -> Proposal:
        """A proposal fitted to all points, in part the first one: what it reached stays in reach."""
        y, density = (np.concatenate(each) for each in (self._seen.points, self._seen.log_densities))
        own, single = adapted(y, log_weights, int(self._rng.integers(2**31))), paraboloid(y, density)
        if single is not None:
            few = effective(log_weights - logsumexp(log_weights)) < _FEW
            own = own.blended(single, _SINGLE[int(few)])
        return Blend(own, first, _FIRST)

    def _last(self, proposal: Proposal, log_weights: Vector, share: float, wanted: float) -> Weighted | None:
        """Draws of a proposal that knows nothing of them, as many as are needed; None where these are too
        many, or walkers go where it hardly draws from."""
        self._bar.set_description("looking for missed modes")
        walked = self._walked(log_weights)
        self._bar.set_description("drawing from the posterior")
        y = spread_evenly(walked, _VISITED)
        visited = clustered(y, np.zeros(len(y)), int(self._rng.integers(2**31)))
        proposal, before, count = Blend(proposal, visited, _WALKED), len(self._points), 0
        needed = _SPARE * wanted / share
        while count < needed <= _MOST * wanted:
            # an error that few draws tell is taken larger, so that what is needed falls as they come
            more = max(_LEARNING, ceil(min(needed, 2 * count) if count else needed) - count)
            if self._round(proposal, more, None) is None:
                return None
            count += more
            weighted = self._weighted(self._points[before:], proposal, count)
            worth = weighted.smallest_ess(self._rng) if weighted.ess > 2.0 else 0.0
            enough = worth >= wanted or (self._late() and worth >= _FEW)
            if enough and weighted.pareto_k <= usable_k(count):
                return None if self._misses(proposal, weighted, walked) else weighted
            needed = max(_SPARE * count * wanted / max(worth, 1.0), count + 1.0)
        return None

    def _round(self, proposal: Proposal, count: int, starts: Matrix | None) -> Weighted | None:
        """Draws of a proposal with their weights; None where hardly any lies inside the prior."""
        y = proposal.draw(count, self._rng)
        values = self.outer.values(y)
        # a point whose orders do not decrease is another's, which has its own density
        usable = self.outer.inside(values) & np.isclose(self.outer.y(values), y).all(axis=1)
        if np.count_nonzero(usable) < _NEIGHBOURS:
            return None
        point = self._evaluated(y[usable], values[usable], starts)
        self._points.append(point)
        self._seen = self._seen.joined(proposal, count, point.y, point.log_marginal)
        return self._weighted([point], proposal, count)

    def _weighted(self, points: Sequence[_Point], proposal: Proposal, count: int) -> Weighted:
        """Points as draws of a proposal, out of `count`."""
        z = np.concatenate([one.coordinates for one in points])
        density = np.concatenate([one.log_density for one in points])
        raw = np.concatenate([one.log_marginal - proposal.log_density(one.y) for one in points])
        exists = np.isfinite(raw)
        return Weighted.of(self.posterior, z[exists], density[exists], raw[exists], count, smooth=False)

    def _walked(self, log_weights: Vector) -> Matrix:
        """Where emcee goes from draws of equal weight, (points, size): into what no draw has met."""
        known = np.concatenate([point.coordinates for point in self._points])
        z = known[resampled(log_weights, _TEACHING, self._rng)]
        mixture = learned(self.posterior, [z[None]], int(self._rng.integers(2**31)))
        walkers = max(_WALKERS, 2 * self.posterior.dimension + 2)
        seed = np.random.SeedSequence(int(self._rng.integers(2**31)))
        begin = Ensemble.started(z[:walkers], self.posterior.log_density(z[:walkers]), z, seed)
        chain = advance(self.posterior, begin, *_WALK, mixture).chain
        visited = chain[len(chain) // 2 :].reshape(-1, z.shape[1])
        return self.outer.y(self.posterior.values(visited))

    def _misses(self, proposal: Proposal, weighted: Weighted, walked: Matrix) -> bool:
        """Whether the mean weight of points that walkers went to is larger than the draws' own weights say: a
        region that the proposal hardly draws from shows in no weight of its draws."""
        y = spread_evenly(walked, _LOOKED_AT)
        raw = self._evaluated(y, self.outer.values(y), None).log_marginal - proposal.log_density(y)
        mean = float(logsumexp(raw) - np.log(len(y)) - weighted.log_evidence)
        return bool(mean > np.log(_HEAVIER * weighted.count / weighted.ess))

    def _evaluated(self, y: Matrix, values: Matrix, starts: Matrix | None) -> _Point:
        """Optima and draws at points; the first of a search twice, the second time from their neighbours."""
        if starts is None:
            known = np.concatenate([point.y for point in self._points])
            optima = np.concatenate([point.values for point in self._points])
            objective = np.concatenate([point.objective for point in self._points])
            begin = optima[_best_near(y, known, objective)]
        else:
            begin = starts[_nearest(y, self.outer.y(starts), 1)[:, 0]]
            begin, objective, _ = self._done(Optima(), values, begin)
            begin = begin[_best_near(y, y, objective)]
        efficiency = [float(np.median(point.efficiency)) for point in self._points[-1:]]
        tries = int(np.clip(_EFFECTIVE_TRIES / max(*efficiency, 1e-3), *_TRIES)) if efficiency else _TRIES[0]
        optimum, level, z, density, marginal, share = self._done(Draw(tries), values, begin)
        marginal += self.posterior.table.log_permutations
        return _Point(y, optimum, level, z, density, marginal, share)

    def _done(self, task: Optima | Draw, values: Matrix, starts: Matrix | None) -> list[Matrix]:
        """A task for all points, by the workers."""
        count = max(1, ceil(len(values) / _TASK))
        begins: Sequence[Matrix | None] = [None] * count if starts is None else np.array_split(starts, count)
        tasks = zip(np.array_split(values, count), begins, self._seeds.spawn(count), strict=True)
        parts = []
        for part in self._crew.each(task, list(tasks)):  # type: ignore[arg-type]
            parts.append(part)
            self._bar.update(len(part[0]))
        return [np.concatenate(each) for each in zip(*parts, strict=True)]

    def _first(self) -> tuple[Proposal, Matrix]:
        """A proposal from the prior of the orders and estimates of delays and noise; optima to start from."""
        outer, posterior = self.outer, self.posterior
        values = self._nearly_white(posterior.table.draw(_PILOT, self._rng))
        pilot = Optima(pilot=True)
        values, objective, _ = self._done(pilot, values, None)
        if outer.orders.any():
            orders = outer.y(values)[:, outer.orders]
            begin = values[_best_near(orders, orders, objective)]
            values, objective, _ = self._done(pilot, values, begin)
        if outer.orders.all():
            return self._with_optima(PriorOrders(outer, None), values)
        weights = tempered(objective, _PICKED)
        chosen = values[np.unique(self._rng.choice(len(values), _PICKED, p=weights))]
        for _ in range(2):
            chosen, noise = self._with_noise(chosen)
            chosen, reached, natural = self._done(pilot, chosen, chosen)
        good = reached > reached.max() - _HOPELESS
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
        return self._with_optima(
            PriorOrders(outer, rest) if outer.orders.any() else rest, np.concatenate([values, chosen])
        )

    def _with_optima(self, proposal: Proposal, values: Matrix) -> tuple[Proposal, Matrix]:
        """A proposal, in part around least-squares optima, and points to start from with these."""
        optima: Sequence[Optimum] = weighty(
            self._optima or find_optima(self.posterior, self._rng, starts=_OPTIMA)
        )
        if not optima:
            return proposal, values
        for _ in range(_AGAIN):  # plant and correlated noise, found in turn, draw each other along
            optima = again(self.posterior, optima)
        places = self.outer.places
        shapes = [one.covariance[np.ix_(places, places)] for one in optima]
        factors = [np.linalg.cholesky(one + 1e-9 * np.diag(np.diag(one))) for one in shapes]
        known = np.array([one.values for one in optima])
        around = Mixture(np.full(len(optima), 1 / len(optima)), self.outer.y(known), np.array(factors))
        wider = replace(around, factors=_WIDER * around.factors)
        return Blend(proposal, around.blended(wider, 0.5), _AROUND), np.concatenate([values, known])

    def _nearly_white(self, values: Matrix) -> Matrix:
        """With noise of a twentieth of the responses' spread where it is free."""
        posterior, table, out = self.posterior, self.posterior.table, values.copy()
        for axis in range(len(table.layout.responses)):
            pooled = np.concatenate([samples.axes[axis].values for samples in posterior.samples])
            for name, value in posterior.noise.nearly_white(0.05 * (float(pooled.std()) or 1.0)).items():
                if table.rows[table.at(name, axis)].free:
                    out[:, table.at(name, axis)] = value
        return out

    def _with_noise(self, values: Matrix) -> tuple[Matrix, Matrix]:
        """With noise fitted to each residual, and its widths in the sampled coordinates, (batch, size)."""
        posterior, out = self.posterior, values.copy()
        widths, problem = np.zeros((len(values), len(self.outer.columns))), LeastSquares(posterior)
        for row, one in enumerate(out):
            full = posterior.complete(posterior.coordinates(one[None]), None)[0]
            for axis, fit in enumerate(problem.noise_fits(full)):
                where = [posterior.table.at(name, axis) for name in posterior.noise.names]
                if not fit.free:
                    continue
                one[where] = fit.best(full[where])
                variance = np.diag(fit.covariance(one[where]))
                for k, size in zip(fit.free, variance, strict=True):
                    widths[row, self.outer.columns.index(where[k])] = np.sqrt(size)
        return out, widths


def _nearest(y: Matrix, known: Matrix, count: int) -> Index:
    """Positions of the nearest of some known points, (batch, count)."""
    scale = np.where(np.ptp(y, axis=0) > 0, y.std(axis=0), 1.0)
    near = cKDTree(known / scale).query(y / scale, k=min(count, len(known)))[1]
    return np.asarray(near).reshape(len(y), -1)


def _best_near(y: Matrix, known: Matrix, objective: Vector) -> Index:
    """Position of the best among the nearest of some known points, (batch,)."""
    near = _nearest(y, known, _NEIGHBOURS)
    return np.asarray(near[np.arange(len(y)), np.argmax(objective[near], axis=1)])
