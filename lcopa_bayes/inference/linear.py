"""Parameters that enter linearly, integrated out exactly under Gaussian noise and normal priors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector


@final
@dataclass(frozen=True, eq=False)
class NormalEquations:
    """``y = X b + white noise`` for a batch of X; b standardised, so its prior is N(0, I).

    ``gram = X'X + I`` (batch, p, p), ``moment = X'y`` (batch, p), ``square = y'y`` (batch,).
    """

    gram: Array
    moment: Matrix
    square: Vector

    @classmethod
    def of_columns(cls, batch: int, p: int) -> NormalEquations:
        """Before any data: the prior alone."""
        return cls(np.tile(np.eye(p), (batch, 1, 1)), np.zeros((batch, p)), np.zeros(batch))

    def add(self, columns: Array, target: Matrix, place: list[int]) -> None:
        """Add whitened columns (batch, k, n) standing at `place`, and their target (batch, n)."""
        rows = np.array(place, dtype=int)
        if rows.size:
            self.gram[:, rows[:, None], rows] += columns @ columns.swapaxes(1, 2)
            self.moment[:, rows] += (columns @ target[..., None])[..., 0]
        self.square[:] += np.einsum("bn,bn->b", target, target)

    def log_marginal(self) -> Vector:
        """Log of the Gaussian integral over b, without the white noise's normalisation, (batch,)."""
        if self.moment.shape[1] == 0:
            return -0.5 * self.square
        factor = np.linalg.cholesky(self.gram)
        bent = np.linalg.solve(factor, self.moment[..., None])[..., 0]
        half_log_det = np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
        return np.asarray(-0.5 * (self.square - np.einsum("bp,bp->b", bent, bent)) - half_log_det)

    def mean(self) -> Matrix:
        """Conditional mean of b, (batch, p)."""
        return np.asarray(np.linalg.solve(self.gram, self.moment[..., None])[..., 0])

    def draw(self, rng: np.random.Generator) -> Matrix:
        """One draw of b for each member of the batch, (batch, p)."""
        factor = np.linalg.cholesky(self.gram)
        noise = rng.standard_normal(self.moment.shape)
        return np.asarray(self.mean() + np.linalg.solve(factor.swapaxes(1, 2), noise[..., None])[..., 0])
