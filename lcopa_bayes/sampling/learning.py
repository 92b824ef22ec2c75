"""When the mixture that moves follow is learned, and from what."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lcopa_bayes.core.arrays import Array
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.cover import Cover
from lcopa_bayes.sampling.ensemble import Ensemble
from lcopa_bayes.sampling.mixture import Mixture
from lcopa_bayes.sampling.mixturemoves import learned

LEARNING = 2
"""Rounds before the mixture is learned from the draws of all ensembles; and again at each doubling."""
_WIDE = 0.5
"""Share of the mixture that is learned from the populations on their way from the prior [-]."""
_KNOWN = 0.2
"""Share of modes that are known from elsewhere, where there are any [-]."""

_COMPONENTS = 40
"""Components of the cover that is learned."""


def taught(
    posterior: Posterior, ensembles: Sequence[Ensemble], per_round: int, seed: int, known: Mixture | None
) -> Mixture:
    """The mixture that moves follow: learned from the later half of the draws at the last power of two,
    and in part from the populations on their way from the prior, which saw modes that few walkers stand
    on; blended with the modes `known` from elsewhere.

    `per_round` draws are kept of each walker in a round. A function of the chains alone, so that a resumed
    run learns the same; learning thins out, as the ergodicity of adaptive sampling asks (Roberts and
    Rosenthal 2007, J. Appl. Probab. 44).
    """
    wide = learned(posterior, [ensemble.trail for ensemble in ensembles], seed).levelled()
    lesson = _lesson(ensembles, per_round)
    found = learned(posterior, lesson, seed).levelled().blended(wide, _WIDE) if lesson else wide
    return found if known is None else found.blended(known, _KNOWN)


def taught_cover(
    posterior: Posterior, ensembles: Sequence[Ensemble], per_round: int, seed: int
) -> Cover | None:
    """A levelled cover of the same draws that `taught` learns from; None before there are any."""
    lesson = _lesson(ensembles, per_round)
    if not lesson:
        return None
    pooled = np.concatenate([chain.reshape(-1, posterior.dimension) for chain in lesson])
    return Cover.fitted(posterior, pooled, seed, _COMPONENTS).levelled()


def _lesson(ensembles: Sequence[Ensemble], per_round: int) -> list[Array]:
    """The later half of the draws at the last power of two of rounds, by ensemble; none before `LEARNING`."""
    done = ensembles[0].chain.shape[0] // per_round
    if done < LEARNING:
        return []
    last = per_round << (done.bit_length() - 1)
    return [ensemble.chain[last // 2 : last] for ensemble in ensembles]
