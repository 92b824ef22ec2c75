"""Hidden effects in the plant, drawn at realistic sizes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lcopa_bayes.bench.command import Command
from lcopa_bayes.bench.driveeffects import by_axis, signed, unsigned
from lcopa_bayes.bench.hiddeneffects import Balance, Hidden, Shot
from lcopa_bayes.core.arrays import Array, Matrix, Vector


def pointwise(curve: Callable[[Vector, Vector, Vector, Shot], Vector]) -> Callable[[Shot, float], Balance]:
    """Balance from (force, deflection, rate, shot)."""

    def balance(shot: Shot, step: float) -> Balance:
        return lambda f, y, rate, number: curve(f, y, rate, shot)

    return balance


def cubic_stiffness(rng: np.random.Generator) -> Hidden:
    """Restoring force with a cubic part."""
    c = signed(0.02, 0.3, rng)
    force = pointwise(lambda f, y, rate, shot: f - c * y**3 / shot.deflection**2)
    return Hidden("cubic_stiffness", {"c": c}, balance=force)


def rise_fall_asymmetry(rng: np.random.Generator) -> Hidden:
    """Slower on the return."""
    e = unsigned(0.08, 0.8, rng)

    def force(f: Vector, y: Vector, rate: Vector, shot: Shot) -> Vector:
        return np.where(y * rate < 0, y + (f - y) / (1 + e), f)

    return Hidden("rise_fall_asymmetry", {"e": e}, balance=pointwise(force))


def level_dependent_speed(rng: np.random.Generator) -> Hidden:
    """Faster at large deflection."""
    e = unsigned(0.04, 0.3, rng)

    def force(f: Vector, y: Vector, rate: Vector, shot: Shot) -> Vector:
        return np.asarray(y + (f - y) / (1 + e * (1 - 2 * np.abs(y) / shot.deflection)))

    return Hidden("level_dependent_speed", {"e": e}, balance=pointwise(force))


def overflow(rng: np.random.Generator) -> Hidden:
    """Loss as a square root, and a spill above a level."""
    s, k, level = unsigned(0.05, 0.4, rng), unsigned(0.1, 1.0, rng), float(rng.uniform(0.6, 0.9))

    def force(f: Vector, y: Vector, rate: Vector, shot: Shot) -> Vector:
        size = shot.deflection
        loss = np.sign(y) * size * (np.sqrt(1 + 2 * s * np.abs(y) / size) - 1) / s
        return np.asarray(f + y - loss - k * np.sign(y) * np.maximum(np.abs(y) - level * size, 0))

    return Hidden("overflow", {"s": s, "k": k, "level": level}, balance=pointwise(force))


def viscosity_drift(rng: np.random.Generator) -> Hidden:
    """Time constants that change through the campaign."""
    d = signed(0.02, 0.15, rng)
    return Hidden("viscosity_drift", {"d": d}, stretch=lambda shot: 1 + d * shot.epoch)


def beside(
    shape: Callable[[Array], Array], *, gains: Matrix | None = None, only_falls: bool = False, static: bool
) -> Callable[[Matrix, Vector, Command, Shot], Matrix]:
    """Adds ``gain_ij sum jump_j shape(t - t_k - delay)``; default gains: one on each axis' own drive.

    Gains are in deflection over drive range; `static` adds what the resting drive leaves.
    """

    def seen(y: Matrix, times: Vector, command: Command, shot: Shot) -> Matrix:
        table = np.eye(y.shape[1]) if gains is None else gains
        out = y.copy()
        instants, jumps = by_axis(command)
        for j, (at, sizes) in enumerate(zip(instants, jumps, strict=True)):
            new = command.at(at)[:, j]
            kept = np.abs(new) < np.abs(new - sizes) if only_falls else np.ones(at.size, dtype=bool)
            lags = times[:, None] - at[kept] - shot.delay
            moved = np.where(lags > 0, shape(np.maximum(lags, 0.0)), 0.0) @ sizes[kept]
            moved += command.rest[j] if static else 0.0
            out += np.outer(moved / shot.drive[j], table[:, j] * shot.deflection)
        return out

    return seen


def ion_creep(rng: np.random.Generator) -> Hidden:
    """Slow further deflection."""
    k, time = signed(0.01, 0.06, rng), unsigned(20.0, 300.0, rng)
    grow = beside(lambda t: k * (1 - np.exp(-t / time)), static=False)
    return Hidden("ion_creep", {"k": k, "time": time}, seen=grow)


def backflow(rng: np.random.Generator) -> Hidden:
    """A kick when the drive falls."""
    k, time = signed(0.03, 0.2, rng), float(rng.uniform(0.4, 2.0))
    kick = beside(lambda t: k * (t / time) ** 2 / 2 * np.exp(-t / time), only_falls=True, static=False)
    return Hidden("backflow", {"k": k, "time": time}, seen=kick)


def extra_mode(rng: np.random.Generator) -> Hidden:
    """A lightly damped resonance."""
    k, frequency, damping = signed(0.01, 0.06, rng), unsigned(0.1, 0.6, rng), unsigned(0.02, 0.1, rng)
    pole = 2 * np.pi * frequency * complex(-damping, np.sqrt(1 - damping**2))

    def step(t: Array) -> Array:  # residues at 0 and at the two poles
        return np.asarray(k * (1 + (np.exp(pole * t) * pole.conjugate() / (1j * pole.imag)).real))

    grow = beside(step, static=True)
    return Hidden("extra_mode", {"k": k, "frequency": frequency, "damping": damping}, seen=grow)


def missing_cross_path(rng: np.random.Generator) -> Hidden:
    """A coupling of the axes with dynamics of its own."""
    k, time = (signed(0.01, 0.05, rng), signed(0.01, 0.05, rng)), unsigned(6.0, 40.0, rng)
    gains = np.array([[0.0, k[0]], [k[1], 0.0]])
    grow = beside(lambda t: 1 - np.exp(-t / time), gains=gains, static=True)
    return Hidden("missing_cross_path", {"k_xy": k[0], "k_yx": k[1], "time": time}, seen=grow)
