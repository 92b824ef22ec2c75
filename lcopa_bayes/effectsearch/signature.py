"""Signatures: what an effect would leave in the residual, and the evidence for it in closed form.

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
from scipy.special import log_ndtr

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.priorwidth import FACTORS, RARE
from lcopa_bayes.effectsearch.whitening import Whitening
from lcopa_bayes.model.effects.effect import Effect

_LEAST_POWER = 1e-10
"""Power of a direction of a signature at one prior sd below which it is nothing [-]."""
_RANK = 1e-9
"""Singular values below this share of the largest are zero [-]."""
_ROUNDED = 1e-6
"""Share of a residual's power that remains of it at least: directions are of single precision [-]."""


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


@final
@dataclass(frozen=True, eq=False)
class Scale:
    """What is known of the noise scale: quiet samples and, to the same rights, the residuals themselves.

    With the variance integrated out under ``1 / variance`` (its scale in the whitening is only an
    estimate), a
    drop of half the residual power by g is worth ``(m + n) / 2 * log((m + P) / (m + P - 2 g))`` nat, m
    quiet samples, n
    degrees of freedom and power P of the residual; g itself where m is large and P = n.
    """

    quiet: float
    """Samples the noise was known from [-]."""
    freedom: float
    """Degrees of freedom of the residual [-]."""
    power: Vector
    """Squared whitened residual, (draws,) [-]."""

    def gain(self, half_power: Vector) -> Vector:
        """Log evidence of a drop of half the residual power, (draws,) [nat]."""
        taken = np.minimum(2 * half_power, (1 - _ROUNDED) * self.power)
        return np.asarray(-0.5 * (self.quiet + self.freedom) * np.log1p(-taken / (self.quiet + self.power)))

    def drop(self, gain: float) -> float:
        """Drop of half the residual power that is worth `gain` nat, the inverse of `gain` [-]."""
        whole = self.quiet + float(self.power[0])
        return float(-0.5 * whole * np.expm1(-2 * gain / (self.quiet + self.freedom)))


