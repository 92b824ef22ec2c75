"""What every effect is: a card, coefficients with a scale, and one abstract class per place.

An effect is a frozen dataclass. Its fields are its internal constants (a frequency, a frame length);
`grid` lists the instances worth trying on a set of records. Its coefficients psi are what is estimated;
at psi = 0 every effect vanishes and the plant is the linear one, exactly. The order of the stages is

    commands -> DriveEffect -> delay, gain -> ElementEffect, ForceEffect -> SensorEffect (on the grid)
             -> read at the samples -> ParallelEffect (adds) -> ReadoutEffect -> offset -> noise

Deflection always means the response without its offset, so that it is 0 at zero drive.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from types import MappingProxyType
from typing import Any, ClassVar, Literal, NamedTuple, Self, TypeAlias, final

import numpy as np

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.model.grid import Grid
from lcopa_bayes.model.layout import Layout


@final
class UnstableError(ArithmeticError):
    """The plant with its effects has no bounded response; carries the `effects`, `record` and `why`."""

    def __init__(self, effects: tuple[str, ...], record: str, why: str) -> None:
        self.effects, self.record, self.why = effects, record, why
        super().__init__(f"record {record!r} with {', '.join(effects) or 'no effect'}: {why}")

    def __reduce__(self) -> tuple[object, ...]:
        return UnstableError, (self.effects, self.record, self.why)


@final
@dataclass(frozen=True, eq=False)
class Ranges:
    """Scales that make coefficients comparable between devices; frozen once, at the base fit."""

    drive: Vector
    """Largest magnitude of any drive of the same unit [drive unit]."""
    response: Vector
    """Largest deflection of each response axis in the base model, alike for axes of one unit in proportion to
    what their drives hold [response unit]."""
    period: float
    """Median distance of samples [time unit]."""
    span: float
    """Length of the longest record [time unit]."""
    speed: float
    """Time from 0 to half of the final deflection after a step, delay excluded [time unit]."""
    direct: Index
    """Drive that each response axis belongs to [-]."""
    names: tuple[str, ...]
    """Names of the response axes."""
    devices: Index
    """Device that reads each response axis, one for every unit [-]."""

    @property
    def axes(self) -> int:
        """Number of response axes."""
        return self.response.size

    @property
    def column(self) -> Matrix:
        """`response` as a column, (axes, 1)."""
        return self.response[:, None]


@final
@dataclass(frozen=True)
class Coefficient:
    """One number that an effect estimates; it vanishes at 0."""

    name: str
    unit: str
    """"-", "time" or "response": the latter two are units of the records."""
    scale: float
    """Standard deviation of its prior, normal or, when `one_signed`, half-normal [`unit`]."""
    one_signed: bool = False
    """Whether only values of 0 or more make sense."""
    axis: int | None = None
    """Response axis it acts on; None when it acts on several."""
    share: bool = False
    """Whether it says how much of the effect is there, 1 being all of it: larger values make no sense."""


@final
@dataclass(frozen=True)
class Constant:
    """One internal constant of an effect and where its default prior reaches."""

    name: str
    unit: str
    """"-", "time", "response" or "1/time"."""
    low: float
    """Smallest value that is tried [`unit`]."""
    high: float
    """Largest value that is tried; equal to `low` where it is fixed unless a study gives a prior [`unit`]."""
    kind: Literal["constant", "fraction", "choice"]
    """Positive, of any magnitude; a share from 0 to 1; or no (0) and yes (1)."""


@final
@dataclass(frozen=True)
class Card:
    """What a reader needs to know about an effect."""

    name: str
    place: str
    """drive, plant, output, noise or generic."""
    formula: str
    source: str
    reveals: str
    """Excitation that shows it."""
    mistaken_for: str
    """What it looks like under a plain step."""
    per_record: bool = False
    """Whether each record has coefficients of its own."""
    disturbance: bool = False
    """Whether it belongs to the noise model and not to the plant."""
    resting: bool = False
    """Whether it goes on where nothing moves."""
    linear: bool = False
    """Whether it is a linear response to the drive that does not change with time."""
    fields: tuple[str, ...] = ()
    """optical, thermal, electrical, mechanical: where it can occur; anywhere by default."""
    dynamics: bool = False
    """Whether it stands for any such response that the plant may lack."""
    always: bool = False
    """Whether every reading has it, however small."""
    delays: bool = False
    """Whether a plant without it has a longer delay in its place."""


@final
@dataclass(frozen=True, eq=False)
class Scene:
    """One record as the effects see it."""

    layout: Layout
    ranges: Ranges
    record: int
    """Position among the simulated records [-]."""
    epoch: float
    """Place in the campaign, -1/2 for the first record, 1/2 for the last [-]."""
    times: Vector
    """Sample times [time unit]."""
    grid: Grid
    drives: tuple[AxisDrive, ...]
    """Commands as recorded, deviations from rest."""
    rest: Vector
    """Drive before the first command [drive unit]."""
    gains: Matrix
    """(responses, drives) [response unit per drive unit]."""
    delays: Matrix
    """(responses, drives) [time unit]."""

    def direct(self, axis: int) -> tuple[AxisDrive, float, float, float]:
        """Own drive of a response axis, its rest, gain and delay."""
        j = int(self.ranges.direct[axis])
        return self.drives[j], float(self.rest[j]), float(self.gains[axis, j]), float(self.delays[axis, j])


@dataclass(frozen=True)
class Effect(ABC):
    """An addition to the linear plant; concrete effects subclass one of the classes below."""

    card: ClassVar[Card]
    estimated: ClassVar[tuple[Coefficient, ...]] = ()
    """Coefficients whose scales are the same on any records."""
    per_device: ClassVar[bool] = False
    """Whether every device that reads responses has coefficients of its own; axes of one unit share one."""
    per_command: ClassVar[bool] = False
    """Whether it is computed command by command, which takes long on records of thousands."""
    linear: ClassVar[bool] = False
    """Whether what it adds, where it acts, is proportional to its coefficients: one difference is then
    enough for a slope."""
    affine: ClassVar[bool] = True
    """Whether every response axis stays linear in the gains of its own paths."""
    additive: ClassVar[bool] = False
    """Whether what it adds depends on time alone, not on the plant or its drive."""
    units: ClassVar[Mapping[str, str]] = MappingProxyType({})
    """Units of the internal constants that have one."""
    fractions: ClassVar[frozenset[str]] = frozenset()
    """Internal constants that lie between 0 and 1."""
    ratios: ClassVar[Mapping[str, tuple[float, float]]] = MappingProxyType({})
    """Ends of internal constants that compare response axes; they have a default value, at which they stay
    where there is one axis."""

    @classmethod
    def grid(cls, ranges: Ranges) -> tuple[Self, ...]:
        """Instances with the internal constants worth trying; one when there are none to try."""
        return (cls(),)

    @classmethod
    def internal(cls, ranges: Ranges) -> tuple[Constant, ...]:
        """Internal constants, in the order of the fields; they reach from end to end of `grid` or of
        `ratios`, and what else has a default value is fixed there."""
        listed, out = cls.grid(ranges), []
        ratios = cls.ratios if ranges.axes > 1 else {}
        for field in fields(cls):
            values = [getattr(one, field.name) for one in listed]
            if isinstance(values[0], bool):
                out.append(Constant(field.name, "-", 0.0, 0.0, "choice"))
                continue
            fixed = (min(values), max(values)) if field.default is MISSING else (field.default,) * 2
            low, high = ratios.get(field.name, fixed)
            kind: Literal["constant", "fraction"] = "fraction" if field.name in cls.fractions else "constant"
            unit = cls.units.get(field.name, "-")
            out.append(Constant(field.name, unit, float(low), float(high), kind))
        return tuple(out)

    @classmethod
    def with_constants(cls, constants: Sequence[Constant], values: Sequence[float]) -> Self:
        """The instance with its constants, those of `internal`, as numbers."""
        pairs = zip(constants, values, strict=True)
        return cls(*(bool(v) if one.kind == "choice" else v for one, v in pairs))

    def coefficients(self, ranges: Ranges) -> tuple[Coefficient, ...]:
        """Coefficients, of one record when the card says `per_record`; by default those of `estimated`,
        of every device where they are `per_device`."""
        return of_devices(ranges, self.estimated) if self.per_device else self.estimated

    @classmethod
    def applies(cls, layout: Layout) -> bool:
        """Whether a plant of this layout can have the effect."""
        return True

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.card.name

    @property
    def constants(self) -> dict[str, Any]:
        """Internal constants by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @property
    def timed(self) -> bool:
        """Whether commands jump with internal constants, those of a clock: no slope says where they are."""
        return self.card.place == "drive" and bool(self.fractions)


