"""When the mixture that moves follow is learned, and from what."""

from __future__ import annotations

from collections.abc import Sequence

from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.ensemble import Ensemble
from lcopa_bayes.sampling.mixture import Mixture
from lcopa_bayes.sampling.mixturemoves import learned

LEARNING = 2
"""Rounds before the mixture is learned from the draws of all ensembles."""
_WIDE = 0.5
"""Share of the mixture that is learned from the populations of the tempering path [-]."""
_KNOWN = 0.2
"""Share of modes that are known from elsewhere, where there are any [-]."""


def due(done: int) -> bool:
    """Whether the mixture is learned again after so many rounds: at every power of two."""
    return done >= LEARNING and done.bit_count() == 1


def taught(
    posterior: Posterior, ensembles: Sequence[Ensemble], per_round: int, seed: int, known: Mixture | None
) -> Mixture:
    """The mixture that moves follow: learned from the later half of the draws when it was last due,
    and in part from the populations of the tempering path, which covered modes that few walkers
    are in; blended with the modes `known` from elsewhere.

    `per_round` draws are kept of each walker in a round. A function of the chains alone, so that a resumed
    run learns the same; learning thins out, as the ergodicity of adaptive sampling asks (Roberts and
    Rosenthal 2007, J. Appl. Probab. 44).
    """
    wide = learned(posterior, [ensemble.trail for ensemble in ensembles], seed).levelled()
    last = ensembles[0].chain.shape[0] // per_round
    while last and not due(last):
        last -= 1
    if last == 0:
        mixture = wide
    else:
        first, end = per_round * last // 2, per_round * last
        own = learned(posterior, [ensemble.chain[first:end] for ensemble in ensembles], seed)
        mixture = own.levelled().blended(wide, _WIDE)
    return mixture if known is None else mixture.blended(known, _KNOWN)
