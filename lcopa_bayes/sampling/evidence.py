"""Log evidence by bridge sampling between the posterior and a mixture fitted to it.

Meng and Wong (1996), Statistica Sinica 6; Gronau et al. (2017), J. Math. Psychol. 81. Each ensemble gives
an estimate of its own: a mixture fitted to the draws of the others, in the chart of the posterior, is
bridged to its draws. So no draw is used twice, and the spread of the estimates includes the error of
populations that have not reached the same modes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from scipy.optimize import brentq
from scipy.special import log_expit, logsumexp

from lcopa_bayes.core.arrays import Array, Vector
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.convergence import Grade, Level
from lcopa_bayes.sampling.coordinates import Chart, charted_density
from lcopa_bayes.sampling.mixture import Mixture, spread_evenly
from lcopa_bayes.sampling.run import Run

_RELIABLE = 0.5
"""Largest standard error of a reliable log evidence or log predictive density: a model comparison turns on a
few nats [nat]."""
_TENTATIVE = 2.0
"""Above it the estimates of the ensembles differ [nat]."""
_BRIDGED = 3_000
"""Draws of each side of a bridge."""
_SETTLED = 1e-10
"""Accuracy of the log ratio of a bridge [nat]."""
_BEYOND = 50.0
"""Distance of the ends between which the log ratio is sought from all that draws give [nat]."""


@final
@dataclass(frozen=True)
class Evidence:
    """Log evidence of a posterior."""

    value: float
    """Mean over ensembles [nat]."""
    sd: float
    """Standard error of the mean, by the ensembles' spread or the draws' number if that is larger [nat]."""
    by_ensemble: tuple[float, ...]
    """One estimate per ensemble [nat]."""

    @property
    def grade(self) -> Grade:
        """Reliable with an error of at most half a nat, unusable with more than two."""
        return Grade(known_to(self.sd), f"log evidence {self.value:.2f}, standard error {self.sd:.2f} nat")


def known_to(error: float) -> Level:
    """Level of a sum of log densities by its Monte Carlo standard error [nat]; unusable without an error."""
    return "reliable" if error <= _RELIABLE else "tentative" if error <= _TENTATIVE else "unusable"


def evidence_of(posterior: Posterior, run: Run, ess: float) -> Evidence | None:
    """Log evidence of a run: the mean weight of importance draws, with that of every batch; or `evidence` of
    its ensembles. None and `ess` as there."""
    weighted = run.weighted
    if weighted is None:
        return evidence(posterior, run.kept()[0], ess, run.plan.seed)
    by_batch = tuple(weighted.batch_evidence.tolist())
    return Evidence(weighted.log_evidence, weighted.log_evidence_sd, by_batch)


def evidence(posterior: Posterior, coordinates: Array, ess: float, seed: int) -> Evidence | None:
    """Log evidence from draws (ensembles, walkers, draws, dimension); None for a single ensemble.

    None too where the mixture of some ensembles meets no density: they have not reached what the others have.
    `ess` is the smallest effective sample size of all the draws; NaN where walkers hardly moved, so that an
    ensemble counts as one draw. Deterministic given `seed`.
    """
    ensembles, dimension = coordinates.shape[0], coordinates.shape[-1]
    if ensembles < 2:
        return None
    random = np.random.RandomState(np.random.MT19937(np.random.SeedSequence(seed, spawn_key=(2_000,))))
    chart = Chart.of(posterior)
    own_ess = ess / ensembles if np.isfinite(ess) else 1.0
    pools = [chart.usable(spread_evenly(draws.reshape(-1, dimension), _BRIDGED)) for draws in coordinates]
    estimates = []
    for k, (pool, y, log_volume) in enumerate(pools):
        others = np.concatenate([points for j, (_, points, _) in enumerate(pools) if j != k])
        mixture = Mixture.fitted(others, seed)
        drawn = mixture.draw(_BRIDGED, random)
        own = posterior.log_density(pool) + posterior.table.log_permutations - log_volume
        other = charted_density(posterior, chart, drawn) - mixture.log_density(drawn)
        if not (other > -np.inf).any():
            return None
        estimates.append(bridge(own - mixture.log_density(y), other, own_ess))
    values = [value for value, _ in estimates]
    spread = float(np.std(values, ddof=1))
    claimed = float(np.sqrt(np.mean([error**2 for _, error in estimates])))
    return Evidence(float(np.mean(values)), float(max(spread, claimed) / np.sqrt(ensembles)), tuple(values))


def bridge(posterior_side: Vector, mixture_side: Vector, ess: float) -> tuple[float, float]:
    """Log of the ratio of two normalising constants, and its standard error [nat].

    Both arguments are log (unnormalised density / normalised density of the mixture): at draws of the
    first, equivalent to `ess` independent draws, and at independent draws of the mixture; -inf is allowed
    there, not everywhere.
    """
    ess = min(ess, float(posterior_side.size))
    level = np.log(mixture_side.size / ess)
    sides = np.concatenate((posterior_side, mixture_side))
    reach = abs(level) + _BEYOND

    def terms(ratio: float) -> tuple[Vector, Vector]:
        """Logarithms of what the draws of either side count, (n,) each."""
        return log_expit(ratio + level - posterior_side), log_expit(mixture_side - ratio - level)

    def excess(ratio: float) -> float:
        """Falls with the ratio, through 0 where iterating on it (Meng and Wong, eq. 4.1) would stay."""
        first, second = terms(ratio)
        return float(logsumexp(second) - logsumexp(first) + np.log(first.size / ess))

    low, high = sides[sides > -np.inf].min() - reach, sides.max() + reach
    ratio = float(brentq(excess, low, high, xtol=_SETTLED))
    first, second = terms(ratio)
    error = _relative_variance(first) / ess + _relative_variance(second) / second.size
    return ratio, float(np.sqrt(error))


def _relative_variance(log_terms: Vector) -> float:
    terms = np.exp(log_terms - log_terms.max())
    return float(np.var(terms) / np.mean(terms) ** 2)
