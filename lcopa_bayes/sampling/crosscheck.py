"""Whether the draws of a run and those of nested sampling can come from one posterior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

import numpy as np
from scipy.stats import kstwobign, norm

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.estimate import EQUAL_TAILED, LEVEL, attributes, plain
from lcopa_bayes.sampling.convergence import Grade, Level, Limitation, also_said
from lcopa_bayes.sampling.draws import Draws
from lcopa_bayes.sampling.nested import Nested

ALARM = 0.01
"""Probability that two samples of one posterior are reported to disagree, over all comparisons together [-]:
a study in a hundred is graded too low, and a mode that one method missed has p-values far below."""
_LOWER: dict[Level, Level] = {"reliable": "tentative", "tentative": "unusable", "unusable": "unusable"}
_REMEDY = (
    "one of the two has missed a mode or its posterior mass; sample more steps, with more ensembles and "
    "without --quick, or fix parameters that the record does not determine, or narrow their priors"
)


@final
@dataclass(frozen=True)
class Summary:
    """Marginal of a parameter by one method, in the parameter's unit."""

    value: float
    """Median, in the parameter's unit."""
    lower: float
    """Lower end of the equal-tailed 90 % interval, in the parameter's unit."""
    upper: float
    """Upper end, in the parameter's unit."""
    ess: float
    """Effective sample size [draws]."""

    @classmethod
    def of(cls, draws: Vector, ess: float) -> Summary:
        """From draws; an undefined effective sample size counts as one draw."""
        tail = (1 - LEVEL) / 2
        lower, middle, upper = np.quantile(draws, (tail, 0.5, 1 - tail))
        known = min(ess, float(draws.size)) if np.isfinite(ess) else 1.0
        return cls(float(middle), float(lower), float(upper), known)

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        interval = {"lower": self.lower, "upper": self.upper, "level": LEVEL, "interval": EQUAL_TAILED}
        return {"value": self.value} | interval | {"ess": self.ess}


@final
@dataclass(frozen=True)
class Compared:
    """A parameter by both methods."""

    name: str
    unit: str
    run: Summary
    """By the ensembles."""
    nested: Summary
    """By nested sampling."""
    distance: float
    """Largest difference of the cumulative probabilities (Kolmogorov-Smirnov) [-]."""
    p: float
    """Probability of such a distance when both sample one posterior, adjusted for all comparisons [-]."""
    resolution: float
    """Smallest distance that is called a disagreement [-]."""


