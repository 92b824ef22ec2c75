r"""The integrated equation of one path, and its two errors (Ta et al. 2026, Eqs. 59-64).

``b I^a1 u(t - tau) = sum_i eta_i I^(a1 - a_i) y + k I^a1 y`` in block pulses. It is homogeneous in
(etas, k, b), so one of them is a convention: Eq. 62 takes k as known, Eq. 65 prints the last eta as 1.
Least squares on it minimises the *equation error*. With k known, etas and b come out proportional to k
and the response does not depend on k at all: no output error distinguishes values of k. The two
conventions give the same answer on exact data and different ones under noise, because they leave
different noisy columns on the right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import final

import numpy as np
from scipy.special import gamma

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.model.blockpulses import integration_weights, lower_toeplitz
from lcopa_bayes.model.element import PaperForm
from lcopa_bayes.model.grid import Mesh
from lcopa_bayes.model.powerseries import Circle, Spectrum
from lcopa_bayes.paper.paths import Blocks, PathRecord


class Convention(Enum):
    """Which coefficient of the equation is fixed before the least squares."""

    STIFFNESS = "k given"
    """k, as in Eq. 62."""
    LAST_ETA = "last eta = 1"
    """The viscosity of the lowest order, as in Eq. 65."""


@final
@dataclass(frozen=True)
class PathModel:
    """Coefficients of one path, of any sign, with its delay."""

    form: PaperForm
    delay: float
    """tau [time unit]."""

    @property
    def physical(self) -> bool:
        """Whether viscosities and stiffness are positive, as springs and dashpots are."""
        return all(value > 0 for value in (*self.form.etas, self.form.stiffness))

    @property
    def steady(self) -> float:
        """Response at rest under a unit drive [response unit per drive unit]."""
        return self.form.gain / self.form.stiffness

    def scaled(self, convention: Convention, stiffness: float) -> PaperForm:
        """The same path with the given k, or with the last eta 1."""
        form = self.form
        divisor = form.stiffness / stiffness if convention is Convention.STIFFNESS else form.etas[-1]
        etas = tuple(eta / divisor for eta in form.etas)
        return PaperForm(form.gain / divisor, etas, form.orders, form.stiffness / divisor)


def columns(blocks: Blocks, orders: Sequence[float], delay: float) -> Matrix:
    """Columns that etas, k and b multiply in the equation brought to one side, (n, terms + 2)."""
    top, n, step = orders[0], blocks.grid.n, blocks.grid.step
    exponents = np.array([*(top - order for order in orders), top])
    weights = integration_weights(exponents, n, step)
    drive = blocks.drive.block_means(blocks.grid.edges, np.array([delay]))[0][0]
    matrices = [lower_toeplitz(row) for row in weights]
    columns = [matrix @ blocks.response for matrix in matrices]
    return np.stack([*columns, -matrices[-1] @ drive], axis=1)


def known_column(convention: Convention, terms: int) -> int:
    """Column whose coefficient a convention fixes."""
    return terms if convention is Convention.STIFFNESS else terms - 1


def least_squares(
    records: Sequence[Blocks],
    orders: Sequence[float],
    delay: float,
    *,
    convention: Convention = Convention.STIFFNESS,
    known: float = 1.0,
) -> PathModel:
    """Etas and b of Eq. 63 (or etas, b and k with the last eta known) for given orders and delay.

    Parameters: orders [-] decreasing; delay [time unit]; known, the value of the fixed coefficient.
    Coefficients of any sign may come out: nothing in the equation forbids it.
    """
    stacked = np.concatenate([columns(blocks, orders, delay) for blocks in records])
    fixed = known_column(convention, len(orders))
    others = np.delete(np.arange(stacked.shape[1]), fixed)
    norms = np.linalg.norm(stacked, axis=0)
    scaled = stacked[:, others] / norms[others]
    solution = np.linalg.lstsq(scaled, -known * stacked[:, fixed], rcond=None)[0] / norms[others]
    values = np.insert(solution, fixed, known)
    *etas, stiffness, gain = (float(value) for value in values)
    return PathModel(PaperForm(gain, tuple(etas), tuple(orders), stiffness), delay)


def equation_rmse(records: Sequence[Blocks], model: PathModel) -> float:
    """Root mean square equation error over all blocks, per unit of left side [response unit].

    The error of each record is divided by ``sum_i |eta_i| I^(a1 - a_i) 1 + |k| I^a1 1`` at its end: what
    the left side would be for a response of 1. That makes it independent of the convention.
    """
    form, parts = model.form, []
    values = np.array([*form.etas, form.stiffness, form.gain])
    exponents = np.array([*(form.orders[0] - order for order in form.orders), form.orders[0]])
    for blocks in records:
        span = blocks.grid.n * blocks.grid.step
        scale = np.abs(values[:-1]) @ (span**exponents / gamma(exponents + 1))
        parts.append(columns(blocks, form.orders, model.delay) @ values / scale)
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def responses(records: Sequence[PathRecord], model: PathModel, *, blocks: int | None = None) -> list[Vector]:
    """Modelled response at every sample of every record [response unit]; `blocks` as in `response_to`."""
    out = []
    for each in records:
        taken = np.isfinite(each.record.response[:, 0])
        times, drive = each.record.time[taken], each.blocks.drive
        out.append(response_to(drive, model, times, blocks=blocks, exposure=each.exposure))
    return out


def response_to(
    drive: AxisDrive, model: PathModel, times: Vector, *, blocks: int | None = None, exposure: float = 0.0
) -> Vector:
    """Modelled deviation from rest at `times` [time unit] under a drive that moves [response unit].

    On the meshes of the forward model, hence second order in a block no wider than a sampling period;
    `blocks` and `exposure` as in `Mesh.of_samples`. Coefficients may have any sign; a response that runs
    away is of the right size only.
    """
    mesh = Mesh.of_samples(times, float(drive.times[0]), blocks=blocks, exposure=exposure)
    circle = Circle(mesh.grid.n)
    form, top = model.form, model.form.orders[0]
    exponents = np.array([*(top - order for order in form.orders), top])
    spectra = differenced_integrals(exponents, circle, mesh.grid.step)
    means = drive.block_means(mesh.grid.edges, np.array([model.delay]))[0]
    quotient = form.gain * spectra[-1] / (np.array([*form.etas, form.stiffness]) @ spectra)
    read: Vector = mesh.reading(circle.coefficients(quotient * circle.spectrum(means)))[0]
    return read


def output_rmse(records: Sequence[PathRecord], model: PathModel, *, blocks: int | None = None) -> float:
    """Root mean square of response minus model over all samples (Eq. 64) [response unit]."""
    parts: list[Array] = []
    for each, modelled in zip(records, responses(records, model, blocks=blocks), strict=True):
        values = each.record.response[:, 0]
        parts.append(values[np.isfinite(values)] - modelled)
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def differenced_integrals(exponents: Vector, circle: Circle, step: float) -> Spectrum:
    """``1 - z`` times the integrals of these orders on the circle, (exponents, points).

    Numerators and denominators have the same factor; without it weights of orders above 1 grow.
    """
    weights = integration_weights(exponents, circle.n, step)
    weights[:, 1:] -= weights[:, :-1].copy()
    return circle.spectrum(weights)
