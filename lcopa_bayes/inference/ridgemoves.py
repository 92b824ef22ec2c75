"""Moves along the ridges of a posterior, and the mixture a posterior is sampled with.

No one coordinate system fits both a ridge and the wide region where a term is negligible, so a run
mixes: differential evolution in the sampled coordinates (ter Braak 2006, Statistics and Computing 16) and
in the coordinates of `shape`, a slide of orders along the ridge, one order drawn anew along the ridge,
and one whole term drawn anew. Proposals that leave the support have factor -inf or fail the prior.
"""

from __future__ import annotations

from typing import Any, final

import emcee
import numpy as np

from lcopa_bayes.arrays import Flags, Matrix, Vector
from lcopa_bayes.inference.moves import (
    LARGEST_ORDER,
    DifferenceMove,
    PopulationMove,
    TermRedraw,
    Terrain,
    jittered,
    pairs,
    scales,
)
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.inference.shape import ElementColumns


class RidgeMove(PopulationMove):
    """A move that says where ratios and orders of one element go; the times follow."""

    def rebuilt(
        self,
        proposed: Matrix,
        here: Matrix,
        element: ElementColumns,
        log_ratios: Matrix,
        orders: Matrix,
        frequencies: Vector,
    ) -> tuple[Matrix, Vector]:
        """`proposed` with the element of these ratios and orders; its gains keep the level D(s_0).

        The factor is the ratio of the volumes that the change of coordinates spans at both ends.
        """
        before = element.shape(here, frequencies)
        inside: Flags = np.asarray(((orders > 0) & (orders <= LARGEST_ORDER)).all(axis=1))
        safe = np.where(inside[:, None], orders, here[:, element.orders])
        times = element.log_times(log_ratios, safe, frequencies)
        void: Flags = np.logical_not(inside & np.isfinite(times).all(axis=1))
        proposed[:, element.orders], proposed[:, element.times] = safe, times
        proposed[void] = here[void]
        after = element.shape(proposed, frequencies)
        factor = before.log_volume - after.log_volume
        rise = after.log_level - before.log_level
        for column, by_logarithm in element.gains:
            if by_logarithm:
                proposed[:, column] += np.where(void, 0.0, rise)
            else:
                proposed[:, column] *= np.exp(np.where(void, 0.0, rise))
                factor = factor + rise
        return proposed, np.where(void, -np.inf, factor)


@final
class ShapeMove(RidgeMove):
    """Differential evolution in ratios and orders of all elements, or of one, and what they share."""

    def proposal(self, here: Matrix, others: Matrix, random: Any) -> tuple[Matrix, Vector]:
        """See `PopulationMove.proposal`."""
        elements = self.terrain.elements if random.rand() < 0.5 else (self.element(random),)
        a, b = (others[chosen] for chosen in pairs(len(here), len(others), random))
        still = [e for e in self.terrain.elements if e not in elements]
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
            frequencies = self.terrain.frequencies(element.terms, random)
            shapes = [element.shape(points, frequencies) for points in (here, a, b)]
            for column, by_logarithm in element.gains:
                if by_logarithm:  # differences of gain over level, which `rebuilt` turns into gains
                    level = (a[:, column] - shapes[1].log_level) - (b[:, column] - shapes[2].log_level)
                    proposed[:, column] = here[:, column] + scale[:, 0] * level
            ratios = shapes[0].log_ratios + scale * jittered(
                shapes[1].log_ratios - shapes[2].log_ratios, random
            )
            orders = proposed[:, element.orders]
            proposed, factor = self.rebuilt(proposed, here, element, ratios, orders, frequencies)
            total = total + factor
        return proposed, total


@final
class OrderSlide(RidgeMove):
    """Orders of one element move, its ratios stay."""

    def proposal(self, here: Matrix, others: Matrix, random: Any) -> tuple[Matrix, Vector]:
        """See `PopulationMove.proposal`."""
        element = self.element(random)
        frequencies = self.terrain.frequencies(element.terms, random)
        a, b = pairs(len(here), len(others), random)
        count, terms = len(here), element.terms
        scale = np.exp(random.uniform(np.log(0.01), np.log(1.5), (count, 1)))
        difference = others[a][:, element.orders] - others[b][:, element.orders]
        step = scale * (difference + 0.02 * random.randn(count, terms))
        orders = here[:, element.orders] + np.where(random.rand(count, terms) < 0.6, step, 0.0)
        ratios = element.shape(here, frequencies).log_ratios
        return self.rebuilt(here.copy(), here, element, ratios, orders, frequencies)


@final
class OrderRoam(RidgeMove):
    """One order of one element is drawn anew from (0, 2), its ratios stay."""

    def proposal(self, here: Matrix, others: Matrix, random: Any) -> tuple[Matrix, Vector]:
        """See `PopulationMove.proposal`."""
        element = self.element(random)
        frequencies = self.terrain.frequencies(element.terms, random)
        orders = here[:, element.orders].copy()
        rows = np.arange(len(here))
        orders[rows, random.randint(0, element.terms, len(here))] = LARGEST_ORDER * random.rand(len(here))
        ratios = element.shape(here, frequencies).log_ratios
        return self.rebuilt(here.copy(), here, element, ratios, orders, frequencies)


def moves(posterior: Posterior) -> list[tuple[emcee.moves.Move, float]]:
    """The mixture a posterior is sampled with, and how often each move is made."""
    terrain = Terrain.of(posterior)
    if not terrain.elements:
        return [(DifferenceMove(terrain), 0.6), (emcee.moves.StretchMove(), 0.4)]
    return [
        (DifferenceMove(terrain), 0.2),
        (ShapeMove(terrain), 0.35),
        (OrderSlide(terrain), 0.25),
        (OrderRoam(terrain), 0.1),
        (TermRedraw(terrain), 0.05),
        (emcee.moves.StretchMove(), 0.05),
    ]
