"""A number with its unit, interval, effective sample size and grade: the only form in which one leaves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from lcopa_bayes.core.arrays import Array, Vector

LEVEL = 0.9
"""Probability inside the intervals that are reported [-]."""
HALF_WIDTH = 1.6448536269514722
"""Half the width of such an interval of a normal distribution [sd]."""
EQUAL_TAILED = "equal-tailed credible"
"""The kind of interval reported: as much probability below it as above."""


@final
@dataclass(frozen=True)
class Estimate:
    """Posterior median and interval of one quantity."""

    name: str
    value: float
    """Median, in `unit`; infinite when more than half of the draws never reach it."""
    unit: str
    lower: float
    """Lower end, in `unit`; infinite when open."""
    upper: float
    """Upper end, in `unit`; infinite when open."""
    ess: float
    """Effective sample size behind it [draws]."""
    grade: str
    mean: float = np.nan
    """Mean, in `unit`; NaN when a draw is infinite."""
    sd: float = np.nan
    """Standard deviation, in `unit`; NaN when a draw is infinite."""
    level: float = LEVEL
    """Probability inside the interval [-]."""
    interval: str = EQUAL_TAILED
    note: str = ""

    @classmethod
    def of(cls, name: str, unit: str, draws: Vector, *, ess: float, grade: str, note: str = "") -> Estimate:
        """From draws; infinite draws (never reached) may make a side open, NaN draws raise ValueError."""
        if np.isnan(draws).any():
            raise ValueError(f"{name}: {np.isnan(draws).sum()} of {draws.size} draws are NaN")
        finite = bool(np.isfinite(draws).all())
        tail = (1 - LEVEL) / 2
        lower, middle, upper = (float(quantile(draws, q)) for q in (tail, 0.5, 1 - tail))
        mean, sd = (float(draws.mean()), float(draws.std(ddof=1))) if finite else (np.nan, np.nan)
        return cls(
            name=name,
            value=middle,
            unit=unit,
            lower=lower,
            upper=upper,
            ess=ess,
            grade=grade,
            mean=mean,
            sd=sd,
            note=note,
        )

    def as_json(self) -> dict[str, Any]:
        """Plain values; what is infinite or undefined is None."""
        out: dict[str, Any] = attributes(
            self, "name", "value", "unit", "mean", "sd", "lower", "upper", "level", "interval", "ess", "grade"
        )
        return plain(out | ({"note": self.note} if self.note else {}))


def quantile(values: Array, probability: float) -> Array:
    """Quantile along the first axis that does not interpolate between a finite and an infinite entry."""
    method = "linear" if np.isfinite(values).all() else "higher"
    return np.asarray(np.quantile(values, probability, axis=0, method=method))  # type: ignore[call-overload]


def attributes(one: object, *names: str) -> dict[str, Any]:
    """Some attributes of an object, by their names."""
    return {name: getattr(one, name) for name in names}


def plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values that JSON can hold, nested ones too; numbers that are not finite become None."""
    return {str(key): _plain(item) for key, item in values.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return plain(value)
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) + 0.0 if np.isfinite(value) else None  # no negative zero
    return value
