"""What a noise model is: density, draws and estimates of what is left when the plant has been taken off."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.inference.priors import Prior

if TYPE_CHECKING:
    from lcopa_bayes.inference.defaultpriors import Scales

LOG_2PI = float(np.log(2 * np.pi))
SLIGHT = 0.1
"""A correlation, or a correlated part over the white one, that hardly shows [-]."""


class Noise(ABC):
    """Density of one response axis' residual on one record, batched over parameter sets.

    `parameters` (batch, len(names)) in the order of `names`; `gaps` (n,) time since the previous
    sample in sampling periods (its first entry is not used). The first parameter is `sigma`, the scale
    that remains when everything else of the noise vanishes.
    """

    kind: ClassVar[str]
    names: ClassVar[tuple[str, ...]]
    """Kinds of its parameters (`kinds.KINDS`)."""
    memory: ClassVar[int] = 0
    """Parameters that shape autocorrelations: a test of whiteness loses a degree of freedom to each."""

    @abstractmethod
    def pointwise(self, residual: Matrix, parameters: Matrix, gaps: Vector) -> Matrix:
        """Log density of each sample given those before it, (batch, n)."""

    @abstractmethod
    def draw(self, parameters: Matrix, gaps: Vector, rng: np.random.Generator) -> Matrix:
        """Noise for each parameter set, (batch, n) [response unit]."""

    def standard(self, residual: Matrix, parameters: Matrix, gaps: Vector) -> Matrix:
        """Residual less what those before it predict, over the noise scale, (batch, n) [-]."""
        return residual / parameters[:, :1]

    @staticmethod
    @abstractmethod
    def priors(scales: Scales, axis: int) -> Mapping[str, Prior]:
        """Default prior of each parameter on a response axis."""

    @staticmethod
    @abstractmethod
    def nearly_white(sd: float) -> Mapping[str, float]:
        """Parameters under which a misfit of `sd` [response unit] is judged almost sample by sample."""

    @classmethod
    def estimate(cls, residuals: Sequence[Vector]) -> Mapping[str, float]:
        """Starting values from residuals of equally spaced samples, by moments where there are any."""
        return cls.nearly_white(root_mean_square(residuals))


class GaussianNoise(Noise):
    """Noise that a linear map makes white with unit variance."""

    @abstractmethod
    def whiten(self, columns: Array, parameters: Matrix, gaps: Vector) -> tuple[Array, Vector]:
        """Whitened columns (batch, k, n) and the sum over samples of log innovation sd, (batch,)."""

    def pointwise(self, residual: Matrix, parameters: Matrix, gaps: Vector) -> Matrix:
        """Log density of each sample given those before it, (batch, n)."""
        white = self.standard(residual, parameters, gaps)
        return -0.5 * (white**2 + LOG_2PI) - self.log_scales(parameters, gaps)

    def standard(self, residual: Matrix, parameters: Matrix, gaps: Vector) -> Matrix:
        """Residual less what those before it predict, over its innovation sd, (batch, n) [-]."""
        return np.asarray(self.whiten(residual[:, None, :], parameters, gaps)[0][:, 0])

    @abstractmethod
    def log_scales(self, parameters: Matrix, gaps: Vector) -> Matrix:
        """Log innovation sd of each sample, broadcastable to (batch, n)."""


def root_mean_square(residuals: Sequence[Vector]) -> float:
    """Over all samples of some residuals [unit of the residuals]."""
    return float(np.sqrt(products(residuals, 0) / sum(residual.size for residual in residuals)))


def products(residuals: Sequence[Vector], lag: int) -> float:
    """Sum of products of samples `lag` apart [unit of the residuals squared]."""
    return sum(float(residual[lag:] @ residual[: residual.size - lag]) for residual in residuals)
