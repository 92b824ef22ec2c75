"""How often intervals held the truth, with the exact Monte Carlo band of that share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

from scipy import stats

BAND = "Clopper-Pearson"
"""Clopper and Pearson 1934, Biometrika 26: an exact binomial confidence interval."""
LEVELS = (0.5, 0.9)
"""Probabilities inside the central intervals that are checked [-]."""


@final
@dataclass(frozen=True)
class Coverage:
    """Coverage of the central interval of one quantity at one level."""

    parameter: str
    """Name of the parameter, or of the step response and its time."""
    kind: str
    level: float
    """Probability inside the interval, as stated [-]."""
    hits: int
    """Replicas whose interval held the truth."""
    replicas: int
    confidence: float
    """Confidence of the band [-]."""

    @property
    def observed(self) -> float:
        """Share of replicas whose interval held the truth [-]."""
        return self.hits / self.replicas

    @property
    def lower(self) -> float:
        """Lower end of the band of the true coverage [-]."""
        tail = (1 - self.confidence) / 2
        return float(stats.beta.ppf(tail, self.hits, self.replicas - self.hits + 1)) if self.hits else 0.0

    @property
    def upper(self) -> float:
        """Upper end of the band of the true coverage [-]."""
        tail, missed = (1 - self.confidence) / 2, self.replicas - self.hits
        return float(stats.beta.ppf(1 - tail, self.hits + 1, missed)) if missed else 1.0

    @property
    def holds(self) -> bool:
        """Whether the stated level lies within the band."""
        return self.lower <= self.level <= self.upper

    @property
    def p_value(self) -> float:
        """Of the exact binomial test that the coverage is as stated [-]."""
        return float(stats.binomtest(self.hits, self.replicas, self.level).pvalue)

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "parameter": self.parameter,
            "kind": self.kind,
            "level": self.level,
            "observed": self.observed,
            "lower": self.lower,
            "upper": self.upper,
            "band": BAND,
            "confidence": self.confidence,
            "within": self.holds,
            "p_value": self.p_value,
            "replicas": self.replicas,
        }