Acting: TypeAlias = tuple[AxisDrive, float]
"""Commands as they act, deviations from the resting drive, and that rest [drive unit]."""


class DriveEffect(Effect):
    """Changes the commands of one drive axis."""

    lags: ClassVar[bool] = False
    """Whether all it does is to make every change act later by the same time, `lag`."""

    def lag(self, ranges: Ranges, psi: Array) -> Array:
        """That time [time unit], of coefficients (coefficients, ...)."""
        raise NotImplementedError(f"{self.name} does more than delay its commands")

    @abstractmethod
    def commands(self, drive: AxisDrive, rest: float, axis: int, scene: Scene, psi: Vector) -> Acting:
        """Commands as they act."""


class ElementEffect(Effect):
    """Changes the time constants from record to record."""

    @abstractmethod
    def stretch(self, scene: Scene, psi: Vector) -> float:
        """Factor on all time constants [-]."""


@final
class Motion(NamedTuple):
    """Deflection of the direct paths on blocks, each (axes, blocks)."""

    y: Matrix
    """Block means [response unit]."""
    rate: Matrix
    """Derivative [response unit per time unit]."""
    bend: Matrix
    """Second derivative [response unit per time unit squared]."""

    def ends(self, step: float) -> tuple[tuple[Matrix, Matrix], tuple[Matrix, Matrix]]:
        """Deflection and derivative where each block, of width `step` [time unit], begins and ends."""
        half = 0.5 * step
        moved, turned = half * self.rate, half * self.bend
        middle = self.y + 0.5 * half * turned
        return (middle - moved, self.rate - turned), (middle + moved, self.rate + turned)


