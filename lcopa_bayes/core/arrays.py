"""Arrays are checked, copied and locked at the door and trusted inside.

A number with its unit, interval, effective sample size and grade: the only form in which one leaves.

Units of time, each a whole multiple of the one before.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lcopa_bayes.core.errors import InputError

Array: TypeAlias = NDArray[np.float64]
"""Float array of any shape; the docstring that uses it states the shape."""
Vector: TypeAlias = NDArray[np.float64]
"""One-dimensional float array."""
Matrix: TypeAlias = NDArray[np.float64]
"""Two-dimensional float array."""
Index: TypeAlias = NDArray[np.intp]
"""Integer positions."""
Flags: TypeAlias = NDArray[np.bool_]
"""Truth values."""


def frozen(values: ArrayLike, *, name: str, ndim: int = 1, missing: bool = False) -> Array:
    """Read-only float copy with `ndim` dimensions.

    Raises ValueError when the shape differs or an entry is not finite; with `missing`, NaN is let
    through (a sample that was not taken) while infinities are not.
    """
    out = np.array(values, dtype=float)
    if out.ndim != ndim:
        raise ValueError(f"`{name}` must have {ndim} dimension(s); got shape {out.shape}")
    if not (np.isfinite(out) | (np.isnan(out) if missing else False)).all():
        raise ValueError(f"`{name}` must be finite")
    out.setflags(write=False)
    return out


def finite(
    values: ArrayLike, *, name: str, lower: float = -inf, upper: float = inf, unit: str = "-"
) -> Array:
    """`values` as a float array of any shape, finite and within ``[lower, upper]``.

    Otherwise InputError, in which `name` and `unit` say what was expected.
    """
    try:
        out = np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"`{name}` must hold numbers [{unit}]; got {type(values).__name__}.") from error
    bad = ~np.isfinite(out) | (out < lower) | (out > upper)
    if bad.any():
        raise InputError(
            f"`{name}` must be finite and within [{lower:.6g}, {upper:.6g}] {unit}; "
            f"{int(bad.sum())} of {out.size} value(s) are not, "
            f"the first is {float(out[bad].flat[0])!r}: remove or correct them."
        )
    return out


def digest_of(array: Array) -> str:
    """SHA-256 of an array's shape and numbers."""
    held = hashlib.sha256(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes())
    return held.hexdigest()


LEVEL = 0.9
"""Probability inside the intervals that are reported [-]."""
EQUAL_TAILED = "equal-tailed credible"
"""The kind of interval reported: as much probability below it as above."""


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
        return float(value) if np.isfinite(value) else None
    return value


TIME_UNITS: Mapping[str, int] = MappingProxyType(
    {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": 1_000_000_000, "min": 60_000_000_000, "h": 3_600_000_000_000}
)
"""Nanoseconds in each unit of time by its word."""


def in_time_unit(time: Array | float, given: str, wanted: str) -> Array:
    """`time` [given] in the unit `wanted`; one correctly rounded multiplication or division."""
    more, fewer = TIME_UNITS[given], TIME_UNITS[wanted]
    with np.errstate(over="ignore"):  # an infinite time is refused by `Record`
        return np.asarray(time * float(more // fewer) if more >= fewer else time / float(fewer // more))