@final
@dataclass(frozen=True, eq=False)
class CrossCheck:
    """A run beside nested sampling of the same posterior."""

    parameters: tuple[Compared, ...]
    log_evidence: float | None
    """Of the run [nat]; None when it has none."""
    log_evidence_sd: float | None
    """Its standard error [nat]."""
    evidence_p: float | None
    """Probability of such a difference of log evidence, adjusted for all comparisons [-]."""
    nested: Nested

    @classmethod
    def of(
        cls,
        draws: Draws,
        nested: Nested,
        *,
        log_evidence: float | None = None,
        log_evidence_sd: float | None = None,
    ) -> CrossCheck:
        """Compare every free marginal, and the evidence where the run has one with a standard error.

        Marginals by the two-sample Kolmogorov-Smirnov distance at effective sample sizes, the evidence by
        its difference over the joint standard error; p-values are adjusted for the number of comparisons
        (Holm 1979, Scandinavian Journal of Statistics 6).
        """
        names = draws.table.names
        pairs, distances, scales = [], [], []
        for quality in draws.qualities:
            k = names.index(quality.name)
            ours, theirs = draws.flat[:, k], nested.values[:, k]
            pair = Summary.of(ours, quality.ess), Summary.of(theirs, float(nested.ess[k]))
            pairs.append(pair)
            distances.append(_distance(ours, theirs))
            scales.append(_scale(*(summary.ess for summary in pair)))
        raw = [float(kstwobign.sf(d * s)) for d, s in zip(distances, scales, strict=True)]
        with_evidence = log_evidence is not None and log_evidence_sd is not None
        if log_evidence is not None and log_evidence_sd is not None:
            error = np.hypot(log_evidence_sd, nested.log_evidence_sd)
            raw.append(float(2 * norm.sf(abs(log_evidence - nested.log_evidence) / error)))
        adjusted = holm(raw)
        called = float(kstwobign.isf(ALARM / len(raw)))
        return cls(
            tuple(
                Compared(
                    quality.name, draws.table.rows[names.index(quality.name)].unit, *pair, d, p, called / s
                )
                for quality, pair, d, p, s in zip(
                    draws.qualities, pairs, distances, adjusted, scales, strict=False
                )
            ),
            log_evidence if with_evidence else None,
            log_evidence_sd if with_evidence else None,
            adjusted[-1] if with_evidence else None,
            nested,
        )

    @property
    def agrees(self) -> bool:
        """Whether no comparison is so unlikely that it raises the alarm."""
        return not self._apart and not self._evidence_apart

    @cached_property
    def _apart(self) -> tuple[Compared, ...]:
        """Parameters that raise the alarm, the largest distance first."""
        apart = [parameter for parameter in self.parameters if parameter.p < ALARM]
        return tuple(sorted(apart, key=lambda parameter: -parameter.distance))

    @property
    def _evidence_apart(self) -> bool:
        return self.evidence_p is not None and self.evidence_p < ALARM

    @property
    def sentence(self) -> str:
        """Result of the comparison as a sentence without a full stop."""
        if self.agrees:
            coarse = max(self.parameters, key=lambda parameter: parameter.resolution)
            noticed = (
                f"a difference of {coarse.resolution:.2f} in a cumulative probability of {coarse.name}, the "
                "least well resolved, would have been detected"
                if coarse.resolution < 1
                else f"but there are too few effective draws of {coarse.name} to detect any"
            )
            return (
                "nested sampling, an independent method, agrees: no marginal differs by more than chance "
                f"({noticed}){self._evidences('and')}"
            )
        said = []
        if self._apart:
            worst = self._apart[0]
            also = also_said([parameter.name for parameter in self._apart[1:]])
            said.append(
                f"the marginal of {worst.name} differs by {worst.distance:.2f} in cumulative probability, "
                f"p = {worst.p:.1g}{also}"
            )
        if self._evidence_apart:
            said.append(self._evidences("").strip())
        return f"nested sampling, an independent method, disagrees: {'; '.join(said)}"

    def _evidences(self, joint: str) -> str:
        if self.log_evidence is None:
            return ""
        return (
            f" {joint} log evidence {self.log_evidence:.2f} ± {self.log_evidence_sd:.2f} against "
            f"{self.nested.log_evidence:.2f} ± {self.nested.log_evidence_sd:.2f}"
        )

    def limitations(self, grade: Grade) -> tuple[Limitation, ...]:
        """None when the methods agree; else a limitation that lowers draws of this grade by one level."""
        return () if self.agrees else (Limitation(_LOWER[grade.level], self.sentence, _REMEDY),)

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return plain(
            {
                "agrees": self.agrees,
                "sentence": self.sentence,
                "alarm": ALARM,
                **attributes(self.nested, "log_evidence", "log_evidence_sd", "run_log_evidences"),
                "run_log_evidence": self.log_evidence,
                "run_log_evidence_sd": self.log_evidence_sd,
                "evidence_p": self.evidence_p,
                "evaluations": self.nested.evaluations,
                "parameters": [
                    {
                        "name": parameter.name,
                        "unit": parameter.unit,
                        "run": parameter.run.as_json(),
                        "nested": parameter.nested.as_json(),
                        **attributes(parameter, "distance", "p", "resolution"),
                    }
                    for parameter in self.parameters
                ],
            }
        )


def holm(p: Sequence[float]) -> list[float]:
    """p-values adjusted for their number [-]: the chance that the least of them is below a level, when
    both sample one posterior, is at most that level."""
    order = np.argsort(p, kind="stable")
    steps = np.asarray(p)[order] * np.arange(len(p), 0, -1)
    out = np.empty(len(p))
    out[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return [float(value) for value in out]


def _distance(first: Vector, second: Vector) -> float:
    """Largest difference of two empirical distribution functions [-]."""
    at = np.concatenate([first, second])
    shares = [np.searchsorted(np.sort(values), at, side="right") / values.size for values in (first, second)]
    return float(np.abs(shares[0] - shares[1]).max())


def _scale(first: float, second: float) -> float:
    """What turns a distance into Kolmogorov's statistic (Stephens 1970, J. R. Statist. Soc. B 32) [-]."""
    size = np.sqrt(first * second / (first + second))
    return float(size + 0.12 + 0.11 / size)
