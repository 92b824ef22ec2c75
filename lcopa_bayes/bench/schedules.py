"""Drives of a campaign: what an experimenter would command to reveal effects, and what many do command."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import final

import numpy as np

from lcopa_bayes.bench.command import Command, quiet, two_axis
from lcopa_bayes.bench.driveeffects import joined

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
    told = [
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
    return [Schedule(two_axis(x, y), duration, held) for x, y, duration, held in told]


def plain_schedules(rng: np.random.Generator) -> list[Schedule]:
    """Eleven records of on-steps alone, three of them held out; both axes, several heights, 30 to 50 ms."""
    heights = [(1.0, 0.0), (0.5, 0.0), (0.75, 0.0), (0.6, 0.4), (0.0, 1.0), (0.0, 0.5)]
    heights += [(0.9, 0.0), (0.25, 0.0), (0.7, 0.7), (0.0, 0.8), (1.0, 0.0)]
    held = {3, 6, 9}
    out = []
    for number, (x, y) in enumerate(heights):
        start, duration = float(rng.uniform(3.0, 6.0)), float(rng.uniform(30.0, 50.0))
        commands = [_levels([level], start, []) if level else quiet() for level in (x, y)]
        out.append(Schedule(two_axis(*commands), duration, number in held))
    return out
