"""Units of time, each a whole multiple of the one before, and units of ratios."""

from __future__ import annotations

import re
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from lcopa_bayes.core.arrays import Array

TIME_UNITS: Mapping[str, int] = MappingProxyType(
    {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": 1_000_000_000, "min": 60_000_000_000, "h": 3_600_000_000_000}
)
"""Nanoseconds in each unit of time by its word."""
DIMENSIONLESS = ("-", "1")
"""Units of what has none: that of our own numbers, and what records may say."""
_COMPOUND = re.compile(r"[/*· ]")


def in_time_unit(time: Array | float, given: str, wanted: str) -> Array:
    """`time` [given] in the unit `wanted`; one correctly rounded multiplication or division."""
    more, fewer = TIME_UNITS[given], TIME_UNITS[wanted]
    with np.errstate(over="ignore"):  # an infinite time is refused by `Record`
        return np.asarray(time * float(more // fewer) if more >= fewer else time / float(fewer // more))


def per(unit: str, other: str) -> str:
    """Unit of a ratio, that of the numerator where the denominator has none."""
    if other in DIMENSIONLESS:
        return unit
    other = (
        f"({other})" if _COMPOUND.search(other) else other
    )  # °C/L/min would be a degree per litre and minute
    return f"1/{other}" if unit in DIMENSIONLESS else f"{unit}/{other}"


def measured(figure: str | float, unit: str, form: str = ".3g") -> str:
    """A figure with its unit, alone where it has none; a number in the `form` of its digits."""
    shown = figure if isinstance(figure, str) else format(figure, form)
    return shown if unit in DIMENSIONLESS else f"{shown} {unit}"
