"""Passage of a record through a plant or many, from the commands that act to the deflection that is read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple, TypeAlias, final

import numpy as np
from scipy import fft

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector
from lcopa_bayes.model.blockpulses import Spectrum
from lcopa_bayes.model.effects.balance import RunawayError, balanced, earlier, iterated, resting
from lcopa_bayes.model.effects.effect import (
    Effect,
    ElementEffect,
    ForceEffect,
    Scene,
    SensorEffect,
    UnstableError,
)
from lcopa_bayes.model.forward import Dynamics, Experiment, ForwardModel, StepResponses, deflections
from lcopa_bayes.model.layout import Layout
from lcopa_bayes.model.stepresponse import transfer

Acting: TypeAlias = Sequence[tuple[Effect, Vector]]
"""Effects with their coefficients."""
Forces: TypeAlias = Sequence[tuple[ForceEffect, Array]]
"""Forces with their coefficients: (coefficients,) of one plant, or (coefficients, plants times axes, 1), the
constants that differ likewise."""
Spectra: TypeAlias = dict[tuple[int, int, float, float], Spectrum]
"""By element, number and width of the blocks, and the factor on time constants."""
_SWEEPS = 100
"""Most sweeps of the iteration [-]: what they do not bring to rest is solved by dividing the record."""


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
    model: ForwardModel, scenes: Sequence[Scene], gains: Array, dynamics: Dynamics, forces: Forces
) -> Iterator[tuple[Array, dict[int, str]]]:
    """Of every record, deflections of many plants under forces, (axes, batch, samples) [response unit], and
    why some of the plants, by number, have no bounded response."""
    spectra: Spectra = {}
    for experiment, scene, units in zip(
        model.experiments, scenes, model.unit_responses(dynamics), strict=True
    ):
        passage = Passage(model.layout, experiment, scene, gains, dynamics, forces, spectra)
        change, failures = passage.change()
        yield deflections(model.layout, scene.rest, gains, units) + change, failures


def passed(
    model: ForwardModel, scenes: Sequence[Scene], plant: Plant, acting: Sequence[Acting]
) -> list[Moved]:
    """Every record with effects on elements, forces and sensors; raises UnstableError."""
    spectra: Spectra = {}
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
                spectra,
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

    Effects are simulated on blocks at fixed times, which misread the kink at an onset. So only the change
    they make there is taken: it is added to the response of the linear plants.
    """

    layout: Layout
    experiment: Experiment
    scene: Scene
    """Of any of the plants: commands, scales and the grid are those of all."""
    gains: Array
    """(batch, responses, drives) [response unit per drive unit]."""
    dynamics: Dynamics
    forces: Forces
    spectra: Spectra
    """Of elements, (batch, points), shared by the records of these plants."""
    stretch: float = 1.0
    """Factor on all time constants [-]."""
    filters: Sequence[tuple[SensorEffect, Vector]] = ()
    """Of the sensor, with their coefficients."""

    def change(self) -> tuple[Array, dict[int, str]]:
        """What effects add to the deflections at the samples, (axes, batch, samples) [response unit], and why
        some plants, by number, have no bounded response."""
        ranges, batch, n = self.scene.ranges, len(self.gains), self.experiment.mesh.grid.n
        linear, moved = np.zeros((ranges.axes, batch, n)), np.zeros((ranges.axes, batch, n))
        for i, row in enumerate(self.layout.unit_of):
            for j, unit in enumerate(row):
                gain = self.gains[:, i, j, None]
                linear[i] += gain * self._unit(unit, 1.0)
                if not (self.forces and j == ranges.direct[i]):
                    moved[i] += gain * self._unit(unit, self.stretch)
        at_rest, failures = np.zeros((ranges.axes, batch)), dict[int, str]()
        if self.forces:
            at_rest, bent, failures = self._balanced()
            moved += bent
        for effect, psi in self.filters:
            moved = np.stack([effect.filtered(moved[:, b], self.scene, psi) for b in range(batch)], axis=1)
        read = self.experiment.mesh.reading((moved - linear).reshape(-1, n))
        out = read.reshape(ranges.axes, batch, -1) + at_rest[..., None]
        for b in np.flatnonzero(~np.isfinite(out).all(axis=(0, 2))).tolist():
            failures.setdefault(b, "the response is not finite")
        return out, failures

    def _spectrum(self, element: int, stretch: float) -> Spectrum:
        grid = self.experiment.mesh.grid
        key = (element, grid.n, grid.step, stretch)
        if key not in self.spectra:
            times, orders = self.dynamics.times[element], self.dynamics.orders[element]
            self.spectra[key] = transfer(stretch * times, orders, self.experiment.circle, grid.step)
        return self.spectra[key]

    def _means(self, unit: int) -> Matrix:
        """Block means of the delayed drive of a unit, (batch, blocks) [drive unit]."""
        _, delay, axis = self.layout.units[unit]
        late = self.dynamics.delays[:, delay]
        return self.scene.drives[axis].block_means(self.experiment.edges, late)[0]

    def _unit(self, unit: int, stretch: float) -> Array:
        """Block means of a unit response with all time constants times `stretch`, (batch, blocks)."""
        element, _, axis = self.layout.units[unit]
        if not self.scene.drives[axis].moves:
            return np.zeros((len(self.gains), self.experiment.mesh.grid.n))
        circle = self.experiment.circle
        return circle.coefficients(self._spectrum(element, stretch) * circle.spectrum(self._means(unit)))

    def _balanced(self) -> tuple[Matrix, Array, dict[int, str]]:
        """What forces add to the level of the direct paths at rest, (axes, batch), deflection of these paths
        from that level, (axes, batch, blocks), and why some plants have none."""
        ranges, batch, n = self.scene.ranges, len(self.gains), self.experiment.mesh.grid.n
        direct = list(enumerate(ranges.direct.tolist()))
        gains = np.stack([self.gains[:, i, j] for i, j in direct], axis=1)
        rest = gains * self.scene.rest[ranges.direct]
        means = np.stack([self._means(self.layout.unit_of[i][j]) for i, j in direct], axis=1)
        spectra = [self._spectrum(self.layout.element_of[i][j], self.stretch) for i, j in direct]
        kernel = np.stack([self.experiment.circle.coefficients(one) for one in spectra], axis=1)
        f0 = rest.reshape(-1, 1)
        problem = _Forced(
            self.forces,
            replace(self.scene, ranges=replace(ranges, response=np.tile(ranges.response, batch))),
            f0 + (gains[..., None] * means).reshape(len(f0), -1),
            self.experiment.mesh.grid.step,
        )
        every, scale = np.arange(len(f0)), problem.scene.ranges.column
        level, settled = resting(lambda y: problem.acting(every, f0, y, np.zeros_like(y)), f0, scale)
        places = every.reshape(batch, ranges.axes)
        length = fft.next_fast_len(2 * n - 1, real=True)
        spectrum, before = fft.rfft(kernel, length), np.zeros((len(f0), 2))

        def swept(plants: Index, y: Array) -> Array:
            rows, flat = places[plants].ravel(), y.reshape(-1, n)
            v = problem.deviation(level, rows, slice(None), flat, *earlier(before[rows], flat))
            chosen = spectrum if plants.size == batch else spectrum[plants]
            return np.asarray(fft.irfft(chosen * fft.rfft(v.reshape(y.shape), length), length)[..., :n])

        y, solved = iterated(swept, np.zeros(kernel.shape), scale.reshape(batch, -1, 1), _SWEEPS)
        failures: dict[int, str] = {}
        for b in np.flatnonzero(~solved).tolist():
            try:
                if not settled[places[b]].all():
                    raise RunawayError(0)
                force = partial(problem.deviation, level, places[b])
                y[b] = balanced(kernel[b], force, scale[places[b]], y[b])
            except RunawayError as error:
                failures[b] = str(error)
        return (level.reshape(rest.shape) - rest).T, np.moveaxis(y, 1, 0), failures


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

    def acting(self, rows: Index, f: Matrix, y: Matrix, rate: Matrix) -> Matrix:
        """The force that acts on some of the rows."""
        ranges = self.scene.ranges
        own = replace(self.scene, ranges=replace(ranges, response=ranges.response[rows]))
        for effect, psi in self.forces:
            one, mine = (effect, psi) if psi.ndim == 1 else (_of_rows(effect, rows), psi[:, rows])
            f = one.force(f, y, rate, own, mine)
        return f

    def deviation(
        self, level: Matrix, rows: Index, blocks: slice | Index, y: Matrix, one: Matrix, two: Matrix
    ) -> Matrix:
        """That force less the level (rows, 1), from y less the level and its values one and two blocks
        before."""
        rate = (1.5 * y - 2.0 * one + 0.5 * two) / self.step
        return self.acting(rows, self.f[rows][:, blocks], level[rows] + y, rate) - level[rows]


def _of_rows(effect: ForceEffect, rows: Index) -> ForceEffect:
    """The effect with those constants that differ from row to row taken of some rows."""
    constants = {
        name: value[rows] for name, value in effect.constants.items() if isinstance(value, np.ndarray)
    }
    return replace(effect, **constants) if constants else effect
