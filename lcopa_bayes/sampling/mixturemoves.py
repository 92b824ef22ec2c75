"""Moves of emcee that follow a mixture fitted to earlier draws, anywhere at once or nearby."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.coordinates import Chart
from lcopa_bayes.sampling.mixture import Mixture
from lcopa_bayes.sampling.moves import PopulationMove, scales


def learned(posterior: Posterior, chains: Sequence[Array], seed: int) -> Mixture:
    """Mixture in the chart of a posterior, fitted to chains (draws, walkers, dimension).

    From the draws of all ensembles: a mode that one has reached, all can then reach.
    """
    pooled = np.concatenate([chain.reshape(-1, posterior.dimension) for chain in chains])
    return Mixture.fitted(Chart.of(posterior).usable(pooled)[1], seed)


@final
class MixtureMove(PopulationMove):
    """Independence proposals: a walker goes anywhere in the charted posterior in one step.

    The mixture is fixed while it is used, so detailed balance holds exactly (Tierney 1994, Ann.
    Statist. 22).
    """

    def __init__(self, chart: Chart, mixture: Mixture) -> None:
        super().__init__(chart.terrain)
        self.chart = chart
        self.mixture = mixture

    def proposal(self, here: Matrix, others: Matrix, random: Any) -> tuple[Matrix, Vector]:
        """See `PopulationMove.proposal`."""
        proposed, exists = self.chart.uncharted(self.mixture.draw(len(here), random))
        proposed[~exists] = here[~exists]
        before, after = self._log_density(here), self._log_density(proposed)
        exists &= np.isfinite(before) & np.isfinite(after)
        factor = np.full(len(here), -np.inf)
        factor[exists] = before[exists] - after[exists]
        return proposed, factor

    def _log_density(self, z: Matrix) -> Vector:
        """Minus infinity at an end of a range, where the chart is infinite."""
        y, log_volume = self.chart.charted(z)
        inner = np.isfinite(y).all(axis=1) & np.isfinite(log_volume)
        out = np.full(len(z), -np.inf)
        out[inner] = self.mixture.log_density(y[inner]) + log_volume[inner]
        return out


@final
class MixtureWalk(PopulationMove):
    """A step as long and as wide as the component a walker belongs to.

    The component is drawn from its probability at the walker; the factor is the ratio of that
    probability at both ends, as the reverse step needs.
    """

    def __init__(self, chart: Chart, mixture: Mixture) -> None:
        super().__init__(chart.terrain)
        self.chart = chart
        self.mixture = mixture

    def proposal(self, here: Matrix, others: Matrix, random: Any) -> tuple[Matrix, Vector]:
        """See `PopulationMove.proposal`."""
        rows, dimension = np.arange(len(here)), here.shape[1]
        y, log_volume = self.chart.charted(here)
        y[~np.isfinite(y).all(axis=1)] = 0.0  # at an end of a range, where the log volume is infinite too
        shares = self.mixture.log_shares(y)
        component = np.argmax(shares + random.gumbel(size=shares.shape), axis=0)
        steps = np.einsum("nij,nj->ni", self.mixture.factors[component], random.randn(*here.shape))
        proposed, exists = self.chart.uncharted(
            y + scales(len(here), dimension, random) * np.sqrt(2.0) * steps
        )
        proposed[~exists] = here[~exists]
        new_y, new_log_volume = self.chart.charted(proposed)
        new_y[~np.isfinite(new_y).all(axis=1)] = 0.0
        ratio = self.mixture.log_shares(new_y)[component, rows] - shares[component, rows]
        exists &= np.isfinite(log_volume) & np.isfinite(new_log_volume) & np.isfinite(ratio)
        factor = np.full(len(here), -np.inf)
        factor[exists] = log_volume[exists] - new_log_volume[exists] + ratio[exists]
        return proposed, factor
