"""Importance sampling over orders, delays and noise, the rest of a plant integrated out at each point.

What makes such posteriors hard are the orders: along them a response hardly changes while times and gains
follow, and a narrow mode may hold a tenth of the mass. Given them the rest is nearly Gaussian
(`conditional`), so that only orders, delays and noise are searched. Points from their prior, each with
the optimum of the rest, give a map of the marginal posterior that omits no region; a mixture fitted to the
weighted points is the next proposal, and so on (Cornuet, Marin, Mira and Robert 2012, Scand. J. Statist. 39).
Draws of a last proposal, which knows nothing of them, give the result: their weights are those of whole
parameter sets, exact whatever the approximations that led to the proposal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import NamedTuple, TypeAlias, final

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import logsumexp

from lcopa_bayes.core.arrays import Index, Matrix, Vector
from lcopa_bayes.core.parallel import Workers
from lcopa_bayes.inference.conditional import Conditional, screened
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.conditionaldraws import kept
from lcopa_bayes.sampling.ensemble import Ensemble, advance
from lcopa_bayes.sampling.importanceweights import effective, usable_k
from lcopa_bayes.sampling.mixture import Mixture, spread_evenly
from lcopa_bayes.sampling.mixturemoves import learned
from lcopa_bayes.sampling.outer import Outer, PriorOrders, conditional_of
from lcopa_bayes.sampling.proposal import Seen, clustered, tempered
from lcopa_bayes.sampling.weighted import Weighted, resampled

_PILOT = 256
"""Points from the prior at which delays and noise are estimated."""
_SCREENED, _DESCENT, _CORRECTION = 16, 8, 4
"""Prior draws that give a start; steps of a descent from one, and of one that begins at a neighbour."""
_WARM = 2
"""Steps of a descent from a neighbour once there are many."""
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
_ROUNDS, _LARGER = 20, 6
"""Most rounds, and most of them that are larger than for learning."""
_HELPFUL, _GROWTH = 0.1, 4
"""Effective draws per draw from which the next round may be larger, and by how many times [-]."""
_MOST = 10.0
"""Most points of a round over the effective draws wanted [-]."""
_VISITED = 6_000
"""Most points that a first proposal is learned from."""
_TEACHING, _WALKERS, _WALK = 3_000, 256, (20, 5)
"""Draws that the moves of walkers are learned from, walkers, and draws kept of each and steps per draw."""
_LOOKED_AT, _HEAVIER = 1_000, 1.5
"""Points of theirs that are weighted, and factor on the expected mean weight that shows a missed region."""
_POPULATION = 50.0
"""Effective draws of all points at which ensembles may start from them."""
_SPARE = 1.15
"""Factor on the estimated number of draws needed [-]."""
_TASK = 64
"""Points of a task."""


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
@dataclass(frozen=True)
class _Optimum:
    """Task: optimum of the rest from `starts`, or from the best of prior draws where these are None."""

    steps: int
    pilot: bool = False
    """Whether delays are fitted in any case."""

    def __call__(
        self, posterior: Posterior, task: tuple[Matrix, Matrix | None, np.random.SeedSequence]
    ) -> tuple[Matrix, Vector, Matrix]:
        """Table values, objective and widths of the coordinates in their natural scale."""
        values, starts, seed = task
        conditional = Conditional(posterior, delays=True) if self.pilot else conditional_of(posterior)
        if starts is None:
            values = screened(conditional, values, _SCREENED, np.random.default_rng(seed))
        else:
            values = values.copy()
            values[:, conditional.columns] = starts[:, conditional.columns]
        at, objective = conditional.descended(values, self.steps)
        return at.values, objective, conditional.uncertainty(at)


@final
@dataclass(frozen=True)
class _Draw:
    """Task: optimum of the rest from `starts`, and a draw of it."""

    steps: int
    tries: int

    def __call__(
        self, posterior: Posterior, task: tuple[Matrix, Matrix, np.random.SeedSequence]
    ) -> tuple[Matrix, Vector, Matrix, Vector, Vector, Vector]:
        """`_Point` without its `y`."""
        values, starts, seed = task
        conditional = conditional_of(posterior)
        values = values.copy()
        values[:, conditional.columns] = starts[:, conditional.columns]
        at, objective = conditional.descended(values, self.steps)
        draw = kept(conditional, at, self.tries, np.random.default_rng(seed))
        exists = np.isfinite(draw.log_likelihood)
        density, marginal = np.full(len(values), -np.inf), np.full(len(values), -np.inf)
        z = draw.coordinates[exists]
        density[exists] = posterior.log_density(z)
        error = density[exists] - posterior.log_prior(z) - draw.log_likelihood[exists]
        marginal[exists] = error + draw.log_evidence[exists]
        return at.values, objective, draw.coordinates, density, marginal, draw.efficiency


Proposal: TypeAlias = "Mixture | PriorOrders"


@final
class Search:
    """Points, proposals and weights of a search; deterministic given its arguments and what it is asked."""

    def __init__(self, posterior: Posterior, seed: int, crew: Workers[Posterior]) -> None:
        self.posterior = posterior
        self.outer = Outer(posterior)
        self._crew = crew
        self._seeds = np.random.SeedSequence(seed, spawn_key=(7_000,))
        self._rng = np.random.default_rng(self._seeds.spawn(1)[0])
        self._seen = Seen((), (), ())
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

    def _improved(self, proposal: Proposal, starts: Matrix, wanted: float) -> Weighted | None:
        """The same from a proposal, whose points begin at the nearest of the table values `starts`."""
        count, larger = _LEARNING, 0
        for number in range(_ROUNDS):
            weighted = self._round(proposal, count, starts if number == 0 else None)
            if weighted is None:
                return None
            worth = weighted.smallest_ess(self._rng) if weighted.ess > 2.0 else 0.0
            enough = worth >= wanted and weighted.pareto_k <= usable_k(weighted.count)
            walked = self._walked(weighted) if count > _LEARNING or enough else None
            if enough and walked is not None and not self._misses(proposal, weighted, walked):
                return weighted
            larger += count > _LEARNING
            if larger == _LARGER:
                return None
            log_weights = self._seen.log_weights()
            if not np.isfinite(log_weights).any():
                return None
            proposal = clustered(
                np.concatenate(self._seen.points), log_weights, int(self._rng.integers(2**31))
            )
            if walked is not None:
                y = spread_evenly(walked, _VISITED)
                own = clustered(y, np.zeros(len(y)), int(self._rng.integers(2**31)))
                proposal = proposal.blended(own, 0.5)
            # a larger round only where the proposal is close to the posterior
            needed = int(min(_SPARE * count / max(worth, 1.0), _MOST) * wanted)
            more = min(needed, _GROWTH * count) if weighted.ess >= _HELPFUL * count else 0
            count = max(_LEARNING, more)
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
        self._seen = self._seen.joined(proposal, point.y, point.log_marginal)
        raw = self._seen.last_weights()
        exists = np.isfinite(raw)
        kept_draws = point.coordinates[exists], point.log_density[exists], raw[exists]
        return Weighted.of(self.posterior, *kept_draws, count, smooth=False)

    def _walked(self, weighted: Weighted) -> Matrix:
        """Where emcee goes from draws of equal weight, (points, size): into what no draw has met."""
        z = weighted.coordinates[weighted.resampled(_TEACHING, self._rng)]
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
            begin, steps = optima[_best_near(y, known, objective)], _WARM
        else:
            begin = starts[_nearest(y, self.outer.y(starts), 1)[:, 0]]
            begin, objective, _ = self._done(_Optimum(_DESCENT), values, begin)
            begin, steps = begin[_best_near(y, y, objective)], _CORRECTION
        efficiency = [float(np.median(point.efficiency)) for point in self._points[-1:]]
        tries = int(np.clip(_EFFECTIVE_TRIES / max(*efficiency, 1e-3), *_TRIES)) if efficiency else _TRIES[0]
        optimum, level, z, density, marginal, share = self._done(_Draw(steps, tries), values, begin)
        marginal += self.posterior.table.log_permutations
        return _Point(y, optimum, level, z, density, marginal, share)

    def _done(self, task: _Optimum | _Draw, values: Matrix, starts: Matrix | None) -> list[Matrix]:
        """A task for all points, by the workers."""
        count = max(1, ceil(len(values) / _TASK))
        begins: Sequence[Matrix | None] = [None] * count if starts is None else np.array_split(starts, count)
        tasks = zip(np.array_split(values, count), begins, self._seeds.spawn(count), strict=True)
        parts = list(self._crew.each(task, list(tasks)))  # type: ignore[arg-type]
        return [np.concatenate(each) for each in zip(*parts, strict=True)]

    def _first(self) -> tuple[Proposal, Matrix]:
        """A proposal from the prior of the orders and estimates of delays and noise; optima to start from."""
        outer, posterior = self.outer, self.posterior
        values = self._nearly_white(posterior.table.draw(_PILOT, self._rng))
        pilot = _Optimum(_DESCENT, pilot=True)
        values, objective, _ = self._done(pilot, values, None)
        if outer.orders.any():
            orders = outer.y(values)[:, outer.orders]
            begin = values[_best_near(orders, orders, objective)]
            values, objective, _ = self._done(replace(pilot, steps=_CORRECTION), values, begin)
        if outer.orders.all():
            return PriorOrders(outer, None), values
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
        return (PriorOrders(outer, rest) if outer.orders.any() else rest), np.concatenate([values, chosen])

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