class ForceEffect(Effect):
    """Changes the balance of forces in the direct paths: ``y + viscous(y) = v(f, y)`` instead of ``= f``."""

    affine = False
    batched: ClassVar[bool] = False
    """Whether `force` takes many plants at once, an axis of each per row: coefficients, constants and the
    column of `Ranges` then have a value per row, (rows, 1), and no axis sees another."""

    @abstractmethod
    def force(self, f: Matrix, motion: Motion, scene: Scene, psi: Vector) -> Matrix:
        """Effective force v on each direct path, (axes, blocks) [response unit].

        Parameters: f, the force so far (gain times delayed drive), (axes, blocks); motion of the direct
        path. Pointwise in time.
        """


class SensorEffect(Effect):
    """A linear filter between the deflection and the reading."""

    @abstractmethod
    def filtered(self, y: Matrix, scene: Scene, psi: Vector) -> Matrix:
        """Deviation from rest after the filter, (axes, blocks), from that before it; 0 before the first."""


class ParallelEffect(Effect):
    """A response of its own beside that of the paths, proportional to its coefficients."""

    linear = True

    @abstractmethod
    def added(self, scene: Scene, psi: Vector) -> Matrix:
        """What it adds at the sample times, (samples, axes) [response unit]."""


class ReadoutEffect(Effect):
    """Acts on the deflection at the sample times."""

    affine = False

    @abstractmethod
    def seen(self, y: Matrix, scene: Scene, psi: Vector) -> Matrix:
        """Deflection as read, (samples, axes) [response unit], from the one before."""


class ScatterEffect(Effect):
    """Changes the distribution of the noise and not the mean: its signature is 0."""

    noise: ClassVar[str]
    """Noise model that takes the place of the study's; the parameters it has beside a scale are those of the
    effect."""


def single(
    name: str, scale: float, unit: str = "-", *, one_signed: bool = False, share: bool = False
) -> tuple[Coefficient, ...]:
    """One coefficient; a share has one sign."""
    return (Coefficient(name, unit, scale, one_signed or share, share=share),)


def of_devices(ranges: Ranges, shared: Sequence[Coefficient]) -> tuple[Coefficient, ...]:
    """Coefficients of every device in turn, named after its first axis where there are several."""
    _, first = np.unique(ranges.devices, return_index=True)
    if first.size == 1:
        return tuple(shared)
    return tuple(replace(one, name=f"{one.name}_{ranges.names[axis]}") for axis in first for one in shared)


def devices_of(units: Sequence[str]) -> Index:
    """Number of each one's unit, in the order of their first."""
    order = list(dict.fromkeys(units))
    return np.array([order.index(unit) for unit in units], dtype=np.intp)


def per_axis(ranges: Ranges, names: Sequence[str], part: float) -> tuple[Coefficient, ...]:
    """Coefficients [response unit] for every axis in turn; their scale is a `part` of its deflection."""
    return tuple(
        Coefficient(
            f"{name}_{axis}" if ranges.axes > 1 else name, "response", part * float(size), axis=number
        )
        for number, (axis, size) in enumerate(zip(ranges.names, ranges.response, strict=True))
        for name in names
    )
