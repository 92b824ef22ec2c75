"""Devices with something hidden in them that no declared model has, and how their forces are marched."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias, final

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from lcopa_bayes.bench.command import Command
from lcopa_bayes.bench.device import Device
from lcopa_bayes.bench.inversion import unit_step
from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.model.path import Normalisation, TransferPath

Balance: TypeAlias = Callable[[Vector, Vector, Vector, int], Vector]
"""(force, deflection, its rate, each (axes,); number of the step) -> force that acts, (axes,)."""

_SWEEPS = 40
_CLOSE = 1e-13
"""Change of a deflection that ends the iteration of a step, over the largest force [-]."""


@final
class MarchError(ArithmeticError):
    """The deflection is unbounded; holds the `time` reached."""

    def __init__(self, time: float) -> None:
        self.time = time
        super().__init__(f"the deflection runs away at {time:.6g}")


def step_means(edges: Vector, times: Vector, levels: Vector) -> Vector:
    """Mean, between successive edges, of a signal that has ``levels[i]`` from ``times[i]`` on, 0 before."""
    rise = np.maximum(edges[:, None] - times, 0.0)  # the integral of a unit step is a ramp
    area = rise @ np.diff(levels, prepend=0.0) if times.size else np.zeros(edges.size)
    return np.asarray(np.diff(area) / np.diff(edges))


def marched(
    paths: tuple[TransferPath, ...], force: Matrix, balance: Balance, level: Vector, step: float
) -> Matrix:
    """Deflections at the end of every step, (axes, n), of paths that rest at `level` before the first.

    ``y(t) = level + int S'(t - s) (v(s) - level) ds``, S the step response of stiffness 1, with v constant
    over each step and taken at its middle, ``v = balance(mean force, middle of y, rate of y)``; an implicit
    step is iterated. Parameters: force (axes, n), means over the steps. Accuracy: second order in `step`
    where v is smooth in y. Raises MarchError.
    """
    axes, n = force.shape
    lags = step * np.arange(n + 1)
    kernel = np.stack([np.diff(unit_step(path, lags)) for path in paths])
    backward = kernel[:, ::-1].copy()
    acting, y = np.zeros((axes, n)), np.zeros((axes, n))
    before = np.zeros(axes)
    bound = 1e6 * float(np.abs(force).max() + np.abs(level).max() + 1e-300)
    close = _CLOSE * bound / 1e6
    for k in range(n):
        history = np.einsum("ij,ij->i", acting[:, :k], backward[:, n - k - 1 : n - 1])
        now = history + kernel[:, 0] * (acting[:, k - 1] if k else 0.0)
        with np.errstate(over="ignore", invalid="ignore"):  # divergence raises below
            for _ in range(_SWEEPS):
                v = balance(force[:, k], level + 0.5 * (now + before), (now - before) / step, k) - level
                new = history + kernel[:, 0] * v
                moved = np.abs(new - now).max()
                now = new
                if moved <= close:
                    break
        if not np.abs(now).max() < bound:
            raise MarchError(step * k)
        acting[:, k], y[:, k], before = v, now, now
    return y + level[:, None]


STEPS = 4
"""Steps of a march per camera period; halving them moves a response by less than 1e-5 of its range."""
_FINE = 8
"""Points per camera period on which a lag of the sensor is integrated."""


@final
@dataclass(frozen=True, eq=False)
class Shot:
    """Properties of the record being simulated that a hidden effect may use."""

    epoch: float
    """Place in the campaign, -1/2 to 1/2 [-]."""
    drive: Vector
    """Largest drive of each axis in the campaign [drive unit]."""
    deflection: Vector
    """Deflection under it [response unit]."""
    delay: float
    """Of the direct paths [ms]."""
    steady: Matrix
    """Deflection per unit of drive held for ever, (responses, drives)."""
    chance: np.random.Generator
    """For what differs from record to record."""


@final
@dataclass(frozen=True, eq=False)
class Hidden:
    """An effect by the places where it acts; None where it does not."""

    name: str
    numbers: Mapping[str, float]
    """Sizes and internal constants."""
    disturbance: bool = False
    """Whether it is no part of the plant, so that the truth is without it."""
    commands: Callable[[Command, Shot], Command] | None = None
    stretch: Callable[[Shot], float] | None = None
    """Factor on every time constant."""
    balance: Callable[[Shot, float], Balance] | None = None
    """From the shot and the step [ms]: force that acts on the direct paths."""
    lag: float = 0.0
    """Time constant of the sensor [ms]."""
    exposure: float = 0.0
    """[ms]."""
    seen: Callable[[Matrix, Vector, Command, Shot], Matrix] | None = None
    """(deflections, times, command that acts, shot) -> deflections."""
    turns: bool = False
    """Whether `seen` is given the deflections where commands begin to act, too, among those of `times`."""
    noise: Callable[[Matrix, np.random.Generator], Matrix] | None = field(default=None)
    """From noise to noise, (n, axes)."""


@final
@dataclass(frozen=True, eq=False)
class HiddenDevice:
    """A device with hidden effects; answers commands as `Device` does."""

    device: Device
    effects: tuple[Hidden, ...]
    shot: Shot
    steps: int = STEPS

    def response(self, command: Command, time: ArrayLike, *, exposure: float = 0.0) -> Matrix:
        """Responses at `time` [ms], (n, n_responses); the first axis pairs with the first drive, and so on.

        Accuracy: that of `Device.response` unless forces are changed; then see `marched`.
        """
        times, shot = np.asarray(time, dtype=float), self.shot
        offsets = np.array(self.device.offsets)
        for effect in self.effects:
            if effect.commands is not None:
                command = effect.commands(command, shot)
        factors = [effect.stretch(shot) for effect in self.effects if effect.stretch is not None]
        device = stretched(self.device, float(np.prod(factors)))
        exposure += sum(effect.exposure for effect in self.effects)
        lags = [effect.lag for effect in self.effects if effect.lag > 0]
        wanted = times
        if any(effect.turns for effect in self.effects):
            begins = acting(command, shot)
            wanted = np.union1d(times, begins[(times[0] <= begins) & (begins <= times[-1])])
        at = wanted
        if lags:  # a lag is integrated between the samples
            inner = wanted[:-1, None] + np.diff(wanted)[:, None] * np.arange(_FINE) / _FINE
            at = np.append(inner.ravel(), wanted[-1])
        y = device.response(command, at, exposure=exposure) - offsets
        balances = [effect.balance for effect in self.effects if effect.balance is not None]
        if balances:
            period = float(np.min(np.diff(times)))
            direct, crossed = _parted(device)
            y = crossed.response(command, at) - offsets
            y += bent(direct, command, at, period / self.steps, balances, shot)
        for lag in lags:
            y = _lagging(at, y, lag)
        if lags:
            y = y[::_FINE]
        for effect in self.effects:
            if effect.seen is not None:
                y = effect.seen(y, wanted, command, shot)
        return np.asarray(y[np.searchsorted(wanted, times)] + offsets)


def acting(command: Command, shot: Shot) -> Vector:
    """When changes of the command begin to act on the direct paths [ms]."""
    return np.asarray(command.times + shot.delay)


def stretched(device: Device, factor: float) -> Device:
    """The device with every time constant multiplied."""
    if factor == 1.0:
        return device

    def slower(path: TransferPath) -> TransferPath:
        etas = tuple(eta * factor**order for eta, order in zip(path.etas, path.orders, strict=True))
        return replace(path, etas=etas)

    return replace(device, paths=tuple(tuple(map(slower, row)) for row in device.paths))


def _parted(device: Device) -> tuple[list[TransferPath], Device]:
    """Direct paths, and the device without them."""
    direct = [row[i] for i, row in enumerate(device.paths)]
    rows = tuple(
        tuple(replace(path, gain=0.0) if i == j else path for j, path in enumerate(row))
        for i, row in enumerate(device.paths)
    )
    return direct, replace(device, paths=rows)


def bent(
    paths: Sequence[TransferPath],
    command: Command,
    times: Vector,
    step: float,
    balances: Sequence[Callable[[Shot, float], Balance]],
    shot: Shot,
) -> Matrix:
    """Deflections of direct paths under changed forces at `times`, (n, axes); see `marched`."""
    first = min([*(command.times + min(path.delay for path in paths)), float(times[-1])])
    start = times[0] + step * np.floor((first - times[0]) / step - 1.0)
    edges = start + step * np.arange(int(np.ceil((times[-1] - start) / step + 1e-6)) + 3)
    gains = np.array([path.steady for path in paths])
    moved = command.values - command.rest
    means = [step_means(edges, command.times + path.delay, moved[:, i]) for i, path in enumerate(paths)]
    rest = gains * command.rest
    forces = [make(shot, step) for make in balances]

    def balance(f: Vector, y: Vector, rate: Vector, number: int) -> Vector:
        for force in forces:
            f = force(f, y, rate, number)
        return f

    level = rest
    for _ in range(400):  # at rest the force that acts holds the deflection
        level = 0.5 * (level + balance(rest, level, np.zeros_like(level), -1))
    elements = tuple(path.normalised(Normalisation.STIFFNESS) for path in paths)
    force = rest[:, None] + gains[:, None] * np.stack(means)
    y = marched(elements, force, balance, level, step)
    table = CubicSpline(edges, np.concatenate((level[:, None], y), axis=1), axis=1)
    out = np.where(times[:, None] <= start, level, table(np.maximum(times, start)).T)
    return np.asarray(out)


def _lagging(at: Vector, y: Matrix, lag: float) -> Matrix:
    """First-order lag of a signal that is linear between `at` and has always had its first value."""
    out = np.empty_like(y)
    out[0] = y[0]
    for k, gap in enumerate(np.diff(at)):
        fade = np.exp(-gap / lag)
        slope = (y[k + 1] - y[k]) / gap
        out[k + 1] = y[k + 1] - lag * slope + (out[k] - y[k] + lag * slope) * fade
    return out
