"""The forward model: from a batch of plants to the responses of every record, with exact derivatives."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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

_CELLS = 3 << 13
"""Plants times blocks times viscous terms evaluated at once. Larger temporaries go back to the operating
system after every operation and come back as page faults: 64 plants took 1.6 times as long."""
_ABREAST = 8
"""Portions are multiples of this: transforms of so many series run in one vector register."""


@final
@dataclass(frozen=True, eq=False)
class Dynamics:
    """What shapes unit responses, for a batch of plants."""

    times: tuple[Matrix, ...]
    """Time constants [time unit] of each element, (batch, terms)."""
    orders: tuple[Matrix, ...]
    """Orders [-] of each element, (batch, terms), not increasing along a row."""
    delays: Matrix
    """Delays [time unit], (batch, delay slots)."""

    @property
    def batch(self) -> int:
        """Number of plants."""
        return int(self.delays.shape[0])

    def __getitem__(self, plants: slice) -> Dynamics:
        """Some of the plants."""
        times, orders = (tuple(each[plants] for each in part) for part in (self.times, self.orders))
        return Dynamics(times, orders, self.delays[plants])


Spectra = dict[tuple[int, int, float], Spectrum]
"""Transfer functions by element, number of blocks and block width."""


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

    def unit_responses(self, dynamics: Dynamics, spectra: Spectra | None = None) -> list[Array]:
        """Deviation from rest per unit gain, for each experiment (units, batch, samples) [drive unit].

        The response of axis i is ``offset_i + sum_j gain_ij (rest_j + unit_ij)``. Second order in the
        block width; see `operational.transfer`. `spectra` are transfer functions of these very dynamics, a
        batch of one, under other commands; those that lack are added.
        """
        shapes = [(len(self.layout.units), dynamics.batch, e.mesh.reading.samples) for e in self.experiments]
        out = [np.zeros(shape) for shape in shapes]
        for plants in self._portions(dynamics.batch):
            own = {} if spectra is None else spectra
            self._respond(dynamics[plants], [read[:, plants] for read in out], own)
        return out

    def _portions(self, batch: int) -> Iterator[slice]:
        """Slices of a batch that are small enough to be fast."""
        blocks = max(experiment.mesh.grid.n for experiment in self.experiments)
        terms = max(element.terms for element in self.layout.elements)
        size = max(_ABREAST, _CELLS // (blocks * terms) // _ABREAST * _ABREAST)
        return (slice(first, first + size) for first in range(0, batch, size))

    def _respond(self, dynamics: Dynamics, out: list[Array], spectra: Spectra) -> None:
        """Write the unit responses of a few plants into `out`."""
        known: dict[tuple[int, int, int, int], Array] = {}
        for number, (experiment, read) in enumerate(zip(self.experiments, out, strict=True)):
            grid, circle = experiment.mesh.grid, experiment.circle
            for index, (element, delay, axis) in enumerate(self.layout.units):
                drive = experiment.drives[axis]
                if not drive.moves:
                    continue
                first, first_axis, scale = self._alike[number][axis]
                same = (element, delay, first, first_axis)
                if same in known:
                    np.multiply(scale, known[same], out=read[index])
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
                if scale == 1.0:
                    known[same] = read[index]

    @cached_property
    def _alike(self) -> list[list[tuple[int, int, float]]]:
        """First experiment and axis with a proportional drive read in the same way, and the factor.

        Steps of several heights are then simulated once, not once per record.
        """
        found: list[list[tuple[int, int, float]]] = []
        seen: list[tuple[int, int]] = []
        for number, experiment in enumerate(self.experiments):
            found.append([(number, axis, 1.0) for axis in range(len(experiment.drives))])
            for axis, drive in enumerate(experiment.drives):
                for first, first_axis in seen:
                    scale = drive.over(self.experiments[first].drives[first_axis])
                    if scale is not None and experiment.mesh.reads_like(self.experiments[first].mesh):
                        found[number][axis] = (first, first_axis, scale)
                        break
                else:
                    seen.append((number, axis))
        return found

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
