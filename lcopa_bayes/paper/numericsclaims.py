"""Claims N1 and N2: what wavelets add to block pulses, and what whole-block delays cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.data.record import Axis
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.model.forward import Dynamics, Experiment, ForwardModel
from lcopa_bayes.model.grid import Mesh
from lcopa_bayes.model.layout import Layout
from lcopa_bayes.model.literature import PAPER, Stated
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.model.wavelets import FormCost, form_cost
from lcopa_bayes.paper.printedmodel import RECORD_LENGTH
from lcopa_bayes.paper.verdict import Evidence, Kind, Verdict

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
def wavelet_cost(stated: Stated = PAPER, blocks: int = WAVELET_BLOCKS) -> FormCost:
    """Both forms of the response of the direct path to the step of Fig. 13."""
    return form_cost(stated.plant.xx, stated.records.step_drive, RECORD_LENGTH, blocks)


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
