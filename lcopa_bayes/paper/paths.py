r"""The records from which one path is identified: one drive moves, deviations from rest, block pulses.

The integrated equation of one path, and its two errors (Ta et al. 2026, Eqs. 59-64).

``b I^a1 u(t - tau) = sum_i eta_i I^(a1 - a_i) y + k I^a1 y`` in block pulses. It is homogeneous in
(etas, k, b), so one of them is free to choose: Eq. 62 takes k as known, Eq. 65 prints the last eta as 1.
Least squares on it minimises the *equation error*. With k known, etas and b come out proportional to k
and the response does not depend on k at all: no output error distinguishes values of k. The two
normalisations give the same answer on exact data and different ones under noise, because they leave
different noisy columns on the right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.special import gamma

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.core.errors import refuse_if
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.data.record import Record
from lcopa_bayes.data.study import Study
from lcopa_bayes.model.blockpulses import Circle, Spectrum, integration_weights, lower_toeplitz
from lcopa_bayes.model.grid import Grid, Mesh
from lcopa_bayes.model.layout import Layout
from lcopa_bayes.model.path import Normalisation, TransferPath

MOST_BLOCKS = 1024
"""A record with more samples is identified on this many block means: the algebra is quadratic in them."""
_EVEN = 1e-4
"""Largest deviation from equidistance that still counts as equidistant, in sampling periods."""
_RESTING = 5
"""So many samples before the first change of the drive give a resting level of their own."""
_AT_MOST = 0.1
"""Largest share of a record's samples whose mean is taken for its resting level [-]."""
_DEPARTED = 3.5
"""A sample this many noise sd from the mean of those before it is no longer at the resting level."""


@final
@dataclass(frozen=True, eq=False)
class Blocks:
    """One path of one record as block pulses (Ta et al. 2026, Eqs. 43-46), deviations from rest."""

    grid: Grid
    """Blocks of one sampling period, samples at their midpoints, where the samples allow it."""
    drive: AxisDrive
    response: Vector
    """Block means, (n,) [response unit]."""

    @classmethod
    def of(cls, record: Record, exposure: float = 0.0) -> Blocks:
        """From a record of one drive and one response, both deviations from rest.

        A sample is the value at the middle of its `exposure` [time unit].

        Equidistant samples are taken as the means of blocks around them. Others, or more than
        `MOST_BLOCKS`, give the exact block means of straight lines between samples.
        """
        taken = np.isfinite(record.response[:, 0])
        times, values = record.time[taken] - exposure / 2, record.response[taken, 0]
        drive = AxisDrive.of_rows(record.time, record.drive[:, 0])
        begin = float(drive.times[0])
        after = times > begin
        knots = np.concatenate(([begin], times[after]))
        heights = np.concatenate(([0.0], values[after]))
        if times.size > 1:  # else there is no period
            period = float(times[-1] - times[0]) / (times.size - 1)
            even = np.abs(np.diff(times) - period).max() < _EVEN * period
            back = int(np.ceil((times[-1] - begin) / period - 0.5 + 1e-9))
            if even and back < MOST_BLOCKS:
                grid = Grid(float(times[-1]) - (back + 0.5) * period, period, back + 1)
                middles = grid.start + grid.step * (np.arange(grid.n) + 0.5)
                return cls(grid, drive, np.interp(middles, knots, heights))
        n = min(MOST_BLOCKS, knots.size)
        grid = Grid(begin, float(times[-1] - begin) / n, n)
        return cls(grid, drive, _means(grid, knots, heights))


def _means(grid: Grid, knots: Vector, heights: Vector) -> Vector:
    """Block means of the straight lines through the knots, exact."""
    edges = np.clip(grid.edges, knots[0], knots[-1])  # rounding may put the last edge beyond the last sample
    areas = make_interp_spline(knots, heights, k=1).antiderivative()(edges)
    return np.asarray(np.diff(areas) / grid.step)


@final
@dataclass(frozen=True, eq=False)
class PathRecord:
    """Data of one record for one path."""

    record: Record
    """One drive, less its resting value; one response, less its resting level."""
    level: float
    """Resting level that was subtracted [response unit]."""
    level_from: str
    """The samples it is the mean of."""
    exposure: float
    """Time over which a sample is a mean [time unit]."""
    blocks: Blocks


@final
@dataclass(frozen=True, eq=False)
class PathData:
    """The records of a study from which one path is identified."""

    response: int
    drive: int
    name: str
    """``<response>_<drive>``."""
    response_unit: str
    drive_unit: str
    terms: int
    """Viscous terms [-]; of fixed orders that are equal, one."""
    records: tuple[PathRecord, ...]

    @property
    def blocks(self) -> list[Blocks]:
        """Those of every record."""
        return [each.blocks for each in self.records]

    @property
    def span(self) -> float:
        """Shortest time from a record's first drive change to its end [time unit]."""
        return min(float(each.blocks.grid.edges[-1] - each.blocks.drive.times[0]) for each in self.records)


