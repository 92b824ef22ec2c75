"""Noise models: density, draws and estimates of what is left when the plant has been taken off."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar, final

import numpy as np
from scipy.linalg.lapack import dpttrs
from scipy.special import gammaln
from scipy.stats import t as student_t

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.inference.priors import Prior
from lcopa_bayes.inference.recursions import (
    Filter,
    correlated,
    differences,
    equal,
    factors,
    scalar_products,
)

if TYPE_CHECKING:
    from lcopa_bayes.inference.defaultpriors import Scales

LOG_2PI = float(np.log(2 * np.pi))
_SLIGHT = 0.1
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
        return cls.nearly_white(_root_mean_square(residuals))


class GaussianNoise(Noise):
    """Noise that a linear map makes white with unit variance."""

    @abstractmethod
    def whiten(self, columns: Array, parameters: Matrix, gaps: Vector) -> tuple[Array, Vector]:
        """Whitened columns (batch, k, n) and the sum over samples of log innovation sd, (batch,)."""

    @abstractmethod
    def products(self, columns: Array, parameters: Matrix, gaps: Vector) -> tuple[Array, Vector]:
        """Scalar products of the whitened columns (batch, k, n) with each other, (batch, k, k), and the sum
        over samples of log innovation sd, (batch,): what a density needs, without the whitened columns."""

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


@final
class White(GaussianNoise):
    """Independent Gaussian samples."""

    kind = "white"
    names = ("sigma",)

    def whiten(self, columns: Array, parameters: Matrix, gaps: Vector) -> tuple[Array, Vector]:
        """Whitened columns (batch, k, n) and the sum over samples of log innovation sd, (batch,)."""
        sigma = parameters[:, 0]
        return columns * (1 / sigma)[:, None, None], gaps.size * np.log(sigma)

    def products(self, columns: Array, parameters: Matrix, gaps: Vector) -> tuple[Array, Vector]:
        """Scalar products of whitened columns, (batch, k, k), and the sum of log innovation sd, (batch,)."""
        sigma = parameters[:, 0]
        return scalar_products(columns, columns) / (sigma**2)[:, None, None], gaps.size * np.log(sigma)

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

    def products(self, columns: Array, parameters: Matrix, gaps: Vector) -> tuple[Array, Vector]:
        """Scalar products of whitened columns, (batch, k, k), and the sum of log innovation sd, (batch,)."""
        if gaps.size < 2 or not equal(gaps):
            white, scales = self.whiten(columns, parameters, gaps)
            return scalar_products(white, white), scales
        link, scales = self._transition(parameters, gaps[:2])
        later = columns[..., 1:] - link[:, :, None] * columns[..., :-1]
        first = columns[..., :1] * np.exp(-scales[:, :1, None])
        later_scale = np.exp(2 * scales[:, 1])[:, None, None]
        products = scalar_products(later, later) / later_scale + scalar_products(first, first)
        return products, scales[:, 0] + (gaps.size - 1) * scales[:, 1]

    def log_scales(self, parameters: Matrix, gaps: Vector) -> Matrix:
        """Log innovation sd of each sample, (batch, n)."""
        return self._transition(parameters, gaps)[1]

    def draw(self, parameters: Matrix, gaps: Vector, rng: np.random.Generator) -> Matrix:
        """Noise for each parameter set, (batch, n) [response unit]."""
        link, scales = self._transition(parameters, gaps)
        return correlated(np.exp(scales) * rng.standard_normal(scales.shape), link)

    @staticmethod
    def priors(scales: Scales, axis: int) -> Mapping[str, Prior]:
        """Default prior of each parameter on a response axis."""
        return {"sigma": scales.sigma(axis), "rho": scales.rho()}

    @staticmethod
    def nearly_white(sd: float) -> Mapping[str, float]:
        """A slight correlation, so that it can grow."""
        return {"sigma": sd, "rho": _SLIGHT}

    @classmethod
    def estimate(cls, residuals: Sequence[Vector]) -> Mapping[str, float]:
        """Standard deviation and first autocorrelation."""
        power, lagged = (_products(residuals, lag) for lag in (0, 1))
        return {"sigma": _root_mean_square(residuals), "rho": lagged / power if power else 0.0}

    @staticmethod
    def _transition(parameters: Matrix, gaps: Vector) -> tuple[Matrix, Matrix]:
        """Correlation with the previous sample, (batch, n-1), and log innovation sd, (batch, n)."""
        link = parameters[:, 1:2] ** gaps[1:]
        scales = np.repeat(np.log(parameters[:, :1]), gaps.size, axis=1)
        scales[:, 1:] += 0.5 * np.log1p(-(link**2))
        return link, scales


@final
class WhiteAR1(GaussianNoise):
    """White measurement noise plus a correlated part that is Gaussian and stationary.

    `sigma` is the standard deviation of the white part, `sigma_ar` that of the correlated part, whose
    correlation over a gap of g sampling periods is ``rho**g``. Whitened by a Kalman filter (`recursions`).
    """

    kind = "white+ar1"
    names = ("sigma", "sigma_ar", "rho")
    memory = 2

    def whiten(self, columns: Array, parameters: Matrix, gaps: Vector) -> tuple[Array, Vector]:
        """Whitened columns (batch, k, n) and the sum over samples of log innovation sd, (batch,)."""
        batch = max(len(columns), len(parameters))
        filtered = Filter.of(np.broadcast_to(parameters, (batch, 3)), gaps)
        return filtered(columns), filtered.log_scales.sum(axis=1)[: parameters.shape[0]]

    def products(self, columns: Array, parameters: Matrix, gaps: Vector) -> tuple[Array, Vector]:
        """Scalar products of whitened columns, (batch, k, k), and the sum of log innovation sd, (batch,)."""
        batch, k, n = columns.shape
        if n == 0:
            return np.zeros((batch, k, k)), np.zeros(batch)
        link, variances, lower = factors(parameters, gaps)
        work = differences(columns, link, (k, batch, n))
        solved = dpttrs(variances, lower, work.reshape(k, batch * n).T)[0].T.reshape(k, batch, n)
        logs = 0.5 * np.log(variances).reshape(batch, n).sum(axis=1)
        return scalar_products(work.swapaxes(0, 1), solved.swapaxes(0, 1)), logs

    def adjoint(self, columns: Matrix, parameters: Vector, gaps: Vector) -> Matrix:
        """Adjoint of `whiten` at one parameter set (3,): columns (k, n), same shape [1 / response unit]."""
        link, variances, lower = factors(parameters[None], gaps)
        work = columns * np.sqrt(variances)
        work[:, 1:] += lower[: gaps.size - 1] * work[:, :-1]
        out = np.asarray(dpttrs(variances, lower, work.T)[0].T)
        return np.concatenate([out[:, :-1] - link[0] * out[:, 1:], out[:, -1:]], axis=1)

    def log_scales(self, parameters: Matrix, gaps: Vector) -> Matrix:
        """Log innovation sd of each sample, (batch, n)."""
        variances = factors(parameters, gaps)[1] if gaps.size else np.empty(0)
        return 0.5 * np.log(variances).reshape(parameters.shape[0], gaps.size)

    def draw(self, parameters: Matrix, gaps: Vector, rng: np.random.Generator) -> Matrix:
        """Noise for each parameter set, (batch, n) [response unit]."""
        sigma, sigma_ar, rho = (parameters[:, k : k + 1] for k in range(3))
        link = rho ** (gaps[1:2] if equal(gaps) else gaps[1:])
        out = sigma_ar * rng.standard_normal((parameters.shape[0], gaps.size))
        out[:, 1:] *= np.sqrt(1 - link**2)
        out = correlated(out, link)
        return out + sigma * rng.standard_normal(out.shape)

    @staticmethod
    def priors(scales: Scales, axis: int) -> Mapping[str, Prior]:
        """Default prior of each parameter on a response axis."""
        return {
            "sigma": scales.sigma_white(axis),
            "sigma_ar": scales.sigma_ar(axis),
            "rho": scales.rho_short(),
        }

    @staticmethod
    def nearly_white(sd: float) -> Mapping[str, float]:
        """A correlated part of little power, so that it can grow."""
        return {"sigma": sd, "sigma_ar": _SLIGHT * sd, "rho": 0.5}

    @classmethod
    def estimate(cls, residuals: Sequence[Vector]) -> Mapping[str, float]:
        """By the autocovariances at lags 0, 1 and 2, where these are those of such noise."""
        power, first, second = (_products(residuals, lag) for lag in (0, 1, 2))
        count = sum(residual.size for residual in residuals)
        if not 0 < second < first < power or first**2 >= second * power:
            return cls.nearly_white(_root_mean_square(residuals))
        correlated = first**2 / second
        return {
            "sigma": float(np.sqrt((power - correlated) / count)),
            "sigma_ar": float(np.sqrt(correlated / count)),
            "rho": second / first,
        }


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


def _root_mean_square(residuals: Sequence[Vector]) -> float:
    """Over all samples of some residuals [unit of the residuals]."""
    return float(np.sqrt(_products(residuals, 0) / sum(residual.size for residual in residuals)))


def _products(residuals: Sequence[Vector], lag: int) -> float:
    """Sum of products of samples `lag` apart [unit of the residuals squared]."""
    return sum(float(residual[lag:] @ residual[: residual.size - lag]) for residual in residuals)
