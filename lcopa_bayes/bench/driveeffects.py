"""Hidden effects on the commands, drawn at realistic sizes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lcopa_bayes.bench.command import Command
from lcopa_bayes.bench.hiddeneffects import Hidden, Shot
from lcopa_bayes.core.arrays import Matrix, Vector


def signed(low: float, high: float, rng: np.random.Generator) -> float:
    """A size between `low` and `high`, evenly in its logarithm, with a random sign."""
    return float(rng.choice((-1.0, 1.0)) * np.exp(rng.uniform(np.log(low), np.log(high))))


def unsigned(low: float, high: float, rng: np.random.Generator) -> float:
    """A size between `low` and `high`, evenly in its logarithm."""
    return abs(signed(low, high, rng))


def joined(times: list[Vector], jumps: list[Vector], rest: Vector) -> Command:
    """Command whose axis i jumps by ``jumps[i]`` at ``times[i]``, in any order; jumps of 0 are omitted."""
    times = [at[change != 0] for at, change in zip(times, jumps, strict=True)]
    jumps = [change[change != 0] for change in jumps]
    instants = np.unique(np.concatenate(times))
    values = np.tile(rest, (instants.size, 1))
    for axis, (at, change) in enumerate(zip(times, jumps, strict=True)):
        for when, size in zip(at, change, strict=True):
            values[instants >= when, axis] += size
    return Command(instants, values, rest)


def by_axis(command: Command) -> tuple[list[Vector], list[Vector]]:
    """Instants and sizes of the changes of each axis."""
    moved = [np.flatnonzero(column) for column in command.jumps.T]
    return [command.times[k] for k in moved], [command.jumps[k, i] for i, k in enumerate(moved)]


def relevelled(curve: Callable[[Matrix, Shot], Matrix]) -> Callable[[Command, Shot], Command]:
    """Commands with a curve applied to every level, (levels, axes)."""

    def changed(command: Command, shot: Shot) -> Command:
        levels = curve(np.vstack([command.rest, command.values]), shot)
        return Command(command.times, levels[1:], levels[0])

    return changed


def voltage_knee(rng: np.random.Generator) -> Hidden:
    """Curve from drive to force."""
    k = signed(0.015, 0.06, rng)
    curve = relevelled(lambda u, shot: u * (1 + k * (1 - np.abs(u) / shot.drive)))
    return Hidden("voltage_knee", {"k": k}, commands=curve)


def grey_quantisation(rng: np.random.Generator) -> Hidden:
    """Drive in a few grey levels."""
    levels = float(rng.choice((15, 16, 31, 32)))
    # commands half way between two levels go to the even one, whatever their rounding errors
    curve = relevelled(lambda u, shot: shot.drive / levels * np.round(np.round(u * levels / shot.drive, 9)))
    return Hidden("grey_quantisation", {"levels": levels}, commands=curve)


def hysteresis(rng: np.random.Generator) -> Hidden:
    """Play in parallel with the drive."""
    h, width = signed(0.04, 0.15, rng), float(rng.choice((0.1, 0.2, 0.35)))

    def curve(levels: Matrix, shot: Shot) -> Matrix:
        out, play = levels.copy(), levels[0].copy()
        for k, level in enumerate(levels):
            play = np.clip(play, level - width * shot.drive, level + width * shot.drive)
            out[k] = level + h * (play - level)
        return out

    return Hidden("hysteresis", {"h": h, "width": width}, commands=relevelled(curve))


def overdrive_pulse(rng: np.random.Generator) -> Hidden:
    """A frame of exaggerated drive."""
    k, frame = signed(0.05, 0.4, rng), float(rng.uniform(0.5, 2.0))

    def pulsed(command: Command, shot: Shot) -> Command:
        times, jumps = by_axis(command)
        back = [np.concatenate((at, at + frame)) for at in times]
        return joined(back, [np.concatenate((j + k * j, -k * j)) for j in jumps], command.rest)

    return Hidden("overdrive_pulse", {"k": k, "frame": frame}, commands=pulsed)


def refresh_hold(rng: np.random.Generator) -> Hidden:
    """Commands wait for a 1 kHz refresh."""
    phase = float(rng.choice((0.0, 0.25, 0.5, 0.75)))

    def held(command: Command, shot: Shot) -> Command:
        late = Command(command.times - phase, command.values, command.rest).refreshed(1.0)
        return Command(late.times + phase, late.values, late.rest)

    return Hidden("refresh_hold", {"refresh": 1.0, "phase": phase}, commands=held)


def field_dependent_delay(rng: np.random.Generator) -> Hidden:
    """Large changes start sooner."""
    e = unsigned(0.05, 0.3, rng)

    def shifted(command: Command, shot: Shot) -> Command:
        times, jumps = by_axis(command)
        new = [command.at(at)[:, axis] for axis, at in enumerate(times)]
        late = [
            at + e * shot.delay * (0.5 - np.abs(level) / size)
            for at, level, size in zip(times, new, shot.drive, strict=True)
        ]
        return joined(late, jumps, command.rest)

    return Hidden("field_dependent_delay", {"e": e}, commands=shifted)


def clock_skew(rng: np.random.Generator) -> Hidden:
    """The driver's clock runs at another speed."""
    e = signed(0.002, 0.008, rng)

    def skewed(command: Command, shot: Shot) -> Command:
        return Command(command.times * (1 + e), command.values, command.rest)

    return Hidden("clock_skew", {"e": e}, commands=skewed)


def trigger_jitter(rng: np.random.Generator) -> Hidden:
    """Every record starts at its own time."""
    sd = unsigned(0.05, 0.4, rng)

    def late(command: Command, shot: Shot) -> Command:
        return Command(command.times + sd * shot.chance.standard_normal(), command.values, command.rest)

    return Hidden("trigger_jitter", {"sd": sd}, disturbance=True, commands=late)