def path_data(study: Study) -> tuple[PathData, ...]:
    """Every path of a study, row by row; each from the fit records where its drive alone moves.

    InputError, for all paths together, when no record moves a drive alone, and when samples are
    fewer than a path's unknowns or do not move.
    """
    layout = Layout.of(study.drive_axes, study.response_axes, study.model)
    fixed = len(set(study.model.orders)) if study.model.orders != "free" else 0
    problems: list[str] = []
    alone = [[r for r in study.fit if _moving(r) == [j]] for j in range(len(layout.drives))]
    for j, axis in enumerate(layout.drives):
        if alone[j]:
            continue
        together = ", ".join(repr(r.name) for r in study.fit if j in _moving(r))
        problems.append(
            f"no fit record moves drive {axis.name!r} alone"
            + (f"; in {together} several drives move at once, which mixes paths" if together else "")
            + "; add a record with a step of this drive only"
        )
    paths = []
    for i, response in enumerate(layout.responses):
        for j, drive in enumerate(layout.drives):
            name = f"{response.name}_{drive.name}"
            terms = fixed or layout.elements[layout.element_of[i][j]].terms
            usable = [r for r in alone[j] if _samples_after(r, i, j) > 0]
            unknowns = 2 * terms + 2
            count = sum(_samples_after(r, i, j) for r in usable)
            if alone[j] and count <= unknowns:
                problems.append(
                    f"path {name}: {count} response samples after the drive moves cannot determine "
                    f"{unknowns} unknowns; add samples or choose fewer terms under [model]"
                )
            elif alone[j]:
                records = tuple(_path_record(r, i, j, study.exposure) for r in usable)
                if not any(np.any(each.blocks.response) for each in records):
                    problems.append(f"path {name}: the response never moves; leave its column out")
                paths.append(PathData(i, j, name, response.unit, drive.unit, terms, records))
    refuse_if(problems)
    return tuple(paths)


def _moving(record: Record) -> list[int]:
    return [int(j) for j in np.flatnonzero((record.drive != record.drive[0]).any(axis=0))]


def _begin(record: Record, drive: int) -> float:
    return float(AxisDrive.of_rows(record.time, record.drive[:, drive]).times[0])


def _samples_after(record: Record, response: int, drive: int) -> int:
    later = record.time > _begin(record, drive)
    return int(np.isfinite(record.response[later, response]).sum())


def _path_record(record: Record, response: int, drive: int, exposure: float) -> PathRecord:
    taken = np.isfinite(record.response[:, response])
    level, level_from = resting_level(
        record.time[taken], record.response[taken, response], _begin(record, drive)
    )
    column = record.drive[:, [drive]]
    single = Record(
        name=record.name,
        time=record.time,
        drive=column - column[0],
        response=record.response[:, [response]] - level,
        drive_axes=(record.drive_axes[drive],),
        response_axes=(record.response_axes[response],),
        time_unit=record.time_unit,
    )
    return PathRecord(single, level, level_from, exposure, Blocks.of(single, exposure))


def resting_level(times: Vector, values: Vector, begin: float) -> tuple[float, str]:
    """Mean of the samples up to the first drive change, or of the first samples that do not leave it.

    Parameters: times [time unit] and values [response unit] of the samples; begin [time unit], the change.
    Returns: the level [response unit] and a description of the samples it is the mean of.
    """
    before = int(np.searchsorted(times, begin, side="right"))
    if before >= _RESTING:
        return float(values[:before].mean()), f"the {before} samples before the drive moves"
    count = _unmoved(values, max(1, before))
    first = f"the first {count} samples, which do not leave their mean" if count > 1 else "the first sample"
    return float(values[:count].mean()), first


def _unmoved(values: Array, least: int) -> int:
    """How many first samples stay within the noise of the mean of those before them, at least `least`."""
    bends = np.abs(np.diff(values, 2))  # of white noise, sqrt(6) sd; of a smooth response, nearly nothing
    sd = float(np.median(bends)) / (0.6745 * np.sqrt(6.0)) if bends.size else 0.0
    most = max(least, int(_AT_MOST * values.size))
    for count in range(least, most):
        mean = float(values[:count].mean())
        if abs(float(values[count]) - mean) > _DEPARTED * sd * np.sqrt(1 + 1 / count):
            return count
    return most


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


def output_rmse(records: Sequence[PathRecord], model: TransferPath) -> float:
    """Root mean square of response minus model over all samples (Eq. 64) [response unit]."""
    parts: list[Array] = []
    for each, modelled in zip(records, responses(records, model), strict=True):
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
