"""Passage of one record through the plant, from the commands that act to the deflection that is read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, final

import numpy as np

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector
from lcopa_bayes.model.effects.balance import RunawayError, balanced, resting
from lcopa_bayes.model.effects.effect import (
    Effect,
    ElementEffect,
    ForceEffect,
    Scene,
    SensorEffect,
    UnstableError,
)
from lcopa_bayes.model.forward import Dynamics, Experiment, ForwardModel, StepResponses
from lcopa_bayes.model.layout import Layout
from lcopa_bayes.model.powerseries import Spectrum
from lcopa_bayes.model.transfer import transfer

Acting = Sequence[tuple[Effect, Vector]]
"""Effects with their coefficients."""


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
        Moved(scene, deflections(model.layout, scene, plant.gains, units[:, 0]))
        for scene, units in zip(scenes, responses, strict=True)
    ]


def deflections(layout: Layout, scene: Scene, gains: Matrix, units: Matrix) -> Matrix:
    """Deflections of a linear plant, (samples, axes), from its unit responses, (units, samples)."""
    rows = [
        np.sum([gains[i, j] * (scene.rest[j] + units[unit]) for j, unit in enumerate(row)], axis=0)
        for i, row in enumerate(layout.unit_of)
    ]
    return np.stack(rows, axis=1)


def passed(
    model: ForwardModel, scenes: Sequence[Scene], plant: Plant, acting: Sequence[Acting]
) -> list[Moved]:
    """Every record with effects on elements, forces and sensors; raises UnstableError.

    The effects are simulated on blocks at fixed times, which misread the kink at an onset. So only the change
    they make there is taken, and added to the response of the linear plant.
    """
    spectra: dict[tuple[int, int, float, float], Spectrum] = {}
    return [
        _Passage(model.layout, experiment, scene, plant, own, spectra).moved(without)
        for experiment, scene, own, without in zip(
            model.experiments, scenes, acting, linear(model, scenes, plant), strict=True
        )
    ]


@final
@dataclass(frozen=True, eq=False)
class _Passage:
    """One record on its grid."""

    layout: Layout
    experiment: Experiment
    scene: Scene
    plant: Plant
    acting: Acting
    spectra: dict[tuple[int, int, float, float], Spectrum]

    def moved(self, without: Moved) -> Moved:
        """Deflection at the samples, from that of the linear plant."""
        scene, gains = self.scene, self.plant.gains
        bent = [(effect, own) for effect, own in self.acting if isinstance(effect, ForceEffect)]
        at_rest = gains @ scene.rest
        change = np.zeros((scene.ranges.axes, self.experiment.mesh.grid.n))
        for i, row in enumerate(self.layout.unit_of):
            for j, unit in enumerate(row):
                if not (bent and j == scene.ranges.direct[i]):
                    change[i] += gains[i, j] * self._unit(unit, self._stretch)
        if bent:
            level, moving = self._balance(bent)
            own = np.array([gains[i, j] * scene.rest[j] for i, j in enumerate(scene.ranges.direct)])
            at_rest, change = at_rest - own + level, change + moving
        for effect, own in self.acting:
            if isinstance(effect, SensorEffect):
                change = effect.filtered(change, scene, own)
        rest_change, change = at_rest - gains @ scene.rest, change - self._linear()
        read = without.deflection + self.experiment.mesh.reading(change).T + rest_change
        if not np.isfinite(read).all():
            raise self._unstable("the response is not finite")
        return Moved(scene, read)

    def _linear(self) -> Matrix:
        """Block means of the linear plant's deviation from rest, (axes, blocks)."""
        gains, units = self.plant.gains, self.layout.unit_of
        rows = [
            [gains[i, j] * self._unit(unit, 1.0) for j, unit in enumerate(row)] for i, row in enumerate(units)
        ]
        return np.asarray(np.sum(rows, axis=1))

    @cached_property
    def _stretch(self) -> float:
        """Factor on all time constants [-]."""
        factors = [e.stretch(self.scene, own) for e, own in self.acting if isinstance(e, ElementEffect)]
        stretch = float(np.prod(factors))
        if not 0 < stretch < np.inf:
            raise self._unstable(f"its time constants would be multiplied by {stretch:.3g}")
        return stretch

    def _spectrum(self, element: int, stretch: float) -> Spectrum:
        grid = self.experiment.mesh.grid
        key = (element, grid.n, grid.step, stretch)
        if key not in self.spectra:
            times, orders = self.plant.dynamics.times[element], self.plant.dynamics.orders[element]
            self.spectra[key] = transfer(stretch * times, orders, self.experiment.circle, grid.step)[0]
        return self.spectra[key]

    def _means(self, unit: int) -> Vector:
        """Block means of the delayed drive of a unit [drive unit]."""
        _, delay, axis = self.layout.units[unit]
        late = self.plant.dynamics.delays[:, delay]
        means, _ = self.scene.drives[axis].block_means(self.experiment.edges, late)
        return np.asarray(means[0])

    def _unit(self, unit: int, stretch: float) -> Array:
        """Block means of a unit response with all time constants times `stretch` [drive unit]."""
        element, _, axis = self.layout.units[unit]
        if not self.scene.drives[axis].moves:
            return np.zeros(self.experiment.mesh.grid.n)
        circle = self.experiment.circle
        return circle.coefficients(self._spectrum(element, stretch) * circle.spectrum(self._means(unit)))

    def _balance(self, bent: Sequence[tuple[ForceEffect, Vector]]) -> tuple[Vector, Matrix]:
        """Deflection of the direct paths at rest, (axes,), and deviation from it, (axes, blocks)."""
        scene, circle = self.scene, self.experiment.circle
        direct = list(enumerate(scene.ranges.direct))
        gains = np.array([self.plant.gains[i, j] for i, j in direct])[:, None]
        f0 = gains * scene.rest[scene.ranges.direct][:, None]
        f = f0 + gains * np.stack([self._means(self.layout.unit_of[i][j]) for i, j in direct])
        kernel = np.stack(
            [
                circle.coefficients(self._spectrum(self.layout.element_of[i][j], self._stretch))
                for i, j in direct
            ]
        )

        def acting(f: Matrix, y: Matrix, rate: Matrix) -> Matrix:
            for effect, own in bent:
                f = effect.force(f, y, rate, scene, own)
            return f

        def deviation(blocks: slice | Index, y: Matrix, one: Matrix, two: Matrix) -> Matrix:
            rate = (1.5 * y - 2.0 * one + 0.5 * two) / self.experiment.mesh.grid.step
            return acting(f[:, blocks], level + y, rate) - level

        try:
            level = resting(lambda y: acting(f0, y, np.zeros_like(y)), f0, scene.ranges.response)
            return level[:, 0], balanced(kernel, deviation, scene.ranges.response)
        except RunawayError as error:
            raise self._unstable(str(error)) from error

    def _unstable(self, why: str) -> UnstableError:
        return UnstableError(tuple(effect.name for effect, _ in self.acting), self.experiment.name, why)
