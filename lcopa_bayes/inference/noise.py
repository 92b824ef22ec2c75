"""Noise models, and all of them by the name a study gives them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, final

import numpy as np
from scipy.special import gammaln
from scipy.stats import t as student_t

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.inference.mixednoise import WhiteAR1
from lcopa_bayes.inference.noisemodel import SLIGHT, products, root_mean_square
from lcopa_bayes.inference.noisemodel import GaussianNoise as GaussianNoise
from lcopa_bayes.inference.noisemodel import Noise as Noise
from lcopa_bayes.inference.priors import Prior

if TYPE_CHECKING:
    from lcopa_bayes.inference.defaultpriors import Scales


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

    @staticmethod
    def priors(scales: Scales, axis: int) -> Mapping[str, Prior]:
        """Default prior of each parameter on a response axis."""
        return {"sigma": scales.sigma(axis)}

    @staticmethod
    def nearly_white(sd: float) -> Mapping[str, float]:
        """White noise of `sd`."""
        return {"sigma": sd}


@final
class AR1(GaussianNoise):
    """Gaussian samples whose correlation over a gap of g sampling periods is ``rho**g``.

    `sigma` is the stationary standard deviation; at ``rho = 0`` the noise is white.
    """

    kind = "ar1"
    names = ("sigma", "rho")
    memory = 1

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
    def priors(scales: Scales, axis: int) -> Mapping[str, Prior]:
        """Default prior of each parameter on a response axis."""
        return {"sigma": scales.sigma(axis), "rho": scales.rho()}

    @staticmethod
    def nearly_white(sd: float) -> Mapping[str, float]:
        """A slight correlation, so that it can grow."""
        return {"sigma": sd, "rho": SLIGHT}

    @classmethod
    def estimate(cls, residuals: Sequence[Vector]) -> Mapping[str, float]:
        """Standard deviation and first autocorrelation."""
        power, lagged = (products(residuals, lag) for lag in (0, 1))
        return {"sigma": root_mean_square(residuals), "rho": lagged / power if power else 0.0}

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

    @staticmethod
    def priors(scales: Scales, axis: int) -> Mapping[str, Prior]:
        """Default prior of each parameter on a response axis."""
        return {"sigma": scales.sigma(axis), "nu": scales.nu()}

    @staticmethod
    def nearly_white(sd: float) -> Mapping[str, float]:
        """Nearly Gaussian noise of scale `sd`."""
        return {"sigma": sd, "nu": 10.0}


NOISES: dict[str, type[Noise]] = {noise.kind: noise for noise in (White, AR1, WhiteAR1, Student)}
"""Noise models by the name a study gives them."""
