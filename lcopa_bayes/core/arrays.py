"""Arrays are checked, copied and locked at the door and trusted inside."""

from __future__ import annotations

import hashlib
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

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


def digest_of(array: Array) -> str:
    """SHA-256 of an array's shape and numbers."""
    held = hashlib.sha256(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes())
    return held.hexdigest()
