r"""The integrated equation of one path, and its two errors (Ta et al. 2026, Eqs. 59-64).

``b I^a1 u(t - tau) = sum_i eta_i I^(a1 - a_i) y + k I^a1 y`` in block pulses. It is homogeneous in
(etas, k, b), so one of them is free to choose: Eq. 62 takes k as known, Eq. 65 prints the last eta as 1.
Least squares on it minimises the *equation error*. With k known, etas and b come out proportional to k
and the response does not depend on k at all: no output error distinguishes values of k. The two
normalisations give the same answer on exact data and different ones under noise, because they leave
different noisy columns on the right.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import gamma

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.model.blockpulses import integration_weights, lower_toeplitz
from lcopa_bayes.model.grid import Mesh
from lcopa_bayes.model.path import Normalisation, TransferPath
from lcopa_bayes.model.powerseries import Circle, Spectrum
from lcopa_bayes.paper.paths import Blocks, PathRecord


def columns(blocks: Blocks, orders: Sequence[float], delay: float) -> Matrix:
    """Columns that etas, k and b multiply in the equation brought to one side, (n, terms + 2)."""
    top, n, step = orders[0], blocks.grid.n, blocks.grid.step
    exponents = np.array([*(top - order for order in orders), top])
    weights = integration_weights(exponents, n, step)
    drive = blocks.drive.block_means(blocks.grid.edges, np.array([delay]))[0][0]
    matrices = [lower_toeplitz(row) for row in weights]
    columns = [matrix @ blocks.response for matrix in matrices]
    return np.stack([*columns, -matrices[-1] @ drive], axis=1)


def known_column(normalisation: Normalisation, terms: int) -> int:
    """Column whose coefficient a normalisation fixes."""
    return terms if normalisation is Normalisation.STIFFNESS else terms - 1


def least_squares(
    records: Sequence[Blocks],
    orders: Sequence[float],
    delay: float,
    *,
    normalisation: Normalisation = Normalisation.STIFFNESS,
    known: float = 1.0,
) -> TransferPath:
    """Etas and b of Eq. 63 (or etas, b and k with the last eta known) for given orders and delay.

    Parameters: orders [-] decreasing; delay [time unit]; known, the value of the fixed coefficient.
    Coefficients of any sign may come out: nothing in the equation forbids it.
    """
    stacked = np.concatenate([columns(blocks, orders, delay) for blocks in records])
    fixed = known_column(normalisation, len(orders))
    others = np.delete(np.arange(stacked.shape[1]), fixed)
    norms = np.linalg.norm(stacked, axis=0)
    scaled = stacked[:, others] / norms[others]
    solution = np.linalg.lstsq(scaled, -known * stacked[:, fixed], rcond=None)[0] / norms[others]
    values = np.insert(solution, fixed, known)
    *etas, stiffness, gain = (float(value) for value in values)
    return TransferPath(gain, delay, tuple(etas), tuple(orders), stiffness)


def equation_rmse(records: Sequence[Blocks], model: TransferPath) -> float:
    """Root mean square equation error over all blocks, per unit of left side [response unit].

    The error of each record is divided by ``sum_i |eta_i| I^(a1 - a_i) 1 + |k| I^a1 1`` at its end: what
    the left side would be for a response of 1. That makes it independent of the normalisation.
    """
    parts = []
    values = np.array([*model.etas, model.stiffness, model.gain])
    exponents = np.array([*(model.orders[0] - order for order in model.orders), model.orders[0]])
    for blocks in records:
        span = blocks.grid.n * blocks.grid.step
        scale = np.abs(values[:-1]) @ (span**exponents / gamma(exponents + 1))
        parts.append(columns(blocks, model.orders, model.delay) @ values / scale)
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def responses(
    records: Sequence[PathRecord], model: TransferPath, *, blocks: int | None = None
) -> list[Vector]:
    """Modelled response at every sample of every record [response unit]; `blocks` as in `response_to`."""
    out = []
    for each in records:
        taken = np.isfinite(each.record.response[:, 0])
        times, drive = each.record.time[taken], each.blocks.drive
        out.append(response_to(drive, model, times, blocks=blocks, exposure=each.exposure))
    return out


def response_to(
    drive: AxisDrive, model: TransferPath, times: Vector, *, blocks: int | None = None, exposure: float = 0.0
) -> Vector:
    """Modelled deviation from rest at `times` [time unit] under a drive that moves [response unit].

    On the meshes of the forward model, hence second order in a block no wider than a sampling period;
    `blocks` and `exposure` as in `Mesh.of_samples`. Coefficients may have any sign; a response that runs
    away is of the right size only.
    """
    mesh = Mesh.of_samples(times, float(drive.times[0]), blocks=blocks, exposure=exposure)
    circle = Circle(mesh.grid.n)
    top = model.orders[0]
    exponents = np.array([*(top - order for order in model.orders), top])
    spectra = differenced_integrals(exponents, circle, mesh.grid.step)
    means = drive.block_means(mesh.grid.edges, np.array([model.delay]))[0]
    quotient = model.gain * spectra[-1] / (np.array([*model.etas, model.stiffness]) @ spectra)
    read: Vector = mesh.reading(circle.coefficients(quotient * circle.spectrum(means)))[0]
    return read


def output_rmse(records: Sequence[PathRecord], model: TransferPath, *, blocks: int | None = None) -> float:
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
