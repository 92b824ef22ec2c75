"""Which refits of a round may be kept, which of them leads, and with what that is confounded."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.refits import Refit, refit
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.signature import Projection, expected_margin, signature_of
from lcopa_bayes.effectsearch.trace import Trace
from lcopa_bayes.effectsearch.verdict import MARGIN

SINGLE = 0.3
"""Share of the residual's power that an effect must take when a single record is all there is [-]."""
CLEAR = 1.5
"""Residual over noise from which a single record names anything: its noise may differ from level to level
[-]."""


def accepted(refits: Sequence[Refit], seen: Trace, bar: float, *, generic: bool = True) -> list[Refit]:
    """Refits that may be kept, by falling evidence; behind a generic class too where that is no rival.

    What linear dynamics without a name explain as well is no evidence of a name: a zero, a further lag, or
    paths that differ in what the model lets them share look like many effects.
    """
    linear = max((one.log_bayes_factor for one in refits if one.dynamics), default=-np.inf)
    ahead = (one for one in refits if one.dynamics or one.log_bayes_factor > linear + MARGIN)
    # beside such dynamics a linear effect is one more of them
    ahead = (one for one in ahead if one.dynamics or not (one.linear and one.unnamed))
    return [one for one in ahead if acceptable(one, seen, bar, generic=generic)]


def beside_dynamics(likely: Sequence[Refit], dynamics: Sequence[Refit]) -> list[Refit]:
    """Accepted refits from the first on that linear `dynamics` leave something to explain.

    A linear effect is one of the dynamics; it must remain beside those of no more coefficients, and beats
    the others by its few. Any other effect must remain beside each of them.
    """
    for number, one in enumerate(likely):
        rivals = [each for each in dynamics if not (one.linear and len(each.new) > len(one.new))]
        if one.dynamics or all(_remains(rival, one) for rival in rivals):
            return list(likely[number:])
    return []


def _remains(linear: Refit, candidate: Refit) -> bool:
    """Whether the effects of a refit are worth naming beside linear dynamics.

    They are where they are ahead by more than the coefficients of these can cost.
    """
    if candidate.log_bayes_factor - linear.log_bayes_factor > MARGIN * (1 + len(linear.new)):
        return True
    kept = {e.name for e in linear.model.effects}
    sizes = candidate.model.sizes(candidate.optimum.x)
    added = [(effect, size) for effect, size in sizes if effect.name not in kept]
    try:
        both = refit(linear.model, linear.optimum, linear.whitening, added, linear.quiet)
    except ArithmeticError:
        return False
    return both.log_bayes_factor > MARGIN and both.significant


def acceptable(candidate: Refit, seen: Trace, bar: float, *, generic: bool = True) -> bool:
    """Whether a refit has more evidence than a `bar` [nat] and any `generic` class, predicts records left out
    better, and is a significant effect at a possible optimum."""
    generics = (g for g in seen.traced if generic and g.card.place == "generic")
    others = (g for g in generics if not (candidate.dynamics and g.card.dynamics))
    rival = max((g.log_bayes_factor for g in others), default=-np.inf)
    ahead = candidate.log_bayes_factor > rival + MARGIN
    return (
        candidate.log_bayes_factor > bar
        and ahead
        and candidate.left_out > 0
        and candidate.significant
        and candidate.resting
        and candidate.possible
    )


def large(candidate: Refit) -> bool:
    """Whether an effect is so large that a single record may name it."""
    return candidate.taken > SINGLE and candidate.excess > CLEAR


def leader(accepted: Sequence[Refit]) -> Refit | None:
    """The refit of largest evidence; of those level with it the first whose coefficients all records share,
    since one of a single record predicts no other, unless it predicts records left out worse."""
    if not accepted:
        return None
    first = accepted[0]
    level = [one for one in accepted if one.log_bayes_factor > first.log_bayes_factor - MARGIN]
    shared = (one for one in level if not any(c.record is not None for c in one.new))
    return next((one for one in shared if one.left_out > first.left_out - MARGIN), first)


def group(state: State, chosen: Refit, refits: Sequence[Refit], seen: Trace) -> tuple[str, ...]:
    """Names that these records confound with the chosen one, its own first.

    A rival that was refitted belongs to the group when it lost by less than 3 nat; one that was not, when the
    margin expected at the fitted size, which the angle between projected signatures sets, is below 3 nat.
    Where noise was fitted jointly that margin would count the effect as noise, and only refits say.
    """
    name = chosen.added[0]
    project = Projection(state.optimum.moving * state.model.spread)
    (effect,) = [one for one in chosen.model.effects if one.name == name]
    own = signature_of(state.model, state.optimum.x, state.whitening, project, effect)
    where = chosen.places(name)
    amplitude = chosen.optimum.x[where] / chosen.model.spread[where]
    out = [name]
    fitted = {one.added[0]: one for one in refits}
    for one in seen.traced:
        if one.name == name or one.card.place == "generic" or not one.signatures:
            continue
        if one.name in fitted:
            if chosen.log_bayes_factor - fitted[one.name].log_bayes_factor < MARGIN:
                out.append(one.name)
            continue
        if chosen.whitening.dependence:
            continue
        margin = min(expected_margin(own, amplitude, rival, seen.scale) for rival in one.signatures)
        if margin < MARGIN:
            out.append(one.name)
    return tuple(out)


def single_record(study: Study) -> tuple[str, ...]:
    """What a single record leaves open."""
    if len(study.fit) > 1:
        return ()
    said = "an effect of the device and a peculiarity of a single record are confounded"
    if not study.held_out:
        said += (
            f": an effect is named only where the residual is {CLEAR:g} times the noise and it takes "
            f"{100 * SINGLE:.0f} % of its power"
        )
    return (f"{said}; fit a second record",)
