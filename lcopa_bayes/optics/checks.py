"""Sentences about numbers that cannot be used, shared by the optics modules."""

from __future__ import annotations

from math import inf, isfinite

import numpy as np
from numpy.typing import ArrayLike

from lcopa_bayes.core.arrays import Array
from lcopa_bayes.core.errors import InputError


def unless_positive(name: str, value: float, unit: str) -> list[str]:
    """One sentence, with `name` and `unit`, if `value` is not a positive finite number; else none."""
    if isfinite(value) and value > 0:
        return []
    return [f"`{name}` must be a positive number of {unit}; got {value!r}: give it in SI units."]


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
