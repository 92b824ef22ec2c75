"""One verdict per parameter from symmetries, curvature, profile and draws, with contrary evidence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, final

import numpy as np

from lcopa_bayes.core.estimate import HALF_WIDTH, LEVEL, attributes, plain
from lcopa_bayes.identifiability.contraction import Belief, Tolerance
from lcopa_bayes.identifiability.curvature import Curvature
from lcopa_bayes.identifiability.profile import Profile
from lcopa_bayes.identifiability.symmetries import Structure

Verdict = Literal[
    "identified",
    "weakly identified",
    "unresolved",
    "one-sided",
    "practically unidentifiable",
    "structurally unidentifiable",
    "prior-dominated",
]
HALF = 0.5
"""Contraction below which the prior is more informative than the data [-]."""
_NARROW = 0.9
"""Contraction of draws that appear well determined [-]."""
_APART = 3.0
"""Factor between local and profile widths from which they disagree [-]."""


@final
@dataclass(frozen=True, eq=False)
class Finding:
    """Verdict of one parameter with its evidence."""

    profile: Profile
    belief: Belief
    verdict: Verdict
    reason: str
    partners: tuple[str, ...]
    relative_sd: float
    """Cramer-Rao standard deviation over the size of the value [-]; NaN for noise parameters, infinite
    where the Fisher matrix is singular."""
    disagreements: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return plain(
            {
                "name": self.profile.parameter,
                "unit": self.profile.unit,
                **attributes(self, "verdict", "reason", "partners"),
                "profile": self.profile.as_json(),
                "contraction": self.belief.contraction,
                "relative_sd": self.relative_sd,
                "draws": self.belief.as_json(),
                "posterior": self.belief.estimate.as_json(),
                "disagreements": self.disagreements,
            }
        )


def judged(
    profile: Profile,
    belief: Belief,
    structure: Structure,
    curvature: Curvature | None,
    flat_prior: bool,
    tolerance: Tolerance,
    unresolved: str = "",
) -> Finding:
    """Verdict of one parameter.

    Unresolved: of an element that resonates faster than the samples resolve, as given in `unresolved`.
    Structurally unidentifiable: part of a symmetry. Otherwise by the profile at `LEVEL`: no side closed,
    practically unidentifiable, or prior-dominated where the prior is not flat on the sampled scale; one
    side closed, one-sided; both closed, identified, or weakly identified where the interval exceeds the
    tolerance, or prior-dominated where the prior is more informative than the data (contraction below a
    half).
    """
    name, open_sides = profile.parameter, profile.open_sides
    partners = dict.fromkeys(
        [
            *structure.partners(name),
            *belief.companions,
            *(profile.moving[:3] if open_sides else ()),
            *(curvature.partners(name)[:3] if curvature else ()),
        ]
    )
    local = curvature.at(name) if curvature else None
    sd, relative = (None, np.nan) if local is None else local
    verdict, reason = _decided(profile, belief, structure, flat_prior, tolerance)
    if unresolved:
        verdict, reason = "unresolved", unresolved
    against = _against(verdict, profile, belief, sd)
    return Finding(profile, belief, verdict, reason, tuple(partners), relative, tuple(against))


def _decided(
    profile: Profile, belief: Belief, structure: Structure, flat_prior: bool, tolerance: Tolerance
) -> tuple[Verdict, str]:
    """The verdict and its reason."""
    name, unit = profile.parameter, "" if profile.unit == "-" else f" {profile.unit}"
    symmetry = next((s for s in structure.symmetries if s.kind != "exchange" and name in s.parameters), None)
    if symmetry is not None:
        return "structurally unidentifiable", f"before any noise, {symmetry.sentence}"
    level, low, high = f"{100 * LEVEL:g} %", *profile.intervals[LEVEL]
    several = "" if len(profile.moving) > 1 else "s"
    moving = f" while {', '.join(profile.moving[:3])} compensate{several}" if profile.moving else ""
    if low is None and high is None:
        a, b = profile.said_end(0), profile.said_end(1)
        most = float(profile.fall.max())
        detail = f"between {a} and {b}{unit} twice the log likelihood falls by at most {most:.2g}{moving}"
        if flat_prior:
            return "practically unidentifiable", f"the data bound it on neither side: {detail}"
        return "prior-dominated", f"only its prior bounds it: {detail}"
    if low is None or high is None:
        side, end = ("above", high) if low is None else ("below", low)
        other, limit = ("below", profile.said_end(0)) if low is None else ("above", profile.said_end(1))
        return "one-sided", (
            f"bounded {side} by {end:.3g}{unit} ({level}), but {other} it the data exclude nothing up to the "
            f"end of the search at {limit}{unit}{moving}"
        )
    share = belief.contraction
    within = f"{low:.4g} to {high:.4g}{unit} ({level})"
    if share < HALF:
        return "prior-dominated", (
            f"bounded within {within}, but the data reduce the variance of its prior by "
            f"{100 * share:.0f} % only"
        )
    parts = f", in {profile.parts} separate intervals" if profile.parts > 1 else ""
    wide = tolerance.exceeded(low, high)
    if wide:
        return "weakly identified", f"the data alone bound it, but only within {within}, {wide}{parts}"
    return "identified", f"the data alone bound it within {within}{parts}"


def _against(verdict: Verdict, profile: Profile, belief: Belief, sd: float | None) -> list[str]:
    """Evidence of single methods against the verdict."""
    out, (low, high) = [], profile.intervals[LEVEL]
    if low is not None and high is not None and sd is not None:
        ends = np.interp([low, high], profile.values, profile.coordinates)
        half = float(ends[1] - ends[0]) / (2 * HALF_WIDTH)
        if not np.isfinite(sd):
            out.append("curvature: singular at the maximum, where the profile is bounded farther away")
        elif not 1 / _APART < sd / half < _APART:
            wide = "wider" if sd > half else "narrower"
            out.append(
                f"curvature: {wide} than the profile by a factor of {max(sd / half, half / sd):.2g}, "
                "the likelihood is far from Gaussian"
            )
    if profile.open_sides and belief.contraction > _NARROW:
        out.append(
            f"draws: a contraction of {belief.contraction:.2f} suggests a determined parameter, but on the "
            "open side the volume of the other parameters makes values rare, not the data"
        )
    if belief.modes > 1:
        out.append(f"draws: {belief.modes} separate modes")
    moved = belief.sensitivity
    bounded = verdict in ("identified", "weakly identified")
    if bounded and moved is not None and moved.diagnosis not in ("-", "not trusted"):
        out.append(f"power scaling: {moved.diagnosis}")
    ends_95 = profile.intervals[max(profile.intervals)]
    middle = belief.estimate.value
    if (ends_95[0] is not None and middle < ends_95[0]) or (ends_95[1] is not None and middle > ends_95[1]):
        out.append(f"draws: their median {middle:.3g} lies outside the profile's 95 % interval")
    if profile.at_bound and bounded:
        out.append(f"profile: depends on the bounds of {', '.join(profile.at_bound)}")
    return out
