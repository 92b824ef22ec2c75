"""The verb `audit`: what the records of a study determine, combined from four methods.

Radial test: a fit far from the maximum, whose likelihood shows whether a direction is free.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
from scipy.optimize import least_squares

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.estimate import attributes, plain
from lcopa_bayes.core.parallel import workers
from lcopa_bayes.identifiability.contraction import (
    Known,
    Tolerance,
    beliefs,
    known_best,
    prior_draws,
    prior_spread,
)
from lcopa_bayes.identifiability.curvature import (
    Curvature,
    Sensitivities,
    curvature,
    delays,
    sensitivities,
)
from lcopa_bayes.identifiability.profile import Profile, profile
from lcopa_bayes.identifiability.symmetries import (
    DIFFERENCED,
    TOLERANCES,
    Structure,
    exchanges,
    printed_structure,
    structure,
)
from lcopa_bayes.identifiability.verdict import Finding, judged
from lcopa_bayes.inference.leastsquares import apart
from lcopa_bayes.inference.likelihood import Landscape, Peak
from lcopa_bayes.inference.optimum import find_optima
from lcopa_bayes.inference.parameter import Parameter
from lcopa_bayes.model.effects.effect import UnstableError
from lcopa_bayes.results.nearby import surrogate_about
from lcopa_bayes.results.predictive import Predictive
from lcopa_bayes.results.resonances import unresolved
from lcopa_bayes.results.sensitivity import sensitivity

_MOVED = 0.2
"""Share of the radius from which a parameter counts as moved [-]."""
_WEIGHT = 10.0
"""Standardised residual of a point that stays at the maximum: far above what the data object [-]."""


@final
@dataclass(frozen=True)
class Radial:
    """Result of the radial test (Kreutz 2018, Bioinformatics 34)."""

    radius: float
    """Distance requested, in prior standard deviations [-]."""
    reached: float
    """Distance reached [-]."""
    fall: float
    """``2 (max L - L)`` there [nat]."""
    moved: tuple[str, ...]
    """Parameters that moved, farthest first."""

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return plain(vars(self))


def radial(landscape: Landscape, peak: Peak, prior_sd: Vector, direction: Vector, radius: float) -> Radial:
    """The easier of two fits that start along plus and minus `direction` and are pulled to `radius`.

    Plant parameters only, at the noise parameters of `peak`; distances in prior standard deviations
    (`prior_sd`, (rows,)) of the sampled scale.
    """
    least = landscape.least
    centre, scale = least.coordinates(peak.values), prior_sd[least.columns]
    ends = np.array([landscape.search(k) for k in least.columns]).T
    names = [landscape.posterior.table.names[k] for k in least.columns]
    moving = list(range(centre.size))
    base = landscape.rows(centre, peak.values, moving)[0]

    def pulled(x: Vector) -> tuple[Vector, Matrix]:
        residual, jacobian = landscape.rows(x, peak.values, moving)
        away = (x - centre) / scale
        distance = float(np.linalg.norm(away))
        slope = away / scale / max(distance, 1e-12)
        pull = _WEIGHT * (distance - radius) / radius
        return np.append(residual, pull), np.vstack([jacobian, _WEIGHT * slope / radius])

    candidates = []
    for sign in (-1.0, 1.0):
        start = np.clip(centre + 0.1 * sign * radius * scale * direction, *ends)
        solved = least_squares(*apart(pulled, start), bounds=(ends[0], ends[1]), x_scale="jac", max_nfev=100)
        residual = landscape.rows(solved.x, peak.values, moving)[0]
        away = np.abs(solved.x - centre) / scale
        order = [p for p in np.argsort(-away) if away[p] > _MOVED * radius]
        fall = float(residual @ residual - base @ base)
        reached = float(np.linalg.norm(away))
        candidates.append(Radial(radius, reached, max(fall, 0.0), tuple(names[p] for p in order)))
    return min(
        candidates, key=lambda candidate: candidate.fall + (_WEIGHT * (candidate.reached / radius - 1)) ** 2
    )


_POINTS, _FEWER = 24, 6
"""Prior draws at which symmetries are sought, besides likely ones, and with effects, whose slopes cost a
second each."""
_WITNESSES = 400
"""Draws that profiles are started from."""
_CLIMBED = 8
"""Draws from which the maximum is sought, besides the optima."""
_RADIUS = 0.5
"""Radius of the radial test [prior standard deviations]."""
_BETTER = 0.05
"""A higher maximum than this [nat] starts the profiles anew ..."""
_TRIES = 3
"""... this many times at most."""


@final
@dataclass(frozen=True, eq=False)
class Audit:
    """Identifiability of a fitted study."""

    fit: Predictive
    findings: tuple[Finding, ...]
    """One per free parameter, in table order."""
    structure: Structure
    printed: Structure | None
    """The same of the printed parametrisation, for a plant with one path and free orders."""
    curvature: Curvature | None
    """None when only noise parameters are free."""
    radial: Radial | None
    known: tuple[Known, ...]
    delays: Mapping[str, Any]
    """As `curvature.delays` gives them."""
    peak: Peak

    @property
    def sentence(self) -> str:
        """The audit in a sentence."""
        counted: dict[str, list[str]] = {}
        for finding in self.findings:
            counted.setdefault(finding.verdict, []).append(finding.profile.parameter)
        verdicts = "; ".join(f"{verdict}: {', '.join(names)}" for verdict, names in counted.items())
        best = self.known[0].estimate.name if self.known else ""
        limits = "; ".join(limitation.reason for limitation in self.fit.draws.limitations)
        return (
            f"Given this model, {verdicts}."
            + (f" Best determined: {best}." if best else "")
            + (f" But {limits}." if limits else "")
        )

    def as_json(self) -> dict[str, Any]:
        """Every number of the audit; what is open, infinite or undefined is None."""
        draws = self.fit.draws
        return plain(
            {
                "study": self.fit.study.name,
                "verdict": self.sentence,
                "grade": draws.grade.level,
                "grade_reason": draws.grade.reason,
                "limitations": [limitation.as_json() for limitation in draws.limitations],
                "time_unit": self.fit.study.time_unit,
                "parameters": [entry.as_json() for entry in self.findings],
                "symmetries": [entry.as_json() for entry in self.structure.symmetries],
                "structure": _structure(self.structure),
                "printed_form": None if self.printed is None else _structure(self.printed),
                "spectrum": [] if self.curvature is None else self.curvature.spectrum(),
                "local": None if self.curvature is None else self.curvature.as_json(),
                "radial": None if self.radial is None else self.radial.as_json(),
                "functions": [known.as_json() for known in self.known],
                "delays": self.delays,
                "log_likelihood": self.peak.log_likelihood,
                "next_measurement": None,
            }
        )


def _structure(structure: Structure) -> dict[str, Any]:
    return {
        **attributes(structure, "parameters", "rank", "certain"),
        "singular_values": structure.singular,
        "symmetries": [symmetry.as_json() for symmetry in structure.symmetries],
    }


def audit(fit: Predictive, *, jobs: int = 1) -> Audit:
    """Verdict for every free parameter of a fitted study; profiles are calculated in `jobs` processes."""
    posterior, seed = fit.problem.posterior, fit.study.seed
    landscape, rng = Landscape(posterior), np.random.default_rng([seed, 5])
    prior = prior_draws(landscape, rng)
    spread = prior_spread(landscape, prior)
    thinned = fit.draws.thinned(_WITNESSES)
    surrogate = None
    if posterior.simulation is not None:  # a profile asks for the likelihood 100 000 times
        surrogate = surrogate_about(posterior, fit.draws, rng, jobs=jobs)
    ground = Landscape.about(replace(posterior, surrogate=surrogate), fit.draws.flat)
    ranked = thinned[np.argsort(-ground.log_likelihood(thinned))]
    likely = ranked[:_CLIMBED]
    optima = np.empty((0, prior.shape[1]))
    if surrogate is None:
        optima = np.array([o.values for o in find_optima(posterior, rng)]).reshape(-1, prior.shape[1])
    starts = np.concatenate([optima, likely])
    peak = max((ground.maximise(v) for v in starts), key=lambda peak: peak.log_likelihood)
    known = known_best(fit.draws, prior, fit.problem.scales.span, time_unit=fit.study.time_unit)
    rough = Landscape(fit.problem.thrifty.posterior)
    profiles, peak = _profiles(ground, peak, np.concatenate([thinned, optima]), jobs)
    count = _POINTS if posterior.simulation is None else _FEWER
    points = _points(rough, (*prior[:count], *likely[:count])) if landscape.least.columns else []
    symmetric, curved, moved, printed = Structure((), 0, 0, True, np.empty(0)), None, None, None
    if points:
        tolerances = TOLERANCES if posterior.simulation is None else DIFFERENCED
        symmetric = structure(
            points[0].names, [p.relative() for p in points], [p.values for p in points], tolerances=tolerances
        )
        symmetric = replace(symmetric, symmetries=(*symmetric.symmetries, *exchanges(posterior.table)))
        printed = printed_structure(points, rng)
        curved = curvature(landscape, peak.values, spread)
        moved = radial(rough, peak, spread, curved.directions[-1], _RADIUS)
    believed = beliefs(landscape, fit.draws, spread, sensitivity(fit.draws, ground.posterior))
    rows = [posterior.table.rows[k] for k in landscape.free]
    scales = fit.problem.scales
    fast = unresolved(fit.problem, fit.draws)
    findings = tuple(
        judged(
            *(profile, belief, symmetric, curved, _flat(row), Tolerance.of(row, scales)),
            next((f.sentence(scales.period, fit.study.time_unit) for f in fast if f.concerns(row)), ""),
        )
        for profile, belief, row in zip(profiles, believed, rows, strict=True)
    )
    apart = delays(fit.study, posterior.table, peak.values)
    return Audit(
        fit=fit,
        findings=findings,
        structure=symmetric,
        printed=printed,
        curvature=curved,
        radial=moved,
        known=known,
        delays=apart,
        peak=peak,
    )


def _points(landscape: Landscape, values: Iterable[Vector]) -> list[Sensitivities]:
    """Sensitivities at table values; where effects leave no bounded response, or one of them vanishes, there
    are none."""
    out = []
    for each in values:
        try:
            point = sensitivities(landscape, each)
        except UnstableError:
            continue
        if landscape.posterior.simulation is None or (point.values != 0).all():
            out.append(point)
    return out


def _flat(row: Parameter) -> bool:
    """Whether the prior has no density to prefer one value on the sampled scale."""
    assert row.prior is not None
    return row.prior.dist == ("loguniform" if row.log_scale else "uniform")


def _profiles(landscape: Landscape, peak: Peak, witnesses: Matrix, jobs: int) -> tuple[list[Profile], Peak]:
    """Profiles of all free parameters about one maximum, and that maximum."""
    for _ in range(_TRIES):
        with workers((landscape, peak, witnesses), jobs=min(jobs, len(landscape.free))) as crew:
            profiles = list(crew.each(_profile, landscape.free))
        top = max(profiles, key=lambda profile: profile.best)
        better = top.best - peak.log_likelihood
        surrogate = landscape.precision is not None  # heights of profiles are of the posterior itself
        if better > 0 or surrogate:
            peak = Peak(top.top, top.best)
        if better <= _BETTER or surrogate:
            break
    held = []
    for k, one in zip(landscape.free, profiles, strict=True):
        at = float(np.clip(landscape.coordinate(k, peak.values[k]), *landscape.search(k)))
        held.append(one.holding(peak, at, landscape.value(k, at)))
    return held, peak


def _first_step(landscape: Landscape, k: int, witnesses: Matrix) -> float:
    """A tenth of the spread of the draws, on the sampled scale."""
    spread = float(landscape.column(k, witnesses).std())
    low, high = landscape.search(k)
    return 0.1 * spread if spread > 0 else 1e-3 * (high - low)


def _profile(shared: tuple[Landscape, Peak, Matrix], k: int) -> Profile:
    landscape, peak, witnesses = shared
    return profile(landscape, k, peak, witnesses, _first_step(landscape, k, witnesses))
