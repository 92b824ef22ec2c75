"""Noise as the residual of a fit knows it: with what the fit took up of it, with its memory and its tails."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self, final

import numpy as np
from scipy.optimize import brentq
from scipy.stats import t as student

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.core.estimate import HALF_WIDTH, LEVEL
from lcopa_bayes.effectsearch.basefit import axis_pieces, fitted_scales
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.noise import joint_noise
from lcopa_bayes.effectsearch.noiselaw import Law, plausible_in_residual, single_correlation
from lcopa_bayes.effectsearch.regression import Optimum
from lcopa_bayes.effectsearch.whitening import Whitening, parts
from lcopa_bayes.inference.noise import Student
from lcopa_bayes.inference.observations import Observed
from lcopa_bayes.inference.recursions import correlated

_FREEDOM = np.array([2.5, 3.0, 4.0, 5.0, 7.0, 10.0, 20.0, 1e6])
"""Degrees of freedom of Student's law that are tried, the last those of a normal one [-]."""
_STEPS = 100
"""Steps to the likeliest scale of each [-]."""


@final
@dataclass(frozen=True)
class BandScales:
    """Scales of a pointwise 90 % band around a prediction, where noise is known with an uncertainty."""

    noise: float
    """Standard deviation of the normal noise that as wide a band holds [response unit]."""
    prediction: float = 1.0
    """Factor on the standard deviation of what the fit leaves uncertain [-]."""

    def half_width(self, variance: Vector) -> Vector:
        """Half the width of the band with noise at a variance of the prediction, same shape [response
        unit]."""
        return np.asarray(HALF_WIDTH * np.sqrt(self.prediction**2 * variance + self.noise**2))


@final
@dataclass(frozen=True, eq=False)
class ResidualNoise:
    """Draws of all that the residual on one response axis leaves plausible of its noise."""

    sd: Vector
    """Scale, the standard deviation where the tails are normal, (draws,) [response unit]."""
    rho: Vector
    """Correlation one sampling period apart that gives as many independent samples, (draws,) [-]."""
    freedom: Vector
    """Degrees of freedom of what the past does not predict, (draws,) [-]."""
    widening: Vector
    """Standard deviations of what a fit leaves open under it, over those under the noise by which the fit
    weighs its samples, (draws,) [-]."""
    period: float
    """Sampling period [time unit]."""
    slopes: Array
    """Covariance of the slope of the cost under it, (draws, coordinates, coordinates)."""

    @classmethod
    def of(
        cls,
        model: ExtendedModel,
        optimum: Optimum,
        whitening: Whitening,
        axis: int,
        count: int,
        rng: np.random.Generator,
    ) -> Self:
        """So many draws given the fitted records, at the optimum of a model under its whitening."""
        plant = model.plant
        own, pieces = parts(plant.samples, axis), axis_pieces(plant, optimum.residual, axis)
        regressors = [optimum.tangents[part.rows] for part in own]
        jacobian = np.concatenate([optimum.jacobian[part.rows] for part in own])
        besides = optimum.information - jacobian.T @ jacobian  # what other axes and priors say
        scales = fitted_scales(plant)
        alone = joint_noise(pieces, plant.table.layout.responses[axis], "", scales)
        known = plausible_in_residual(
            list(zip(pieces, regressors, strict=True)),
            besides * whitening.weighed[axis].sd ** 2,
            scales,
            alone.posterior,
            alone.dependence,
        )
        laws = known.draw_shapes(count, rng)
        freedom, scale = _tails(_innovations(Law.of(known), pieces), known.count, count, rng)
        laws[:, :2] *= scale[:, None]
        white, correlated_sd, rho = laws.T
        share = correlated_sd**2 / (white**2 + correlated_sd**2)
        beyond = 2 * share**2 * rho**2 / (1 - rho**2)  # as `Law.correlated` over all lags, less 1
        heavier = np.sqrt(freedom / (freedom - 2))
        of_all = np.column_stack([heavier * white, heavier * correlated_sd, rho])
        noise = whitening.products_under(of_all, whitening.adjoint(optimum.jacobian.T), axis)
        return cls(
            np.hypot(white, correlated_sd),
            single_correlation(beyond),
            freedom,
            _widening(optimum, np.concatenate(regressors), noise + besides),
            scales.period,
            noise,
        )

    @property
    def scales(self) -> BandScales:
        """Those of bands that hold it."""
        return BandScales(_pooled(self.sd, self.freedom), _pooled(self.widening, np.inf))

    def draw(self, times: Vector, rng: np.random.Generator) -> Matrix:
        """Noise of each draw at times [time unit], (draws, n) [response unit]."""
        link = self.rho[:, None] ** (np.diff(times) / self.period)
        out = rng.standard_t(self.freedom[:, None], (self.sd.size, times.size))
        out[:, 1:] *= np.sqrt(1 - link**2)
        return np.asarray(self.sd[:, None] * correlated(out, link))


