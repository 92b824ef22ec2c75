"""What samples at rest say about white measurement noise and a correlated part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from scipy.special import expit

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.inference.mixednoise import WhiteAR1
from lcopa_bayes.inference.observations import Observed

FEWEST = 8
"""Independent deviations from rest below which nothing is derived from them [-]: with 8 a standard deviation
is known to a quarter."""
_LEVELS = 5
"""Different readings at rest below which their scatter is the resolution of the instrument [-]."""
_SHARES = expit(np.linspace(-6.0, 6.0, 25))
"""Shares of the correlated part in the variance that are tried [-]."""
_CORRELATIONS = 12
"""Correlations that are tried [-]."""
_DRAWS = 4000
_UPPER = 0.975
"""Probability that the correlated part is below its limit, at rest [-]."""
_CELLS = 2_000_000
"""Samples times parameter sets that are whitened at once [-]."""


@final
@dataclass(frozen=True)
class QuietNoise:
    """Noise of one response axis as its samples at rest give it."""

    samples: int
    """Samples less one level for each record [-]."""
    sigma: float
    """Posterior median of the white part's standard deviation [response unit]."""
    log_sd: float
    """Posterior standard deviation of its logarithm [-]."""
    correlated: float
    """97.5 % limit of the correlated part's standard deviation [response unit]."""


def quiet_noise(pieces: Sequence[Observed], correlations: tuple[float, float]) -> QuietNoise | None:
    """Posterior of `WhiteAR1` from samples at rest, the level of each piece unknown; None where too few.

    With flat priors on the level of each piece, on the logarithm of the standard deviation, on the share of
    the correlated part in the variance and on its correlation between two `correlations`: level and scale are
    integrated out in closed form, share and correlation over a grid.
    """
    count = sum(piece.values.size - 1 for piece in pieces)
    readings = {value for piece in pieces for value in piece.values}
    if count < FEWEST or len(readings) < _LEVELS:
        return None
    tried = np.linspace(*correlations, _CORRELATIONS)
    shares, rho = (grid.ravel() for grid in np.meshgrid(_SHARES, tried))
    parameters = np.column_stack([np.sqrt(1 - shares), np.sqrt(shares), rho])
    level, squares = np.zeros(len(rho)), np.zeros(len(rho))
    for piece in pieces:
        portions = np.array_split(np.arange(len(rho)), max(1, len(rho) * piece.values.size // _CELLS))
        told = [_about_own_level(piece, parameters[portion]) for portion in portions if portion.size]
        level += np.concatenate([one[0] for one in told])
        squares += np.concatenate([one[1] for one in told])
    weight = level - 0.5 * count * np.log(squares) + np.log(shares * (1 - shares))  # uniform in the share
    weight = np.exp(weight - weight.max())
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(rho), _DRAWS, p=weight / weight.sum())
    scale = np.sqrt(squares[chosen] / rng.chisquare(count, _DRAWS))
    sigma = scale * parameters[chosen, 0]
    limit = float(np.quantile(scale * parameters[chosen, 1], _UPPER))
    return QuietNoise(count, float(np.median(sigma)), float(np.log(sigma).std()), limit)


def _about_own_level(piece: Observed, parameters: Matrix) -> tuple[Vector, Vector]:
    """Log density of a piece under noise of unit variance, its level integrated out, without the sum of
    squares, and that sum, each (batch,)."""
    columns = np.stack([np.ones_like(piece.values), piece.values - piece.values.mean()])[None]
    white, scales = WhiteAR1().whiten(columns, parameters, piece.gaps)
    ones, misfit = white[:, 0], white[:, 1]
    strength = np.einsum("bn,bn->b", ones, ones)
    squares = np.einsum("bn,bn->b", misfit, misfit) - np.einsum("bn,bn->b", ones, misfit) ** 2 / strength
    return -scales - 0.5 * np.log(strength), squares
