"""Moves of emcee that follow a mixture fitted to earlier draws, anywhere at once or nearby."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, final

import numpy as np

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.coordinates import Chart
from lcopa_bayes.sampling.mixture import Mixture
from lcopa_bayes.sampling.moves import PopulationMove, scales

_JOINTLY = 16
"""Most coordinates that one mixture proposes for at once: of more, hardly a proposal is accepted [-]."""


def learned(posterior: Posterior, chains: Sequence[Array], seed: int) -> Mixture:
    """Mixture in the chart of a posterior, fitted to chains (draws, walkers, dimension).

    From the draws of all ensembles: a mode that one has reached, all can then reach. About the middle of the
    chart where nearly all draws are in corners of the prior, which have no place in it: walkers then move by
    each other alone.
    """
    pooled = np.concatenate([chain.reshape(-1, posterior.dimension) for chain in chains])
    charted = Chart.of(posterior).usable(pooled)[1]
    return Mixture.fitted(charted if len(charted) > 1 else np.zeros((2, posterior.dimension)), seed)


def parts(posterior: Posterior, mixture: Mixture) -> list[tuple[Index, Mixture]]:
    """Columns of the chart that moves propose for together, with the mixture of these: all of them, or of
    many those that act on the same response axes, and those of one element, one noise or one delay."""
    every = np.arange(posterior.dimension)
    if every.size <= _JOINTLY:
        return [(every, mixture)]
    keys = [list(each) for each in zip(*map(tuple, _sharing(posterior)), strict=True)]
    groups = [np.flatnonzero([key == one for key in own]) for own in keys for one in dict.fromkeys(own)]
    return [(group, mixture.marginal(group)) for group in groups]


def _sharing(posterior: Posterior) -> Iterator[tuple[tuple[int, ...], tuple[str, int]]]:
    """Of each sampled coordinate the response axes it acts on, and the element, noise or slot it is of."""
    table = posterior.table
    for k in posterior.sampled:
        row = table.rows[k]
        element = row.kind in ("time", "order")
        yield (
            table.acting_on(k),
            ("element" if element else "noise" if row.noise else row.kind, row.place.first),
        )


@final
class MixtureMove(PopulationMove):
    """Independence proposals: a walker goes anywhere in the charted posterior in one step, or in one of its
    `parts`.

    The mixture is fixed while it is used, so detailed balance holds exactly (Tierney 1994, Ann.
    Statist. 22).
    """

    def __init__(self, chart: Chart, groups: Sequence[tuple[Index, Mixture]]) -> None:
        super().__init__(chart.terrain)
        self.chart, self.groups = chart, groups

    def proposal(self, here: Matrix, others: Matrix, random: Any) -> tuple[Matrix, Vector]:
        """See `PopulationMove.proposal`."""
        own, mixture = chosen(self.groups, random)
        y, log_volume = self.chart.charted(here)
        new = y.copy()
        new[:, own] = mixture.draw(len(here), random)
        new[~np.isfinite(new).all(axis=1)] = 0.0  # at an end of a range, where the log volume is infinite too
        proposed, exists = self.chart.uncharted(new)
        proposed[~exists] = here[~exists]
        before = _log_density(mixture, y[:, own], log_volume)
        new, log_volume = self.chart.charted(proposed)
        after = _log_density(mixture, new[:, own], log_volume)
        exists &= np.isfinite(before) & np.isfinite(after)
        factor = np.full(len(here), -np.inf)
        factor[exists] = before[exists] - after[exists]
        return proposed, factor


def chosen(groups: Sequence[tuple[Index, Mixture]], random: Any) -> tuple[Index, Mixture]:
    """One of the groups, chosen evenly."""
    return groups[int(random.randint(len(groups))) if len(groups) > 1 else 0]


def _log_density(mixture: Mixture, y: Matrix, log_volume: Vector) -> Vector:
    """Minus infinity at an end of a range, where the chart is infinite."""
    inner = np.isfinite(y).all(axis=1) & np.isfinite(log_volume)
    out = np.full(len(y), -np.inf)
    out[inner] = mixture.log_density(y[inner]) + log_volume[inner]
    return out


@final
class MixtureWalk(PopulationMove):
    """A step as long and as wide as the component a walker belongs to.

    The component is drawn from its probability at the walker; the factor is the ratio of that
    probability at both ends, as the reverse step needs.
    """

    def __init__(self, chart: Chart, groups: Sequence[tuple[Index, Mixture]]) -> None:
        super().__init__(chart.terrain)
        self.chart, self.groups = chart, groups

    def proposal(self, here: Matrix, others: Matrix, random: Any) -> tuple[Matrix, Vector]:
        """See `PopulationMove.proposal`."""
        (own, mixture), rows = chosen(self.groups, random), np.arange(len(here))
        y, log_volume = self.chart.charted(here)
        y[~np.isfinite(y).all(axis=1)] = 0.0  # at an end of a range, where the log volume is infinite too
        shares = mixture.log_shares(y[:, own])
        component = np.argmax(shares + random.gumbel(size=shares.shape), axis=0)
        steps = np.einsum("nij,nj->ni", mixture.factors[component], random.randn(len(here), own.size))
        new_y = y.copy()
        new_y[:, own] += scales(len(here), own.size, random) * np.sqrt(2.0) * steps
        proposed, exists = self.chart.uncharted(new_y)
        proposed[~exists] = here[~exists]
        new_y, new_log_volume = self.chart.charted(proposed)
        new_y[~np.isfinite(new_y).all(axis=1)] = 0.0
        ratio = mixture.log_shares(new_y[:, own])[component, rows] - shares[component, rows]
        exists &= np.isfinite(log_volume) & np.isfinite(new_log_volume) & np.isfinite(ratio)
        factor = np.full(len(here), -np.inf)
        factor[exists] = log_volume[exists] - new_log_volume[exists] + ratio[exists]
        return proposed, factor