@final
@dataclass(frozen=True, eq=False)
class Signature:
    """One instance of an effect, whitened and projected off what the base model can imitate."""

    effect: Effect
    span: Matrix
    """Orthonormal columns that span the projected signatures, (n, rank); single precision, there are
    hundreds."""
    scale: Vector
    """Length of each direction at one prior sd of its combination of coefficients, (rank,) [-]."""
    turned: Matrix
    """Combination of coefficients behind each direction, (rank, k) [-]."""
    survival: float
    """Share of the signature that is left [-]."""
    one_signed: bool
    """Whether its single coefficient cannot be negative."""
    share: bool = False
    """Whether a coefficient is a share, whose prior has one width."""

    @classmethod
    def of(
        cls, effect: Effect, columns: Matrix, survival: float, one_signed: bool, *, share: bool = False
    ) -> Signature:
        """From projected signatures over the prior sd of their coefficients, (n, k) [-].

        By the small Gram matrix: ten times faster than of the tall one, and exact enough for weights of
        order 1.
        """
        power, turned = np.linalg.eigh(columns.T @ columns)
        kept = power > max(_LEAST_POWER, 1e-12 * float(power.max(initial=0.0)))
        scale = np.sqrt(power[kept])
        span = (columns @ turned[:, kept] / scale).astype(np.float32)
        return cls(effect, span, scale, turned[:, kept].T, survival, one_signed, share)

    @property
    def columns(self) -> Matrix:
        """Projected signatures over the prior sd of their coefficients, (n, k) [-]."""
        return np.asarray(self.span @ (self.scale[:, None] * self.turned), dtype=float)

    def evidence(self, inner: Matrix, scale_of: Scale) -> Vector:
        """Log Bayes factors against no effect from ``span.T @ r``, (k, draws) -> (draws,) [nat].

        Averaged over wider and wider priors, each a tenth as common as the one before. A coefficient of one
        sign has a half-normal prior: the factor is 2 Phi(mean / sd) of the normal one.
        """
        each = self._by_width(inner, scale_of)
        # not scipy's sum, which on so few numbers takes fifty times as long: there are hundreds of signatures
        return np.asarray(np.logaddexp.reduce(each, axis=0) - np.logaddexp.reduce(RARE[: len(each)]))

    def _by_width(self, inner: Matrix, scale_of: Scale) -> Matrix:
        """Evidence within each width of the prior less what the width costs, (widths, draws) [nat]."""
        scale = self._factors[:, None] * self.scale
        power = scale**2
        gain = scale_of.gain(0.5 * (power / (1 + power)) @ inner**2)
        gain = gain + (RARE[: len(scale)] - 0.5 * np.log1p(power).sum(axis=1))[:, None]
        if self.one_signed and self.scale.size == 1:
            sign = np.sign(self.turned[0, 0])
            gain = gain + np.log(2) + log_ndtr(sign * scale * inner / np.sqrt(1 + power))
        return np.asarray(gain, dtype=float)

    @property
    def _factors(self) -> Vector:
        return np.asarray(FACTORS[:1] if self.share else FACTORS, dtype=float)

    def cosine(self, other: Signature) -> float:
        """Cosine of the smallest angle between the spans [-]; 0 when either is empty."""
        if 0 in (self.scale.size, other.scale.size):
            return 0.0
        return float(min(np.linalg.svd(self.span.T @ other.span, compute_uv=False).max(), 1.0))

    def width(self, residual: Vector, scale_of: Scale) -> float:
        """Likeliest width of the prior, over the stated one [-]."""
        inner = self.span.T @ residual
        return float(self._factors[self._by_width(inner[:, None], scale_of)[:, 0].argmax()])

    def amplitude(self, residual: Vector, scale_of: Scale) -> Vector:
        """Posterior mean of the coefficients over their prior sd, under the likeliest width of the prior;
        the normal part of a one-signed one."""
        factor = self.width(residual, scale_of)
        scale = factor * self.scale
        return np.asarray(factor * self.turned.T @ (scale / (1 + scale**2) * (self.span.T @ residual)))

    def drop(self, residual: Vector, scale_of: Scale) -> float:
        """What these coefficients take off half the squared residual, if all is linear [-]."""
        shift = self.scale * (self.turned @ self.amplitude(residual, scale_of))
        return float(shift @ (self.span.T @ residual) - 0.5 * shift @ shift)


def signature_of(
    model: ExtendedModel, x: Vector, whitening: Whitening, project: Projection, effect: Effect
) -> Signature:
    """Signature of one more effect beside those of `model`; ArithmeticError where it cannot be simulated."""
    raw, placed = model.signature(x, effect)
    if not np.isfinite(raw).all():
        raise FloatingPointError(f"{effect.name}: its signature is not finite")
    white = whitening(raw.T).T
    left = project(white)
    one_signed = len(placed) == 1 and placed[0].coefficient.one_signed
    share = any(one.coefficient.share for one in placed)
    return Signature.of(effect, left, survival(white, left), one_signed, share=share)


def expected_margin(truth: Signature, amplitude: Vector, rival: Signature, scale: Scale) -> float:
    """Log evidence by which `truth` of that size is expected to beat `rival` [nat]: the difference of their
    closed-form evidences on the noise-free residual it leaves."""
    shift = (truth.span @ (truth.scale * (truth.turned @ amplitude)))[:, None]
    size = Scale(scale.quiet, scale.freedom, scale.freedom + (shift**2).sum(axis=0))
    own = float(truth.evidence(truth.span.T @ shift, size)[0])
    return own - float(rival.evidence(rival.span.T @ shift, size)[0])


def pair_evidence(first: Signature, second: Signature, residual: Vector) -> float:
    """Log Bayes factor of two effects at once against none [nat]."""
    both = np.concatenate([first.columns, second.columns], axis=1)
    return float(log_bayes_factors(both, residual[:, None])[0])
