"""Moves along the ridges of a posterior, and the mixture a posterior is sampled with.

No one coordinate system fits both a ridge and the wide region where a term is negligible, so a run
mixes: differential evolution in the sampled coordinates (ter Braak 2006, Statistics and Computing 16) and
in the coordinates of `shapecoordinates`, a slide of orders along the ridge, one order drawn anew along the
ridge, and one whole term drawn anew. Proposals that leave the support have factor -inf or fail the prior.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, final

import emcee
import numpy as np

from lcopa_bayes.core.arrays import Flags, Matrix, Vector
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.coordinates import Chart
from lcopa_bayes.sampling.mixture import Mixture
from lcopa_bayes.sampling.mixturemoves import MixtureMove, MixtureWalk, parts
from lcopa_bayes.sampling.moves import (
    LARGEST_ORDER,
    DifferenceMove,
    PopulationMove,
    Terrain,
    jittered,
    pairs,
    scales,
)
from lcopa_bayes.sampling.shapecoordinates import ElementColumns

_DENSE = 3.0
"""Orders drawn anew are dense at 0: twice a uniform number to this power [-]."""
_ANEW = 0.3
"""Share of moves that draw anew from the mixture."""
_NEARBY = 0.3
"""Share of moves along it."""


class RidgeMove(PopulationMove):
    """A move of ratios, orders and held times of one element; the other times follow."""

    def rebuilt(
        self, proposed: Matrix, here: Matrix, element: ElementColumns, log_ratios: Matrix, frequencies: Vector
    ) -> tuple[Matrix, Vector]:
        """`proposed` with the times that follow from its ratios; its gains keep the level D(s_0).

        The factor is the ratio of the volumes that the change of coordinates spans at both ends; -inf where
        it spans none, as between two terms alike: no move leads back from there.
        """
        before = element.shape(here, frequencies)
        orders = proposed[:, element.orders]
        inside: Flags = np.asarray(((orders > 0) & (orders <= LARGEST_ORDER)).all(axis=1))
        safe = np.where(inside[:, None], orders, here[:, element.orders])
        held = None if element.held is None else proposed[:, element.times[element.held]]
        times = element.log_times(log_ratios, safe, frequencies, held)
        void: Flags = np.logical_not(inside & np.isfinite(times).all(axis=1))
        proposed[:, element.following] = times
        proposed[void] = here[void]
        after = element.shape(proposed, frequencies)
        spanned: Flags = np.isfinite(before.log_volume) & np.isfinite(after.log_volume)
        factor = np.full(len(here), -np.inf)
        factor[spanned] = before.log_volume[spanned] - after.log_volume[spanned]
        rise = after.log_level - before.log_level
        for column, by_logarithm in element.gains:
            if by_logarithm:
                proposed[:, column] += np.where(void, 0.0, rise)
            else:
                proposed[:, column] *= np.exp(np.where(void, 0.0, rise))
                factor = factor + rise
        return proposed, np.where(void, -np.inf, factor)

    def sometimes_holding(self, element: ElementColumns, random: Any) -> ElementColumns:
        """The element with a random term held, or none: each fits another part of a ridge."""
        term = int(random.randint(-1, element.terms))
        return element if term < 0 else element.holding(term)


@final
class ShapeMove(RidgeMove):
    """Differential evolution in ratios and orders of all elements, or of one, and what they share."""

    def proposal(self, here: Matrix, others: Matrix, random: Any) -> tuple[Matrix, Vector]:
        """See `PopulationMove.proposal`."""
        chosen = self.terrain.elements if random.rand() < 0.5 else (self.element(random),)
        still = [e for e in self.terrain.elements if e not in chosen]
        elements = [self.sometimes_holding(element, random) for element in chosen]
        a, b = (others[drawn] for drawn in pairs(len(here), len(others), random))
        moving = here.shape[1] - sum(2 * element.terms for element in still)
        scale = scales(len(here), moving, random)
        proposed = here + scale * jittered(a - b, random)
        for element in still:
            columns = np.concatenate([element.times, element.orders, [g for g, _ in element.gains]]).astype(
                int
            )
            proposed[:, columns] = here[:, columns]
        total = np.zeros(len(here))
        for element in elements:
            frequencies = self.terrain.frequencies(element.ratios, random)
            shapes = [element.shape(points, frequencies) for points in (here, a, b)]
            for column, by_logarithm in element.gains:
                # differences of gain over level, which `rebuilt` turns into gains
                if by_logarithm:
                    level = (a[:, column] - shapes[1].log_level) - (b[:, column] - shapes[2].log_level)
                    proposed[:, column] = here[:, column] + scale[:, 0] * level
                else:
                    own, first, second = (
                        points[:, column] * np.exp(-shape.log_level)
                        for points, shape in zip((here, a, b), shapes, strict=True)
                    )
                    moved = own + scale[:, 0] * (first - second)
                    proposed[:, column] = moved * np.exp(shapes[0].log_level)
            ratios = shapes[0].log_ratios + scale * jittered(
                shapes[1].log_ratios - shapes[2].log_ratios, random
            )
            proposed, factor = self.rebuilt(proposed, here, element, ratios, frequencies)
            total = total + factor
        return proposed, total


@final
class OrderSlide(RidgeMove):
    """Orders of one element move, its ratios stay."""

    def proposal(self, here: Matrix, others: Matrix, random: Any) -> tuple[Matrix, Vector]:
        """See `PopulationMove.proposal`."""
        element = self.sometimes_holding(self.element(random), random)
        frequencies = self.terrain.frequencies(element.ratios, random)
        a, b = pairs(len(here), len(others), random)
        count, terms = len(here), element.terms
        scale = np.exp(random.uniform(np.log(0.01), np.log(1.5), (count, 1)))
        difference = others[a][:, element.orders] - others[b][:, element.orders]
        step = scale * (difference + 0.02 * random.randn(count, terms))
        proposed = here.copy()
        proposed[:, element.orders] += np.where(random.rand(count, terms) < 0.6, step, 0.0)
        ratios = element.shape(here, frequencies).log_ratios
        return self.rebuilt(proposed, here, element, ratios, frequencies)


@final
class OrderRoam(RidgeMove):
    """One order of one element is drawn anew from (0, 2), its ratios stay."""

    crosses = True

    def proposal(self, here: Matrix, others: Matrix, random: Any) -> tuple[Matrix, Vector]:
        """See `PopulationMove.proposal`."""
        element = self.element(random)
        frequencies = self.terrain.frequencies(element.ratios, random)
        proposed = here.copy()
        rows, term = np.arange(len(here)), random.randint(0, element.terms, len(here))
        proposed[rows, element.orders[term]] = LARGEST_ORDER * random.rand(len(here))
        ratios = element.shape(here, frequencies).log_ratios
        return self.rebuilt(proposed, here, element, ratios, frequencies)


@final
class TermRedraw(RidgeMove):
    """One term is drawn anew and the others follow: large moves where it is negligible or a spring."""

    crosses = True

    def proposal(self, here: Matrix, others: Matrix, random: Any) -> tuple[Matrix, Vector]:
        """See `PopulationMove.proposal`; each walker chooses its term, for the reverse move may need
        another."""
        element = self.element(random)
        term = random.randint(element.terms, size=len(here))
        frequencies = self.terrain.frequencies(element.terms - 1, random)
        proposed, factor = here.copy(), np.full(len(here), -np.inf)
        for k in range(element.terms):
            rows = np.flatnonzero(term == k)
            proposed[rows], factor[rows] = self._redrawn(here[rows], element.holding(k), frequencies, random)
        return proposed, factor

    def _redrawn(
        self, here: Matrix, element: ElementColumns, frequencies: Vector, random: Any
    ) -> tuple[Matrix, Vector]:
        """The held term drawn anew: log time evenly, order dense at 0, half of the orders unchanged."""
        time, order = (columns[element.held] for columns in (element.times, element.orders))
        low, high = (bound[element.held] for bound in element.reach)
        proposed = here.copy()
        proposed[:, time] = low + (high - low) * random.rand(len(here))
        drawn = LARGEST_ORDER * (1.0 - random.rand(len(here))) ** _DENSE
        proposed[:, order] = np.where(random.rand(len(here)) < 0.5, drawn, here[:, order])
        thinning = (1 - 1 / _DENSE) * (np.log(proposed[:, order]) - np.log(here[:, order]))
        ratios = element.shape(here, frequencies).log_ratios
        proposed, factor = self.rebuilt(proposed, here, element, ratios, frequencies)
        reached: Flags = (here[:, time] >= low) & (here[:, time] <= high)
        return proposed, np.where(reached & np.isfinite(factor), factor + thinning, -np.inf)


def moves(posterior: Posterior, mixture: Mixture | None = None) -> list[tuple[emcee.moves.Move, float]]:
    """The moves a posterior is sampled with, and the share of each; with `mixture` also moves
    that follow it."""
    terrain = Terrain.of(posterior)
    local: list[tuple[emcee.moves.Move, float]] = (
        [
            (DifferenceMove(terrain), 0.25),
            (ShapeMove(terrain), 0.25),
            (OrderSlide(terrain), 0.25),
            (OrderRoam(terrain), 0.1),
            (TermRedraw(terrain), 0.15),
        ]
        if terrain.elements
        else [(DifferenceMove(terrain), 0.6), (emcee.moves.StretchMove(), 0.4)]
    )
    if mixture is None:
        return local
    chart, groups = Chart.of(posterior), parts(posterior, mixture)
    return [
        (MixtureMove(chart, groups), _ANEW),
        (MixtureWalk(chart, groups), _NEARBY),
        *((move, (1 - _ANEW - _NEARBY) * often) for move, often in local),
    ]


def emcee_sampler(
    posterior: Posterior,
    log_density: Callable[[Matrix], Vector],
    walkers: int,
    mixture: Mixture | None,
    random: tuple[Any, ...],
) -> emcee.EnsembleSampler:
    """emcee with these moves, at a state of its generator.

    Its own wrapper, which prints the arguments at an exception or interrupt, is not used: the caller reports
    it.
    """
    sampler = emcee.EnsembleSampler(
        walkers, posterior.dimension, log_density, moves=moves(posterior, mixture), vectorize=True
    )
    sampler.log_prob_fn = log_density
    sampler.random_state = random
    return sampler
