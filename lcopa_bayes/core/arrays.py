"""Arrays are checked, copied and locked at the door and trusted inside."""

from __future__ import annotations

import hashlib
from math import inf
from typing import TypeAlias

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
