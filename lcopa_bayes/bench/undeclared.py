"""Campaigns with undeclared effects: rich and plain drives, records, and the truth for scoring."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import pi
from types import ModuleType
from typing import ClassVar, Literal, final

import numpy as np

from lcopa_bayes.bench import driveeffects, planteffects, readingeffects, unnamedeffects
from lcopa_bayes.bench.command import Command, joint, quiet
from lcopa_bayes.bench.device import Bench, Device, truth
from lcopa_bayes.bench.driveeffects import joined
from lcopa_bayes.bench.hiddeneffects import STEPS, Hidden, HiddenDevice, Shot
from lcopa_bayes.core.arrays import Matrix
from lcopa_bayes.core.errors import InputError, nearest
from lcopa_bayes.core.rules import Ruled
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.model.path import TransferPath

LARGEST = pi / 2
"""Largest drive of either axis [rad]."""


@final
@dataclass(frozen=True, eq=False)
class Schedule:
    """Drive of one record."""

    command: Command
    duration: float
    """[ms]."""
    held_out: bool


def _levels(levels: list[float], start: float, holds: list[float]) -> Command:
    """One axis: levels [largest drive] from `start` [ms], each held [ms]; the last stays."""
    times = start + np.concatenate(([0.0], np.cumsum(holds)))
    jumps = LARGEST * np.diff(levels, prepend=0.0)
    return joined([times], [jumps], np.zeros(1))


def _holds(count: int, low: float, high: float, rng: np.random.Generator) -> list[float]:
    return [float(hold) for hold in rng.uniform(low, high, count)]


def _random_signs(start: float, count: int, rng: np.random.Generator) -> Command:
    """Pseudo-random levels: signs and sizes at random, held for 2 to 6 ms."""
    levels = [float(v) for v in rng.choice((-1.0, 1.0), count) * rng.choice((0.3, 0.6, 0.9), count)]
    return _levels([*levels, 0.0], start, _holds(count, 2.0, 6.0, rng))


def rich_schedules(rng: np.random.Generator) -> list[Schedule]:
    """Eleven records, three of them held out, in the order taken.

    Amplitude series on x, on/off on both axes, staircases with reversal of sign, pseudo-random levels, both
    axes at once and a repeat of the first record; 6 to 12 ms of quiet before any drive, commands
    at any time, 30 to 100 ms long.
    """

    def start() -> float:
        return float(rng.uniform(6.0, 12.0))

    full = _levels([1.0, 0.0], start(), _holds(1, 18.0, 24.0, rng))
    half = _levels([0.5, 0.0], start(), _holds(1, 15.0, 20.0, rng))
    quarter = _levels([-0.25, -1.0, 0.0], start(), _holds(2, 12.0, 18.0, rng))
    other = _levels([0.9, 0.0, -0.45, 0.0], start(), _holds(3, 10.0, 16.0, rng))
    up = _levels([0.2, 0.45, 0.75, 1.0, 0.6, 0.1, -0.5, -0.9, -0.2], start(), _holds(8, 5.0, 10.0, rng))
    down = _levels([-0.3, 0.4, 0.8, 0.3, -0.8, 0.0], start(), _holds(5, 6.0, 12.0, rng))
    random_x, random_y = _random_signs(start(), 14, rng), _random_signs(start(), 14, rng)
    mixed = _levels([0.7, 0.35, 0.0], start(), _holds(2, 8.0, 16.0, rng))
    check_x = _levels([0.75, -0.4, 0.9, 0.0], start(), _holds(3, 6.0, 14.0, rng))
    check_y = _levels([-0.6, 0.85, 0.2], start(), _holds(2, 8.0, 16.0, rng))
    still = quiet()
    entries = [
        (full, still, 50.0, False),
        (half, still, 45.0, False),
        (quarter, still, 60.0, False),
        (check_x, still, 60.0, True),
        (still, other, 70.0, False),
        (up, mixed, 100.0, False),
        (check_x, check_y, 65.0, True),
        (random_x, still, 80.0, False),
        (down, random_y, 80.0, False),
        (_random_signs(start(), 8, rng), _random_signs(start(), 8, rng), 60.0, True),
        (full, still, 50.0, False),
    ]
    return [Schedule(joint(x, y), duration, held) for x, y, duration, held in entries]


def plain_schedules(rng: np.random.Generator) -> list[Schedule]:
    """Eleven records of on-steps alone, three of them held out; both axes, several heights, 30 to 50 ms."""
    heights = [(1.0, 0.0), (0.5, 0.0), (0.75, 0.0), (0.6, 0.4), (0.0, 1.0), (0.0, 0.5)]
    heights += [(0.9, 0.0), (0.25, 0.0), (0.7, 0.7), (0.0, 0.8), (1.0, 0.0)]
    held = {3, 6, 9}
    out = []
    for number, (x, y) in enumerate(heights):
        start, duration = float(rng.uniform(3.0, 6.0)), float(rng.uniform(30.0, 50.0))
        commands = [_levels([level], start, []) if level else quiet() for level in (x, y)]
        out.append(Schedule(joint(*commands), duration, number in held))
    return out


NOISE = 1.8e-4
"""Standard deviation of the noise of a sample [rad], Ta et al. 2026, Figs. 13 to 16."""
CAMERA = 0.1
"""Camera period [ms]."""
Maker = Callable[[np.random.Generator], Hidden]


def _makers(*modules: ModuleType) -> dict[str, Maker]:
    """Functions of one Generator that return a hidden effect, by name."""
    makers: dict[str, Maker] = {}
    for module in modules:
        for name, maker in inspect.getmembers(module, inspect.isfunction):
            signature = inspect.signature(maker)
            if signature.return_annotation == "Hidden" and maker.__module__ == module.__name__:
                makers[name] = maker
    return makers


NAMED: dict[str, Maker] = _makers(driveeffects, planteffects, readingeffects)
"""Effects that a catalogue may contain."""
OUTSIDE: dict[str, Maker] = _makers(unnamedeffects)
"""Effects that no catalogue contains."""


@final
@dataclass(frozen=True, eq=False)
class Campaign:
    """Records of one device with hidden effects, and what only the evaluation may read."""

    fit: tuple[Record, ...]
    held_out: tuple[Record, ...]
    truth: dict[str, Matrix]
    """Response of the plant without noise and disturbances, (rows of the record, axes), by record."""
    hidden: tuple[Hidden, ...]
    device: Device
    correlation: float
    """Of successive noise samples [-]."""


def steerer(rng: np.random.Generator) -> Device:
    """A two-axis steerer near that of Ta et al. 2026, Eq. 65: two direct terms, one cross term, one delay.

    Every number is drawn within 15 % of its middle (orders within 4 %).
    """

    def near(value: float, part: float = 0.15) -> float:
        return float(value * rng.uniform(1 - part, 1 + part))

    def path(gain: float, terms: Sequence[tuple[float, float]]) -> TransferPath:
        times, orders = zip(*terms, strict=True)
        return TransferPath.of_times(gain, delay, times, orders)

    delay = near(3.0)
    direct = ((near(1.8), near(1.75, 0.04)), (near(2.4), near(0.88, 0.04)))
    cross = ((near(2.2), near(0.9, 0.04)),)
    paths = (
        (path(near(0.0174), direct), path(near(0.0012), cross)),
        (path(near(0.0010), cross), path(near(0.0160), direct)),
    )
    axes = (Axis("x", "rad"), Axis("y", "rad"))
    offsets = tuple(float(v) for v in rng.normal(0.0, 2e-4, 2))
    return Device(paths, axes, axes, offsets)


def drawn(names: Sequence[str], rng: np.random.Generator) -> tuple[Hidden, ...]:
    """Effects of these names at sizes drawn at random; InputError for a name that is not known."""
    known = NAMED | OUTSIDE
    wrong = [
        f"there is no hidden effect {name!r}{nearest(name, known)}" for name in names if name not in known
    ]
    if wrong:
        raise InputError(wrong)
    return tuple(known[name](rng) for name in names)


def campaign(
    hidden: Sequence[Hidden],
    rng: np.random.Generator,
    *,
    drives: Literal["rich", "plain"] = "rich",
    correlation: float = 0.0,
    noise_sd: float = NOISE,
    device: Device | None = None,
    steps: int = STEPS,
) -> Campaign:
    """Eight records to fit and three held out, named by the order in which they were taken.

    Parameters: hidden effects, none for a control; `correlation` [-] of successive noise samples (AR(1));
    `noise_sd` [rad]; `device`, by default a `steerer` drawn at random; `steps` per camera period where
    forces are changed. Records have 30 to 100 ms at 10 kHz and, when rich, a part at rest before the drive.
    """
    device = device or steerer(rng)
    schedules = rich_schedules(rng) if drives == "rich" else plain_schedules(rng)
    bench = Bench(refresh=0.0, camera=CAMERA, noise_sd=noise_sd, noise_correlation=correlation)
    fit: list[Record] = []
    held_out: list[Record] = []
    exact: dict[str, Matrix] = {}
    plant = tuple(effect for effect in hidden if not effect.disturbance)
    for number, schedule in enumerate(schedules):
        shot = shot_of(device, (number + 0.5) / len(schedules) - 0.5, rng)
        name = f"run{number + 1:02d}"
        taken = [
            truth(
                device,
                bench,
                schedule.command,
                duration=schedule.duration,
                name=name,
                responding=HiddenDevice(device, acting, shot, steps).response,
            )
            for acting in dict.fromkeys((plant, tuple(hidden)))
        ]
        clean, response = taken[0], np.array(taken[-1].response)
        exact[name] = clean.response
        sampled = ~np.isnan(response[:, 0])
        noise = bench.noise(int(sampled.sum()), response.shape[1], rng)
        for effect in hidden:
            if effect.noise is not None:
                noise = effect.noise(noise, rng)
        response[sampled] += noise
        (held_out if schedule.held_out else fit).append(replace(clean, response=response))
    return Campaign(tuple(fit), tuple(held_out), exact, tuple(hidden), device, correlation)


def shot_of(device: Device, epoch: float, rng: np.random.Generator) -> Shot:
    """Properties of the record that effects use, for drives up to the largest of the schedules."""
    steady = np.array([[path.steady for path in row] for row in device.paths])
    drive = np.full(steady.shape[1], LARGEST)
    return Shot(epoch, drive, np.abs(np.diag(steady)) * drive, device.paths[0][0].delay, steady, rng)


@final
@dataclass(frozen=True)
class UndeclaredPlan(Ruled):
    """A campaign file with a table ``[undeclared]``: effects by name, at sizes drawn from the seed.

    Raises InputError for an unknown effect, unknown drives or a correlation out of range.
    """

    name: str
    seed: int
    effects: tuple[str, ...] = ()
    """Names among `NAMED` and `OUTSIDE`; none for a control."""
    drives: Literal["rich", "plain"] = "rich"
    correlation: float = 0.0
    """Of successive noise samples [-]."""
    noise_sd: float = NOISE
    """[rad]."""

    held_out: ClassVar[tuple[str, ...]] = ("run04", "run07", "run10")
    settings: ClassVar[str] = '[model]\nterms = { direct = 2, cross = 1 }\nshare = "paper"'
    """Model table of the study file, without any effect."""

    def contradictions(self) -> list[str]:
        """Unknown effects, and noise that no bench has."""
        try:
            drawn(self.effects, np.random.default_rng(0))
            Bench(noise_sd=self.noise_sd, noise_correlation=self.correlation)
        except InputError as error:
            return list(error.problems)
        return []

    def draw(self, rng: np.random.Generator) -> Campaign:
        """The campaign with what only the evaluation may read."""
        hidden = drawn(self.effects, rng)
        return campaign(hidden, rng, drives=self.drives, correlation=self.correlation, noise_sd=self.noise_sd)

    def run(self, rng: np.random.Generator) -> tuple[Record, ...]:
        """All records in the order taken."""
        records = self.draw(rng)
        return tuple(sorted((*records.fit, *records.held_out), key=lambda record: record.name))
