"""Passage of a record through a plant or many, from the commands that act to the deflection that is read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import NamedTuple, TypeAlias, final

import numpy as np
from scipy import fft

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector
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
from lcopa_bayes.model.forward import Dynamics, Experiment, ForwardModel, StepResponses, deflections
from lcopa_bayes.model.grid import CUBIC
from lcopa_bayes.model.layout import Layout
from lcopa_bayes.model.powerseries import Integrals, transfer

Acting: TypeAlias = Sequence[tuple[Effect, Vector]]
"""Effects with their coefficients."""
Forces: TypeAlias = Sequence[tuple[ForceEffect, Array]]
"""Forces with their coefficients: (coefficients,) of one plant, or (coefficients, plants times axes, 1), the
constants that differ likewise."""
Kernels: TypeAlias = dict[tuple[int, float, float], Matrix]
"""Responses to an impulse by element, width of the blocks, and the factor on time constants."""
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
) -> Iterator[tuple[Array, dict[int, str]]]:
    """Of every record, deflections of many plants under forces, (axes, batch, samples) [response unit], and
    why some of the plants, by number, have no bounded response.

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
    for experiment, scene, units in zip(
        model.experiments, scenes, model.unit_responses(dynamics), strict=True
    ):
        passage = Passage(
            model.layout, experiment, scene, gains, dynamics, forces, kernels, tolerance=tolerance
        )
        change, failures = passage.change()
        yield deflections(model.layout, scene.rest, gains, units) + change, failures


@lru_cache(maxsize=1)
def _earlier(model: ForwardModel, by: float) -> ForwardModel:
    """The model with all changes of its drives earlier by a time [time unit]; the latest one is kept, with
    what it knows of its drives."""
    shifted = (tuple(drive.later(-by) for drive in each.drives) for each in model.experiments)
    pairs = zip(model.experiments, shifted, strict=True)
    return replace(model, experiments=tuple(replace(each, drives=drives) for each, drives in pairs))


