"""The whitening operator of a set of records: every sample divided by what its past does not predict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector
from lcopa_bayes.effectsearch.autoregression import Autoregression, unbroken
from lcopa_bayes.effectsearch.noiseposterior import NoisePosterior
from lcopa_bayes.inference.observations import Samples

_PER_PROCESS = 4
"""Draws of noise from each plausible process [-]."""
_SEED = 7


@final
@dataclass(frozen=True)
class Part:
    """Samples of one response axis of one record inside the stacked samples of all."""

    record: int
    axis: int
    rows: slice


def parts(samples: Sequence[Samples]) -> tuple[Part, ...]:
    """Where each record's axes stand in the stack: records in their order, axes within."""
    out, start = [], 0
    for r, record in enumerate(samples):
        for axis, observed in enumerate(record.axes):
            out.append(Part(r, axis, slice(start, start + observed.values.size)))
            start = out[-1].rows.stop
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
    """Noise of every axis applied to stacked samples; stretches apart by missing samples are independent."""

    samples: tuple[Samples, ...]
    noise: tuple[Autoregression, ...]
    """One per response axis."""
    dependence: tuple[float, ...] = ()
    """Samples that count as one independent sample, per response axis; 1 by default [-]."""
    posterior: tuple[NoisePosterior, ...] = ()
    """What is known of the noise of each response axis; by default it is `noise`."""

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

    @cached_property
    def _stretches(self) -> list[tuple[int, Index]]:
        """Axis and rows of unbroken stretches, those of one axis and length together, (stretches, n)."""
        found: dict[tuple[int, int], list[Index]] = {}
        for part in self.parts:
            gaps = self.samples[part.record].axes[part.axis].gaps
            for piece in unbroken(gaps) if gaps.size else ():
                rows = np.arange(piece.start, piece.stop) + part.rows.start
                found.setdefault((part.axis, rows.size), []).append(rows)
        return [(axis, np.array(rows)) for (axis, _), rows in found.items()]

    def __call__(self, columns: Array) -> Array:
        """Whitened columns (..., n), same shape [-]."""
        out = np.empty_like(columns, dtype=float)
        for axis, rows in self._stretches:
            out[..., rows] = self.noise[axis].whiten(columns[..., rows])
            if self.dependence:
                out[..., rows] /= np.sqrt(self.dependence[axis])
        return out

    def adjoint(self, columns: Array) -> Array:
        """Adjoint of whitening of columns (..., n), same shape [1 / response unit]."""
        out = np.empty_like(columns, dtype=float)
        for axis, rows in self._stretches:
            out[..., rows] = self.noise[axis].adjoint(columns[..., rows])
            if self.dependence:
                out[..., rows] /= np.sqrt(self.dependence[axis])
        return out

    def covariances(self, columns: Matrix, count: int) -> Array:
        """Covariance of products of whitened noise with columns (n, k), under `count` plausible processes,
        (count, k, k) [-]; the estimate is right once where the noise is known, (1, k, k)."""
        if not self.posterior:
            return (columns.T @ columns)[None]
        back, k = self.adjoint(columns.T), columns.shape[1]
        rng, out = np.random.default_rng(_SEED), np.zeros((count, k, k))
        for axis, posterior in enumerate(self.posterior):
            lagged = self._lagged(back, axis)
            for one, process in zip(out, posterior.draw(count, rng), strict=True):
                one += np.einsum("l,lij->ij", process.autocovariance(len(lagged) - 1), lagged)
        return out

    def _lagged(self, columns: Matrix, axis: int) -> Array:
        """Products of columns (k, n) a lag apart within stretches of an axis, either way, (lags, k, k)."""
        own = [rows for number, rows in self._stretches if number == axis]
        longest = max(rows.shape[1] for rows in own)
        out = np.zeros((longest, len(columns), len(columns)))
        for rows in own:
            n = rows.shape[1]
            spectra = np.fft.rfft(columns[:, rows], 2 * n)
            power = np.einsum("igf,jgf->ijf", spectra.conj(), spectra)
            lags = np.moveaxis(np.fft.irfft(power, 2 * n), -1, 0)[:n]
            out[:n] += lags + lags.transpose(0, 2, 1)
        out[0] /= 2
        return out

    @cached_property
    def effective(self) -> float:
        """Independent samples [-]."""
        if not self.dependence:
            return float(self.size)
        return float(sum((p.rows.stop - p.rows.start) / self.dependence[p.axis] for p in self.parts))

    @cached_property
    def log_scale(self) -> float:
        """Sum over samples of log sd of the prediction errors [nat]."""
        return float(
            sum(len(rows) * self.noise[axis].log_scale(rows.shape[1]) for axis, rows in self._stretches)
        )

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
        several = -(-count // _PER_PROCESS)
        for axis, posterior in enumerate(self.posterior):
            own = [rows for number, rows in self._stretches if number == axis]
            for k, process in enumerate(posterior.draw(several, rng)):
                some = slice(k * _PER_PROCESS, min((k + 1) * _PER_PROCESS, count))
                number = some.stop - some.start
                for rows in own:
                    drawn = process.draw(number * len(rows), rows.shape[1], rng)
                    raw[some, rows.ravel()] = drawn.reshape(number, -1)
        return np.ascontiguousarray(self(raw).T)
