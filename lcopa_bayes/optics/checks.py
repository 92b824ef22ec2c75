"""What numbers must be, shared by the optics modules."""

from __future__ import annotations

from math import inf, pi

import numpy as np
from numpy.typing import ArrayLike

from lcopa_bayes.core.arrays import Array
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.rules import POSITIVE, Rule, is_number

LENGTH = Rule("a positive number of metres", POSITIVE.holds)
SHARE = Rule("a number from 0 to 1", lambda value: is_number(value) and 0 <= value <= 1)
PRETILT = Rule(
    "a tilt in radians, from 0 to below pi/2", lambda value: is_number(value) and 0 <= value < pi / 2
)


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
