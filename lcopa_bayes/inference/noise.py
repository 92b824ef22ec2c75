"""Noise models: what is left when the plant has been taken off."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, final

import numpy as np
from scipy.special import gammaln
from scipy.stats import t as student_t

from lcopa_bayes.arrays import Array, Matrix, Vector

_LOG_2PI = float(np.log(2 * np.pi))


class Noise(ABC):
    """Density of one response axis' residual on one record, batched over parameter sets.

    `parameters` (batch, len(names)) in the order of `names`; `gaps` (n,) time since the previous
    sample in sampling periods (its first entry is not used).
    """

    kind: ClassVar[str]
    names: ClassVar[tuple[str, ...]]

    @abstractmethod
    def pointwise(self, residual: Matrix, parameters: Matrix, gaps: Vector) -> Matrix:
        """Log density of each sample given those before it, (batch, n)."""

    @abstractmethod
    def draw(self, parameters: Matrix, gaps: Vector, rng: np.random.Generator) -> Matrix:
        """Noise for each parameter set, (batch, n) [response unit]."""


class GaussianNoise(Noise):
    """Noise that a linear map makes white with unit variance."""

    @abstractmethod
    def whiten(self, columns: Array, parameters: Matrix, gaps: Vector) -> tuple[Array, Vector]:
        """Whitened columns (batch, k, n) and the sum over samples of log innovation sd, (batch,)."""

    def pointwise(self, residual: Matrix, parameters: Matrix, gaps: Vector) -> Matrix:
        """Log density of each sample given those before it, (batch, n)."""
        white, _ = self.whiten(residual[:, None, :], parameters, gaps)
        return -0.5 * (white[:, 0] ** 2 + _LOG_2PI) - self.log_scales(parameters, gaps)

    @abstractmethod
    def log_scales(self, parameters: Matrix, gaps: Vector) -> Matrix:
        """Log innovation sd of each sample, broadcastable to (batch, n)."""


@final
class White(GaussianNoise):
    """Independent Gaussian samples."""

    kind = "white"
    names = ("sigma",)

    def whiten(self, columns: Array, parameters: Matrix, gaps: Vector) -> tuple[Array, Vector]:
        """Whitened columns (batch, k, n) and the sum over samples of log innovation sd, (batch,)."""
        sigma = parameters[:, 0]
        return columns * (1 / sigma)[:, None, None], gaps.size * np.log(sigma)

    def log_scales(self, parameters: Matrix, gaps: Vector) -> Matrix:
        """Log standard deviation, (batch, 1)."""
        return np.log(parameters[:, :1])

    def draw(self, parameters: Matrix, gaps: Vector, rng: np.random.Generator) -> Matrix:
        """Noise for each parameter set, (batch, n) [response unit]."""
        return parameters[:, :1] * rng.standard_normal((parameters.shape[0], gaps.size))


@final
class AR1(GaussianNoise):
    """Gaussian samples whose correlation over a gap of g sampling periods is ``rho**g``.

    `sigma` is the stationary standard deviation; at ``rho = 0`` the noise is white.
    """

    kind = "ar1"
    names = ("sigma", "rho")

    def whiten(self, columns: Array, parameters: Matrix, gaps: Vector) -> tuple[Array, Vector]:
        """Whitened columns (batch, k, n) and the sum over samples of log innovation sd, (batch,)."""
        link, scales = self._transition(parameters, gaps)
        out = np.empty(np.broadcast_shapes(columns.shape, (parameters.shape[0], 1, gaps.size)))
        out[..., :1] = columns[..., :1]
        out[..., 1:] = columns[..., 1:] - link[:, None, :] * columns[..., :-1]
        out /= np.exp(scales)[:, None, :]
        return out, scales.sum(axis=1)

    def log_scales(self, parameters: Matrix, gaps: Vector) -> Matrix:
        """Log innovation sd of each sample, (batch, n)."""
        return self._transition(parameters, gaps)[1]

    def draw(self, parameters: Matrix, gaps: Vector, rng: np.random.Generator) -> Matrix:
        """Noise for each parameter set, (batch, n) [response unit]."""
        link, scales = self._transition(parameters, gaps)
        out = np.exp(scales) * rng.standard_normal(scales.shape)
        for k in range(1, gaps.size):
            out[:, k] += link[:, k - 1] * out[:, k - 1]
        return out

    @staticmethod
    def _transition(parameters: Matrix, gaps: Vector) -> tuple[Matrix, Matrix]:
        """Correlation with the previous sample, (batch, n-1), and log innovation sd, (batch, n)."""
        link = parameters[:, 1:2] ** gaps[1:]
        scales = np.repeat(np.log(parameters[:, :1]), gaps.size, axis=1)
        scales[:, 1:] += 0.5 * np.log1p(-(link**2))
        return link, scales


@final
class Student(Noise):
    """Independent Student-t samples: scale `sigma`, `nu` degrees of freedom."""

    kind = "student"
    names = ("sigma", "nu")

    def pointwise(self, residual: Matrix, parameters: Matrix, gaps: Vector) -> Matrix:
        """Log density of each sample, (batch, n)."""
        sigma, nu = parameters[:, :1], parameters[:, 1:2]
        level = gammaln((nu + 1) / 2) - gammaln(nu / 2) - 0.5 * np.log(nu * np.pi) - np.log(sigma)
        return level - (nu + 1) / 2 * np.log1p((residual / sigma) ** 2 / nu)

    @staticmethod
    def information(nu: Vector) -> Vector:
        """Fisher information of a sample about its location, over that of a Gaussian of scale `sigma` [-]
        (Lange, Little and Taylor 1989, J. Am. Stat. Assoc. 84)."""
        return np.asarray((nu + 1) / (nu + 3))

    def draw(self, parameters: Matrix, gaps: Vector, rng: np.random.Generator) -> Matrix:
        """Noise for each parameter set, (batch, n) [response unit]."""
        shape = (parameters.shape[0], gaps.size)
        return parameters[:, :1] * np.asarray(student_t.rvs(parameters[:, 1:2], size=shape, random_state=rng))


NOISES: dict[str, type[Noise]] = {noise.kind: noise for noise in (White, AR1, Student)}
"""Noise models by the name a study gives them."""
