"""The forward model: from a batch of plants to the responses of every record, with exact derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.arrays import Array, Matrix, Vector
from lcopa_bayes.operational.series import Circle, Spectrum
from lcopa_bayes.operational.transfer import TransferSlopes, transfer, transfer_slopes
from lcopa_bayes.plant.drive import Drive
from lcopa_bayes.plant.grid import Mesh
from lcopa_bayes.plant.layout import Layout
from lcopa_bayes.record import Record


@final
@dataclass(frozen=True, eq=False)
class Dynamics:
    """What shapes unit responses, for a batch of plants."""

    times: tuple[Matrix, ...]
    """Time constants [time unit] of each element, (batch, terms)."""
    orders: tuple[Matrix, ...]
    """Orders [-] of each element, (batch, terms), decreasing along a row."""
    delays: Matrix
    """Delays [time unit], (batch, delay slots)."""

    @property
    def batch(self) -> int:
        """Number of plants."""
        return int(self.delays.shape[0])


@final
@dataclass(frozen=True, eq=False)
class Experiment:
    """A record prepared for simulation: all that does not depend on parameters."""

    name: str
    mesh: Mesh
    drives: tuple[Drive, ...]
    rest: Vector
    """Drive before the first change, one per drive axis [drive unit]."""

    @classmethod
    def of(
        cls, record: Record, times: Vector, *, blocks: int | None = None, exposure: float = 0.0
    ) -> Experiment:
        """For reading `record` at `times` [time unit]; see `Mesh.of_samples` for the options."""
        drives = tuple(Drive.of_rows(record.time, column) for column in record.drive.T)
        begin = min((drive.times[0] for drive in drives if drive.moves), default=times[0])
        mesh = Mesh.of_samples(times, float(begin), blocks=blocks, exposure=exposure)
        return cls(record.name, mesh, drives, record.drive[0])

    @cached_property
    def circle(self) -> Circle:
        """Where this record's series are evaluated."""
        return Circle(self.mesh.grid.n)

    @cached_property
    def edges(self) -> Vector:
        """Block edges [time unit]."""
        return self.mesh.grid.edges


@final
@dataclass(frozen=True, eq=False)
class ForwardModel:
    """Unit responses of every experiment: the operational matrices as a function of the dynamics."""

    layout: Layout
    experiments: tuple[Experiment, ...]

    def unit_responses(self, dynamics: Dynamics) -> list[Array]:
        """Deviation from rest per unit gain, for each experiment (units, batch, samples) [drive unit].

        The response of axis i is ``offset_i + sum_j gain_ij (rest_j + unit_ij)``. Second order in the
        block width; see `operational.transfer`.
        """
        spectra: dict[tuple[int, int, float], Spectrum] = {}
        out = []
        for experiment in self.experiments:
            grid, circle = experiment.mesh.grid, experiment.circle
            read = np.zeros((len(self.layout.units), dynamics.batch, experiment.mesh.reading.samples))
            for index, (element, delay, axis) in enumerate(self.layout.units):
                drive = experiment.drives[axis]
                if not drive.moves:
                    continue
                key = (element, grid.n, grid.step)
                if key not in spectra:
                    spectra[key] = transfer(
                        dynamics.times[element], dynamics.orders[element], circle, grid.step
                    )
                means, _ = drive.block_means(experiment.edges, dynamics.delays[:, delay])
                read[index] = experiment.mesh.reading(
                    circle.coefficients(spectra[key] * circle.spectrum(means))
                )
            out.append(read)
        return out

    def unit_slopes(self, dynamics: Dynamics) -> list[tuple[Array, list[Array]]]:
        """`unit_responses` with exact derivatives, per experiment.

        The second entry holds one array per unit, (2 terms + 1, batch, samples): derivatives in the
        logarithms of the time constants, the orders, and the delay [per time unit].
        """
        spectra: dict[tuple[int, int, float], tuple[Spectrum, TransferSlopes]] = {}
        out = []
        for experiment in self.experiments:
            grid, circle = experiment.mesh.grid, experiment.circle
            samples = experiment.mesh.reading.samples
            read = np.zeros((len(self.layout.units), dynamics.batch, samples))
            slopes = []
            for index, (element, delay, axis) in enumerate(self.layout.units):
                drive = experiment.drives[axis]
                terms = dynamics.times[element].shape[1]
                slopes.append(np.zeros((2 * terms + 1, dynamics.batch, samples)))
                if not drive.moves:
                    continue
                key = (element, grid.n, grid.step)
                if key not in spectra:
                    spectra[key] = transfer_slopes(
                        dynamics.times[element], dynamics.orders[element], circle, grid.step
                    )
                value, parts = spectra[key]
                means, by_delay = drive.block_means(experiment.edges, dynamics.delays[:, delay])
                drive_spectrum = circle.spectrum(means)
                products = [
                    *(part * drive_spectrum for part in (value, *parts.log_times, *parts.orders)),
                    value * circle.spectrum(by_delay),
                ]
                rows = [experiment.mesh.reading(circle.coefficients(product)) for product in products]
                read[index] = rows[0]
                slopes[index][:] = rows[1:]
            out.append((read, slopes))
        return out


def forward_model(
    layout: Layout,
    records: Sequence[Record],
    times: Sequence[Vector],
    *,
    blocks: int | None = None,
    exposure: float = 0.0,
) -> ForwardModel:
    """Forward model of `records`, each read at its own `times` [time unit]."""
    experiments = (
        Experiment.of(record, at, blocks=blocks, exposure=exposure)
        for record, at in zip(records, times, strict=True)
    )
    return ForwardModel(layout, tuple(experiments))
