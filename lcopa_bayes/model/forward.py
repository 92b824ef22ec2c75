"""The forward model: from a batch of plants to the responses of every record, with exact derivatives."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, final

import numpy as np

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector
from lcopa_bayes.data.drive import AxisDrive, axis_drives
from lcopa_bayes.data.record import Driven
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.model.blockpulses import Circle
from lcopa_bayes.model.grid import Mesh
from lcopa_bayes.model.layout import Layout, Unit
from lcopa_bayes.model.stepresponse import Slopes, StepResponse, step_response
from lcopa_bayes.model.superposition import Changes, Phase, Superposition, blocks_of, phases

if TYPE_CHECKING:
    from lcopa_bayes.model.effects.declared import Declared

_CELLS = 3 << 15
"""Plants times blocks times viscous terms evaluated at once: fastest where `core.parallel.keep_freed_memory`
has been called. Elsewhere larger temporaries come back as page faults after every operation, and a quarter of
it were better."""
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

    def later(self, by: Array) -> Dynamics:
        """With all delays longer by a time, (batch,) [time unit]."""
        return Dynamics(self.times, self.orders, self.delays + by[:, None])

    def __getitem__(self, plants: slice | Index) -> Dynamics:
        """Some of the plants."""
        times, orders = (tuple(each[plants] for each in part) for part in (self.times, self.orders))
        return Dynamics(times, orders, self.delays[plants])


def joined(parts: Sequence[Dynamics]) -> Dynamics:
    """All plants of several batches with the same elements."""
    times, orders = (
        tuple(np.concatenate(each) for each in zip(*side, strict=True))
        for side in ([part.times for part in parts], [part.orders for part in parts])
    )
    return Dynamics(times, orders, np.concatenate([part.delays for part in parts]))


StepResponses = dict[tuple[int, float], StepResponse]
"""Step responses by element and block width."""


@final
@dataclass(frozen=True, eq=False)
class Experiment:
    """A record prepared for simulation: all that does not depend on parameters."""

    name: str
    mesh: Mesh
    drives: tuple[AxisDrive, ...]
    rest: Vector
    """Drive before the first change, one per drive axis [drive unit]."""

    @classmethod
    def of(
        cls,
        record: Driven,
        times: Vector,
        *,
        blocks: int | None = None,
        exposure: float = 0.0,
        refinement: int = 1,
        widest: float = np.inf,
    ) -> Experiment:
        """For reading `record` at `times` [time unit]; see `Mesh.of_samples` for the options."""
        drives = axis_drives(record)
        begin = min((drive.times[0] for drive in drives if drive.moves), default=times[0])
        mesh = Mesh.of_samples(
            times, float(begin), blocks=blocks, exposure=exposure, refinement=refinement, widest=widest
        )
        aligned = tuple(AxisDrive(mesh.lattice.aligned(drive.times), drive.values) for drive in drives)
        return cls(record.name, mesh, aligned, record.drive[0])

    def driven_by(self, drive: int) -> Experiment:
        """The same record of one of the drives."""
        return replace(self, drives=(self.drives[drive],), rest=self.rest[[drive]])

    @cached_property
    def circle(self) -> Circle:
        """Where this record's series are evaluated."""
        return Circle(self.mesh.grid.n)

    @cached_property
    def edges(self) -> Vector:
        """Block edges [time unit]."""
        return self.mesh.grid.edges

    @cached_property
    def phases(self) -> tuple[tuple[Phase, ...], ...]:
        """Changes of every drive by phase; none for a drive that never moves."""
        lattice = self.mesh.lattice
        apart = partial(phases, step=lattice.step, even=lattice.slots is not None)
        return tuple(apart(drive) if drive.moves else () for drive in self.drives)

    @cached_property
    def changes(self) -> tuple[Changes, ...]:
        """The same, with the lattice of the samples."""
        return tuple(Changes(own, self.mesh.lattice) for own in self.phases)

    @cached_property
    def blocks(self) -> int:
        """Blocks of the step responses that simulate the record."""
        begins = [float(drive.times[0]) for drive in self.drives if drive.moves]
        # samples may be read from before: readings of a step response reach back as far as these
        times = self.mesh.lattice.times
        return blocks_of(self.mesh.lattice, min([*begins, *times[:1].tolist()])) if begins else 0


