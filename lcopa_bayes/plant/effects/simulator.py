"""Simulation of all records of a set at once: the linear plant with effects at their places."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, final

import numpy as np

from lcopa_bayes.arrays import Array, Matrix, Vector
from lcopa_bayes.operational.series import Spectrum
from lcopa_bayes.operational.transfer import transfer
from lcopa_bayes.plant.effects.balance import RunawayError, balanced, resting
from lcopa_bayes.plant.effects.effect import (
    DriveEffect,
    Effect,
    ElementEffect,
    ForceEffect,
    ParallelEffect,
    Ranges,
    ReadoutEffect,
    Scene,
    SensorEffect,
    UnstableError,
)
from lcopa_bayes.plant.forward import Dynamics, Experiment, ForwardModel

UPSTREAM = (DriveEffect, ElementEffect, ForceEffect, SensorEffect)
"""Places before the reading."""
_KEPT = 3
"""Simulations kept, so that what acts after the plant is evaluated without simulating it again."""


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
        parts = (self.gains, *self.dynamics.times, *self.dynamics.orders, self.dynamics.delays)
        return b"".join(part.tobytes() for part in parts)


class Moved(NamedTuple):
    """A record up to its reading."""

    scene: Scene
    """With the commands as they act."""
    deflection: Matrix
    """(samples, axes) [response unit]."""


@final
@dataclass(frozen=True, eq=False)
class Simulator:
    """Responses of every experiment of `model` with `effects`.

    psi holds the coefficients effect by effect, those of a `per_record` effect record by record.
    """

    model: ForwardModel
    effects: tuple[Effect, ...]
    ranges: Ranges
    epochs: Vector
    """Place of each record in the campaign, (records,), -1/2 to 1/2 [-]."""
    times: tuple[Vector, ...]
    """Sample times of each record [time unit]."""

    @cached_property
    def _kept(self) -> OrderedDict[bytes, list[Moved]]:
        return OrderedDict()

    @cached_property
    def _slices(self) -> list[slice]:
        """Part of psi of each effect."""
        records, first, out = len(self.model.experiments), 0, []
        for effect in self.effects:
            count = len(effect.coefficients(self.ranges)) * (records if effect.card.per_record else 1)
            out.append(slice(first, first + count))
            first += count
        return out

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return self._slices[-1].stop if self.effects else 0

    def part(self, psi: Vector, effect: int, record: int) -> Vector:
        """Coefficients of an effect that act on a record."""
        mine = psi[self._slices[effect]]
        if not self.effects[effect].card.per_record:
            return mine
        count = mine.size // len(self.model.experiments)
        return mine[record * count : (record + 1) * count]

    def responses(self, plant: Plant, psi: Vector) -> list[Matrix]:
        """Responses at the sample times, per record (samples, axes) [response unit].

        Raises UnstableError. Accuracy: second order in the block width, as the forward model; the
        forward model's to rounding at psi = 0.
        """
        if psi.shape != (self.size,):
            raise ValueError(f"psi must have shape {(self.size,)}; got {psi.shape}")
        moved = self.moved(plant, psi)
        return [y + plant.offsets[r] for r, y in enumerate(self.finished(moved, psi))]

    def finished(self, moved: Sequence[Moved], psi: Vector) -> list[Matrix]:
        """Deflections as read, per record, from those before parallel and readout effects."""
        out = []
        for r, (scene, deflection) in enumerate(moved):
            y = deflection
            for kind in (ParallelEffect, ReadoutEffect):
                for e, effect in enumerate(self.effects):
                    if isinstance(effect, kind):
                        mine = self.part(psi, e, r)
                        if isinstance(effect, ParallelEffect):
                            y = y + effect.added(scene, mine)
                        elif isinstance(effect, ReadoutEffect):
                            y = effect.seen(y, scene, mine)
            out.append(y)
        return out

    def moved(self, plant: Plant, psi: Vector) -> list[Moved]:
        """Every record up to its reading; the latest few are kept."""
        upstream = [psi[self._slices[e]] for e, f in enumerate(self.effects) if isinstance(f, UPSTREAM)]
        key = plant.key + b"".join(part.tobytes() for part in upstream)
        if key in self._kept:
            self._kept.move_to_end(key)
        else:
            if upstream:
                spectra: dict[tuple[int, int, float, float], Spectrum] = {}
                records = range(len(self.model.experiments))
                self._kept[key] = [self._moved_record(r, plant, psi, spectra) for r in records]
            else:
                self._kept[key] = self.linear(plant)
            while len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        return self._kept[key]

    def linear(self, plant: Plant) -> list[Moved]:
        """Every record of the linear plant, by the forward model."""
        out = []
        for r, units in enumerate(self.model.unit_responses(plant.dynamics)):
            scene = self.scene(r, plant)
            at_rest = plant.gains @ scene.rest
            rows = [
                sum(plant.gains[i, j] * units[unit, 0] for j, unit in enumerate(row)) + at_rest[i]
                for i, row in enumerate(self.model.layout.unit_of)
            ]
            out.append(Moved(scene, np.stack(rows, axis=1)))
        return out

    def scene(self, record: int, plant: Plant) -> Scene:
        """A record as commanded."""
        experiment, layout = self.model.experiments[record], self.model.layout
        return Scene(
            layout,
            self.ranges,
            record,
            float(self.epochs[record]),
            self.times[record],
            experiment.mesh.grid,
            experiment.drives,
            experiment.rest,
            plant.gains,
            plant.dynamics.delays[0][np.array(layout.delay_of)],
        )

    def _moved_record(
        self, record: int, plant: Plant, psi: Vector, spectra: dict[tuple[int, int, float, float], Spectrum]
    ) -> Moved:
        """One record up to its reading, on its grid."""
        experiment = self.model.experiments[record]
        scene = self.scene(record, plant)
        mine = [self.part(psi, e, record) for e in range(len(self.effects))]
        stretch = 1.0
        for effect, own in zip(self.effects, mine, strict=True):
            if isinstance(effect, DriveEffect):
                pairs = [
                    effect.commands(drive, float(scene.rest[j]), j, scene, own)
                    for j, drive in enumerate(scene.drives)
                ]
                rest = np.array([level for _, level in pairs])
                scene = replace(scene, drives=tuple(drive for drive, _ in pairs), rest=rest)
            elif isinstance(effect, ElementEffect):
                stretch *= effect.stretch(scene, own)
        if not 0 < stretch < np.inf:
            raise self._unstable(record, f"its time constants would be multiplied by {stretch:.3g}")
        units = self._units(experiment, scene, plant, stretch, spectra)
        bent = [(e, own) for e, own in zip(self.effects, mine, strict=True) if isinstance(e, ForceEffect)]
        at_rest = plant.gains @ scene.rest
        change = np.zeros((self.ranges.axes, experiment.mesh.grid.n))
        for i, row in enumerate(self.model.layout.unit_of):
            for j, unit in enumerate(row):
                if not (bent and j == self.ranges.direct[i]):
                    change[i] += plant.gains[i, j] * units[1][unit]
        if bent:
            level, moving = self._balance(experiment, scene, plant, stretch, units[0], bent, spectra)
            own = np.array([plant.gains[i, j] * scene.rest[j] for i, j in enumerate(self.ranges.direct)])
            at_rest, change = at_rest - own + level, change + moving
        for effect, own in zip(self.effects, mine, strict=True):
            if isinstance(effect, SensorEffect):
                change = effect.filtered(change, scene, own)
        return Moved(scene, experiment.mesh.reading(change).T + at_rest)

    def _spectrum(
        self,
        element: int,
        plant: Plant,
        stretch: float,
        experiment: Experiment,
        spectra: dict[tuple[int, int, float, float], Spectrum],
    ) -> Spectrum:
        grid = experiment.mesh.grid
        key = (element, grid.n, grid.step, stretch)
        if key not in spectra:
            times, orders = plant.dynamics.times[element], plant.dynamics.orders[element]
            spectra[key] = transfer(stretch * times, orders, experiment.circle, grid.step)[0]
        return spectra[key]

    def _units(
        self,
        experiment: Experiment,
        scene: Scene,
        plant: Plant,
        stretch: float,
        spectra: dict[tuple[int, int, float, float], Spectrum],
    ) -> tuple[list[Vector], list[Array]]:
        """Block means of the delayed drive and of the unit response, per unit."""
        drives, responses = [], []
        for element, delay, axis in self.model.layout.units:
            means, _ = scene.drives[axis].block_means(experiment.edges, plant.dynamics.delays[:, delay])
            spectrum = self._spectrum(element, plant, stretch, experiment, spectra)
            drives.append(means[0])
            moves = scene.drives[axis].moves
            circle = experiment.circle
            responses.append(
                circle.coefficients(spectrum * circle.spectrum(means[0]))
                if moves
                else np.zeros(means[0].size)
            )
        return drives, responses

    def _balance(
        self,
        experiment: Experiment,
        scene: Scene,
        plant: Plant,
        stretch: float,
        drives: list[Vector],
        bent: list[tuple[ForceEffect, Vector]],
        spectra: dict[tuple[int, int, float, float], Spectrum],
    ) -> tuple[Vector, Matrix]:
        """Deflection of the direct paths at rest, (axes,), and deviation from it, (axes, blocks)."""
        layout, direct = self.model.layout, self.ranges.direct
        gains = np.array([plant.gains[i, j] for i, j in enumerate(direct)])
        f0 = gains[:, None] * scene.rest[direct][:, None]
        f = f0 + gains[:, None] * np.stack([drives[layout.unit_of[i][j]] for i, j in enumerate(direct)])
        kernel = np.stack(
            [
                experiment.circle.coefficients(
                    self._spectrum(layout.element_of[i][j], plant, stretch, experiment, spectra)
                )
                for i, j in enumerate(direct)
            ]
        )

        def acting(f: Matrix, y: Matrix, rate: Matrix) -> Matrix:
            for effect, own in bent:
                f = effect.force(f, y, rate, scene, own)
            return f

        try:
            level = resting(lambda y: acting(f0, y, np.zeros_like(y)), f0, self.ranges.response)

            def deviation(blocks: slice, y: Matrix, before: Matrix) -> Matrix:
                rate = (y - before) / experiment.mesh.grid.step
                return acting(f[:, blocks], level + y, rate) - level

            return level[:, 0], balanced(kernel, deviation, self.ranges.response)
        except RunawayError as error:
            raise self._unstable(scene.record, str(error)) from error

    def _unstable(self, record: int, why: str) -> UnstableError:
        names = tuple(effect.name for effect in self.effects)
        return UnstableError(names, self.model.experiments[record].name, why)
