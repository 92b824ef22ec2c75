"""Importance sampling over orders, delays and noise, the rest of a plant integrated out at each point.

What makes such posteriors hard are the orders: along them a response hardly changes while times and gains
follow, and a narrow mode may hold a tenth of the mass. Given them the rest is nearly Gaussian
(`conditional`), so that only orders, delays and noise are searched. Points from their prior, each with
the optimum of the rest, give a map of the marginal posterior that omits no region; a mixture fitted to the
weighted points is the next proposal, and so on (Cornuet, Marin, Mira and Robert 2012, Scand. J. Statist. 39).

Orders of one element hardly depend on those of another, nor on the noise: a proposal is for the most part a
product over such groups, each fitted on its own. Jointly they would need as many components as there are
combinations of modes, and a mode of one group is met only where all others happen to be likely.

A point that proposals were fitted to has too small a weight as a draw of these: where it is heavy they
follow it. Once the points cover the posterior, draws that count come in two halves, each from proposals
fitted to the other half and to what was before. None of these draws is taken away, however many are needed:
to stop where draws look good would take a mode that was not met for none. Where a few weigh more than all
others, they count anew from there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import ceil, inf
from time import monotonic
from typing import NamedTuple, final

import numpy as np
from scipy.special import logsumexp

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.parallel import Workers
from lcopa_bayes.core.progress import Progress
from lcopa_bayes.inference.optimum import Optimum
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.aroundoptima import around_optima
from lcopa_bayes.sampling.firstproposal import NEIGHBOURS, best_near, first_proposal, nearest
from lcopa_bayes.sampling.importanceweights import effective, tempered, usable_k
from lcopa_bayes.sampling.mixture import spread_evenly
from lcopa_bayes.sampling.mixturemoves import learned
from lcopa_bayes.sampling.outer import Draw, Optima, Outer, Walk
from lcopa_bayes.sampling.proposal import (
    Blend,
    Product,
    Proposal,
    Seen,
    adapted,
    clustered,
    paraboloid,
)
from lcopa_bayes.sampling.weighted import Weighted, resampled

_LEARNING = 768
"""Points of a round that improves the proposal."""
_TRIES = (64, 256)
"""Draws of the rest per point, least and most: more where few of them count."""
_EFFECTIVE_TRIES = 5.0
"""Effective draws among them that are aimed at."""
_TRIAL, _PATIENCE, _ROUNDS = 4, 12, 18
"""Rounds that improve the proposal after which hardly an effective draw, and after which few of them, show
that there is no hope, and most: draws of proposals that near a posterior soon multiply."""
_FEWEST = 2.0
"""Effective draws with which a search ends that has no time left [-]."""
_FEW, _SINGLE = 20.0, (0.2, 0.6)
"""Effective draws of all points below which these say little of the shape of a posterior, and share of a
single normal mode where they are more and fewer [-]."""
_JOINT = 0.3, 0.6
"""Share of a proposal that is not divided into groups, where there are several and one [-]."""
_FIRST, _WALKED = 0.1, 0.3
"""Shares of the first proposal in all others, and of where walkers went [-]."""
_SETTLED, _HELPFUL = 300.0, 0.1
"""Effective draws of all points, and per draw of the next proposal, from which draws count."""
_AGREE = 2.0
"""Standard errors by which the log evidence may change in a round after which draws count: where a proposal
has just met a mode it changes by more, and the next ones are adapted to it [-]."""
_LEARNED = 0.15
"""Share of the last of these in proposals whose draws count: wider than they are [-]."""
_LOST = 0.03
"""Effective draws per draw below which a few are of a region that proposals did not cover [-]."""
_MOST, _MOST_DRAWN, _JUDGED = 4, 80.0, 25.0
"""Most draws of a round over the least, of all that count over the effective draws wanted, and so many of
those since draws last counted anew that they show whether the most would be enough: with fewer, draws are
often few of what a proposal has yet to learn [-]."""
_VISITED = 6_000
"""Most points that a first proposal is learned from."""
_WALKING, _BEGINNING, _TEACHING = 3, 200.0, 3_000
"""Rounds from one walk to the next, effective draws that walkers begin from, at least, and draws that their
moves are learned from."""
_WALKERS, _PARTS = 128, 2
"""Walkers of an ensemble, and ensembles."""
_LOOKED_AT, _HEAVIER = 1_000, 1.5
"""Points of theirs that are weighted, and factor on the expected mean weight that shows a missed region."""
_POPULATION = 50.0
"""Effective draws of all points at which ensembles may start from them."""
_SPARE, _LEAST_RATE = 1.15, 0.2
"""Factor on the estimated number of draws needed, and least of them that are taken to count for the parameter
that is known least, over the effective share of all [-]."""
_TASK, _SAMPLES = (64, 192), 48_000
"""Points of a task, least and most, and samples of all their responses: calls take most of the time of a few
points of a short record. A round is four tasks or more, for as many processes [-]."""


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
    default those of a few searches. Where the posterior stands for an `exact` one that hardly differs, draws
    are those of the latter, and one round decides whether there are any. Once no time is `left` [s], or less
    than half of what the next round takes, a search ends with the draws it has.
    """

    def __init__(
        self,
        posterior: Posterior,
        seed: int,
        crew: Workers[Posterior],
        bar: Progress,
        optima: Sequence[Optimum] = (),
        left: Callable[[], float] = lambda: inf,
        exact: tuple[Posterior, Workers[Posterior]] | None = None,
    ) -> None:
        self.posterior, self._exact = posterior, exact
        self._left, self._pace = left, 0.0
        self.unfinished = False
        """Whether time ended it."""
        self._optima = tuple(optima)
        self._bar = bar
        self.outer = Outer(posterior)
        self._crew = crew
        self._seeds = np.random.SeedSequence(seed, spawn_key=(7_000,))
        self._rng = np.random.default_rng(self._seeds.spawn(1)[0])
        self._points: list[_Point] = []
        self._log_weights: Vector = np.empty(0)

    def run(self, wanted: float, *, direct: bool = True) -> Weighted | None:
        """Weighted draws equivalent to `wanted` independent ones for the centre, the tails and the shares of
        modes of every sampled parameter, from a search of the whole prior; None where no number of draws in
        reach gives them: ensembles may then start from the `population`. Not of optima alone unless
        `direct`."""
        first, starts, optima = first_proposal(self.outer, self._rng, self._done, self._crew, self._optima)
        return self._improved(first, starts, wanted, optima if direct else ())

    def around(self, z: Matrix, wanted: float) -> Weighted | None:
        """The same from points (n, dimension) of the sampled coordinates where ensembles have been."""
        values = self.posterior.values(spread_evenly(z, _VISITED))
        return self._improved(self._clustered(self.outer.y(values)), values, wanted)

    def population(self, parts: int, count: int) -> list[tuple[Matrix, Vector]]:
        """Draws of equal weight and their log densities, `count` from each of so many independent parts of
        all points; none where few of them have any weight."""
        weights = self._log_weights
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

    def _improved(
        self, first: Product, starts: Matrix, wanted: float, optima: Sequence[Optimum] = ()
    ) -> Weighted | None:
        """The same from a first proposal, whose points begin at the nearest of the table values `starts`;
        draws around `optima` alone where these and the first points are enough."""
        proposal: Proposal = first
        seen, count, walked = Seen(), _LEARNING * self._difficulty, None
        level, reached = -np.inf, 0.0
        for number in range(_ROUNDS):
            if self._late(count):
                return self._unfinished(seen)
            self._bar.set_description(f"searching for modes, round {number + 1}")
            rounds = self._round([seen], [proposal], count, starts if number == 0 else None)
            if not rounds:
                return None
            (seen,), count = rounds, _LEARNING
            self._log_weights = log_weights = seen.log_weights()
            if not np.isfinite(log_weights).any():
                return None
            if number == 0 and optima:
                direct = self._direct(optima, seen, wanted)
                if direct is not None or self._exact is not None:
                    return direct
            if number % _WALKING == _WALKING - 1:
                walked = self._walked()
            proposal = self._adapted(first, seen, walked)
            expected = seen.efficiency(proposal, log_weights)
            before, level = (level, reached), float(logsumexp(log_weights) - np.log(sum(seen.counts)))
            reached = effective(log_weights - logsumexp(log_weights))
            agree = abs(level - before[0]) <= _AGREE / np.sqrt(max(before[1], 1.0)) and reached > before[1]
            if expected > _HELPFUL and reached > _SETTLED and (agree or number + 1 >= _PATIENCE):
                return self._last(first, proposal, seen, wanted, expected)
            if number + 1 >= _TRIAL and reached < _FEW * min((number + 1) / _PATIENCE, 1.0) ** 2:
                return None
        return None

    def _direct(self, optima: Sequence[Optimum], seen: Seen, wanted: float) -> Weighted | None:
        """Draws around optima alone, or where time ends them, those there are."""
        (point,) = self._points
        raw = seen.log_weights() - np.log(sum(seen.counts))
        hunted = point.coordinates, point.log_density, raw
        posterior, crew = self._exact or (self.posterior, self._crew)
        enough, weighted = around_optima(
            posterior, crew, self._crew, optima, hunted, self._rng, wanted, self._late
        )
        self.unfinished = not enough and self._late()
        if weighted is None or enough:
            return weighted
        return weighted if self.unfinished and weighted.ess >= _FEWEST else None

    def _last(
        self, first: Product, learned: Proposal, seen: Seen, wanted: float, expected: float
    ) -> Weighted | None:
        """Draws in two halves, each of proposals that know nothing of it, as many as are needed; None where
        these are too many."""
        halves, since, worth, rate = [seen, seen], len(seen.counts), 0.0, expected
        self._bar.set_description("drawing from the posterior")
        drawn = begun = 0
        while drawn < _MOST_DRAWN * wanted:
            proposals: list[Proposal] = [
                Blend(self._by_groups(other, first, settled=True), learned, _LEARNED)
                for other in halves[::-1]
            ]
            count = int(np.clip(_SPARE * (wanted - worth) / rate, _LEARNING, _MOST * _LEARNING))
            halves = self._round(halves, proposals, count // 2, None)
            if not halves:
                return None
            drawn += count
            weighted = self._weighted(halves, len(seen.counts), since)
            worth = weighted.smallest_ess if weighted.ess > 2.0 else 0.0
            rate = max(worth / weighted.count, _LEAST_RATE * expected)
            if worth >= wanted and weighted.pareto_k <= usable_k(weighted.count):
                if not self._misses(proposals[0], weighted, self._walked(), halves[0]):
                    return weighted
                since, worth, begun = len(halves[0].counts), 0.0, drawn
            elif weighted.ess < _LOST * weighted.count:
                # a region met for the first time is learned
                since, worth, begun = len(halves[0].counts), 0.0, drawn
            elif drawn - begun > _JUDGED * wanted and worth * _MOST_DRAWN < drawn - begun:
                break
            if self._late(_LEARNING):
                self.unfinished = True
                return weighted if weighted.ess >= _FEW else self._unfinished(seen)
        return None

    def _late(self, points: int = 0) -> bool:
        """Whether a round of so many points would end later than the time that is left by more than it would
        end before it."""
        return self._left() < 0.5 * self._pace * points

    def _unfinished(self, seen: Seen) -> Weighted | None:
        """All draws of a search that time ended, weighted as draws of the mixture of their proposals; None
        where one has all the weight."""
        self.unfinished, weights = True, self._log_weights
        if not np.isfinite(weights).any() or effective(weights - logsumexp(weights)) < _FEWEST:
            return None
        return self._weighted([seen], 0, 0)

    @property
    def _difficulty(self) -> int:
        """Orders that a first round explores, at most three [-]."""
        orders = int(np.count_nonzero(self.outer.orders))
        return orders if 1 <= orders <= 3 else 1

    def _adapted(self, first: Product, seen: Seen, walked: Matrix | None) -> Proposal:
        """A proposal fitted to points, in part without dividing them into groups, with components at the
        heaviest, and in part to where walkers went: into what no draw has met."""
        log_weights = seen.log_weights()
        y, density = (np.concatenate(each) for each in (seen.points, seen.log_densities))
        joint, single = adapted(y, log_weights, self._seed), paraboloid(y, density)
        if single is not None:
            few = effective(log_weights - logsumexp(log_weights)) < _FEW
            joint = joint.blended(single, _SINGLE[int(few)])
        proposal = Blend(self._by_groups(seen, first), joint, _JOINT[int(len(first.groups) == 1)])
        return proposal if walked is None else Blend(proposal, self._clustered(walked), _WALKED)

    def _by_groups(self, seen: Seen, first: Product, *, settled: bool = False) -> Product:
        """A proposal fitted to points, each group of parameters in part from the first one: what it reached
        stays in reach, and one group is explored where the others are likely."""
        own = self._clustered(np.concatenate(seen.points), seen.log_weights(), settled=settled)
        pairs = zip(own.proposals, first.proposals, strict=True)
        return Product(own.groups, tuple(Blend(*pair, _FIRST) for pair in pairs))

    def _clustered(self, y: Matrix, log_weights: Vector | None = None, *, settled: bool = False) -> Product:
        """Clusters of weighted points, groups of parameters taken for independent."""
        weights = np.zeros(len(y)) if log_weights is None else log_weights
        parts = [clustered(y[:, group], weights, self._seed, settled=settled) for group in self.outer.groups]
        return Product(self.outer.groups, tuple(parts))

    @property
    def _seed(self) -> int:
        """Another one each time."""
        return int(self._rng.integers(2**31))

    def _round(
        self, seen: Sequence[Seen], proposals: Sequence[Proposal], count: int, starts: Matrix | None
    ) -> list[Seen]:
        """With `count` draws of each proposal; nothing where hardly any lies inside the prior."""
        drawn, begin = [], monotonic()
        for proposal in proposals:
            y = proposal.draw(count, self._rng)
            values = self.outer.values(y)
            # a point whose orders do not decrease is another's, which has its own density
            usable = self.outer.inside(values) & np.isclose(self.outer.y(values), y).all(axis=1)
            drawn.append((y[usable], values[usable]))
        y, values = (np.concatenate(each) for each in zip(*drawn, strict=True))
        if len(y) < NEIGHBOURS:
            return []
        ends = np.cumsum([len(own) for own, _ in drawn])[:-1]
        parts = zip(*(np.split(each, ends) for each in self._evaluated(y, values, starts)), strict=True)
        points = [_Point(*part) for part in parts]
        self._points += points
        self._pace = (monotonic() - begin) / (count * len(proposals))
        each = zip(seen, proposals, points, strict=True)
        return [one.joined(proposal, count, own.y, own.log_marginal) for one, proposal, own in each]

    def _weighted(self, halves: Sequence[Seen], before: int, since: int) -> Weighted:
        """Draws of halves, or of all, from round `since` on, in random order; rounds `before` are whole."""
        parts, end = len(halves), len(halves[0].counts)
        own = (self._points[before + part :: parts][since - before : end - before] for part in range(parts))
        points = [point for each in own for point in each]
        raw = np.concatenate([half.log_weights(since) for half in halves])
        order = self._rng.permutation(np.flatnonzero(np.isfinite(raw)))
        z = np.concatenate([point.coordinates for point in points])[order]
        density = np.concatenate([point.log_density for point in points])[order]
        count = sum(sum(half.counts[since:]) for half in halves)
        return Weighted.of(self.posterior, z, density, raw[order], count, smooth=False)

    def _walked(self) -> Matrix:
        """Where emcee goes from draws of nearly equal weight, (points, size): into what no draw has met."""
        weights = tempered(self._log_weights, _BEGINNING)
        known = np.concatenate([point.coordinates for point in self._points])
        z = known[self._rng.choice(len(weights), _TEACHING, p=weights)]
        mixture = learned(self.posterior, [z[None]], self._seed)
        walkers = max(_WALKERS, 2 * self.posterior.dimension + 2)
        places = [slice(part * walkers, (part + 1) * walkers) for part in range(_PARTS)]
        tasks = [(z[own], seed) for own, seed in zip(places, self._seeds.spawn(_PARTS), strict=True)]
        visited = np.concatenate(list(self._crew.each(Walk(mixture), tasks)))
        return self.outer.y(self.posterior.values(visited))

    def _misses(self, proposal: Proposal, weighted: Weighted, walked: Matrix, seen: Seen) -> bool:
        """Whether the mean weight of points that walkers went to is larger than by the points of all
        proposals: a region that the last one hardly draws from shows in no weight of its draws."""
        y = spread_evenly(walked, _LOOKED_AT)
        raw = self._evaluated(y, self.outer.values(y), None).log_marginal - proposal.log_density(y)
        mean = float(logsumexp(raw) - np.log(len(y)) - weighted.log_evidence)
        expected = seen.efficiency(proposal, seen.log_weights())
        return bool(mean > np.log(_HEAVIER / expected))

    def _evaluated(self, y: Matrix, values: Matrix, starts: Matrix | None) -> _Point:
        """Optima and draws at points; the first of a search twice, the second time from their neighbours."""
        if starts is None:
            known = np.concatenate([point.y for point in self._points])
            objective = np.concatenate([point.objective for point in self._points])
            begin = np.concatenate([point.values for point in self._points])
            begin = begin[best_near(y, known, objective)]
        else:
            begin = starts[nearest(y, self.outer.y(starts), 1)[:, 0]]
            begin, objective, _ = self._done(Optima(), values, begin)
            begin = begin[best_near(y, y, objective)]
        efficiency = [float(np.median(point.efficiency)) for point in self._points[-1:]]
        tries = int(np.clip(_EFFECTIVE_TRIES / max(*efficiency, 1e-3), *_TRIES)) if efficiency else _TRIES[0]
        optimum, level, z, density, marginal, share = self._done(Draw(tries), values, begin)
        marginal += self.posterior.table.log_permutations
        return _Point(y, optimum, level, z, density, marginal, share)

    def _done(self, task: Optima | Draw, values: Matrix, starts: Matrix | None) -> list[Matrix]:
        """A task for all points, by the workers."""
        count = max(1, ceil(len(values) / int(np.clip(_SAMPLES // self.posterior.size, *_TASK))))
        begins: Sequence[Matrix | None] = [None] * count if starts is None else np.array_split(starts, count)
        tasks = zip(np.array_split(values, count), begins, self._seeds.spawn(count), strict=True)
        parts = []
        for part in self._crew.each(task, list(tasks)):  # type: ignore[arg-type]
            parts.append(part)
            self._bar.update(len(part[0]))
        return [np.concatenate(each) for each in zip(*parts, strict=True)]
