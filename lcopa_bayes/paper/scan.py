"""The scan of Eqs. 62-64: every candidate of the intervals, then finer candidates around the best.

All integrals are taken once: those of the response for each exponent alpha, alpha - beta, alpha - gamma
that occurs, those of the drive for each alpha and delay. A candidate's normal equations are then picked
from their inner products, and its response is a quotient of stored power series. Every candidate's output
error is computed; none is screened out by its equation error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector
from lcopa_bayes.core.progress import Progress
from lcopa_bayes.model.blockpulses import Circle, Spectrum, integration_weights, lower_toeplitz
from lcopa_bayes.model.path import Normalisation, TransferPath
from lcopa_bayes.paper.intervals import Candidates, Scan
from lcopa_bayes.paper.paths import Blocks, differenced_integrals, known_column, least_squares

_CELLS = 1 << 16
"""Candidates times blocks evaluated at once: 256 candidates of a 250-sample record, 1 MB an array."""
_ROUND = 9
"""Decimals to which exponents are distinguished."""


@final
@dataclass(frozen=True, eq=False)
class Evaluated:
    """Coefficients and output errors of all candidates of a round, delays varying fastest."""

    candidates: Candidates
    coefficients: Matrix
    """Etas, k and b, (candidates, terms + 2); the fixed one is 1. NaN where the drive has not acted."""
    squares: Vector
    """Output error ``sum (y - model)^2`` (Eq. 64), (candidates,) [response unit^2]; infinite if undefined."""

    @cached_property
    def physical(self) -> Array:
        """Whether viscosities and stiffness are positive, (candidates,) of truth values."""
        return np.asarray((self.coefficients[:, :-1] > 0).all(axis=1))

    def best(self) -> int:
        """Position of the winner: physical if any candidate is."""
        allowed = self.physical if self.physical.any() else np.ones(self.squares.size, dtype=bool)
        return int(np.argmin(np.where(allowed, self.squares, np.inf)))

    def of(self, position: int) -> tuple[tuple[float, ...], float]:
        """Orders [-] and delay [time unit] of a candidate."""
        row, late = divmod(position, self.candidates.delays.size)
        return tuple(map(float, self.candidates.orders[row])), float(self.candidates.delays[late])


@final
@dataclass(frozen=True, eq=False)
class _Ground:
    """Records on equal blocks and their stored series."""

    records: tuple[Blocks, ...]
    exponents: Vector
    tops: Index
    """Position of each distinct alpha among the exponents."""
    delays: Vector

    @cached_property
    def circle(self) -> Circle:
        return Circle(self.records[0].grid.n)

    @cached_property
    def series(self) -> Spectrum:
        """Differenced integrals of every exponent, (exponents, points)."""
        return differenced_integrals(self.exponents, self.circle, self.records[0].grid.step)

    @cached_property
    def drives(self) -> list[Spectrum]:
        """Delayed drives of every record, (delays, points) each."""
        return [
            self.circle.spectrum(blocks.drive.block_means(blocks.grid.edges, self.delays)[0])
            for blocks in self.records
        ]

    def inner_products(self) -> tuple[Matrix, Array, Matrix]:
        """Of integrated responses with each other, with integrated drives, and of these with themselves.

        Shapes (exponents, exponents), (exponents, tops, delays) and (tops, delays).
        """
        size = (self.exponents.size, self.tops.size, self.delays.size)
        own, cross, drive = np.zeros(size[:1] * 2), np.zeros(size), np.zeros(size[1:])
        grid = self.records[0].grid
        weights = integration_weights(self.exponents, grid.n, grid.step)
        for blocks in self.records:
            means = blocks.drive.block_means(blocks.grid.edges, self.delays)[0]
            integrated = np.stack([lower_toeplitz(row) @ blocks.response for row in weights])
            own += integrated @ integrated.T
            for a, top in enumerate(self.tops):
                driven = lower_toeplitz(weights[top]) @ means.T
                cross[:, a] += integrated @ driven
                drive[a] += (driven**2).sum(axis=0)
        return own, cross, drive


def evaluate(
    records: Sequence[Blocks],
    candidates: Candidates,
    normalisation: Normalisation,
    bar: Progress | None = None,
) -> Evaluated:
    """Least squares and output error of every candidate.

    Accuracy: coefficients as `least_squares` to the square of its condition number times rounding; the
    winner's are solved again without squaring it.
    """
    orders = candidates.orders
    table = np.round(np.concatenate((orders[:, :1] - orders, orders[:, :1]), axis=1), _ROUND)
    distinct, place = np.unique(table, return_inverse=True)
    exponents, place = np.asarray(distinct, dtype=float), place.reshape(table.shape)
    tops, top_of = np.unique(place[:, -1], return_inverse=True)
    kinds = sorted({(blocks.grid.n, blocks.grid.step) for blocks in records})
    grounds = [
        _Ground(
            tuple(b for b in records if (b.grid.n, b.grid.step) == kind), exponents, tops, candidates.delays
        )
        for kind in kinds
    ]
    parts = [ground.inner_products() for ground in grounds]
    own, cross, drive = (np.sum([part[k] for part in parts], axis=0) for k in range(3))
    portion = max(8, _CELLS // max(n for n, _ in kinds))
    rows, late = np.divmod(np.arange(candidates.size), candidates.delays.size)
    coefficients = np.empty((candidates.size, table.shape[1] + 1))
    squares = np.empty(candidates.size)
    for first in range(0, candidates.size, portion):
        chunk = slice(first, min(first + portion, candidates.size))
        at, top, tau = place[rows[chunk]], top_of[rows[chunk]], late[chunk]
        gram = np.empty((tau.size, at.shape[1] + 1, at.shape[1] + 1))
        gram[:, :-1, :-1] = own[at[:, :, None], at[:, None, :]]
        gram[:, -1, :-1] = gram[:, :-1, -1] = -cross[at, top[:, None], tau[:, None]]
        gram[:, -1, -1] = drive[top, tau]
        coefficients[chunk] = _solved(gram, known_column(normalisation, orders.shape[1]))
        squares[chunk] = _output_squares(grounds, at, tau, coefficients[chunk])
        if bar is not None:
            bar.update(tau.size)
    return Evaluated(candidates, coefficients, squares)


def _solved(gram: Array, fixed: int) -> Matrix:
    """Coefficients of the homogeneous equation with this Gram matrix, the fixed one 1, (batch, columns)."""
    norms = np.sqrt(np.diagonal(gram, axis1=1, axis2=2))
    out = np.full(norms.shape, np.nan)
    acting = np.flatnonzero((norms > 0).all(axis=1))
    norms = norms[acting]
    scaled = gram[acting] / (norms[:, :, None] * norms[:, None, :])
    others = np.delete(np.arange(norms.shape[1]), fixed)
    system, right = scaled[:, others[:, None], others], -scaled[:, others, fixed, None]
    try:
        solution = np.linalg.solve(system, right)[..., 0]
    except np.linalg.LinAlgError:  # columns that depend on each other exactly
        solution = (np.linalg.pinv(system, rcond=1e-12, hermitian=True) @ right)[..., 0]
    values = np.ones_like(norms)
    values[:, others] = solution / norms[:, others] * norms[:, fixed, None]
    out[acting] = values
    return out


def _output_squares(grounds: Sequence[_Ground], at: Index, late: Index, coefficients: Matrix) -> Vector:
    """Sum of squared output errors over all records, (batch,); infinite where the response is."""
    total = np.zeros(late.size)
    with np.errstate(all="ignore"):  # a response that runs away is infinitely wrong
        for ground in grounds:
            series = ground.series
            denominator = coefficients[:, :1] * series[at[:, 0]]
            for column in range(1, at.shape[1]):
                denominator += coefficients[:, column, None] * series[at[:, column]]
            quotient = coefficients[:, -1:] * series[at[:, -1]] / denominator
            for blocks, drives in zip(ground.records, ground.drives, strict=True):
                modelled = ground.circle.coefficients(quotient * drives[late])
                total += ((modelled - blocks.response) ** 2).sum(axis=1)
    total[~np.isfinite(total)] = np.inf
    return total


@final
@dataclass(frozen=True, eq=False)
class Scanned:
    """The best candidates of a scan."""

    model: TransferPath
    """Least output error among candidates with positive viscosities and stiffness, or among all when there
    is none (`TransferPath.physical` is False); as normalised in the scan, the fixed coefficient 1."""
    rmse: float
    """Its output error over the blocks [response unit]."""
    unconstrained_rmse: float
    """Least output error among candidates of any sign [response unit]."""
    candidates: int
    """Candidates tried [-]."""
    physical: int
    """Of these, with positive viscosities and stiffness [-]."""


def scan(
    records: Sequence[Blocks],
    terms: int,
    span: float,
    plan: Scan,
    *,
    normalisation: Normalisation = Normalisation.STIFFNESS,
    bar: Progress | None = None,
) -> Scanned:
    """Scan the intervals, then refine around the best candidate, the least output error winning.

    Parameters: terms [-]; span [time unit] of the shortest record. The unit of the delay is a block of
    the first record.
    """
    block = records[0].grid.step
    samples = sum(blocks.grid.n for blocks in records)
    candidates = plan.first_round(terms, span, block)
    best: tuple[tuple[bool, float], tuple[float, ...], float] | None = None
    tried = physical = 0
    unconstrained = np.inf
    for number in range(plan.rounds + 1):
        if best is not None:
            candidates = plan.next_round(best[1], best[2], number, span, block)
        if bar is not None and bar.total is not None:
            bar.total += candidates.size
            bar.refresh()
        evaluated = evaluate(records, candidates, normalisation, bar)
        tried, physical = tried + candidates.size, physical + int(evaluated.physical.sum())
        unconstrained = min(unconstrained, float(evaluated.squares.min()))
        at = evaluated.best()
        rank = (not evaluated.physical[at], float(evaluated.squares[at]))
        if best is None or rank < best[0]:
            best = (rank, *evaluated.of(at))
    assert best is not None
    (_, squares), orders, delay = best
    model = least_squares(records, orders, delay, normalisation=normalisation)
    rmse, unconstrained_rmse = (float(np.sqrt(value / samples)) for value in (squares, unconstrained))
    return Scanned(model, rmse, unconstrained_rmse, tried, physical)
