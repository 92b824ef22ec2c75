"""Responses of many draws with effects from simulations of few of them.

A response with effects takes a simulation for each plant. Over a narrow posterior it is nearly a linear or a
quadratic function of the parameters, a response surface (Box and Wilson 1951, J. R. Stat. Soc. B 13): it is
fitted by least squares to simulations of some draws and stands for the others where the error of every
simulated draw without itself is small beside the spread of the draws (PRESS: Allen 1974, Technometrics 16).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lcopa_bayes.core.arrays import Array, Index, Matrix

_ERROR = 0.05
"""Largest error of a surface over the standard deviation of the draws, root mean square over samples [-]: in
quadrature it widens a band by 0.1 % ..."""
_LARGEST = 0.5
"""... and at any one sample, where an onset is."""
_PER_TERM = 2
"""Simulations per term of a surface [-]."""


def surfaced(
    simulated: Callable[[Matrix], Array], values: Matrix, moving: Matrix, rng: np.random.Generator
) -> Array:
    """Responses of draws, (axes, draws, samples): by simulation of those a surface needs, or of all where no
    surface follows them.

    Parameters: `simulated` gives responses (axes, batch, samples) of table `values`, (draws, rows), NaN where
    there is no bounded one; `moving`, (draws, k), are the parameters that move responses.
    """
    moving, first, where = np.unique(moving, axis=0, return_index=True, return_inverse=True)
    count, order = len(moving), rng.permutation(len(moving))
    done, responses = 0, np.empty(0)
    for features in _terms(moving):
        wanted = _PER_TERM * features.shape[1]
        if 2 * wanted > count:
            break
        more = simulated(values[first[order[done:wanted]]])
        responses = np.concatenate([responses, more], axis=1) if done else more
        done = wanted
        surface = _surface(features, order[:done], responses)
        if surface is not None:
            return np.asarray(surface[:, where.ravel()])
    more = simulated(values[first[order[done:]]])
    responses = np.concatenate([responses, more], axis=1) if done else more
    return np.asarray(responses[:, order.argsort()[where.ravel()]])


def _terms(moving: Matrix) -> list[Matrix]:
    """Features of a linear surface, and of one with squares along the principal axes, (draws, terms) each."""
    apart = moving - moving.mean(axis=0)
    sd = apart.std(axis=0)
    axes = np.linalg.svd(apart[:, sd > 0] / sd[sd > 0], full_matrices=False)[0] * np.sqrt(len(moving))
    one = np.ones((len(moving), 1))
    return [np.concatenate([one, axes], axis=1), np.concatenate([one, axes, axes**2], axis=1)]


def _surface(features: Matrix, known: Index, responses: Array) -> Array | None:
    """Responses of all draws, those of `known` ones as simulated; None where the surface is too coarse."""
    if np.isnan(responses).any():
        return None
    solve = np.linalg.pinv(features[known])
    own = np.einsum("kt,tk->k", features[known], solve)
    if own.max() > 1 - 1e-9:
        return None
    coefficients = solve @ responses
    missed = (responses - features[known] @ coefficients) / (1 - own)[:, None]
    error, sd = np.sqrt(np.mean(missed**2, axis=1)), responses.std(axis=1)
    ratio = error / np.where(sd > 1e-6 * sd.max(axis=1, keepdims=True), sd, np.inf)
    if np.sqrt(np.mean(ratio**2, axis=1)).max() > _ERROR or ratio.max() > _LARGEST:
        return None
    out = features @ coefficients
    out[:, known] = responses
    return np.asarray(out)
