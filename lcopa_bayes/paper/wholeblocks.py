r"""What a delay in whole blocks costs (Ta et al. 2026, Eq. 51; claim N2): numbers, no verdict.

The response of a path to a step is compared under its delay and under that delay rounded to whole
blocks, everything else exact. With J the Jacobian of the response in the other parameters, a fit whose
delay is held at the rounded value moves them by :math:`J^+ (y_\tau - y_{round})` to first order. The
linearisation is that of the noise-free record, without priors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.data.record import Axis
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.model.forward import Dynamics, Experiment, ForwardModel
from lcopa_bayes.model.grid import Mesh
from lcopa_bayes.model.layout import Layout
from lcopa_bayes.model.literature import PAPER
from lcopa_bayes.model.path import TransferPath

_FINE = 4000
"""Blocks of the response itself, so many that only the rounding of the delay shows [-]."""


@final
@dataclass(frozen=True)
class ParameterShift:
    """How far the rounded delay pulls another parameter."""

    name: str
    shift: float
    """First-order shift of the fit [unit of the parameter; a time constant by its logarithm]."""
    in_sd: float
    """The same over the parameter's linearised sd when the delay is held fixed [-]."""
    in_free_sd: float
    """The same over its linearised sd when the delay is free too [-]."""


@final
@dataclass(frozen=True)
class DelayRounding:
    """Effect of rounding one delay to whole blocks on one record."""

    blocks: int
    """Blocks the delay is counted in [-]."""
    delay: float
    """[time unit]."""
    rounded: float
    """Nearest whole number of blocks [time unit]."""
    largest: float
    """Largest change of the response [noise sd]."""
    rms: float
    """Root mean square change of the response over the samples [noise sd]."""
    loss: float
    """Expected loss of log likelihood, other parameters unchanged [nat]."""
    next_loss: float
    """The same at the second nearest whole number: the likelihood is a staircase between the two [nat]."""
    refitted_loss: float
    """Loss that remains after the other parameters have moved [nat]."""
    shifts: tuple[ParameterShift, ...]

    @property
    def largest_shift(self) -> float:
        """Largest absolute shift [sd with the delay fixed]."""
        return max(abs(shift.in_sd) for shift in self.shifts)


def delay_rounding(
    path: TransferPath = PAPER.plant.xx,
    *,
    blocks: int,
    delay: float | None = None,
    drive: float = PAPER.records.step_drive,
    span: float = 25.0,
    period: float = 1 / PAPER.records.camera_rate,
    noise_sd: float = PAPER.records.fractional_rmse,
) -> DelayRounding:
    """Rounding the delay of `path` on a step record.

    Parameters: blocks over `span` [time unit]; delay [time unit], the path's when None; step of `drive`
    [drive unit] at time 0; samples every `period` [time unit] up to `span`; noise_sd [response unit].
    InputError unless blocks, span, period and noise_sd are positive and the delay lies inside the record.
    """
    delay = path.delay if delay is None else delay
    if not (blocks >= 1 and span > period > 0 and noise_sd > 0 and 0 <= delay < span):
        raise InputError(
            "delay rounding needs blocks >= 1, span > period > 0, noise_sd > 0 and 0 <= delay < span; got "
            f"{blocks}, {span}, {period}, {noise_sd} and {delay}"
        )
    block = span / blocks
    nearest = round(delay / block)
    second = nearest + 1 if delay / block > nearest or nearest == 0 else nearest - 1
    times = np.asarray(period * np.arange(1, round(span / period) + 1), dtype=float)
    curve, jacobian = _response(path, times, drive, delay)
    others = [_response(path, times, drive, block * count)[0] - curve for count in (nearest, second)]
    change, further = (other / noise_sd for other in others)
    scaled = jacobian / noise_sd
    free, fixed = scaled, scaled[:, :-1]
    moved, *_ = np.linalg.lstsq(fixed, -change, rcond=None)
    sd, free_sd = _sd(fixed), _sd(free)[:-1]
    names = _names(len(path.orders))
    residual = change + fixed @ moved
    return DelayRounding(
        blocks,
        delay,
        block * nearest,
        float(np.abs(change).max()),
        float(np.sqrt(np.mean(change**2))),
        0.5 * float(change @ change),
        0.5 * float(further @ further),
        0.5 * float(residual @ residual),
        tuple(
            ParameterShift(name, float(by), float(by / s), float(by / f))
            for name, by, s, f in zip(names, moved, sd, free_sd, strict=True)
        ),
    )


def delay_roundings(sizes: Sequence[int] = (64, 128, 250, 256, 512)) -> tuple[DelayRounding, ...]:
    """`delay_rounding` of the paper's direct path for several numbers of blocks."""
    return tuple(delay_rounding(blocks=blocks) for blocks in sizes)


def _names(terms: int) -> list[str]:
    pairs = [f"{kind}_{k + 1}" for kind in ("time", "order") for k in range(terms)]
    return ["gain", *pairs]


def _sd(jacobian: Matrix) -> Vector:
    """Linearised sd of each parameter from a whitened Jacobian, by its triangular factor."""
    scale = np.linalg.norm(jacobian, axis=0)
    factor = np.linalg.qr(jacobian / scale, mode="r")
    return np.asarray(np.linalg.norm(np.linalg.inv(factor), axis=1) / scale)


def _response(path: TransferPath, times: Vector, drive: float, delay: float) -> tuple[Vector, Matrix]:
    """Response at `times` and its Jacobian in the gain, log times, orders and delay."""
    axis = Axis("x", "rad")
    layout = Layout.of([axis], [axis], ModelSettings(terms=len(path.orders)))
    mesh = Mesh.of_samples(times, 0.0, blocks=_FINE)
    experiment = Experiment("step", mesh, (AxisDrive(np.zeros(1), np.array([drive])),), np.zeros(1))
    dynamics = Dynamics((np.array([path.times]),), (np.array([path.orders]),), np.array([[delay]]))
    unit, slopes = ForwardModel(layout, (experiment,)).unit_slopes(dynamics)[0]
    return path.steady * unit[0, 0], np.concatenate([unit[0], path.steady * slopes[0][:, 0]]).T
