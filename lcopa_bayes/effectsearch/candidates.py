"""Candidates of a round: named effects within reach of the best, refitted with everything free."""

from __future__ import annotations

import numpy as np

from lcopa_bayes.effectsearch.constants import tuned
from lcopa_bayes.effectsearch.descents import descended, movable, rough
from lcopa_bayes.effectsearch.refits import Refit, refit, under_one_noise
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.signature import Signature
from lcopa_bayes.effectsearch.trace import SEEN, Trace, Traced

_CANDIDATES = 4
_TUNED = 8
"""Named effects whose internal constants are moved off their grid before they are ranked [-]."""
NEAR = 0.7
"""Candidates reach this share of the best log Bayes factor [-]."""


def refitted(state: State, seen: Trace) -> tuple[list[Refit], list[str], dict[str, Signature]]:
    """Refits of what may be named, by falling evidence; what could not be refitted and why; best instances.

    Candidates come near the best of all with their internal constants moved off the grid. Effects that the
    base model imitates to first order are tried too, from the size of their prior.
    """
    named = [one for one in seen.traced if one.card.place != "generic" and one.signatures][:_TUNED]
    worth = [one for one in named if one.log_bayes_factor > 0]
    done, failures, signatures = [], [], {}
    for one in worth:
        signatures[one.name] = tuned(state.model, state.optimum, state.whitening, one, seen)
    reached = {name: seen.alone(signature) for name, signature in signatures.items()}
    ranked = sorted(reached, key=lambda name: -reached[name])
    # noise fitted jointly holds the misfit too: only a refit shows what an effect is worth
    least = -np.inf if not seen.alarmed else NEAR * max(reached.values(), default=0.0)
    near = [name for name in ranked if reached[name] > least][:_CANDIDATES]
    far = rough(seen)
    near = ranked if far else near
    blind = [one for one in _blind(seen) if one.name not in near] if seen.alarmed and near else []
    signatures |= {one.name: one.signatures[one.best] for one in blind}
    sizes = {name: signatures[name].amplitude(seen.residual) for name in near}
    sizes |= {one.name: np.ones(signatures[one.name].columns.shape[1]) for one in blind}
    for name, amplitude in sizes.items():
        signature = signatures[name]
        try:
            effect, reached_at = signature.effect, None
            if far and movable(seen.of(name)):
                effect, reached_at = descended(state, seen, seen.of(name), signature)
                amplitude = reached_at[-amplitude.size :] / state.model.having(effect).scale
            done.append(
                refit(
                    state.model,
                    state.optimum,
                    state.whitening,
                    [(effect, amplitude)],
                    seen.scale.quiet,
                    reached_at,
                )
            )
        except ArithmeticError as error:
            failures.append(f"{name}: {error}")
    return under_one_noise(done), failures, signatures


def _blind(seen: Trace) -> list[Traced]:
    """Effects of the reading that the base model imitates to first order: a refit may still show them."""
    return [
        one
        for one in seen.traced
        if one.card.place == "output" and 0 < one.survival < SEEN and len(one.signatures) == 1
    ]
