"""The whitening operator of a set of records: every sample divided by what its past does not predict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.effectsearch.noiselaw import Law, own_correlation
from lcopa_bayes.inference.noise import WhiteAR1
from lcopa_bayes.inference.observations import Observed, PlausibleNoise, Samples
from lcopa_bayes.inference.recursions import Filter

_PER_LAW = 4
"""Draws of noise from each plausible law [-]."""
_SEED = 7


@final
@dataclass(frozen=True, eq=False)
class Part:
    """Samples of one response axis of one record inside the stacked samples of all."""

    record: int
    axis: int
    rows: slice
    samples: Samples
    """Of the record."""

    @property
    def observed(self) -> Observed:
        """Those of the axis."""
        return self.samples.axes[self.axis]

    @property
    def times(self) -> Vector:
        """Times of those [time unit]."""
        return self.samples.times[self.observed.index]


def parts(samples: Sequence[Samples], only: int | None = None) -> tuple[Part, ...]:
    """Where each record's axes are in the stack, those with samples: records in their order, axes within; of
    one axis where `only` names it."""
    out, start = [], 0
    for r, record in enumerate(samples):
        for axis, observed in enumerate(record.axes):
            stop = start + observed.values.size
            if stop > start and only in (None, axis):
                out.append(Part(r, axis, slice(start, stop), record))
            start = stop
    return tuple(out)


def stacked(samples: Sequence[Samples], responses: Sequence[Array]) -> Matrix:
    """Responses per record (..., samples, axes) at the observed samples, (..., n) in the order of `parts`."""
    return np.concatenate(
        [
            response[..., observed.index, axis]
            for record, response in zip(samples, responses, strict=True)
            for axis, observed in enumerate(record.axes)
        ],
        axis=-1,
    )


@final
@dataclass(frozen=True, eq=False)
class Whitening:
    """Noise of every axis applied to stacked samples; records are independent of each other."""

    samples: tuple[Samples, ...]
    noise: tuple[Law, ...]
    """One per response axis."""
    dependence: tuple[float, ...] = ()
    """Samples that count as one independent sample, per response axis; 1 by default [-]."""
    posterior: tuple[PlausibleNoise, ...] = ()
    """What is known of the noise of each response axis; by default it is `noise`."""
    least: bool = False
    """Whether that of every axis is the least noise that is considered, which a residual does not scale."""

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """Places of the records' axes in the stack."""
        return parts(self.samples)

    @cached_property
    def size(self) -> int:
        """Number of stacked samples [-]."""
        return int(self.parts[-1].rows.stop)

    @cached_property
    def observed(self) -> Vector:
        """Observed samples, stacked [response unit]."""
        return np.concatenate([one.values for record in self.samples for one in record.axes])

    @property
    def weighed(self) -> tuple[Law, ...]:
        """Noise of each axis as it weights the samples: one that counts as less than one is the noisier."""
        shares = self.dependence or (1.0,) * len(self.noise)
        pairs = zip(self.noise, np.sqrt(shares).tolist(), strict=True)
        return tuple(Law(root * law.sigma, root * law.sigma_ar, law.rho) for law, root in pairs)

    @cached_property
    def _filters(self) -> tuple[Filter, ...]:
        """That of each part."""
        held = self.held
        return tuple(Filter.of(held[part.axis][None], part.observed.gaps) for part in self.parts)

    @property
    def held(self) -> tuple[Vector, ...]:
        """The same as `WhiteAR1` takes it, (3,) each."""
        return tuple(law.parameters for law in self.weighed)

    def __call__(self, columns: Array) -> Array:
        """Whitened columns (..., n), same shape [-]."""
        flat = columns.reshape(-1, columns.shape[-1])
        out = np.zeros(flat.shape)
        for part, whiten in zip(self.parts, self._filters, strict=True):
            own = flat[:, part.rows]
            acting = own.any(axis=1)  # most tangents are those of other records and axes
            if acting.any():
                out[acting, part.rows] = whiten(own[acting][None])[0]
        return out.reshape(columns.shape)

    def adjoint(self, columns: Matrix) -> Matrix:
        """Adjoint of whitening of columns (k, n), same shape [1 / response unit]."""
        out = np.empty_like(columns, dtype=float)
        for part in self.parts:
            law = self.held[part.axis]
            out[:, part.rows] = WhiteAR1().adjoint(columns[:, part.rows], law, part.observed.gaps)
        return out

    def covariances(self, columns: Matrix, count: int) -> Array:
        """Covariance of products of whitened noise with columns (n, k), under `count` plausible laws,
        (count, k, k) [-]; the estimate is right once where the noise is known, (1, k, k).

        None remembers longer than the residual that it was fitted to.
        """
        if not self.posterior:
            return (columns.T @ columns)[None]
        back, k = self.adjoint(columns.T), columns.shape[1]
        rng, out = np.random.default_rng(_SEED), np.zeros((count, k, k))
        for axis in range(len(self.posterior)):
            out += self.products_under(self._plausible(axis, count, rng), back, axis)
        return out

    def products_under(self, laws: Matrix, back: Matrix, axis: int) -> Array:
        """Covariance of products of the noise of one axis with columns (k, n), under laws (count, 3) as
        `WhiteAR1` takes them, (count, k, k)."""
        rho, which = np.unique(laws[:, 2], return_inverse=True)
        k = len(back)
        white, correlated = np.zeros((k, k)), np.zeros((rho.size, k, k))
        for part in parts(self.samples, axis):
            white += back[:, part.rows] @ back[:, part.rows].T
            correlated += _correlated_products(back[:, part.rows], rho, part.observed.gaps)
        return np.asarray(
            laws[:, 0, None, None] ** 2 * white + laws[:, 1, None, None] ** 2 * correlated[which]
        )

    def _plausible(self, axis: int, count: int, rng: np.random.Generator) -> Matrix:
        """Plausible laws of an axis, as `WhiteAR1` takes them, (count, 3); none remembers longer than the
        residual's own memory (`own_correlation`)."""
        own = self.dependence[axis] if self.dependence else np.inf
        rho = own_correlation(own, Law.of(self.posterior[axis]), self.size)
        if rho is None:
            return self.posterior[axis].draw(count, rng)
        return np.tile([0.0, self.noise[axis].sd, rho], (count, 1))

    @cached_property
    def effective(self) -> float:
        """Independent samples [-]."""
        if not self.dependence:
            return float(self.size)
        return float(sum((p.rows.stop - p.rows.start) / self.dependence[p.axis] for p in self.parts))

    @cached_property
    def log_scale(self) -> float:
        """Sum over samples of log sd of the prediction errors [nat]."""
        laws = [(self.noise[part.axis].parameters[None], part.observed.gaps) for part in self.parts]
        return float(sum(WhiteAR1().log_scales(law, gaps).sum() for law, gaps in laws))

    def excess(self, residual: Vector) -> float:
        """Root mean square of a stacked residual over the noise's [-]."""
        power = sum(np.sum((residual[p.rows] / self.noise[p.axis].sd) ** 2) for p in self.parts)
        return float(np.sqrt(power / self.size))

    def chance(self, count: int, rng: np.random.Generator) -> Matrix:
        """Noise whitened by the estimate, (n, count) [-], drawn from all that its posterior leaves plausible.

        Where the noise is known the draws are independent standard normal.
        """
        if not self.posterior:
            return rng.standard_normal((self.size, count))
        raw = np.empty((count, self.size))
        several = -(-count // _PER_LAW)
        for axis in range(len(self.posterior)):
            drawn = np.repeat(self._plausible(axis, several, rng), _PER_LAW, axis=0)[:count]
            for part in parts(self.samples, axis):
                raw[:, part.rows] = WhiteAR1().draw(drawn, part.observed.gaps, rng)
        return np.ascontiguousarray(self(raw).T)


def _correlated_products(columns: Matrix, rho: Vector, gaps: Vector) -> Array:
    """``columns R columns'`` of columns (k, n), R the correlation ``rho^gap`` of samples, (rho, k, k)."""
    k, n = columns.shape
    past, out = np.zeros((rho.size, k)), np.empty((rho.size, k, n))
    link = rho[:, None] ** gaps
    for i in range(n):
        past *= link[:, i, None]
        out[..., i] = past
        past += columns[:, i]
    cross = out @ columns.T
    return np.asarray(columns @ columns.T + cross + cross.swapaxes(1, 2))