def passed(
    model: ForwardModel, scenes: Sequence[Scene], plant: Plant, acting: Sequence[Acting]
) -> list[Moved]:
    """Every record with effects on elements, forces and sensors; raises UnstableError."""
    kernels: Kernels = {}
    out = []
    for experiment, scene, own, without in zip(
        model.experiments, scenes, acting, linear(model, scenes, plant), strict=True
    ):
        stretch = float(np.prod([e.stretch(scene, psi) for e, psi in own if isinstance(e, ElementEffect)]))
        failures = {0: f"its time constants would be multiplied by {stretch:.3g}"}
        if 0 < stretch < np.inf:
            passage = Passage(
                model.layout,
                experiment,
                scene,
                plant.gains[None],
                plant.dynamics,
                [(e, psi) for e, psi in own if isinstance(e, ForceEffect)],
                kernels,
                stretch,
                [(e, psi) for e, psi in own if isinstance(e, SensorEffect)],
            )
            change, failures = passage.change()
        if failures:
            raise UnstableError(tuple(effect.name for effect, _ in own), experiment.name, failures[0])
        out.append(Moved(scene, without.deflection + change[:, 0].T))
    return out


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
    stretch: float = 1.0
    """Factor on all time constants [-]."""
    filters: Sequence[tuple[SensorEffect, Vector]] = ()
    """Of the sensor, with their coefficients."""
    tolerance: float = TOLERANCE
    """Accuracy of the balance of forces over the scale of the response [-]."""

    def change(self) -> tuple[Array, dict[int, str]]:
        """What effects add to the deflections at the samples, (axes, batch, samples) [response unit], and why
        some plants, by number, have no bounded response."""
        axes, batch, n = self.scene.ranges.axes, len(self.gains), self.experiment.mesh.grid.n
        added, at_rest, failures = np.zeros((axes, batch, n)), np.zeros((axes, batch)), dict[int, str]()
        if self.forces:
            at_rest, added, failures = self._balanced()
        if self.filters or self.stretch != 1.0:
            linear, moved = self._linear(1.0), self._linear(self.stretch) + added
            for effect, psi in self.filters:
                moved = np.stack(
                    [effect.filtered(moved[:, b], self.scene, psi) for b in range(batch)], axis=1
                )
            added = moved - linear
        read = self.experiment.mesh.reading(added.reshape(-1, n))
        out = read.reshape(axes, batch, -1) + at_rest[..., None]
        for b in np.flatnonzero(~np.isfinite(out).all(axis=(0, 2))).tolist():
            failures.setdefault(b, "the response is not finite")
        return out, failures

    def _kernel(self, element: int, n: int) -> Matrix:
        """The first n block means of an element's response to an impulse, (batch, n)."""
        step = self.experiment.mesh.grid.step
        key = (element, step, self.stretch)
        if key not in self.kernels or self.kernels[key].shape[1] < n:
            times, orders = self.dynamics.times[element], self.dynamics.orders[element]
            circle = Circle(n)
            spectrum = transfer(self.stretch * times / step, Integrals(orders, n), circle)
            self.kernels[key] = circle.coefficients(spectrum)
        return self.kernels[key][:, :n]

    def _linear(self, stretch: float) -> Array:
        """Block means of the deflections of the plants alone from rest, with all time constants times
        `stretch`, (axes, batch, blocks)."""
        out = np.zeros((self.scene.ranges.axes, len(self.gains), self.experiment.mesh.grid.n))
        circle, step = self.experiment.circle, self.experiment.mesh.grid.step
        for i, row in enumerate(self.layout.unit_of):
            for j, unit in enumerate(row):
                element, delay, axis = self.layout.units[unit]
                if not self.scene.drives[axis].moves:
                    continue
                late = self.dynamics.delays[:, delay]
                means = self.scene.drives[axis].block_means(self.experiment.edges, late)[0]
                times, orders = self.dynamics.times[element], self.dynamics.orders[element]
                spectrum = transfer(stretch * times / step, Integrals(orders, circle.n), circle)
                spectrum *= circle.spectrum(means)
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
        rest = gains * self.scene.rest[ranges.direct]
        drives = [self.scene.drives[j] for _, j in direct]
        late = self.dynamics.delays[:, [self.layout.delay_of[i][j] for i, j in direct]]
        starts = np.array([drive.times[0] if drive.moves else np.inf for drive in drives])
        apart = all(effect.batched for effect, _ in self.forces)
        begin = late if apart else np.repeat(late[:, :1], len(direct), axis=1)
        starts = np.where(np.isfinite(starts) & apart, starts, min(starts.min(), grid.edges[-1]))
        place = (grid.start - begin - starts) / grid.step
        n = max(grid.n + int(np.floor(place.max())) + 3, 3)
        means = np.stack(
            [
                drive.block_means(start + grid.step * np.arange(n + 1), np.unique(beyond))[0]
                if (beyond == beyond[0]).all()
                else drive.block_means(start + grid.step * np.arange(n + 1), beyond)[0]
                for drive, start, beyond in zip(drives, starts, (late - begin).T, strict=True)
            ],
            axis=1,
        )
        kernel = np.stack([self._kernel(self.layout.element_of[i][j], n) for i, j in direct], axis=1)
        f0, f = rest.reshape(-1, 1), gains[..., None] * means
        problem = _Forced(
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


@final
@dataclass(frozen=True, eq=False)
class _Forced:
    """Forces on the direct paths of plants, a row for every axis of every plant."""

    forces: Forces
    scene: Scene
    """Its scales have a value per row."""
    f: Matrix
    """Gain times delayed drive, (rows, blocks) [response unit]."""
    step: float
    """Width of a block [time unit]."""

    def acting(self, rows: Index, f: Matrix, motion: Motion) -> Matrix:
        """The force that acts on some of the rows."""
        ranges = self.scene.ranges
        own = replace(self.scene, ranges=replace(ranges, response=ranges.response[rows]))
        for effect, psi in self.forces:
            one, mine = (effect, psi) if psi.ndim == 1 else (_of_rows(effect, rows), psi[:, rows])
            f = one.force(f, motion, own, mine)
        return f

    def deviation(
        self, level: Matrix, rows: Index, blocks: slice | Index, y: Matrix, one: Matrix, two: Matrix
    ) -> Matrix:
        """That force less the level (rows, 1), from y less the level and its values one and two blocks
        before."""
        last, before = y - one, one - two
        bend = (last - before) / self.step**2
        rate = last / self.step + 0.5 * self.step * bend
        motion = Motion(level[rows] + y, rate, bend)
        # whole rows would be copied for a few of their blocks
        f = self.f[rows, blocks] if isinstance(blocks, slice) else self.f[rows[:, None], blocks]
        return self.acting(rows, f, motion) - level[rows]


def _of_rows(effect: ForceEffect, rows: Index) -> ForceEffect:
    """The effect with those constants that differ from row to row taken of some rows."""
    constants = {
        name: value[rows] for name, value in effect.constants.items() if isinstance(value, np.ndarray)
    }
    return replace(effect, **constants) if constants else effect
