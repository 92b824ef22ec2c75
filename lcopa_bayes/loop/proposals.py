"""Moves of the loop's walkers: jumps to a t law, and walks on a surrogate that end in one proposal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias, final

import emcee
import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector

Proposal: TypeAlias = Callable[[Matrix, np.random.RandomState], tuple[Matrix, Vector]]
"""Walkers (batch, k) -> proposed ones, and log of the ratio of the proposals' densities, back over forth."""

_FREEDOM = 12
"""Degrees of freedom of the jump's t distribution [-]: heavier tails than any posterior it is used on."""
_STEPS = 30
_STEPS_NEAR = 8
"""Steps on the surrogate per proposal, of long walks and of those that stay near [-]."""
_LEARNERS = 64
_LEARNT = 15
"""Walks on the surrogate that its mean and covariance are learnt from, the first third discarded [-]."""
_SHORTEST = 0.1
"""Shortest stride on the surrogate, over the longest [-]."""
_LONGEST = 2.4
"""Longest stride over the scale of the posterior, times the root of its dimension [-] (Roberts, Gelman &
Gilks 1997, Ann. Appl. Probab. 7)."""


@final
@dataclass(frozen=True, eq=False)
class Jump:
    """Independent proposals from a t distribution."""

    centre: Vector
    """(k,)."""
    root: Matrix
    """Any L with L L' the scale matrix, (k, k)."""

    @classmethod
    def of(cls, centre: Vector, covariance: Matrix) -> Jump:
        """With this scale matrix; directions in which it is singular get 1e-6 of the largest spread."""
        sd = np.sqrt(np.diag(covariance))
        values, vectors = np.linalg.eigh(covariance / np.outer(sd, sd))
        return cls(centre, sd[:, None] * vectors * np.sqrt(np.maximum(values, 1e-12 * values[-1])))

    def updated(self, draws: Matrix) -> Jump:
        """With mean and covariance of further draws (count, k); its own weigh as many as 4 k of them."""
        share = len(draws) / (len(draws) + 4 * self.centre.size)
        covariance = share * np.cov(draws.T) + (1 - share) * self.root @ self.root.T
        return Jump.of(share * draws.mean(axis=0) + (1 - share) * self.centre, covariance)

    def drawn(self, count: int, random: np.random.RandomState) -> Matrix:
        """(count, k)."""
        size = np.sqrt(_FREEDOM / random.chisquare(_FREEDOM, count))[:, None]
        return np.asarray(
            self.centre + (size * random.standard_normal((count, self.centre.size))) @ self.root.T
        )

    def log_density(self, z: Matrix) -> Vector:
        """Up to a constant, (batch, k) -> (batch,)."""
        u = np.linalg.solve(self.root, (z - self.centre).T)
        return np.asarray(-0.5 * (_FREEDOM + self.centre.size) * np.log1p((u**2).sum(axis=0) / _FREEDOM))

    def __call__(self, here: Matrix, random: np.random.RandomState) -> tuple[Matrix, Vector]:
        """As a `Proposal`."""
        there = self.drawn(len(here), random)
        return there, self.log_density(here) - self.log_density(there)


@final
@dataclass(frozen=True, eq=False)
class Walk:
    r"""Metropolis steps on a surrogate :math:`\pi^*`, every walker by itself; their end is the proposal.

    The steps leave :math:`\pi^*` invariant and are reversible under it, so that accepting their end y from x
    with probability :math:`\min(1, \pi(y) \pi^*(x) / \pi(x) \pi^*(y))` leaves :math:`\pi` invariant, whatever
    the surrogate (Christen & Fox 2005, J. Comput. Graph. Stat. 14; Liu 2001, Monte Carlo Strategies, 9.4.3).
    """

    surrogate: Callable[[Matrix], Vector]
    jump: Jump
    near: bool = False
    """Whether it only strides, a few times: it ends where the surrogate errs alike, and is accepted where far
    ones are not."""

    def __call__(self, here: Matrix, random: np.random.RandomState) -> tuple[Matrix, Vector]:
        """As a `Proposal`."""
        z, count = here.copy(), len(here)
        first = value = self.surrogate(z)
        density = self.jump.log_density(z)
        longest = _LONGEST / np.sqrt(z.shape[1])
        for _ in range(_STEPS_NEAR if self.near else _STEPS):
            far = random.random_sample(count) < (0.0 if self.near else 0.5)
            stride = longest * _SHORTEST ** random.random_sample(count)
            near = z + stride[:, None] * random.standard_normal(z.shape) @ self.jump.root.T
            new = np.where(far[:, None], self.jump.drawn(count, random), near)
            found, other = self.surrogate(new), self.jump.log_density(new)
            ratio = found - value + np.where(far, density - other, 0.0)
            taken = np.log(random.random_sample(count)) < ratio
            z[taken], value = new[taken], np.where(taken, found, value)
            density = np.where(taken, other, density)
        return z, first - value


def learnt(
    surrogate: Callable[[Matrix], Vector], centre: Vector, root: Matrix, random: np.random.RandomState
) -> Jump:
    """The t law with mean and covariance of a surrogate, from draws of it."""
    z = np.tile(centre, (_LEARNERS, 1))
    law, chain = Jump(centre, root), []
    for number in range(_LEARNT):
        z, _ = Walk(surrogate, law)(z, random)
        if number >= _LEARNT // 3:
            chain.append(z)
    drawn = np.concatenate(chain)
    return Jump.of(drawn.mean(axis=0), np.cov(drawn.T))


class Counted(emcee.moves.MHMove):  # type: ignore[misc]
    """A Metropolis-Hastings move that counts what is accepted."""

    def __init__(self, proposal: Proposal) -> None:
        super().__init__(proposal)
        self.tried, self.taken = 0, 0

    def propose(self, model: Any, state: Any) -> tuple[Any, Any]:
        """One move of all walkers."""
        state, accepted = super().propose(model, state)
        self.tried += accepted.size
        self.taken += int(accepted.sum())
        return state, accepted

    @property
    def acceptance(self) -> float:
        """Share that is accepted, one success and one failure added [-]."""
        return (self.taken + 1) / (self.tried + 2)
