"""How long chains remember where they started: what is left out of them, and whether they are long enough."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lcopa_bayes.arrays import Array
from lcopa_bayes.inference.grade import Quality, qualities

_LENGTH = 6.0
"""Least length of a chain over the steps after which it forgets [-]."""
_FORGET = 3.0
"""Steps left out at the start of a chain over those after which it forgets [-]: of starts twice as wide as
the posterior less than 1 % of the excess variance is left then."""


def memory(measured: Sequence[Quality], chains: Array) -> float:
    """Steps after which the slowest coordinate of chains (ensembles, walkers, draws, k) forgets where it was:
    draws over the smallest effective sample size within chains; infinite where nothing has moved."""
    worst = np.min([(quality.ess_bulk, quality.ess_tail) for quality in measured])
    return float(chains[..., 0].size / worst) if worst > 0 else np.inf  # NaN is not above 0


def settled(chains: Array) -> Array:
    """Chains (ensembles, walkers, draws, k) without the draws that still remember the starts.

    Three times the memory of the slowest coordinate is left out, at most half of all draws. It is measured on
    the later half, which the starts have affected least.
    """
    steps = chains.shape[2]
    later = chains[:, :, steps // 2 :]
    names = [str(k) for k in range(chains.shape[3])]
    start = min(np.ceil(_FORGET * memory(qualities(names, later), later)), steps // 2)
    return chains[:, :, int(start) :]


def long_enough(measured: Sequence[Quality], chains: Array) -> bool:
    """Whether every walker took many times the steps after which it forgets where it was: from shorter chains
    that number of steps cannot be told."""
    return bool(chains.shape[2] > _LENGTH * memory(measured, chains))