@final
@dataclass(frozen=True, eq=False)
class ForwardModel:
    """Unit responses of every experiment: the operational matrices as a function of the dynamics."""

    layout: Layout
    experiments: tuple[Experiment, ...]
    effects: Declared | None = None
    """Effects of the plant; unit responses are those of the plant without."""
    axis: int | None = None
    """The response axis that is asked for: unit responses that it has no part of are 0. None: all axes."""

    def only(self, *records: int) -> ForwardModel:
        """The same model of some of the records."""
        own = None if self.effects is None else self.effects.only(records)
        return replace(self, experiments=tuple(self.experiments[r] for r in records), effects=own)

    def path(self, response: int, drive: int) -> ForwardModel:
        """A plant of one path with one term, from a drive to a response, on the same records."""
        layout = Layout.of((self.layout.drives[drive],), (self.layout.responses[response],), ModelSettings())
        return ForwardModel(layout, tuple(experiment.driven_by(drive) for experiment in self.experiments))

    def joined(self, other: ForwardModel) -> ForwardModel:
        """The same model of the records of both."""
        own = None
        if self.effects is not None and other.effects is not None:
            own = self.effects.joined(other.effects)
        return replace(self, experiments=(*self.experiments, *other.experiments), effects=own)

    @property
    def plain(self) -> ForwardModel:
        """The same model without effects."""
        return self if self.effects is None else replace(self, effects=None)

    def unit_responses(self, dynamics: Dynamics, known: StepResponses | None = None) -> list[Array]:
        """Deviation from rest per unit gain, for each experiment (units, batch, samples) [drive unit].

        The response of axis i is ``offset_i + sum_j gain_ij (rest_j + unit_ij)``. Accuracy:
        `model.stepresponse`. `known` are step responses of these very dynamics, a batch of one, under other
        commands; those that lack are added.
        """
        shapes = [(len(self.layout.units), dynamics.batch, e.mesh.reading.samples) for e in self.experiments]
        out = [np.zeros(shape) for shape in shapes]
        for plants in self._portions(dynamics.batch):
            own = {} if known is None else known
            self._respond(dynamics[plants], [read[:, plants] for read in out], own)
        return out

    def _portions(self, batch: int) -> Iterator[slice]:
        """Slices of a batch that are small enough to be fast."""
        blocks = max((circle.n for circle in self.circles.values()), default=1)
        terms = max(element.terms for element in self.layout.elements)
        size = max(_ABREAST, _CELLS // (blocks * terms) // _ABREAST * _ABREAST)
        return (slice(first, first + size) for first in range(0, batch, size))

    @cached_property
    def circles(self) -> dict[float, Circle]:
        """Where the step responses of each block width are evaluated: long enough for every record."""
        longest: dict[float, int] = {}
        for experiment in self.experiments:
            step = experiment.mesh.lattice.step
            longest[step] = max(longest.get(step, 0), experiment.blocks)
        return {step: Circle(blocks) for step, blocks in longest.items() if blocks}

    def _respond(self, dynamics: Dynamics, out: list[Array], known: StepResponses) -> None:
        """Write the unit responses of a few plants into `out`."""
        read: dict[tuple[int, int, int, int], Array] = {}
        superposed = {step: Superposition(circle) for step, circle in self.circles.items()}
        for index, (element, delay, axis) in self._asked:
            proportional: list[tuple[int, float, Array]] = []
            for step, moved in self._moved[axis].items():
                own = []
                for number in moved:
                    place, place_axis, scale = self._alike[number][axis]
                    same = (element, delay, place, place_axis)
                    if same in read:
                        proportional.append((number, scale, read[same]))
                        continue
                    own.append(number)
                    if scale == 1.0:
                        read[same] = out[number][index]
                if not own:
                    continue
                response = self._step_response(dynamics, element, step, known)
                late, records = dynamics.delays[:, delay], [self.experiments[k].changes[axis] for k in own]
                found = superposed[step](response, records, late, (element, delay))
                for number, (value,) in zip(own, found, strict=True):
                    out[number][index][:, self.experiments[number].mesh.reading.first :] = value
            for number, scale, one in proportional:
                np.multiply(scale, one, out=out[number][index])

    @cached_property
    def _asked(self) -> list[tuple[int, Unit]]:
        """Unit responses that are asked for, each with its place among all."""
        units, paths = self.layout.units, self.layout.unit_of
        own = range(len(units)) if self.axis is None else sorted(set(paths[self.axis]))
        return [(index, units[index]) for index in own]

    @cached_property
    def _moved(self) -> list[dict[float, list[int]]]:
        """Records in which each drive moves, by the width of their blocks."""
        moved: list[dict[float, list[int]]] = [{} for _ in self.layout.drives]
        for number, experiment in enumerate(self.experiments):
            for own, changes in zip(moved, experiment.phases, strict=True):
                if changes:
                    own.setdefault(experiment.mesh.lattice.step, []).append(number)
        return moved

    def _step_response(
        self, dynamics: Dynamics, element: int, step: float, known: StepResponses, *, slopes: Slopes = None
    ) -> StepResponse:
        """Step response of an element on one block width, from `known` or added to it. Of a single plant all
        that need about as many blocks are evaluated at once, which takes hardly longer than one."""
        circle = self.circles[step]

        def absent(one: tuple[int, float]) -> bool:
            return one not in known or known[one].coarse.shape[2] < self.circles[one[1]].n

        if absent((element, step)):
            batch = dynamics.batch
            some = [*filter(absent, self._evaluated[element, step])] if batch == 1 else [(element, step)]
            times = np.concatenate([dynamics.times[one] / width for one, width in some])
            orders = np.concatenate([dynamics.orders[one] for one, _ in some])
            longest = max((self.circles[width] for _, width in some), key=lambda circle: circle.n)
            found = step_response(times, orders, longest, 1.0, slopes=slopes)
            for place, one in enumerate(some):
                known[one] = found.part(slice(place * batch, (place + 1) * batch))
        return known[element, step].first(circle.n)

    @cached_property
    def _evaluated(self) -> dict[tuple[int, float], list[tuple[int, float]]]:
        """For each element and block width of records, those of as many terms and about as many blocks."""
        used = {
            (unit.element, experiment.mesh.lattice.step)
            for experiment in self.experiments
            for _, unit in self._asked
            if experiment.phases[unit.drive]
        }
        groups: dict[tuple[int, int], list[tuple[int, float]]] = {}
        for element, step in sorted(used):
            size = self.circles[step].n.bit_length()
            groups.setdefault((self.layout.elements[element].terms, size), []).append((element, step))
        return {one: group for group in groups.values() for one in group}

    @cached_property
    def _alike(self) -> list[list[tuple[int, int, float]]]:
        """First experiment and axis with a proportional drive read at the same positions, and the factor.

        Steps of several heights are then simulated once, not once per record.
        """
        shared: list[list[tuple[int, int, float]]] = []
        seen: list[tuple[int, int]] = []
        for number, experiment in enumerate(self.experiments):
            shared.append([(number, axis, 1.0) for axis in range(len(experiment.drives))])
            for axis, drive in enumerate(experiment.drives):
                for first, first_axis in seen:
                    scale = drive.over(self.experiments[first].drives[first_axis])
                    if scale is not None and experiment.mesh.reads_like(self.experiments[first].mesh):
                        shared[number][axis] = (first, first_axis, scale)
                        break
                else:
                    seen.append((number, axis))
        return shared

    def unit_slopes(
        self, dynamics: Dynamics, known: StepResponses | None = None, *, in_orders: bool = True
    ) -> list[tuple[Array, list[Array]]]:
        """`unit_responses` with exact derivatives, per experiment; `known` as there, from this method.

        The second entry holds one array per unit, (2 terms + 1, batch, samples): derivatives in the
        logarithms of the time constants, the orders, and the delay [per time unit]; NaN in the orders where
        `in_orders` is false, which takes a third less time.
        """
        wanted: Slopes = "all" if in_orders else "times"
        known = {} if known is None else known
        superposed = {step: Superposition(circle) for step, circle in self.circles.items()}
        batch, sizes = dynamics.batch, [e.mesh.reading.samples for e in self.experiments]
        values = [np.zeros((len(self.layout.units), batch, size)) for size in sizes]
        rows = [2 * dynamics.times[unit.element].shape[1] + 1 for unit in self.layout.units]
        slopes = [[np.zeros((each, batch, size)) for each in rows] for size in sizes]
        for index, (element, delay, axis) in self._asked:
            terms = dynamics.times[element].shape[1]
            for step, moved in self._moved[axis].items():
                response = self._step_response(dynamics, element, step, known, slopes=wanted)
                records, late = [self.experiments[k].changes[axis] for k in moved], dynamics.delays[:, delay]
                superpose = partial(superposed[step], records=records, delays=late, key=(element, delay))
                found, by_block = superpose(response), superpose(response.alone, kind="slope")
                for number, one, slope in zip(moved, found, by_block, strict=True):
                    first, target = self.experiments[number].mesh.reading.first, slopes[number][index]
                    values[number][index][:, first:] = one[0]
                    target[: len(one) - 1, :, first:] = one[1:]
                    target[-1:, :, first:] = -slope / step
                    if not in_orders:
                        target[terms:-1] = np.nan
        return list(zip(values, slopes, strict=True))


def deflections(layout: Layout, rest: Array, gains: Array, units: Array) -> Array:
    """Deflections of linear plants on a record, (axes, batch, samples) [response unit].

    Parameters: rest of the drives, (drives,), or of each plant, (batch, drives); gains, (batch, responses,
    drives); unit responses, (units, batch, samples).
    """
    out = np.zeros((len(layout.responses), *units.shape[1:]))
    for i, row in enumerate(layout.unit_of):
        for j, unit in enumerate(row):
            out[i] += gains[:, i, j, None] * (rest[..., j, None] + units[unit])
    return out


def forward_model(
    layout: Layout,
    records: Sequence[Driven],
    times: Sequence[Vector],
    *,
    blocks: int | None = None,
    exposure: float = 0.0,
    refinement: int = 1,
    widest: float = np.inf,
) -> ForwardModel:
    """Forward model of `records`, each read at its own `times` [time unit], on blocks as `Mesh.of_samples`
    chooses them."""
    experiments = (
        Experiment.of(record, at, blocks=blocks, exposure=exposure, refinement=refinement, widest=widest)
        for record, at in zip(records, times, strict=True)
    )
    return ForwardModel(layout, tuple(experiments))
