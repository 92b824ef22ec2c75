"""Evidence and weights of nested sampling from its dead points, whatever runs they come from.

A run with N live points is N strands: each starts in the prior and continues to higher likelihood, point by
point (Higson et al. 2018, Bayesian Analysis 13). Strands of several runs together are a run with
all their live points; drawing strands again with replacement gives the sampling error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from scipy.special import logsumexp

from lcopa_bayes.core.arrays import Flags, Index, Matrix, Vector


@final
@dataclass(frozen=True, eq=False)
class Strands:
    """Dead points of one or more runs by increasing likelihood."""

    coordinates: Matrix
    """(points, dimension)."""
    log_likelihood: Vector
    """(points,) [nat]."""
    strand: Index
    """Strand of each point, 0..strands - 1, (points,)."""

    @classmethod
    def of(cls, coordinates: Matrix, log_likelihood: Vector, strand: Index) -> Strands:
        """Points in any order."""
        order = np.argsort(log_likelihood, kind="stable")
        return cls(coordinates[order], log_likelihood[order], strand[order])

    @classmethod
    def joined(cls, runs: Sequence[Strands]) -> Strands:
        """All strands of several runs of the same posterior."""
        first = np.cumsum([0, *(run.strands for run in runs)])
        return cls.of(
            np.concatenate([run.coordinates for run in runs]),
            np.concatenate([run.log_likelihood for run in runs]),
            np.concatenate([run.strand + start for run, start in zip(runs, first, strict=False)]),
        )

    @property
    def strands(self) -> int:
        """Number of strands."""
        return int(self.strand.max()) + 1

    def log_weights(self, copies: Index | None = None) -> Vector:
        """Log of each point's share of the evidence, (points,) [nat]; their sum is the evidence.

        The prior volume above a point shrinks by ``n / (n + m)`` as m copies of it leave n live points.
        `copies`, (strands,), is how often each strand is counted; once by default.
        """
        count = np.ones(self.strands, dtype=np.intp) if copies is None else copies
        leaving = count[self.strand]
        ended = np.cumsum(np.where(self._last, leaving, 0)) - np.where(self._last, leaving, 0)
        live = np.maximum(count.sum() - ended, 1)
        log_volume = np.cumsum(np.log(live) - np.log(live + leaving))
        shell = np.concatenate(([0.0], log_volume[:-1]))
        with np.errstate(divide="ignore"):  # a strand that is not there has no shell
            log_width = shell + np.log(-np.expm1(log_volume - shell))
        return np.asarray(self.log_likelihood + log_width)

    @property
    def _last(self) -> Flags:
        """Whether a point ends its strand."""
        last = np.zeros(self.strand.size, dtype=bool)
        last[self.strand.size - 1 - np.unique(self.strand[::-1], return_index=True)[1]] = True
        return last

    def log_evidence(self, copies: Index | None = None) -> float:
        """Log evidence [nat]."""
        return float(logsumexp(self.log_weights(copies)))

    def redrawn(self, rng: np.random.Generator) -> Index:
        """`copies` of strands drawn again with replacement, (strands,)."""
        return np.bincount(rng.integers(self.strands, size=self.strands), minlength=self.strands)
