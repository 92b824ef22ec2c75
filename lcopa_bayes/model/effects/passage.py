"""Passage of a record through a plant or many, from the commands that act to the deflection that is read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import NamedTuple, TypeAlias, final

import numpy as np
from scipy import fft

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.model.blockpulses import Circle
from lcopa_bayes.model.effects.balance import TOLERANCE, earlier, iterated, marched, resting
from lcopa_bayes.model.effects.effect import (
    Effect,
    ElementEffect,
    ForceEffect,
    Motion,
    Scene,
    SensorEffect,
    UnstableError,
)
from lcopa_bayes.model.effects.forcedrows import ForcedRows, Forces
from lcopa_bayes.model.forward import (
    Dynamics,
    Experiment,
    ForwardModel,
    StepResponses,
    deflections,
    joined,
)
from lcopa_bayes.model.grid import CUBIC
from lcopa_bayes.model.layout import Layout
from lcopa_bayes.model.powerseries import Integrals, transfer

Acting: TypeAlias = Sequence[tuple[Effect, Vector]]
"""Effects with their coefficients."""
Kernels: TypeAlias = dict[tuple[int, float, bytes], Matrix]
"""Responses to an impulse by element, width of the blocks, and the factors on time constants."""
_SWEEPS, _FEWER = 50, 18
"""Most sweeps of the iteration, and where responses need not be so accurate [-]: what they do not bring to
rest is solved block by block."""
RUNS_AWAY = "the response runs away"


@final
@dataclass(frozen=True, eq=False)
class Plant:
    """One plant as numbers."""

    gains: Matrix
    """(responses, drives) [response unit per drive unit]."""
    dynamics: Dynamics
    """A batch of one."""
    offsets: Matrix
    """(records, responses) [response unit]."""

    @property
    def key(self) -> bytes:
        """Equal for plants that move alike."""
        return self.gains.tobytes() + self.dynamics.delays.tobytes() + self.elements

    @property
    def elements(self) -> bytes:
        """Equal for plants of the same elements."""
        return b"".join(part.tobytes() for part in (*self.dynamics.times, *self.dynamics.orders))


@final
class Moved(NamedTuple):
    """A record up to its reading."""

    scene: Scene
    """With the commands as they act."""
    deflection: Matrix
    """(samples, axes) [response unit]."""


@final
class Commanded(NamedTuple):
    """One plant under commands of its own."""

    scenes: Sequence[Scene]
    """Of every record, with the commands as they act."""
    units: Sequence[Array]
    """Unit responses under them, per record (units, 1, samples)."""


def linear(
    model: ForwardModel, scenes: Sequence[Scene], plant: Plant, known: StepResponses | None = None
) -> list[Moved]:
    """Every record of the linear plant, by the forward model; `known` as there."""
    responses = model.unit_responses(plant.dynamics, known)
    return [
        Moved(scene, deflections(model.layout, scene.rest, plant.gains[None], units)[:, 0].T)
        for scene, units in zip(scenes, responses, strict=True)
    ]


def forced(
    model: ForwardModel,
    scenes: Sequence[Scene],
    gains: Array,
    dynamics: Dynamics,
    forces: Forces,
    tolerance: float = TOLERANCE,
    each: Sequence[Commanded] = (),
) -> Iterator[tuple[Array, dict[int, str]]]:
    """Of every record, deflections of many plants under forces, (axes, batch, samples) [response unit], and
    why some of the plants, by number, have no bounded response; under the same commands, or `each` under its
    own.

    Delays below 0, of drives that were sampled while they moved, become changes that come whole sampling
    periods earlier: the forward model takes no response before its cause.
    """
    early = min(0.0, float(dynamics.delays.min()))
    if early < 0.0:
        period = scenes[0].ranges.period
        ahead = period * float(np.ceil(-early / period))
        model = _earlier(model, ahead)
        pairs = zip(scenes, model.experiments, strict=True)
        scenes = [replace(scene, drives=experiment.drives) for scene, experiment in pairs]
        dynamics = dynamics.later(np.full(dynamics.batch, ahead))
    kernels: Kernels = {}
    units = [] if each else model.unit_responses(dynamics)
    for r, (experiment, scene) in enumerate(zip(model.experiments, scenes, strict=True)):
        own = [one.scenes[r] for one in each] or [scene]
        passage = Passage(
            model.layout,
            experiment,
            scene,
            gains,
            dynamics,
            forces,
            kernels,
            tolerance=tolerance,
            commands=[(one.drives, one.rest) for one in own],
        )
        change, failures = passage.change()
        moved = np.concatenate([one.units[r] for one in each], axis=1) if each else units[r]
        yield deflections(model.layout, passage.rest, gains, moved) + change, failures


@lru_cache(maxsize=1)
def _earlier(model: ForwardModel, by: float) -> ForwardModel:
    """The model with all changes of its drives earlier by a time [time unit]; the latest one is kept, with
    what it knows of its drives."""
    shifted = (tuple(drive.later(-by) for drive in each.drives) for each in model.experiments)
    pairs = zip(model.experiments, shifted, strict=True)
    return replace(model, experiments=tuple(replace(each, drives=drives) for each, drives in pairs))


def passed(
    model: ForwardModel,
    plants: Sequence[Plant],
    scenes: Sequence[Sequence[Scene]],
    acting: Sequence[Sequence[Acting]],
) -> list[list[Moved]]:
    """Every record of some plants with effects on elements, forces and sensors; raises UnstableError.

    Scenes and what is acting are those of every plant on every record: the same commands and effects, of
    several plants no forces, with coefficients of their own.
    """
    kernels: Kernels = {}
    out: list[list[Moved]] = [[] for _ in plants]
    gains, dynamics = np.array([plant.gains for plant in plants]), joined([one.dynamics for one in plants])
    for r, (experiment, units) in enumerate(
        zip(model.experiments, model.unit_responses(dynamics), strict=True)
    ):
        here, own = [each[r] for each in scenes], [each[r] for each in acting]
        stretch = np.array([_stretch(scene, effects) for scene, effects in zip(here, own, strict=True)])
        failures = dict[int, str]()
        for b in np.flatnonzero(~((stretch > 0) & (stretch < np.inf))).tolist():
            failures[b] = f"its time constants would be multiplied by {stretch[b]:.3g}"
        if not failures:
            filters = [
                (e, [(scene, one[k][1]) for scene, one in zip(here, own, strict=True)])
                for k, (e, _) in enumerate(own[0])
                if isinstance(e, SensorEffect)
            ]
            forces = [(e, psi) for e, psi in own[0] if isinstance(e, ForceEffect)]
            passage = Passage(
                model.layout, experiment, here[0], gains, dynamics, forces, kernels, stretch, filters
            )
            change, failures = passage.change()
        if failures:
            names = tuple(effect.name for effect, _ in own[0])
            raise UnstableError(names, experiment.name, next(iter(failures.values())))
        deflection = deflections(model.layout, here[0].rest, gains, units) + change
        for b, (each, scene) in enumerate(zip(out, here, strict=True)):
            each.append(Moved(scene, deflection[:, b].T))
    return out


def _stretch(scene: Scene, acting: Acting) -> float:
    """Factor on all time constants of a plant [-]."""
    return float(np.prod([e.stretch(scene, psi) for e, psi in acting if isinstance(e, ElementEffect)]))


@final
@dataclass(frozen=True, eq=False)
class Passage:
    """One record through one plant or many, with what acts between commands and reading.

    Effects are simulated on blocks, which misread the kink at an onset. So only the change they make there is
    taken: it is added to the response of the linear plants.
    """

    layout: Layout
    experiment: Experiment
    scene: Scene
    """Of any of the plants: commands, scales and the grid are those of all."""
    gains: Array
    """(batch, responses, drives) [response unit per drive unit]."""
    dynamics: Dynamics
    forces: Forces
    kernels: Kernels
    """Of elements, (batch, blocks), shared by the records of these plants."""
    stretch: Vector | None = None
    """Factor on all time constants of each plant, (batch,) [-]; None where it is 1."""
    filters: Sequence[tuple[SensorEffect, Sequence[tuple[Scene, Vector]]]] = ()
    """Of the sensor, with scene and coefficients of each plant."""
    tolerance: float = TOLERANCE
    """Accuracy of the balance of forces over the scale of the response [-]."""
    commands: Sequence[tuple[tuple[AxisDrive, ...], Vector]] = ()
    """Drives of each plant and their rest, as the forces see them; by default those of the scene."""

    @property
    def rest(self) -> Matrix:
        """Rest of the drives of each plant, or of all, (batch or 1, drives) [drive unit]."""
        return np.array([rest for _, rest in self.commands or [(self.scene.drives, self.scene.rest)]])

    def change(self) -> tuple[Array, dict[int, str]]:
        """What effects add to the deflections at the samples, (axes, batch, samples) [response unit], and why
        some plants, by number, have no bounded response."""
        axes, batch, n = self.scene.ranges.axes, len(self.gains), self.experiment.mesh.grid.n
        added, at_rest, failures = np.zeros((axes, batch, n)), np.zeros((axes, batch)), dict[int, str]()
        if self.forces:
            at_rest, added, failures = self._balanced()
        stretched = self.stretch is not None and (self.stretch != 1.0).any()
        if self.filters or stretched:
            linear = self._linear(np.ones(batch))
            moved = added + (self._linear(self._factors) if stretched else linear)
            for effect, own in self.filters:
                moved = np.stack([effect.filtered(moved[:, b], *each) for b, each in enumerate(own)], axis=1)
            added = moved - linear
        read = self.experiment.mesh.reading(added.reshape(-1, n))
        out = read.reshape(axes, batch, -1) + at_rest[..., None]
        for b in np.flatnonzero(~np.isfinite(out).all(axis=(0, 2))).tolist():
            failures.setdefault(b, "the response is not finite")
        return out, failures

    @property
    def _factors(self) -> Vector:
        return np.ones(len(self.gains)) if self.stretch is None else self.stretch

    def _kernel(self, element: int, n: int) -> Matrix:
        """The first n block means of an element's response to an impulse, (batch, n)."""
        step = self.experiment.mesh.grid.step
        key = (element, step, self._factors.tobytes())
        if key not in self.kernels or self.kernels[key].shape[1] < n:
            times, orders = self.dynamics.times[element], self.dynamics.orders[element]
            circle = Circle(n)
            spectrum = transfer(self._factors[:, None] * times / step, Integrals(orders, n), circle)
            self.kernels[key] = circle.coefficients(spectrum)
        return self.kernels[key][:, :n]

    def _linear(self, stretch: Vector) -> Array:
        """Block means of the deflections of the plants alone from rest, with all time constants times
        `stretch`, (batch,), (axes, batch, blocks). Most plants of a batch differ in a single number: what
        several have in common is evaluated once."""
        out = np.zeros((self.scene.ranges.axes, len(self.gains), self.experiment.mesh.grid.n))
        circle, step = self.experiment.circle, self.experiment.mesh.grid.step
        for i, row in enumerate(self.layout.unit_of):
            for j, unit in enumerate(row):
                element, delay, axis = self.layout.units[unit]
                if not self.scene.drives[axis].moves:
                    continue
                late, whose = np.unique(self.dynamics.delays[:, delay], return_inverse=True)
                means = self.scene.drives[axis].block_means(self.experiment.edges, late)[0]
                times, orders = self.dynamics.times[element], self.dynamics.orders[element]
                shapes = np.concatenate([stretch[:, None] * times / step, orders], axis=1)
                shapes, which = np.unique(shapes, axis=0, return_inverse=True)
                times, orders = np.split(shapes, 2, axis=1)
                spectrum = transfer(times, Integrals(orders, circle.n), circle)[which]
                spectrum *= circle.spectrum(means)[whose]
                out[i] += self.gains[:, i, j, None] * circle.coefficients(spectrum)
        return out

    def _balanced(self) -> tuple[Matrix, Array, dict[int, str]]:
        """What forces add to the level of the direct paths at rest, (axes, batch), and to their deflection
        from it, (axes, batch, blocks), and why some plants have none.

        On blocks that begin at the delayed first change of the drive: on others a change falls within a
        block, and where it falls there moves the response by the square of a block's width, to and fro with
        the delay. Where no axis sees another each has its own blocks.
        """
        ranges, batch, grid = self.scene.ranges, len(self.gains), self.experiment.mesh.grid
        direct = list(enumerate(ranges.direct.tolist()))
        gains = np.stack([self.gains[:, i, j] for i, j in direct], axis=1)
        rest = gains * self.rest[:, ranges.direct]
        late = self.dynamics.delays[:, [self.layout.delay_of[i][j] for i, j in direct]]
        apart = all(effect.batched for effect, _ in self.forces)
        begin = late if apart else np.repeat(late[:, :1], len(direct), axis=1)
        commanded = [drives for drives, _ in self.commands or [(self.scene.drives, self.scene.rest)]]
        moving = [[drives[j] for _, j in direct] for drives in commanded]
        starts = np.array([[one.times[0] if one.moves else np.inf for one in drives] for drives in moving])
        first = np.minimum(starts.min(axis=1, keepdims=True), grid.edges[-1])
        starts = np.where(np.isfinite(starts) & apart, starts, first)
        place = (grid.start - begin - starts) / grid.step
        n = max(grid.n + int(np.floor(place.max())) + 3, 3)
        blocks, beyond = grid.step * np.arange(n + 1), (late - begin)[: len(moving)]  # of many plants 0
        means = np.array(
            [
                [one.block_means(start + blocks, by[None])[0][0] for one, start, by in zip(*own, strict=True)]
                for own in zip(moving, starts, beyond, strict=True)
            ]
        )
        kernel = np.stack([self._kernel(self.layout.element_of[i][j], n) for i, j in direct], axis=1)
        f0, f = rest.reshape(-1, 1), gains[..., None] * means
        problem = ForcedRows(
            self.forces,
            replace(self.scene, ranges=replace(ranges, response=np.tile(ranges.response, batch))),
            f0 + f.reshape(len(f0), -1),
            grid.step,
        )
        every, scale = np.arange(len(f0)), problem.scene.ranges.column
        still = np.zeros_like(f0)
        level, settled = resting(lambda y: problem.acting(every, f0, Motion(y, still, still)), f0, scale)
        places = every.reshape(-1, 1 if apart else ranges.axes)
        length = fft.next_fast_len(2 * n - 1, real=True)
        before = np.zeros((len(f0), 2))
        alone = fft.irfft(fft.rfft(kernel, length) * fft.rfft(f, length), length)[..., :n]
        alone = alone.reshape(-1, n)
        spectrum = fft.rfft(kernel, length).reshape(*places.shape, -1)

        def swept(plants: Index, y: Array) -> Array:
            rows, flat = places[plants].ravel(), y.reshape(-1, n)
            v = problem.deviation(level, rows, slice(None), flat, *earlier(before[rows], flat))
            chosen = spectrum if plants.size == len(places) else spectrum[plants]
            return np.asarray(fft.irfft(chosen * fft.rfft(v.reshape(y.shape), length), length)[..., :n])

        rough = self.tolerance > TOLERANCE
        sweeps = _FEWER if rough else _SWEEPS
        scales, start = scale.reshape(*places.shape, 1), alone.reshape(*places.shape, n)
        if batch > 1:  # most batches are neighbours
            own = len(places) // batch
            near, known = iterated(swept, start[:own], scales[:own], sweeps, tolerance=self.tolerance)
            if rough or known.all():
                share = np.divide(gains, gains[0], out=np.ones_like(gains), where=gains[0] != 0.0)
                start = (share[..., None] * near.reshape(-1, n)).reshape(start.shape)
            else:
                sweeps = 0
        y, solved = iterated(swept, start, scales, sweeps, tolerance=self.tolerance)
        if not rough and batch > 1 and not solved.all():
            solved[:] = False  # neighbours whose difference is taken meet a force that all but jumps alike
        failures = dict.fromkeys((places[~settled[places].all(axis=1), 0] // ranges.axes).tolist(), RUNS_AWAY)
        slow = np.flatnonzero(~solved & settled[places].all(axis=1))
        if slow.size:
            rows = places[slow].ravel()
            force = partial(problem.deviation, level, rows)
            # differences of neighbours have to meet a force that all but jumps alike: from the same start
            reached = y[slow].reshape(-1, n) if rough else None
            y[slow], lost = marched(
                kernel.reshape(-1, n)[rows],
                force,
                scale[rows],
                len(slow),
                near=reached,
                tolerance=self.tolerance,
            )
            failures |= dict.fromkeys((places[slow[lost], 0] // ranges.axes).tolist(), RUNS_AWAY)
        bent = _shifted(y.reshape(-1, n) - alone, place.ravel(), grid.n)
        return (
            (level.reshape(rest.shape) - rest).T,
            bent.reshape(batch, ranges.axes, -1).swapaxes(0, 1),
            failures,
        )


def _shifted(means: Matrix, place: Vector, n: int) -> Matrix:
    """Means over n blocks, the first of which begins `place` blocks, (rows,), after the first of those of
    `means`, (rows, blocks): the cubic through four of them. 0 before the first."""
    first = np.floor(place).astype(int)
    at = np.clip(first[:, None] + np.arange(n + 3), 0, means.shape[1])
    taken = np.take_along_axis(np.pad(means, ((0, 0), (1, 0))), at, axis=1)
    weights = np.vander(place - first + 1.0, 4, increasing=True) @ CUBIC
    return np.asarray(sum(weights[:, k, None] * taken[:, k : k + n] for k in range(4)))