def _widening(optimum: Optimum, tangents: Matrix, slopes: Array) -> Vector:
    """Root mean square standard deviation of a fitted response with these `tangents` (n, k), over that where
    the weights are right, (draws,) [-]; `slopes`, covariances of the slope of the cost, (draws, k, k).

    By the sandwich of White (1982, Econometrica 50).
    """
    onto = optimum.covariance @ (tangents.T @ tangents) @ optimum.covariance
    variance = np.einsum("kl,dlk->d", onto, slopes) / np.trace(onto @ optimum.information)
    return np.asarray(np.sqrt(variance))


def _pooled(scales: Vector, freedom: Vector | float) -> float:
    """Standard deviation of the normal whose central 90 % interval is that of all these laws of Student's
    together, normal ones at infinite degrees of freedom."""

    def beyond(half_width: float) -> float:
        return float(2 * np.mean(student.cdf(half_width / scales, freedom)) - 1 - LEVEL)

    ends = scales * student.isf((1 - LEVEL) / 2, freedom)
    return float(brentq(beyond, 0.99 * ends.min(), 1.01 * ends.max())) / HALF_WIDTH


def _innovations(law: Law, pieces: Sequence[Observed]) -> Vector:
    """What the past does not predict of pieces, over its root mean square [-]."""
    white = np.concatenate([law.whiten(piece.values, piece.gaps) for piece in pieces])
    return np.asarray(white / np.sqrt(np.mean(white**2)))


def _tails(white: Vector, independent: float, count: int, rng: np.random.Generator) -> tuple[Vector, Vector]:
    """Draws of degrees of freedom and scale of Student's law given innovations of mean square 1 that know
    their scale as so many independent ones do, (count,) each [-].

    Degrees of freedom are equally probable before; their evidence is by Laplace's approximation over the
    logarithm of the scale, of which a sample holds ``2 nu / (nu + 3)`` (Lange, Little and Taylor 1989, J. Am.
    Stat. Assoc. 84).
    """
    squares, nu = white**2, _FREEDOM[:, None]
    variance = np.ones_like(nu)
    for _ in range(_STEPS):
        variance = ((nu + 1) * squares / (nu + squares / variance)).mean(axis=1, keepdims=True)
    parameters = np.hstack([np.sqrt(variance), nu])
    density = Student().pointwise(white[None], parameters, np.ones_like(white)).mean(axis=1)
    information = 2 * independent * _FREEDOM / (_FREEDOM + 3)
    log_evidence = independent * density - 0.5 * np.log(information)
    weights = np.exp(log_evidence - log_evidence.max())
    chosen = rng.choice(_FREEDOM.size, count, p=weights / weights.sum())
    spread = rng.standard_normal(count) / np.sqrt(information[chosen])
    return _FREEDOM[chosen], parameters[chosen, 0] * np.exp(spread)
