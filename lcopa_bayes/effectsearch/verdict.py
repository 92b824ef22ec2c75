"""What the loop concludes, and in which words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, final

Kind = Literal["clean", "explained", "partly explained", "disturbance", "unexplained"]
Confidence = Literal["firm", "tentative"]

EXPLAINED = 0.95
"""Share of the residual power that effects can take which the named ones must take when something significant
remains [-]; with the noise known well it is their share of the log evidence."""
ALONE = 0.8
"""The same from a single record, whose smaller effects are not named [-]."""
UNSEEN = 0.5
"""Share of the error beyond noise on held-out records that named effects may leave [-]."""
RISEN = 1.05
"""Error on held-out records with effects, or of draws, over that without from which neither is used [-]."""
MARGIN = 3.0
"""Log evidence by which a generic class or another set must win [nat]."""
FIRM = 30.0
"""Log evidence that every effect must have brought where names are firm [nat]."""
REACHED = 1.1
"""Root mean square error over noise that an explained axis has on unseen records at most [-]."""


@final
@dataclass(frozen=True)
class Verdict:
    """Conclusion of a loop."""

    kind: Kind
    confidence: Confidence
    sentence: str


@final
@dataclass(frozen=True)
class Findings:
    """What a loop found, as far as the verdict depends on it."""

    failed: str
    """Why the base fit cannot be used; empty when it can."""
    cautions: tuple[str, ...]
    alarmed: bool
    """Whether any class of effect was above the threshold in the first residual."""
    largest: float
    """Largest log Bayes factor there [nat]."""
    threshold: float
    """[nat]."""
    effects: tuple[str, ...]
    """Named effects that were added, refitted and kept."""
    disturbances: tuple[str, ...]
    """Those of them that belong to the noise."""
    gained: float
    """Log evidence they gained together [nat]."""
    generic: float
    """Largest log Bayes factor of a generic class in the first residual [nat]; -inf without any."""
    generic_name: str
    remaining: float
    """Largest log Bayes factor of any class in the last residual [nat]."""
    remaining_threshold: float
    """[nat]."""
    remaining_name: str
    share: float
    """Residual power taken by the effects over that and what the best remaining class would take [-]."""
    excess: float = math.nan
    """Root mean square residual of the base model over the noise [-]."""
    enough: float = EXPLAINED
    """Share of the residual power that named effects must take when something significant remains [-]."""
    scatter: float = -math.inf
    """Evidence that the noise is not normal, in the first residual [nat]."""
    missed: float = math.nan
    """Root mean square error of the base model on held-out records over that of the fit; NaN where that and
    what the fit leaves uncertain explain it [-]."""
    unseen: float = math.nan
    """Squared error beyond noise on held-out records, with the effects over without [-]; NaN where it says
    nothing: no such records, no such error, or effects that differ from record to record."""
    risen: float = math.nan
    """Largest error of any axis on held-out records with the effects over that without [-]; NaN without such
    records."""
    dynamics: bool = False
    """Whether linear dynamics without a name were added."""
    apart: bool = True
    """Whether each effect brought 30 nat and is confounded with no other."""
    reached: float = math.nan
    """Largest error of any axis on unseen records over the noise, with the effects [-]; NaN where these
    differ from record to record."""


def decide(found: Findings) -> Verdict:
    """The verdict; an effect is never named from a base fit that failed."""
    confidence: Confidence = "tentative" if found.cautions or found.failed else "firm"
    if found.failed:
        return Verdict("unexplained", "tentative", f"No effect is named, because {found.failed}.")
    if not found.alarmed:
        return _quiet(found, confidence)
    named = ", ".join(found.effects)
    confidence = confidence if found.apart or not found.effects else "tentative"
    if not found.effects and found.dynamics:
        return Verdict(
            "unexplained",
            confidence,
            f"Unmodelled linear dynamics are missing (worth {found.gained:.0f} nat): a further lag, a zero, "
            "or paths that differ in what the model lets them share explain the residual as well as any "
            "effect. No name is forced; more `terms`, or `share` and `delay` by path in [model], may help.",
        )
    if not found.effects:
        return Verdict(
            "unexplained",
            confidence,
            f"Something is missing (log Bayes factor {found.largest:.0f} nat against "
            f"{found.threshold:.1f} by chance), and the residual is {found.excess:.2f} times the noise; but "
            "no effect of the library survives a full refit: no name is forced.",
        )
    left = found.remaining > found.remaining_threshold
    if left and found.generic > found.gained + MARGIN:
        return Verdict(
            "unexplained",
            confidence,
            f"Something is missing, and {found.generic_name} describes it better by "
            f"{found.generic - found.gained:.0f} nat than the nearest named effect ({named}): no name "
            "is forced.",
        )
    if left and not found.share >= found.enough:
        return Verdict(
            "unexplained",
            confidence,
            f"The nearest effect ({named}) accounts for {_percent(found.share)} of what the base model "
            "leaves to explain, "
            f"and {found.remaining_name} remains with {found.remaining:.0f} nat: no name is forced.",
        )
    if found.unseen > UNSEEN:
        return Verdict(
            "unexplained",
            confidence,
            f"The nearest effect ({named}) takes up what the fitted records leave, but "
            f"{_percent(found.unseen)} of the squared error beyond noise stays on the records held out: no "
            "name is forced.",
        )
    if found.risen > RISEN:
        return Verdict(
            "unexplained",
            confidence,
            f"The nearest effect ({named}) takes up what the fitted records leave, but the error on the "
            f"records held out is {found.risen:.2f} times as large with it: no name is forced.",
        )
    rest = (
        f" What remains is significant ({found.remaining_name}, {found.remaining:.0f} nat) but small: "
        f"{_percent(found.share)} of what the base model leaves to explain is accounted for."
        if left
        else " Nothing significant remains."
    )
    verb = "was" if len(found.effects) == 1 else "were"
    if found.dynamics or found.reached > REACHED:
        rest += " Linear dynamics without a name are missing too." if found.dynamics else ""
        if found.reached > REACHED:
            rest += f" On unseen records the error stays at {found.reached:.2f} times the noise."
        said = f"{named} {verb} missing, but not all that is, worth {found.gained:.0f} nat together."
        return Verdict("partly explained", "tentative", said + rest)
    if set(found.effects) <= set(found.disturbances):
        return Verdict(
            "disturbance",
            confidence,
            f"{named} disturb(s) the records; the plant stays as it is, the noise model changes." + rest,
        )
    return Verdict("explained", confidence, f"{named} {verb} missing, worth {found.gained:.0f} nat." + rest)


def _quiet(found: Findings, confidence: Confidence) -> Verdict:
    """The verdict where the fitted records show nothing."""
    nothing = (
        "Nothing is missing that these records could show: the largest log Bayes factor of any effect is "
        f"{found.largest:.1f} nat, and chance alone reaches {found.threshold:.1f} once in a hundred times."
    )
    if found.missed > 0:
        return Verdict(
            "unexplained",
            confidence,
            f"The records held out are missed by {found.missed:.1f} times the residual of the fit, more than "
            "it leaves uncertain, though the fitted ones show no effect (the largest log Bayes factor is "
            f"{found.largest:.1f} nat): no name is forced.",
        )
    if found.scatter > found.threshold:
        return Verdict(
            "disturbance",
            confidence,
            f"{nothing} But the noise is not normal ({found.scatter:.0f} nat): a few samples lie far "
            "outside, so that intervals are narrower than they should be; a Student noise would hold them.",
        )
    return Verdict("clean", confidence, nothing)


def beside(verdict: Verdict, said: str) -> Verdict:
    """The verdict on records with outliers, which `said` describes: they disturb, nothing else changes."""
    kind: Kind = "disturbance" if verdict.kind == "clean" else verdict.kind
    return Verdict(kind, verdict.confidence, f"{said} {verdict.sentence}")


def widened(verdict: Verdict, wider: Mapping[str, float]) -> Verdict:
    """The verdict on effects whose default priors were made `wider` by factors [-]."""
    said = "".join(
        f" The default prior of {name} is too narrow for these records and was made {factor:.0f} times as "
        "wide."
        for name, factor in wider.items()
    )
    return Verdict(verdict.kind, verdict.confidence, verdict.sentence + said)


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def joined(names: Sequence[str]) -> str:
    """`a, b or c`."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} or {names[-1]}"
