"""Moves of a population, as moves of emcee, and the move in the sampled coordinates."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, final

import emcee
import numpy as np

from lcopa_bayes.core.arrays import Flags, Index, Matrix, Vector
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.shapecoordinates import ElementColumns, element_columns

_JITTER = 1e-3
"""Relative perturbation of a difference, so that no walker is confined to a lattice."""
LARGEST_ORDER = 2.0
"""Orders lie in (0, LARGEST_ORDER] [-]."""


@final
@dataclass(frozen=True, eq=False)
class Terrain:
    """Properties of a posterior that moves use."""

    elements: tuple[ElementColumns, ...]
    exchangeable: tuple[bool, ...]
    """Per entry of `elements`: whether its terms are sampled in any order."""
    slowest: float
    """Lowest frequency the records resolve [1 / time unit]."""
    fastest: float
    """Highest frequency the records resolve [1 / time unit]."""

    @classmethod
    def of(cls, posterior: Posterior) -> Terrain:
        """Terrain of a posterior."""
        grids = [experiment.mesh.grid for experiment in posterior.model.experiments]
        elements = element_columns(posterior)
        same = [posterior.table.exchangeable[element.number] for element in elements]
        span, step = max(grid.n * grid.step for grid in grids), min(grid.step for grid in grids)
        return cls(elements, tuple(same), 0.5 / span, 0.5 / step)

    def sorted(self, z: Matrix) -> Matrix:
        """The same points with exchangeable terms by decreasing order, so that differences match."""
        out = z.copy()
        for element, same in zip(self.elements, self.exchangeable, strict=True):
            if same:
                rank = np.argsort(-z[:, element.orders], axis=1, kind="stable")
                for columns in (element.orders, element.times):
                    out[:, columns] = np.take_along_axis(z[:, columns], rank, axis=1)
        return out

    def in_order(self, z: Matrix) -> Flags:
        """Whether exchangeable terms are in decreasing order, (batch,)."""
        ordered = np.ones(len(z), dtype=bool)
        for element, same in zip(self.elements, self.exchangeable, strict=True):
            if same:
                ordered &= (np.diff(z[:, element.orders], axis=1) <= 0).all(axis=1)
        return ordered

    def frequencies(self, ratios: int, random: Any) -> Vector:
        """One random frequency from each of ratios + 1 equal logarithmic parts of the range."""
        edges = np.linspace(np.log(self.slowest), np.log(self.fastest), ratios + 2)
        return np.asarray(np.exp(edges[:-1] + random.rand(ratios + 1) * np.diff(edges)))


class PopulationMove(emcee.moves.Move):  # type: ignore[misc]
    """A move of one half of the walkers given the other, accepted for all of them at once."""

    crosses = False
    """Whether exchangeable terms may change places in the order. A step taken from sorted terms to sorted
    terms is not reversible when they crossed, unless it treats all terms alike."""

    def __init__(self, terrain: Terrain) -> None:
        self.terrain = terrain

    @abstractmethod
    def proposal(self, here: Matrix, others: Matrix, random: Any) -> tuple[Matrix, Vector]:
        """Proposed coordinates (n, dimension), and log of backward over forward density, (n,)."""

    def propose(self, model: Any, state: emcee.State) -> tuple[emcee.State, Any]:
        """Both halves in turn; see emcee.moves.Move."""
        coordinates = self.terrain.sorted(state.coords)
        log_density = np.array(state.log_prob)
        accepted = np.zeros(log_density.size, dtype=bool)
        order = model.random.permutation(log_density.size)
        for half in (0, 1):
            moving, still = order[half::2], order[1 - half :: 2]
            proposed, factor = self.proposal(coordinates[moving], coordinates[still], model.random)
            void = ~np.isfinite(proposed).all(axis=1) | (factor == -np.inf)
            if not self.crosses:
                void |= ~self.terrain.in_order(proposed)
            proposed[void] = coordinates[moving[void]]  # evaluated for a full batch, never accepted
            new = np.asarray(model.compute_log_prob_fn(proposed)[0], dtype=float)
            gain = np.where(void, -np.inf, new - log_density[moving] + np.where(void, 0.0, factor))
            taken: Flags = np.log(model.random.rand(moving.size)) < gain
            chosen = moving[taken]
            coordinates[chosen], log_density[chosen], accepted[chosen] = proposed[taken], new[taken], True
        return emcee.State(coordinates, log_prob=log_density, random_state=state.random_state), accepted

    def element(self, random: Any) -> ElementColumns:
        """An element, chosen evenly."""
        return self.terrain.elements[int(random.randint(len(self.terrain.elements)))]


def pairs(count: int, pool: int, random: Any) -> tuple[Index, Index]:
    """`count` ordered pairs of different members of a pool."""
    first = random.randint(0, pool, count)
    return first, (first + random.randint(1, pool, count)) % pool


def scales(count: int, dimension: Any, random: Any) -> Matrix:
    """Lengths of difference steps: spread over a decade below the Gaussian optimum, sometimes 1."""
    if random.rand() < 0.1:
        return np.ones((count, 1))
    optimum = 2.38 / np.sqrt(2 * dimension)
    return np.asarray(optimum * np.exp(random.uniform(-2.5, 0.3, (count, 1))))


def jittered(difference: Matrix, random: Any) -> Matrix:
    """A difference, perturbed."""
    return np.asarray(difference * (1 + _JITTER * random.randn(*difference.shape)))


@final
class DifferenceMove(PopulationMove):
    """Differential evolution in the sampled coordinates, in all of them or in a random few."""

    def proposal(self, here: Matrix, others: Matrix, random: Any) -> tuple[Matrix, Vector]:
        """See `PopulationMove.proposal`; symmetric."""
        a, b = pairs(len(here), len(others), random)
        share = random.choice([0.2, 0.5, 1.0], size=(len(here), 1))
        moved = random.rand(*here.shape) < share
        scale = scales(len(here), here.shape[1] * share, random)
        step = scale * jittered(others[a] - others[b], random)
        return here + np.where(moved, step, 0.0), np.zeros(len(here))
