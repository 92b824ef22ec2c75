"""Hidden effects that no catalogue of named effects has, to test whether a loop reports a wrong name for
them."""

from __future__ import annotations

import numpy as np

from lcopa_bayes.bench.command import Command
from lcopa_bayes.bench.driveeffects import by_axis, joined, relevelled, signed, unsigned
from lcopa_bayes.bench.hiddeneffects import Balance, Hidden, Shot
from lcopa_bayes.bench.readingeffects import static
from lcopa_bayes.core.arrays import Matrix, Vector

_PARTS = 24
"""Small steps that approximate an exponential approach."""


def torque_memory(rng: np.random.Generator) -> Hidden:
    """A change acts with a lag that grows with the field it leaves."""
    time = unsigned(0.6, 3.0, rng)
    quantiles = -np.log1p(-(np.arange(_PARTS) + 0.5) / _PARTS)

    def lagged(command: Command, shot: Shot) -> Command:
        times, jumps = by_axis(command)
        late, parts = [], []
        for axis, (at, sizes) in enumerate(zip(times, jumps, strict=True)):
            old = np.abs(command.at(at)[:, axis] - sizes) / shot.drive[axis]
            late.append((at[:, None] + time * old[:, None] * quantiles).ravel())
            parts.append(np.repeat(sizes / _PARTS, _PARTS))
        return joined(late, parts, command.rest)

    return Hidden("torque_memory", {"time": time}, commands=lagged)


def fringing_gain(rng: np.random.Generator) -> Hidden:
    """Gain that changes with the length of the steering vector."""
    c = signed(0.02, 0.08, rng)

    def seen(y: Matrix, shot: Shot) -> Matrix:
        length = np.linalg.norm(y / shot.deflection, axis=1, keepdims=True)
        return np.asarray(y * (1 + c * length))

    return Hidden("fringing_gain", {"c": c}, seen=static(seen))


def duffing_with_memory(rng: np.random.Generator) -> Hidden:
    """Cubic restoring force of the deflection as it was."""
    c, time = signed(0.08, 0.4, rng), unsigned(5.0, 25.0, rng)

    def balance(shot: Shot, step: float) -> Balance:
        memory = np.zeros(shot.deflection.size)
        latest, reached = memory.copy(), -1

        def force(f: Vector, y: Vector, rate: Vector, number: int) -> Vector:
            nonlocal memory, latest, reached
            if number < 0:  # at rest the memory is the deflection
                memory = latest = y.copy()
            elif number > reached:
                memory, reached = memory + (latest - memory) * (1 - np.exp(-step / time)), number
            latest = y.copy()
            return np.asarray(f - c * memory**3 / shot.deflection**2)

        return force

    return Hidden("duffing_with_memory", {"c": c, "time": time}, balance=balance)


def stick_slip(rng: np.random.Generator) -> Hidden:
    """The reading holds until the deflection has moved by a threshold."""
    width = unsigned(0.02, 0.06, rng)

    def seen(y: Matrix, times: Vector, command: Command, shot: Shot) -> Matrix:
        out, held = y.copy(), y[0].copy()
        for k, now in enumerate(y):
            held = np.where(np.abs(now - held) > width * shot.deflection, now, held)
            out[k] = held
        return out

    return Hidden("stick_slip", {"width": width}, seen=seen)


def counting_gain(rng: np.random.Generator) -> Hidden:
    """Every so many commands the drive is stronger."""
    c, period = unsigned(0.02, 0.08, rng), float(rng.uniform(2.3, 4.7))

    def curve(levels: Matrix, shot: Shot) -> Matrix:
        turn = np.sin(2 * np.pi * np.arange(levels.shape[0]) / period)
        return np.asarray(levels * (1 + c * turn[:, None]))

    return Hidden("counting_gain", {"c": c, "period": period}, commands=relevelled(curve))


def self_heating(rng: np.random.Generator) -> Hidden:
    """Gain that falls with the drive power of the last tens of milliseconds, of both axes."""
    c, time = unsigned(0.02, 0.08, rng), unsigned(8.0, 30.0, rng)

    def seen(y: Matrix, times: Vector, command: Command, shot: Shot) -> Matrix:
        power = ((command.values / shot.drive) ** 2).sum(axis=1)
        rest = float(((command.rest / shot.drive) ** 2).sum())
        lags = np.maximum(times[:, None] - command.times, 0.0)
        warm = rest + (1 - np.exp(-lags / time)) @ np.diff(power, prepend=rest)
        return np.asarray(y * (1 - c * warm[:, None]))

    return Hidden("self_heating", {"c": c, "time": time}, seen=seen)
