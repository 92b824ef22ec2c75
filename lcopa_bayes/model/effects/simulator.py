"""Simulation of all records of a set at once: the linear plant with effects at their places."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar, final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.model.effects.effect import (
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
from lcopa_bayes.model.effects.passage import Commanded, Moved, Plant, forced, linear, passed
from lcopa_bayes.model.forward import ForwardModel, StepResponses, joined

UPSTREAM = (DriveEffect, ElementEffect, ForceEffect, SensorEffect)
"""Places before the reading."""
_BENDING = (ElementEffect, ForceEffect, SensorEffect)
"""Those between commands and reading."""
_TOGETHER = 1 << 18
"""Plants times blocks that are simulated at once [-]."""

_Value = TypeVar("_Value")


@final
class Latest(OrderedDict[Hashable, _Value]):
    """The three values used last, so that what acts after the plant is evaluated without simulating it
    again."""

    def get_or(self, key: Hashable, compute: Callable[[], _Value]) -> _Value:
        """The value of a key, computed when it is not kept."""
        if key not in self:
            self[key] = compute()
        self.move_to_end(key)
        while len(self) > 3:
            self.popitem(last=False)
        return self[key]


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
    step_responses: Latest[StepResponses] = field(default_factory=Latest)
    """Step responses of the latest plants; shared with simulators of other effects, for most
    simulations differ in the commands alone."""
    still: Latest[list[Moved]] = field(default_factory=Latest)
    """The latest plants up to their reading where the last effect does not act before it; shared likewise:
    what is tried in its place has them in common."""

    @cached_property
    def _kept(self) -> Latest[list[Moved]]:
        return Latest()

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
            for e, effect in enumerate(self.effects):
                if isinstance(effect, ParallelEffect):
                    y = y + effect.added(scene, self.part(psi, e, r))
            for e, effect in enumerate(self.effects):
                if isinstance(effect, ReadoutEffect):
                    y = effect.seen(y, scene, self.part(psi, e, r))
            out.append(y)
        return out

    def moved(self, plant: Plant, psi: Vector) -> list[Moved]:
        """Every record up to its reading; the latest few are kept.

        Effects whose coefficients are all 0 are omitted, and what only changes commands is simulated by
        the forward model itself.
        """
        pairs = zip(self.effects, self._slices, self._acts(psi, UPSTREAM), strict=True)
        acting = tuple((effect, psi[part].tobytes()) for effect, part, acts in pairs if acts)
        whole = bool(acting) and acting[-1][0] is self.effects[-1]
        # what is kept holds its ranges, so that no others have their identity
        key = plant.key, id(self.ranges), acting
        return (self._kept if whole else self.still).get_or(key, lambda: self._simulated(plant, psi))

    def _simulated(self, plant: Plant, psi: Vector) -> list[Moved]:
        acting = self._acts(psi, _BENDING)
        scenes = self.scenes(plant, psi)
        model = self.driven(scenes)
        if any(acting):
            own = [self._acting(acting, psi, r) for r in range(len(scenes))]
            return passed(model, [plant], [scenes], [own])[0]
        return linear(model, scenes, plant, self.step_responses.get_or(plant.elements, dict))

    def moved_together(self, cases: Sequence[tuple[Plant, Vector]]) -> list[list[Moved]]:
        """`moved` of many plants and coefficients: at once where forces that take many are all that acts
        between commands and reading, or no forces act and nothing on the commands.

        Raises UnstableError.
        """
        psis = np.array([psi for _, psi in cases])
        acting = [
            (effect, psis[:, part])
            for effect, part in zip(self.effects, self._slices, strict=True)
            if isinstance(effect, UPSTREAM) and psis[:, part].any()
        ]
        forces = [
            (effect, np.repeat(own.T, self.ranges.axes, axis=1)[..., None])
            for effect, own in acting
            if isinstance(effect, ForceEffect) and effect.batched and not effect.card.per_record
        ]
        drives = [(one, own) for one, own in acting if isinstance(one, DriveEffect)]
        if not forces or len(forces) + len(drives) < len(acting):
            return self._passed_together(cases)
        plants, records = [plant for plant, _ in cases], range(len(self.model.experiments))
        gains, dynamics = np.array([plant.gains for plant in plants]), joined([p.dynamics for p in plants])
        commanded = list[Commanded]()
        if all(effect.lags for effect, _ in drives):
            for effect, own in drives:
                dynamics = dynamics.later(effect.lag(self.ranges, own.T))
            scenes = [self.scenes(plant, psi) for plant, psi in cases]
        else:
            commanded = [self.commanded(plant, psi) for plant, psi in cases]
            scenes = [list(one.scenes) for one in commanded]
        shared = [self.scene(r, plants[0]) for r in records]
        out: list[list[Moved]] = [[] for _ in plants]
        responses = forced(self.model, shared, gains, dynamics, forces, each=commanded)
        for r, (deflection, failures) in enumerate(responses):
            if failures:
                names = tuple(effect.name for effect, _ in forces)
                raise UnstableError(names, self.model.experiments[r].name, next(iter(failures.values())))
            for b, each in enumerate(out):
                each.append(Moved(scenes[b][r], deflection[:, b].T))
        return out

    def _passed_together(self, cases: Sequence[tuple[Plant, Vector]]) -> list[list[Moved]]:
        """`moved` of many plants and coefficients, at once of those under which the same effects act, all of
        them on elements or before the sensor."""
        alike: dict[tuple[bool, ...], list[int]] = {}
        for k, (_, psi) in enumerate(cases):
            alike.setdefault(tuple(self._acts(psi, UPSTREAM)), []).append(k)
        out: dict[int, list[Moved]] = {}
        longest = max(experiment.mesh.grid.n for experiment in self.model.experiments)
        size = max(1, _TOGETHER // longest)
        for acts, every in alike.items():
            kinds = [effect for effect, does in zip(self.effects, acts, strict=True) if does]
            alone = len(every) == 1 or any(isinstance(one, (DriveEffect, ForceEffect)) for one in kinds)
            if alone or not kinds:
                out |= {k: self.moved(*cases[k]) for k in every}
                continue
            for begin in range(0, len(every), size):
                some = every[begin : begin + size]
                scenes = [self.scenes(*cases[k]) for k in some]
                own = [
                    [self._acting(acts, cases[k][1], r) for r in range(len(self.model.experiments))]
                    for k in some
                ]
                found = passed(self.model, [cases[k][0] for k in some], scenes, own)
                out |= dict(zip(some, found, strict=True))
        return [out[k] for k in range(len(cases))]

    def _acts(self, psi: Vector, places: tuple[type[Effect], ...]) -> list[bool]:
        """Of each effect, whether it acts, at one of some places."""
        return [
            isinstance(effect, places) and bool(psi[part].any())
            for effect, part in zip(self.effects, self._slices, strict=True)
        ]

    def bends(self, psi: Vector) -> bool:
        """Whether anything acts between commands and reading, so that the forward model does not hold."""
        return any(self._acts(psi, _BENDING))

    def _acting(self, acting: Sequence[bool], psi: Vector, record: int) -> list[tuple[Effect, Vector]]:
        """Effects that act before the reading, with their coefficients on a record."""
        return [(self.effects[e], self.part(psi, e, record)) for e, acts in enumerate(acting) if acts]

    def scenes(self, plant: Plant, psi: Vector) -> list[Scene]:
        """Every record with the commands as they act."""
        out = []
        for record in range(len(self.model.experiments)):
            scene = self.scene(record, plant)
            for e, effect in enumerate(self.effects):
                own = self.part(psi, e, record)
                if isinstance(effect, DriveEffect) and own.any():
                    pairs = [
                        effect.commands(drive, float(scene.rest[j]), j, scene, own)
                        for j, drive in enumerate(scene.drives)
                    ]
                    drives, rest = tuple(drive for drive, _ in pairs), np.array([at for _, at in pairs])
                    scene = replace(scene, drives=drives, rest=rest)
            out.append(scene)
        return out

    def commanded(self, plant: Plant, psi: Vector) -> Commanded:
        """A plant's own commands and its responses to them before anything acts on these."""
        scenes = self.scenes(plant, psi)
        known = self.step_responses.get_or(plant.elements, dict)
        return Commanded(scenes, self.driven(scenes).unit_responses(plant.dynamics, known))

    def driven(self, scenes: Sequence[Scene]) -> ForwardModel:
        """The forward model under the commands of the scenes."""
        pairs = list(zip(self.model.experiments, scenes, strict=True))
        if all(experiment.drives is scene.drives for experiment, scene in pairs):
            return self.model
        changed = (replace(each, drives=scene.drives, rest=scene.rest) for each, scene in pairs)
        return replace(self.model, experiments=tuple(changed))

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
