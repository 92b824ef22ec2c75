"""When the mixture that moves follow is learned, and from what."""

from __future__ import annotations

from collections.abc import Sequence

from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.ensemble import Ensemble
from lcopa_bayes.sampling.mixture import Mixture
from lcopa_bayes.sampling.mixturemoves import learned

LEARNING = 2
"""Rounds before the mixture is learned from the draws of all ensembles."""
_WIDE = 1.0
"""Share of the mixture that is learned from the populations on their way from the prior, times rounds [-]."""
_COMPONENTS = 40
"""Most components of the mixture that is learned from draws."""
_KNOWN = 0.2
"""Share of modes that are known from elsewhere, where there are any [-]."""


def due(done: int) -> bool:
    """Whether the mixture is learned again after so many rounds: 2, 3, ... 8, then 10, 12, 14, 16, 20, ...

    Often at first, for a mode that few walkers have met gains components each time; then ever more rarely.
    """
    return done >= LEARNING and done % (1 << max(0, done.bit_length() - 3)) == 0


def taught(
    posterior: Posterior, ensembles: Sequence[Ensemble], per_round: int, seed: int, known: Mixture | None
) -> Mixture:
    """The mixture that moves follow: learned from the later half of the draws when it was last due,
    and in part from the populations on their way from the prior, which saw modes that few walkers stand
    on; blended with the modes `known` from elsewhere.

    `per_round` draws are kept of each walker in a round. A function of the chains alone, so that a resumed
    run learns the same; learning thins out, as the ergodicity of adaptive sampling asks (Roberts and
    Rosenthal 2007, J. Appl. Probab. 44).
    """
    wide = learned(posterior, [ensemble.trail for ensemble in ensembles], seed).levelled()
    last = ensembles[0].chain.shape[0] // per_round
    while last and not due(last):
        last -= 1
    if last == 0:
        found = wide
    else:
        first, end = per_round * last // 2, per_round * last
        own = learned(posterior, [ensemble.chain[first:end] for ensemble in ensembles], seed, _COMPONENTS)
        found = own.levelled().blended(wide, _WIDE / last)
    return found if known is None else found.blended(known, _KNOWN)
