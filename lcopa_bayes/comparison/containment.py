"""A richer candidate held against those it contains: it is at least as likely, or has missed a mode.

The optimum of every contained model is set into the richer one and the likelihood maximised from there. Where
that ends higher than any search from the richer model's own draws, its ensembles have missed a mode, and it
is sampled again with that mode among the proposals (`inference.knownmodes`).
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
from scipy.special import expit, logsumexp

from lcopa_bayes.comparison.candidatefit import Contender, criteria, highest
from lcopa_bayes.comparison.candidates import Candidate
from lcopa_bayes.core.arrays import Flags, Matrix
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.likelihood import Landscape, Peak
from lcopa_bayes.inference.nestedmodels import lifted
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.results.fit import Fit
from lcopa_bayes.sampling.convergence import Limitation
from lcopa_bayes.sampling.coordinates import Chart, charted_density
from lcopa_bayes.sampling.knownmodes import around

TOLERANCE = 0.5
"""Log likelihood by which a search from a contained optimum may exceed the model's own [nat]: no more than a
reliable log evidence may err."""
_COPIES = 8
"""Ways in which the terms that a contained model lacks are added to its optimum [-]."""
_NEGLIGIBLE = 0.01
"""Share of the posterior below which a mode need not be met [-]."""
_PROBED = 1_000
"""Draws by which the share of a mode is estimated [-]."""
Card = Mapping[str, Any]


@final
@dataclass(frozen=True, eq=False)
class Check:
    """Task: a candidate's card held against the cards of those it may contain."""

    contender: Contender
    card: Card
    others: tuple[tuple[Candidate, Card], ...]

    @property
    def candidate(self) -> Candidate:
        """The richer candidate."""
        return self.contender.candidate

    def __call__(self) -> Card:
        """The card with what was found under `containment`; that of a new fit where a mode was missed."""
        if self.card.get("containment", {}).get("key") == self._key:
            return self.card
        entries = self._checked()
        self.contender.store(entries)
        return entries

    @property
    def _key(self) -> str:
        """Hash of all cards it depends on."""
        prints = [self.card["fingerprint"], *(str(card["fingerprint"]) for _, card in self.others)]
        likely = [str(card["max_log_likelihood"]) for _, card in self.others]
        return hashlib.sha256("\0".join([*prints, *likely]).encode()).hexdigest()

    def _checked(self) -> Card:
        problem = problem_of(self.candidate.study)
        if self.card["refinement"] > 1:
            problem = problem.refined(int(self.card["refinement"]))
        own, rows, peaks, starts = float(self.card["max_log_likelihood"]), [], [], []
        for candidate, other in self.others:
            result = reached(problem, candidate, other)
            if result is None:
                continue
            peak, draws = result
            missed = peak.log_likelihood > own + TOLERANCE
            rows.append(
                {
                    "model": candidate.name,
                    "max_log_likelihood": other["max_log_likelihood"],
                    "reached": peak.log_likelihood,
                    "own": own,
                    "missed": missed,
                }
            )
            if missed:
                peaks.append(peak)
                starts.append(np.concatenate([np.repeat(peak.values[None], _COPIES, axis=0), draws]))
        entries = {"key": self._key, "contains": rows, "sampled_again": bool(peaks), "met": True}
        if not peaks:
            return dict(self.card) | {"containment": entries}
        began = time.perf_counter()
        try:
            fitted, limitations = self._again(np.concatenate(starts), peaks)
        except (
            InputError
        ) as error:  # the mode cannot be sampled: what was sampled without it stands for nothing
            entries["met"] = False
            refused = {"usable": False, "grade": "unusable", "grade_reason": str(error)}
            return dict(self.card) | refused | {"containment": entries}
        entries["met"] = not limitations
        scored = self.contender.scored(fitted, also=peaks)
        seconds = float(self.card["seconds"]) + time.perf_counter() - began
        return scored | {"containment": entries, "seconds": seconds}

    def _again(self, starts: Matrix, peaks: Sequence[Peak]) -> tuple[Fit, tuple[Limitation, ...]]:
        """The fit with these starts, limited where it still has not met a mode that matters."""
        fitted = self.contender.fitted_from(starts)
        best = max(peaks, key=lambda one: one.log_likelihood)
        own = criteria(fitted).log_likelihood
        if own + TOLERANCE >= best.log_likelihood:
            return fitted, ()
        share = share_of(fitted, starts)
        if share < _NEGLIGIBLE:
            return fitted, ()
        limitations = (
            Limitation(
                "unusable",
                f"its best log likelihood {own:.1f} stays below {best.log_likelihood:.1f}, which it has at "
                "the optimum of a model that it contains, in a mode that holds about "
                f"{100 * share:.2g} % of its posterior",
                "sample more steps, or narrow its priors to the mode that is meant",
            ),
        )
        return replace(fitted, draws=fitted.draws.limited(limitations)), limitations


def reached(problem: Problem, candidate: Candidate, card: Card) -> tuple[Peak, Matrix] | None:
    """The maximum of the likelihood searched from the optimum of a contained candidate, and that
    candidate's draws set into the richer model; None where it is not contained or lies outside the prior."""
    source, target = problem_of(candidate.study).posterior, problem.posterior
    rng = np.random.default_rng([problem.study.seed, 10])
    optimum = np.repeat(np.array([card["starts"]["optimum"]], dtype=float), _COPIES, axis=0)
    result = [
        lifted(values, source, target, rng)
        for values in (optimum, np.array(card["starts"]["draws"], dtype=float))
    ]
    if result[0] is None or result[1] is None:
        return None
    inside = [values[_inside(target, values)] for values in result if values is not None]
    if not len(inside[0]):
        return None
    landscape = Landscape(target)
    peak = highest(Landscape(problem.thrifty.posterior), inside[0])
    if problem.thrifty is not problem:
        peak = Peak(peak.values, float(landscape.log_likelihood(peak.values[None])[0]))
    if not _inside(target, peak.values[None]).all():  # a climb knows the ends of priors, not all they exclude
        heights = landscape.log_likelihood(inside[0])
        peak = Peak(inside[0][int(heights.argmax())], float(heights.max()))
    return peak, inside[1]


def _inside(posterior: Posterior, values: Matrix) -> Flags:
    with np.errstate(divide="ignore", invalid="ignore"):
        coordinates = posterior.coordinates(values)
    inside: Flags = np.asarray(np.isfinite(coordinates).all(axis=1))
    inside[inside] = np.isfinite(posterior.log_prior(coordinates[inside]))
    return inside


def share_of(fitted: Fit, starts: Matrix) -> float:
    """Share of the posterior on the modes of `starts`, by importance draws of the mixture around them [-]."""
    posterior, seed = fitted.problem.posterior, fitted.run.plan.seed
    mixture = around(posterior, starts, seed)
    random = np.random.RandomState(np.random.MT19937(np.random.SeedSequence(seed, spawn_key=(5_000,))))
    drawn = mixture.draw(_PROBED, random)
    ratio = charted_density(posterior, Chart.of(posterior), drawn) - mixture.log_density(drawn)
    mass = float(logsumexp(ratio) - np.log(_PROBED))
    if fitted.evidence is None or mass == -np.inf:
        return float(mass > -np.inf)
    return float(expit(mass - fitted.evidence.value))
