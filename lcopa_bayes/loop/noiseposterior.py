"""Autoregressions that samples of noise leave plausible: what an estimate of the noise does not know.

Posterior of order, partial autocorrelations and innovation under flat priors of the order and of every
partial autocorrelation in (-1, 1), and ``1 / sd`` of the innovation; levels of the pieces are integrated out
under a flat prior. The innovation is integrated out in closed form, the correlations by importance sampling
about the mode of every order (Geweke 1989, Econometrica 57).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from scipy.special import gammaln, logsumexp

from lcopa_bayes.arrays import Matrix, Vector
from lcopa_bayes.loop.autoregression import Autoregression
from lcopa_bayes.loop.noisepieces import Mode, NoisePieces

_PROPOSED = 400
"""Proposals per order [-]."""
_TAIL = 4.0
"""Degrees of freedom of the proposals [-]: their tails are wider than those of any posterior here."""
_WIDER = 1.3
"""Factor on the width of the proposals about a mode [-]."""
_STEP = 1e-2
"""Step of the second differences at a mode, in inverse hyperbolic tangents [-]."""
_HELD = 4.0
"""Largest inverse hyperbolic tangent that proposals are centred at (a correlation of 0.999) [-]."""
_WIDEST = 1.0
"""Largest width of proposals, in inverse hyperbolic tangents [-]: a flat prior has about this."""
_DROPPED = 12.0
"""Corrected Akaike criterion above the least from which an order is left out [-]: a weight of 0.003."""
_SEED = 3
"""Of the nodes of the integral: the same pieces give the same answer."""


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
        spread = _WIDER * self._spread(centre)
        normal = rng.standard_normal((_PROPOSED, k))
        shrink = np.sqrt(_TAIL / rng.chisquare(_TAIL, _PROPOSED))
        apart = normal * shrink[:, None]
        log_scale = float(np.linalg.slogdet(spread)[1])
        constant = gammaln((_TAIL + k) / 2) - gammaln(_TAIL / 2) - 0.5 * k * np.log(_TAIL * np.pi)
        out = []
        for z in apart:
            x = centre + spread @ z
            density = constant - log_scale - 0.5 * (_TAIL + k) * np.log1p(z @ z / _TAIL)
            partial = np.tanh(x)
            cost, sd = self.pieces.cost(partial)
            # a flat prior of each partial autocorrelation in the coordinate x: sech(x)^2 / 2
            prior = float((-2 * np.logaddexp(x, -x) + np.log(2.0)).sum())
            out.append(
                (np.clip(partial, -1 + 1e-9, 1 - 1e-9), -cost + prior - density - np.log(_PROPOSED), sd)
            )
        return out

    def _spread(self, centre: Vector) -> Matrix:
        """Triangular root of the covariance about a mode, from second differences, (k, k)."""
        k = centre.size

        def target(x: Vector) -> float:
            return self.pieces.cost(np.tanh(x))[0] + float((2 * np.logaddexp(x, -x)).sum())

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
        width = 1.0 / np.sqrt(np.maximum(power, 1.0 / _WIDEST**2))
        return np.linalg.cholesky((turned * width**2) @ turned.T)

    def draw(self, count: int, rng: np.random.Generator) -> list[Autoregression]:
        """Noise processes of the posterior, `count` of them."""
        proposed, weights, sds = self._pool
        edges = np.cumsum(weights)
        at = np.searchsorted(edges / edges[-1], (rng.uniform() + np.arange(count)) / count)
        freedom = self.pieces.freedom
        factors = np.sqrt(freedom / rng.chisquare(freedom, count))
        chosen = rng.permutation(at)
        return [Autoregression(proposed[k], float(sds[k] * f)) for k, f in zip(chosen, factors, strict=True)]
