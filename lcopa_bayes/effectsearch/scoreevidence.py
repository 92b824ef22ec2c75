"""Evidence of a direction the model lacks, in closed form, from residual, tangents and signatures.

With a whitened residual r at the mode, tangents J (columns scaled by their prior sd) and signatures S
(scaled likewise), the linearised model with the effect is ``r ~ N(0, I + J J' + S S')`` against
``N(0, I + J J')`` without. Projection is ``C^(-1/2)``, ``C = I + J J'``: directions the base model fits
freely are removed, those its priors hold are not.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector

_RANK = 1e-9
"""Singular values below this share of the largest are zero [-]."""


@final
@dataclass(frozen=True, eq=False)
class Projection:
    """``(I + J J')^(-1/2)`` from tangents J (n, k) scaled by their prior sd."""

    tangents: Matrix
    """(n, k) [-]."""

    @cached_property
    def parts(self) -> tuple[Matrix, Vector]:
        """Directions of the tangents, (n, rank), and the share of each that is removed, (rank,) [-]."""
        left, scale, _ = np.linalg.svd(self.tangents, full_matrices=False)
        kept = scale > _RANK * max(float(scale.max(initial=0.0)), 1.0)
        return left[:, kept], 1.0 - 1.0 / np.sqrt(1.0 + scale[kept] ** 2)

    def __call__(self, columns: Array) -> Array:
        """Projected columns (n,) or (n, m)."""
        left, removed = self.parts
        inner = left.T @ columns
        return np.asarray(columns - left @ (inner.T * removed).T)


def survival(signature: Matrix, projected: Matrix) -> float:
    """Share of a signature that the base model cannot imitate [-]; 0 for a signature that vanishes."""
    whole = float(np.linalg.norm(signature))
    return float(np.linalg.norm(projected)) / whole if whole > 0 else 0.0


def log_bayes_factors(signature: Matrix, residuals: Matrix) -> Vector:
    """``log N(r; 0, I + S S') - log N(r; 0, I)`` for residuals (n, draws), (draws,) [nat]."""
    left, scale, _ = np.linalg.svd(signature, full_matrices=False)
    power = scale**2
    inner = left.T @ residuals
    gain = 0.5 * np.einsum("k,kd->d", power / (1.0 + power), inner**2)
    return np.asarray(gain - 0.5 * np.log1p(power).sum())
