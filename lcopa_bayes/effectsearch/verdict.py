"""What the loop concludes, and in which words."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, final

from scipy.stats import norm

from lcopa_bayes.core.estimate import HALF_WIDTH
from lcopa_bayes.core.wording import joined, listed

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
AHEAD = 6.0
"""Log evidence by which an effect is ahead of every other one where its name is firm [nat]: of 81 names that
30 nat alone made firm two were ahead by less, and one of these was wrong."""
FIRM = 30.0
"""Log evidence that every effect must have brought where names are firm [nat]."""
REACHED = 1.1
"""Root mean square error over noise that a clean or explained axis has on unseen records at most [-]."""
COVERED = float(2 * norm.cdf(HALF_WIDTH / REACHED) - 1)
"""Share of samples that 90 % bands hold of normal errors so large: bands that hold less do not cover [-]."""
CHANCE = 0.02
"""Probability below which chance does not explain such errors or bands on unseen records [-]: with that of an
alarm, 1 %, three clean campaigns in a hundred are not called clean; four where a held-out drive leaves the
range of the fitted ones, beyond which chance has half as much."""


@final
@dataclass(frozen=True)
class Verdict:
    """Conclusion of a loop."""

    kind: Kind
    confidence: Confidence
    sentence: str

    @property
    def leaves(self) -> bool:
        """Whether something remains that nothing explains."""
        return self.kind in ("unexplained", "partly explained")

    @property
    def names(self) -> bool:
        """Whether its model has effects."""
        return self.kind in ("explained", "partly explained", "disturbance")


@final
@dataclass(frozen=True)
class Miss:
    """Errors of one response axis on unseen records beside what chance gives."""

    axis: str
    ratio: float
    """Root mean square error over the noise [-]."""
    coverage: float
    """Share of the samples inside 90 % bands [-]."""
    p: float
    """Probability of so large an error and so little coverage by chance [-]."""
    beyond: bool = False
    """Whether it is where their drive is beyond the range of the fitted records, else within it."""

    @property
    def far(self) -> bool:
        """Whether the error is above 1.1 times the noise, or the bands do not cover."""
        return self.ratio > REACHED or self.coverage < COVERED

    @property
    def significant(self) -> bool:
        """Whether chance does not explain that."""
        return self.far and self.p < CHANCE

    @property
    def said(self) -> str:
        """The errors, a clause without a full stop."""
        where = ", after their drive leaves the range of the fitted ones," if self.beyond else ""
        return (
            f"on unseen records{where} the error of {self.axis} is {self.ratio:.2f} times the noise and 90 % "
            f"bands hold {_percent(self.coverage)} of the samples (by chance with probability {self.p:.2g})"
        )


@final
@dataclass(frozen=True)
class Dynamics:
    """A linear plant of another form that follows the fitted records to the noise."""

    said: str
    """What it is, and that it follows them as well; to be followed by "as any effect"."""
    unseen: float = math.nan
    """Largest error of any axis on unseen records over the noise [-]; NaN where it was not predicted."""

    @property
    def astray(self) -> bool:
        """Whether it leaves more than the noise on unseen records."""
        return self.unseen > REACHED


@final
@dataclass(frozen=True)
class Findings:
    """What a loop found, as far as the verdict depends on it."""

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
    """Largest log Bayes factor of any class in the last residual [nat]; -inf where a refit refutes it, or
    nothing is above what chance gives."""
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
    missed: Miss | None = None
    """Errors of the final model on unseen records; None where it says nothing."""
    unseen: float = math.nan
    """Squared error beyond noise on held-out records, with the effects over without [-]; NaN where it says
    nothing: no such records, no such error, or effects that differ from record to record."""
    risen: float = math.nan
    """Largest error of any axis on unseen records with the effects over that without [-]; NaN with effects
    that differ from record to record: those of an unseen one are unknown, so that either error is chance."""
    dynamics: bool = False
    """Whether linear dynamics without a name were added."""
    apart: bool = True
    """Whether each effect brought 30 nat, also beside the others, is 6 nat ahead of every other in its place,
    and nothing significant remains."""
    reached: float = math.nan
    """Largest error of any axis on unseen records over the noise, with the effects [-]; NaN where these
    differ from record to record."""
    varying: tuple[str, ...] = ()
    """Effects that differ from record to record, given which held-out records were judged."""
    nothing: float = 1.0
    """Probability that nothing more is missing, by the last residual [-]."""
    linear: Dynamics | None = None
    """Sums of lags, or integer orders, where they are all that the fitted records ask for."""
    preferred: bool = False
    """Whether the records prefer sums of lags to the plant on a response axis."""

    @property
    def contested(self) -> bool:
        """Whether an effect with a name is ahead of every generic class, though by too little to be named."""
        return 0.0 < self.largest - self.generic <= MARGIN


def decide(given: Findings) -> Verdict:
    """The verdict from a base fit that can be used."""
    confidence: Confidence = "tentative" if given.cautions else "firm"
    if not given.alarmed:
        return _quiet(given, confidence)
    refused = _refused(given)
    if refused:
        apart = given.apart if given.effects else given.linear or given.dynamics or not given.contested
        apart = apart and not (given.linear and given.linear.astray)
        return Verdict("unexplained", confidence if apart else "tentative", refused)
    named, one = ", ".join(given.effects), len(given.effects) == 1
    remains = given.remaining > given.remaining_threshold
    rest = ""
    if remains:
        rest = (
            f" What remains is significant ({given.remaining_name}, {given.remaining:.0f} nat) but small: "
            f"{_percent(given.share)} of what the base model leaves to explain is accounted for."
        )
    confidence = confidence if given.apart else "tentative"
    said = f"{named} {'was' if one else 'were'} missing"
    missed, above = given.missed, given.reached > REACHED
    astray = missed is not None and missed.significant
    if given.dynamics or astray or above:
        rest = rest or " Nothing significant remains in the fitted records."
        rest += " Linear dynamics without a name are missing too." if given.dynamics else ""
        perhaps = ""
        if above:
            rest += f" On unseen records the error stays at {given.reached:.2f} times the noise"
            if missed is not None and missed.far and not (astray or remains or given.dynamics):
                perhaps = "perhaps "
                rest += f", which chance gives with probability {missed.p:.2g}"
            rest += "."
        elif missed is not None and missed.significant:
            rest += f" But {missed.said}."
        together = "" if one and not given.dynamics else " together"
        said += f", but {perhaps}not all that is, worth {given.gained:.0f} nat{together}."
        return Verdict("partly explained", "tentative", said + rest)
    rest = rest or " Nothing significant remains."
    if missed is not None and missed.far:  # says nothing of the name
        rest += f" But {missed.said}."
    if set(given.effects) <= set(given.disturbances):
        verb = "disturbs" if one else "disturb"
        said = f"{named} {verb} the records; the plant stays as it is, the noise model changes."
        return Verdict("disturbance", confidence, said + rest)
    if given.varying:
        rest += (
            f" Given {listed(given.varying)} of each held-out record, which no other record tells, the error "
            f"there is {given.reached:.2f} times the noise."
        )
    return Verdict("explained", confidence, f"{said}, worth {given.gained:.0f} nat." + rest)


def _refused(given: Findings) -> str:
    """Why nothing is named though something is missing; empty where something is."""
    if given.linear:
        left = "no more than the noise"
        if given.linear.astray:
            left += f" on the fitted records, but {given.linear.unseen:.2f} times that on unseen ones"
        return (
            f"Unmodelled linear dynamics are missing: {given.linear.said} as any effect, and leave {left}. "
            "No name is forced; figures of the step responses are over them."
        )
    if given.dynamics and not given.effects:
        return (
            f"Unmodelled linear dynamics are missing (worth {given.gained:.0f} nat): a further lag, a zero, "
            "or paths that differ in what the model lets them share explain the residual as well as any "
            "effect. No name is forced; more `terms`, or `share` and `delay` by path in [model], may help."
        )
    if not given.effects:
        why = "no effect of the library survives a full refit"
        if given.generic > given.largest - MARGIN:
            why = f"{given.generic_name} describes it as well as any effect of the library"
        return (
            f"Something is missing (log Bayes factor {given.largest:.0f} nat against {given.threshold:.1f} "
            f"by chance), and the residual is {given.excess:.2f} times the noise; but {why}: no name is "
            "forced."
        )
    nearest = f"The nearest effect ({', '.join(given.effects)})"
    if given.remaining > given.remaining_threshold:
        if given.generic > given.gained + MARGIN:
            return (
                f"{nearest} is behind {given.generic_name}, which describes what is missing better by "
                f"{given.generic - given.gained:.0f} nat: no name is forced."
            )
        if not given.share >= given.enough:
            return (
                f"{nearest} accounts for {_percent(given.share)} of what the base model leaves to explain, "
                f"and {given.remaining_name} remains with {given.remaining:.0f} nat: no name is forced."
            )
    if given.unseen > UNSEEN:
        return (
            f"{nearest} takes up what the fitted records leave, but {_percent(given.unseen)} of the squared "
            "error beyond noise stays on the records held out: no name is forced."
        )
    if given.risen > RISEN:
        return (
            f"{nearest} takes up what the fitted records leave, but the error on unseen records is "
            f"{given.risen:.2f} times as large with it: no name is forced."
        )
    return ""


def _quiet(given: Findings, confidence: Confidence) -> Verdict:
    """The verdict where the fitted records show nothing."""
    nothing = (
        "Nothing is missing that these records could show: the largest log Bayes factor of any effect is "
        f"{given.largest:.1f} nat, and chance alone reaches {given.threshold:.1f} once in a hundred times."
    )
    if given.nothing < 0.5 and not given.scatter > given.threshold:
        confidence = "tentative"
        nothing += f" But that an effect is there is more probable than not ({_percent(1 - given.nothing)})."
    if given.missed is not None and given.missed.significant:
        return Verdict(
            "unexplained",
            "tentative",
            f"Something is missing: {given.missed.said}. The fitted records do not show what: the largest "
            f"log Bayes factor of any effect is {given.largest:.1f} nat, and chance alone reaches "
            f"{given.threshold:.1f}. So no name is given.",
        )
    if given.preferred:
        confidence = "tentative"
        nothing += (
            " But sums of lags follow them better than the plant does: it has another form, and figures of "
            "the step responses are over the lags."
        )
    if given.missed is not None and given.missed.far:
        # chance explains it, and it contradicts nothing
        confidence, nothing = "tentative", f"{nothing} {joined([given.missed.said])}"
    elif given.reached > REACHED:
        confidence = "tentative"
        nothing += (
            f" But on unseen records the error is {given.reached:.2f} times the noise, which may be chance "
            "or something that is missing: their drive leaves the range of the fitted ones, or the noise is "
            "known from the same residual alone."
        )
    if given.scatter > given.threshold:
        return Verdict(
            "disturbance",
            confidence,
            f"{nothing} But the noise is not normal ({given.scatter:.0f} nat): a few samples lie far "
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
