r"""Legendre wavelets and their operational matrices, dense and as printed (Ta et al. 2026, Eqs. 32-61).

Vectors of basis functions are on the left in the paper, ``(I^a Phi)(t) = P^a Phi(t)``, so that the
coefficients of a function are rows and its matrices the transposes of those in `blockpulses`:
``F^a = integration_matrix(a).T`` and the delay E by j1 blocks, ones above the diagonal, upper triangular.

The printed equations are inconsistent in three places; this module uses:

- Eq. 37 with m = 1 has unit norm and zero mean on one level, but the levels k = 1..K of Eq. 38 are not
  orthogonal to each other: a ramp is not orthogonal to the shorter ramps inside it. The inner product of
  nested wavelets is ``2^(-3/2 (k' - k))``. So Eq. 38's ``c = <f, psi>`` are not the coefficients of the
  expansion; they are taken from the sampled matrix, ``c^T = f^T Psi^-1``.
- Wavelets live on [0, 1) and block pulses on [0, Tf): Eqs. 46 and 48 equate functions of different
  arguments. Here the wavelets are functions of t / Tf and the integrals have the unit.
- Eq. 46, ``Phi = Psi B``, holds at the nodes t_i only. Taken as a definition, everything after it is
  the block-pulse method in other coordinates: ``P^a = Psi F^a Psi^-1`` is a similarity transform.
"""

from __future__ import annotations

import timeit
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.model.blockpulses import integration_matrix
from lcopa_bayes.model.path import TransferPath


@dataclass(frozen=True)
class WaveletBasis:
    """The constant and the wavelets of Eq. 37 with m = 1 on levels 1..K, N = 2^K functions in all.

    InputError unless N is a power of two, 2 or more.
    """

    n: int
    """N [-]."""

    def __post_init__(self) -> None:
        if isinstance(self.n, bool) or not isinstance(self.n, int) or self.n < 2 or self.n & (self.n - 1):
            raise InputError(
                f"wavelets need a power of two of blocks, 2 or more; got {self.n!r}: resample the record or "
                "use block pulses, which take any number"
            )

    def functions(self, t: Vector) -> Matrix:
        """Phi(t) of Eq. 40, ordered by level and place, at t [-] in [0, 1); (N, points)."""
        rows = [np.ones_like(t)]
        for level in range(1, self.n.bit_length()):
            for place in range(1, 2 ** (level - 1) + 1):
                x = 2.0**level * t - (2 * place - 1)  # P_1(x) = x
                rows.append(np.where((x >= -1) & (x < 1), np.sqrt(1.5) * 2 ** (level / 2) * x, 0.0))
        return np.array(rows)

    @cached_property
    def psi(self) -> Matrix:
        """Psi of Eq. 42: the functions at ``t_i = (2i - 1) / (2N)``, (N, N) [-]."""
        return self.functions((np.arange(self.n) + 0.5) / self.n)

    @cached_property
    def inverse(self) -> Matrix:
        """``Psi^-1`` [-]; ``c^T = f^T Psi^-1`` are the coefficients of values f at the nodes."""
        return np.asarray(np.linalg.inv(self.psi))

    @cached_property
    def gram(self) -> Matrix:
        """Inner products on [0, 1), (N, N) [-], exact: two Gauss points on each half of a finest wavelet."""
        offsets = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)
        at = self.functions(((np.arange(self.n)[:, None] + offsets) / self.n).ravel())
        return np.asarray(at @ at.T / (2 * self.n))

    @property
    def largest_overlap(self) -> float:
        """Largest absolute inner product of two different functions [-]; 0 for an orthogonal basis."""
        return float(np.abs(self.gram - np.diag(np.diag(self.gram))).max())

    def integration(self, order: float, span: float) -> Matrix:
        """P^a of Eq. 49 over a record of length `span` [time unit]; (N, N) [time unit^order]."""
        return np.asarray(self.psi @ integration_matrix(order, self.n, span / self.n).T @ self.inverse)

    def shift(self, blocks: int) -> Matrix:
        """Z of Eq. 57, a delay of whole blocks; (N, N) [-]."""
        return np.asarray(self.psi @ np.eye(self.n, k=blocks) @ self.inverse)


def wavelet_response(
    path: TransferPath, drive: Vector, basis: WaveletBasis, span: float, blocks: int
) -> Vector:
    """Response at the nodes, (N,) [response unit], to block values of the drive (N,) [drive unit].

    Eq. 61 of `path` solved for ``Y^T`` over a record of length `span` [time unit], with `blocks` whole blocks
    for its delay. Accuracy: `block_pulse_response` to rounding.
    """
    system = _system(path, lambda order: basis.integration(order, span))
    forced = basis.shift(blocks) @ basis.integration(path.orders[0], span)
    right = path.gain * (drive @ basis.inverse) @ forced
    return np.asarray(np.linalg.solve(system.T, right) @ basis.psi)


def block_pulse_response(path: TransferPath, drive: Vector, span: float, blocks: int) -> Vector:
    """`wavelet_response` in block-pulse coordinates, where the system is triangular; any number of blocks."""
    n = drive.size
    system = _system(path, lambda order: integration_matrix(order, n, span / n).T)
    late = np.concatenate((np.zeros(min(blocks, n)), drive[: max(0, n - blocks)]))
    right = path.gain * (late @ integration_matrix(path.orders[0], n, span / n).T)
    return np.asarray(solve_triangular(system, right, trans="T"))


def _system(path: TransferPath, integration: Callable[[float], Matrix]) -> Matrix:
    top = path.orders[0]
    system = path.stiffness * integration(top)
    for eta, order in zip(path.etas, path.orders, strict=True):
        system = system + eta * integration(top - order)
    return system


class FormCost(NamedTuple):
    """What the wavelet form costs and changes against the block-pulse form (claim N1)."""

    n: int
    """Blocks [-]."""
    ratio: float
    """Cost of the wavelet form in block-pulse solves [-]; Psi and its inverse are ready and not counted."""
    difference: float
    """Largest difference of the two responses over the largest response [-]."""
    largest_overlap: float
    """Largest inner product of two different basis functions [-]."""


def form_cost(path: TransferPath, drive: float, span: float, n: int, *, repeats: int = 5) -> FormCost:
    """Both forms of the response to a step of `drive` [drive unit] at time 0 on `n` blocks, timed.

    The record lasts `span` [time unit]; the delay of the path is rounded to whole blocks.
    """
    basis, step = WaveletBasis(n), np.full(n, drive)
    late = round(path.delay * n / span)
    plain = partial(block_pulse_response, path, step, span, late)
    wavelet = partial(wavelet_response, path, step, basis, span, late)
    reference = plain()
    seconds = [min(timeit.repeat(form, number=1, repeat=repeats)) for form in (wavelet, plain)]
    difference = float(np.abs(wavelet() - reference).max() / np.abs(reference).max())
    return FormCost(n, seconds[0] / seconds[1], difference, basis.largest_overlap)
