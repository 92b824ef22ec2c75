r"""Claims N1 and N2: what wavelets add to block pulses, and what whole-block delays cost.

Legendre wavelets and their operational matrices, dense and as printed (Ta et al. 2026, Eqs. 32-61).

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
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import NamedTuple, final

import numpy as np
from scipy.linalg import solve_triangular

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.data.record import Axis
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.model.blockpulses import integration_matrix
from lcopa_bayes.model.forward import Dynamics, Experiment, ForwardModel
from lcopa_bayes.model.grid import Mesh
from lcopa_bayes.model.layout import Layout
from lcopa_bayes.model.literature import PAPER, Stated
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.paper.modelclaims import RECORD_LENGTH
from lcopa_bayes.paper.verdict import Evidence, Kind, Verdict


@final
@dataclass(frozen=True)
class WaveletBasis:
    """The constant and the wavelets of Eq. 37 with m = 1 on levels 1..K, N = 2^K functions in all."""

    n: int
    """N [-]."""

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


@final
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


SAME_ANSWER = 1e-9
"""Relative difference of two responses below which they are the same answer [-]; rounding gives 1e-14."""
WAVELET_BLOCKS = 256
"""The power of two next to the 250 samples of a record [-]."""
TOLERATED_SHIFT = 0.25
"""Bias that is let pass [sd]: a 90 % interval displaced by it still covers 89 %."""
_FINE = 4000
"""Blocks of the response itself, so many that only the rounding of the delay shows [-]."""


def wavelets(stated: Stated, evidence: Evidence) -> Verdict:
    """N1: the same response in wavelet and in block-pulse coordinates, and the time each takes.

    Wavelets are better if they change the answer, simpler if they cost less.
    """
    cost = wavelet_cost(stated)
    better, cheaper = cost.difference > SAME_ANSWER, cost.ratio < 1
    how = (
        f"At N = {cost.n} both forms of Eq. 61 give one response to {cost.difference:.0e} of it, for "
        "P = Psi F inverse(Psi) is a change of coordinates; the wavelet form "
        f"{'costs less' if cheaper else 'costs more'} because its matrices are "
        f"{'not full' if cheaper else 'full where those of block pulses are triangular'}. The printed "
        f"wavelets are not orthogonal either: inner products up to {cost.largest_overlap:.2f}. Number: "
        "relative difference of the responses."
    )
    return Verdict(Kind.of(better or cheaper), cost.difference, "-", how)


@lru_cache(maxsize=4)
def wavelet_cost(stated: Stated) -> FormCost:
    """Both forms of the response of the direct path to the step of Fig. 13."""
    return form_cost(stated.plant.xx, stated.records.step_drive, RECORD_LENGTH, WAVELET_BLOCKS)


def whole_blocks(stated: Stated, evidence: Evidence) -> Verdict:
    """N2: bias of the other parameters when the delay is a whole number of camera periods.

    For the delay that fits worst, half a period off, and for the printed one.
    """
    printed, worst = delay_costs(stated)
    coarse = stated.plant.xx.delay * WAVELET_BLOCKS / RECORD_LENGTH
    how = (
        f"With the delay held half a camera period off, the other parameters move by up to "
        f"{worst.largest_shift:.2f} sd (tolerated {TOLERATED_SHIFT:g} sd) and, held too, the fit loses "
        f"{worst.loss:.0f} nat of log likelihood; the printed {printed.delay:g} ms against "
        f"{printed.rounded:g} ms: {printed.largest_shift:.2f} sd, {printed.loss:.0f} nat. The printed delay "
        f"is {coarse:.3f} blocks of {RECORD_LENGTH:g}/{WAVELET_BLOCKS} ms, so it looks quantised itself."
    )
    return Verdict(Kind.of(worst.largest_shift <= TOLERATED_SHIFT), worst.largest_shift, "sd", how)


@final
@dataclass(frozen=True)
class DelayRounding:
    """Effect of rounding one delay to whole blocks on one record."""

    delay: float
    """[time unit]."""
    rounded: float
    """Nearest whole number of blocks [time unit]."""
    loss: float
    """Expected loss of log likelihood, other parameters unchanged [nat]."""
    shifts: Mapping[str, float]
    """How far a fit with the rounded delay moves each other parameter [sd with the delay fixed]."""

    @property
    def largest_shift(self) -> float:
        """Largest absolute shift [sd with the delay fixed]."""
        return max(map(abs, self.shifts.values()))


@lru_cache(maxsize=4)
def delay_costs(stated: Stated = PAPER) -> tuple[DelayRounding, DelayRounding]:
    """Rounding the printed delay to camera periods, and the worst delay next to it."""
    path, records = stated.plant.xx, stated.records
    period = 1 / records.camera_rate
    times = np.asarray(period * np.arange(1, round(RECORD_LENGTH / period) + 1), dtype=float)
    printed, off = (
        delay_rounding(replace(path, delay=delay), times, records.step_drive, records.fractional_rmse)
        for delay in (path.delay, (round(path.delay / period) + 0.5) * period)
    )
    return printed, off


def delay_rounding(path: TransferPath, times: Vector, drive: float, noise_sd: float) -> DelayRounding:
    r"""Rounding the delay of `path` to the period of the samples of a step record (Ta et al. 2026, Eq. 51).

    With J the Jacobian of the response in the other parameters, a fit whose delay is held at the rounded
    value moves them by :math:`J^+ (y_\tau - y_{round})` to first order, without priors.

    Parameters: equidistant times (n,) [time unit] after the step; `drive`, its height [drive unit]; noise_sd
    [response unit], positive.
    """
    rounded = float(times[0]) * round(path.delay / float(times[0]))
    curve, jacobian = _response(path, times, drive)
    change = (_response(replace(path, delay=rounded), times, drive)[0] - curve) / noise_sd
    scaled = jacobian / noise_sd
    moved, *_ = np.linalg.lstsq(scaled, -change, rcond=None)
    norms = np.linalg.norm(scaled, axis=0)
    factor = np.linalg.qr(scaled / norms, mode="r")
    sd = np.linalg.norm(np.linalg.inv(factor), axis=1) / norms
    names = ["gain", *(f"{kind}_{k + 1}" for kind in ("time", "order") for k in range(len(path.orders)))]
    shifts = dict(zip(names, (moved / sd).tolist(), strict=True))
    return DelayRounding(path.delay, rounded, 0.5 * float(change @ change), shifts)


def _response(path: TransferPath, times: Vector, drive: float) -> tuple[Vector, Matrix]:
    """Response at `times` to a step at 0, and its Jacobian in the gain, log times and orders."""
    axis = Axis("x", "rad")
    layout = Layout.of([axis], [axis], ModelSettings(terms=len(path.orders)))
    mesh = Mesh.of_samples(times, 0.0, blocks=_FINE)
    experiment = Experiment("step", mesh, (AxisDrive(np.zeros(1), np.array([drive])),), np.zeros(1))
    shape = (np.array([path.times]),), (np.array([path.orders]),), np.array([[path.delay]])
    unit, slopes = ForwardModel(layout, (experiment,)).unit_slopes(Dynamics(*shape))[0]
    return path.steady * unit[0, 0], np.concatenate([unit[0], path.steady * slopes[0][:-1, 0]]).T
