"""Hidden effects where the deflection is read, and disturbances, drawn at realistic sizes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lcopa_bayes.bench.command import Command
from lcopa_bayes.bench.driveeffects import signed, unsigned
from lcopa_bayes.bench.hiddeneffects import Hidden, Shot, acting
from lcopa_bayes.core.arrays import Matrix, Vector

Seen = Callable[[Matrix, Vector, Command, Shot], Matrix]


def static(curve: Callable[[Matrix, Shot], Matrix]) -> Seen:
    """From deflections to deflections, at each time alone."""
    return lambda y, times, command, shot: curve(y, shot)


def odd_curvature(rng: np.random.Generator) -> Hidden:
    """Soft saturation."""
    c = signed(0.01, 0.04, rng)
    return Hidden("odd_curvature", {"c": c}, seen=static(lambda y, shot: y + c * y**3 / shot.deflection**2))


def even_curvature(rng: np.random.Generator) -> Hidden:
    """Curvature of one direction."""
    c = signed(0.01, 0.04, rng)
    return Hidden("even_curvature", {"c": c}, seen=static(lambda y, shot: y + c * y * y / shot.deflection))


def bilinear_crosstalk(rng: np.random.Generator) -> Hidden:
    """Product of the axes."""
    c = signed(0.01, 0.06, rng)

    def seen(y: Matrix, shot: Shot) -> Matrix:
        product = c * y[:, 0] * y[:, 1]
        return np.asarray(y + product[:, None] / shot.deflection[::-1])

    return Hidden("bilinear_crosstalk", {"c": c}, seen=static(seen))


def axis_rotation(rng: np.random.Generator) -> Hidden:
    """Camera at an angle."""
    phi = signed(0.01, 0.08, rng)

    def seen(y: Matrix, shot: Shot) -> Matrix:
        turned = (y[:, 0] + 1j * y[:, 1]) * np.exp(1j * phi)
        return np.stack((turned.real, turned.imag), axis=1)

    return Hidden("axis_rotation", {"phi": phi}, seen=static(seen))


def clipping(rng: np.random.Generator) -> Hidden:
    """The reading stops."""
    level = float(rng.uniform(0.75, 0.96))
    clip = static(lambda y, shot: np.clip(y, -level * shot.deflection, level * shot.deflection))
    return Hidden("clipping", {"level": level}, seen=clip)


def centroid_locking(rng: np.random.Generator) -> Hidden:
    """Drawn to the pixels."""
    a, cycles = unsigned(0.005, 0.02, rng), float(rng.uniform(3.0, 20.0))

    def seen(y: Matrix, shot: Shot) -> Matrix:
        return np.asarray(y + a * shot.deflection * np.sin(2 * np.pi * cycles * y / shot.deflection))

    return Hidden("centroid_locking", {"a": a, "cycles": cycles}, seen=static(seen))


def cross_fade(rng: np.random.Generator) -> Hidden:
    """The centroid waits between diffraction orders."""
    strength = float(rng.uniform(0.3, 1.0))

    def seen(y: Matrix, times: Vector, command: Command, shot: Shot) -> Matrix:
        begins = np.append(acting(command, shot), np.inf)
        where = np.searchsorted(times, begins).clip(max=times.size - 1)
        late = np.zeros((times.size, y.shape[1]))
        lag = np.zeros(y.shape[1])
        for k, target in enumerate(command.values @ shot.steady.T):
            origin, end = y[where[k]], y[where[k + 1], None]
            rows = (times >= begins[k]) & (times < begins[k + 1])
            for axis in range(y.shape[1]):
                change = target[axis] - origin[axis]
                late[rows, axis] = _late(y[rows, axis] - origin[axis], change, lag[axis], strength)
                lag[axis] = _late(end[:, axis] - origin[axis], change, lag[axis], strength)[0]
        return y + late

    return Hidden("cross_fade", {"strength": strength}, seen=seen, turns=True)


def _late(moved: Vector, change: float, lag: float, strength: float) -> Vector:
    """Distance of the centroid from the director after a part `moved` of the change; the initial `lag`
    decays."""
    part = np.full(moved.shape, 1.0) if change == 0 else np.minimum(np.maximum(moved / change, 0.0), 1.0)
    new, old = np.sinc(1 - part) ** 2, np.sinc(part) ** 2
    return np.asarray(lag * (1 - part) + strength * change * (new / (new + old) - part))


def sensor_lag(rng: np.random.Generator) -> Hidden:
    """Lag of the read-out."""
    lag = unsigned(0.05, 0.5, rng)
    return Hidden("sensor_lag", {"Ts": lag}, lag=lag)


def exposure(rng: np.random.Generator) -> Hidden:
    """Samples are means."""
    time = float(rng.uniform(0.03, 0.1))
    return Hidden("exposure", {"Te": time}, exposure=time)


def gain_drift(rng: np.random.Generator) -> Hidden:
    """Deflection that changes through the campaign."""
    d = signed(0.005, 0.04, rng)
    return Hidden("gain_drift", {"d": d}, seen=static(lambda y, shot: y * (1 + d * shot.epoch)))


def pointing_offset(rng: np.random.Generator) -> Hidden:
    """A shift of every record."""
    sd = unsigned(1e-4, 5e-4, rng)
    shift = static(lambda y, shot: y + sd * shot.chance.standard_normal(y.shape[1]))
    return Hidden("pointing_offset", {"sd": sd}, disturbance=True, seen=shift)


def pointing_drift(rng: np.random.Generator) -> Hidden:
    """A drift within every record."""
    sd = unsigned(1e-4, 5e-4, rng)

    def seen(y: Matrix, times: Vector, command: Command, shot: Shot) -> Matrix:
        return np.asarray(y + np.outer(times / times[-1], sd * shot.chance.standard_normal(y.shape[1])))

    return Hidden("pointing_drift", {"sd": sd}, disturbance=True, seen=seen)


def _ripple(size: float, frequency: float, *, of_deflection: bool) -> Seen:
    """A sine of random phase in every record, on every axis, or in proportion to the deflection."""

    def seen(y: Matrix, times: Vector, command: Command, shot: Shot) -> Matrix:
        phases = 2 * np.pi * shot.chance.random(1 if of_deflection else y.shape[1])
        wave = size * np.cos(2 * np.pi * frequency * times[:, None] + phases)
        return np.asarray(y + wave * (np.abs(y) if of_deflection else 1.0))

    return seen


def vibration(rng: np.random.Generator) -> Hidden:
    """The mount shakes."""
    size, frequency = unsigned(3e-5, 2e-4, rng), unsigned(0.03, 0.3, rng)
    seen = _ripple(size, frequency, of_deflection=False)
    return Hidden("vibration", {"a": size, "frequency": frequency}, disturbance=True, seen=seen)


def flicker(rng: np.random.Generator) -> Hidden:
    """The deflection ripples."""
    size, frequency = unsigned(0.003, 0.015, rng), unsigned(0.1, 0.36, rng)
    seen = _ripple(size, frequency, of_deflection=True)
    return Hidden("flicker", {"a": size, "frequency": frequency}, disturbance=True, seen=seen)


def outliers(rng: np.random.Generator) -> Hidden:
    """Some samples are far off."""
    share, times = float(rng.uniform(0.01, 0.05)), float(rng.uniform(5.0, 10.0))

    def noise(e: Matrix, chance: np.random.Generator) -> Matrix:
        return np.asarray(e * np.where(chance.random(e.shape) < share, times, 1.0))

    return Hidden("outliers", {"share": share, "times": times}, disturbance=True, noise=noise)
