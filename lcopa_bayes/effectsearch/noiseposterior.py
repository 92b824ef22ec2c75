"""Autoregressions that samples of noise leave plausible: what an estimate of the noise does not know.

Posterior of order, partial autocorrelations and innovation: a flat prior of the order, ``1 / sd`` of the
innovation, and ``1 / (pi sqrt(1 - kappa^2))`` of every partial autocorrelation kappa, Jeffreys' prior of the
only one of order 1 in a long record (Berger and Yang 1994, Econometric Theory 10): under a flat one, noise of
correlation near 1 raises more alarms than told. Levels of the pieces are integrated out under a flat prior,
the innovation in closed form, the correlations by importance sampling (Geweke 1989, Econometrica 57): half
of them about the mode of every order, half with a first partial autocorrelation from its prior, since few
samples leave long memories possible far from the mode.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from scipy.special import logsumexp
from scipy.stats import multivariate_t

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.effectsearch.autoregression import Autoregression
from lcopa_bayes.effectsearch.noisepieces import Mode, NoisePieces

_PROPOSED = 600
"""Proposals per order [-]."""
_TAIL = 4
"""Degrees of freedom of the proposals [-]: their tails are wider than those of any posterior here."""
_WIDER = 1.3
"""Factor on the width of the proposals about a mode [-]."""
_STEP = 1e-2
"""Step of the second differences at a mode, in inverse hyperbolic tangents [-]."""
_HELD = 4.0
"""Largest inverse hyperbolic tangent that proposals are centred at (a correlation of 0.999) [-]."""
_WIDEST = 1.0
"""Largest width of proposals, in inverse hyperbolic tangents [-]: the prior is wider still."""
_DROPPED = 12.0
"""Corrected Akaike criterion above the least from which an order is left out [-]: a weight of 0.003."""
_SEED = 3
"""Of the nodes of the integral: the same pieces give the same answer."""


def _log_prior(x: Matrix) -> Vector:
    """Log prior density of partial autocorrelations tanh(x), in x (batch, k): sech(x) / pi each, (batch,)."""
    return np.asarray((np.log(2.0 / np.pi) - np.logaddexp(x, -x)).sum(axis=1))


@final
@dataclass(frozen=True, eq=False)
class _Student:
    """Multivariate Student distribution; that of no coordinates is 1."""

    centre: Vector
    shape: Matrix

    def draw(self, count: int, rng: np.random.Generator) -> Matrix:
        """(count, k)."""
        if not self.centre.size:
            return np.empty((count, 0))
        drawn = multivariate_t(self.centre, self.shape, df=_TAIL, seed=rng).rvs(count)
        return np.reshape(drawn, (count, self.centre.size))

    def log_density(self, x: Matrix) -> Vector:
        """At x (batch, k), (batch,)."""
        if not self.centre.size:
            return np.zeros(len(x))
        return np.reshape(multivariate_t.logpdf(x, self.centre, self.shape, _TAIL), len(x))


@final
@dataclass(frozen=True, eq=False)
class NoisePosterior:
    """Posterior of the noise given pieces of it."""

    pieces: NoisePieces

    @cached_property
    def _pool(self) -> tuple[list[Vector], Vector, Vector]:
        """Proposed partial autocorrelations, their normalised weights and their best innovation sd."""
        modes = self.pieces.modes
        least = min(one.criterion for one in modes)
        rng = np.random.default_rng(_SEED)
        proposed: list[Vector] = []
        logs: list[float] = []
        sds: list[float] = []
        for mode in modes:
            if mode.criterion > least + _DROPPED:
                continue
            for partial, log_weight, sd in self._about(mode, rng):
                proposed.append(partial)
                logs.append(log_weight)
                sds.append(sd)
        weights = np.exp(np.array(logs) - logsumexp(logs))
        return proposed, weights, np.array(sds)

    def _about(self, mode: Mode, rng: np.random.Generator) -> list[tuple[Vector, float, float]]:
        """Proposals of one order: partial autocorrelations, log weight, innovation sd."""
        k = mode.partial.size
        if not k:
            return [(mode.partial, -mode.cost, mode.innovation_sd)]
        centre = np.clip(np.arctanh(mode.partial), -_HELD, _HELD)  # where to propose from only
        covariance = self._covariance(centre)
        near, rest = _Student(centre, covariance), _Student(centre[1:], covariance[1:, 1:])
        half = _PROPOSED // 2
        first = np.arctanh(np.sin(np.pi * (rng.uniform(size=(half, 1)) - 0.5)))
        x = np.concatenate([near.draw(half, rng), np.hstack([first, rest.draw(half, rng)])])
        wide = _log_prior(x[:, :1]) + rest.log_density(x[:, 1:])
        density = np.logaddexp(near.log_density(x), wide) - np.log(2.0)
        found = [self.pieces.cost(np.tanh(one)) for one in x]
        logs = _log_prior(x) - density - np.log(len(x)) - np.array([cost for cost, _ in found])
        partial = np.clip(np.tanh(x), -1 + 1e-9, 1 - 1e-9)  # as `cost` takes them: rounding alone gives 1
        return [(one, float(log), sd) for one, log, (_, sd) in zip(partial, logs, found, strict=True)]

    def _covariance(self, centre: Vector) -> Matrix:
        """Covariance of proposals about a mode, from second differences, (k, k)."""
        k = centre.size

        def target(x: Vector) -> float:
            return self.pieces.cost(np.tanh(x))[0] - float(_log_prior(x[None])[0])

        steps, middle = _STEP * np.eye(k), target(centre)
        hessian = np.empty((k, k))
        for i in range(k):
            for j in range(i + 1):
                four = [
                    target(centre + a * steps[i] + b * steps[j]) if i != j else np.nan
                    for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))
                ]
                if i == j:
                    value = (target(centre + steps[i]) - 2 * middle + target(centre - steps[i])) / _STEP**2
                else:
                    value = (four[0] - four[1] - four[2] + four[3]) / (4 * _STEP**2)
                hessian[i, j] = hessian[j, i] = value
        power, turned = np.linalg.eigh(hessian)
        width = _WIDER / np.sqrt(np.maximum(power, 1.0 / _WIDEST**2))
        return np.asarray((turned * width**2) @ turned.T)

    def draw(self, count: int, rng: np.random.Generator) -> list[Autoregression]:
        """Noise processes of the posterior, `count` of them."""
        proposed, weights, sds = self._pool
        edges = np.cumsum(weights)
        at = np.searchsorted(edges / edges[-1], (rng.uniform() + np.arange(count)) / count)
        freedom = self.pieces.freedom
        factors = np.sqrt(freedom / rng.chisquare(freedom, count))
        chosen = rng.permutation(at)
        return [Autoregression(proposed[k], float(sds[k] * f)) for k, f in zip(chosen, factors, strict=True)]
