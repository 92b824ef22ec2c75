"""Names that records cannot tell apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from lcopa_bayes.loop.confirm import Refit
from lcopa_bayes.loop.signature import Signature, expected_margin
from lcopa_bayes.loop.trace import Trace
from lcopa_bayes.loop.verdict import MARGIN


def group(
    chosen: Refit, refits: Sequence[Refit], seen: Trace, signatures: Mapping[str, Signature]
) -> tuple[str, ...]:
    """Names that these records cannot tell from the chosen one.

    A rival that was refitted belongs to the group when it lost by less than 3 nat; one that was not, when the
    margin expected at the fitted size, which the angle between projected signatures sets, is below 3 nat.
    Where noise was fitted jointly that margin would count the effect as noise, and only refits say.
    """
    name = chosen.added[0]
    own = signatures[name]
    amplitude = chosen.optimum.x[chosen.places(name)]
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
