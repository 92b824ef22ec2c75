"""The measurement that would tell apart what these records cannot."""

from __future__ import annotations

from collections.abc import Sequence

from lcopa_bayes.loop.loop import Loop
from lcopa_bayes.loop.trace import SEEN
from lcopa_bayes.plant.effects.effect import Card


def next_measurement(found: Loop) -> str:
    """In words: what excitation splits a group, finds what is unexplained, or shows what stayed invisible."""
    trace = found.trace
    if trace is None:
        return "Mend the base fit first: give it records in which it can follow the response."
    if not found.base.noise_known:
        quiet = (
            "a stretch before the first command, or a repeat, so that the noise is known apart from the fit"
        )
        return f"Record {quiet}."
    cards = {one.name: one.card for one in trace.traced}
    for group in found.groups:
        if len(group) > 1:
            wanted = _wanted([cards[name] for name in group if name in cards])
            return f"To tell {', '.join(group)} apart, record {wanted}."
    if found.verdict.kind == "unexplained":
        near = [one for one in trace.traced if one.card.place != "generic"][:2]
        return f"To find what is missing, record {_wanted([one.card for one in near])}." if near else ""
    hidden = [one for one in trace.traced if one.survival < SEEN and one.card.place != "generic"]
    if hidden:
        names = ", ".join(one.name for one in hidden[:3])
        return f"These records could not show {names}; {_wanted([one.card for one in hidden[:3]])} would."
    return ""


def _wanted(cards: Sequence[Card]) -> str:
    """What reveals these effects, each excitation once."""
    told = (part.strip() for card in cards for part in card.reveals.split(";")[0].split(","))
    return ", ".join(dict.fromkeys(told))
