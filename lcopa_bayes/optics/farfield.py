"""Far fields of linear and square arrays in closed form (Ta et al. 2026, Eqs. 2-4, 7-12).

Directions are direction cosines, ``u = sin th cos ph`` and ``v = sin th sin ph`` (``u = sin th`` on one
axis), where a planar pattern is a product of two linear ones. The obliquity factor of Eq. 1 is omitted, as
in Eqs. 2-12; an element of finite width has a constant phase and the factor sinc^2 of a slit.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import ArrayLike

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.model.literature import PAPER, StatedOptics
from lcopa_bayes.optics.array import LinearArray, paper_array
from lcopa_bayes.optics.checks import finite


def array_factor(array: LinearArray, u: ArrayLike, step: float) -> Array:
    """``sin(N psi/2) / (N sin(psi/2))`` with ``psi = dphi - k d u`` (Ta et al. 2026, Eq. 4).

    `array`; `u` [-] in [-1, 1], any shape; `step` dphi [rad]. Real, signed, exactly +-1 where psi is a
    multiple of 2 pi. The sum of Eq. 3 with ``phi_n = n dphi`` is this times ``exp(j (N-1) psi / 2)``.
    Absolute accuracy about ``elements * 1e-16 * (1 + k d)``, also next to a lobe.
    """
    direction = finite(u, name="u", lower=-1.0, upper=1.0)
    psi = float(finite(step, name="step", unit="rad")) - 2 * pi / array.period * direction
    return _dirichlet(psi, array.elements)


def element_factor(array: LinearArray, u: ArrayLike) -> Array:
    """Intensity ``sinc^2(w u / lambda)`` [-] of one element of `array`, a slit of width ``w = fill_factor
    d``.

    Shape of `u` [-]; 1 at ``u = 0``.
    """
    direction = finite(u, name="u", lower=-1.0, upper=1.0)
    return np.asarray(np.sinc(array.fill_factor / array.period * direction) ** 2)


def intensity(array: LinearArray, u: ArrayLike, step: float) -> Array:
    """Far-field intensity [-] of `array`, 1 where Eq. 5 steers to; shape of `u` [-], which is ``sin th``.

    Raises InputError when `step` [rad] steers beyond end-fire or onto a zero of the element factor.
    """
    direction = array.direction_cosine(step)
    main = float(element_factor(array, direction))
    if main < 1e-12:
        raise InputError(
            f"steering to direction cosine {float(direction):.6g} is at a zero of the element factor: "
            "there is no main lobe to normalise to; use a smaller fill factor or another angle."
        )
    return np.asarray(array_factor(array, u, step) ** 2 * element_factor(array, u) / main)


@dataclass(frozen=True)
class LinearPatterns:
    """Patterns of one linear array steered to several targets: the data of Fig. 3."""

    angle: Vector
    """th, (n,) [rad]."""
    target: Vector
    """th_s, (m,) [rad]."""
    intensity: Matrix
    """(m, n) [-], 1 at each target."""


@dataclass(frozen=True)
class PlanarPattern:
    """Pattern of a square array: the data of one panel of Fig. 5."""

    axis: Vector
    """Direction cosines ``sin th cos ph`` and ``sin th sin ph``, (n,) [-]."""
    target: tuple[float, float]
    """Polar angle and azimuth [rad]."""
    intensity: Matrix
    """(n, n) [-], 1 at the target, NaN outside the unit circle."""


def steered_patterns(optics: StatedOptics = PAPER.optics, *, points: int = 4001) -> LinearPatterns:
    """Data of Fig. 3: the array of Section 2 with isotropic elements, steered to each printed target.

    `optics` holds the printed numbers; `points` angles [-] from -pi/2 to pi/2.
    """
    array = paper_array(optics)
    angle = np.linspace(-pi / 2, pi / 2, points)
    target = np.radians(optics.targets_1d_deg)
    rows = [intensity(array, np.sin(angle), float(array.phase_step(goal))) for goal in target]
    return LinearPatterns(angle, target, np.array(rows))


def planar_patterns(optics: StatedOptics = PAPER.optics, *, points: int = 801) -> tuple[PlanarPattern, ...]:
    """Data of Fig. 5a and 5b: the normal and the printed target, isotropic elements.

    `optics` holds the printed numbers; `points` direction cosines [-] per axis from -1 to 1.
    """
    axis = np.linspace(-1.0, 1.0, points)
    polar, azimuth = map(float, np.radians(optics.target_2d_deg))
    array = paper_array(optics)
    return tuple(planar_pattern(array, axis, target) for target in ((0.0, 0.0), (polar, azimuth)))


def planar_pattern(array: LinearArray, axis: Vector, target: tuple[float, float]) -> PlanarPattern:
    """Two crossed arrays steered to a polar angle and azimuth [rad] (Ta et al. 2026, Eqs. 12, 13).

    The product of two linear patterns on the grid of direction cosines `axis` (n,) [-], each steered by
    ``2 pi d sin th cos ph / lambda`` or with ``sin ph``; NaN where nothing propagates. Errors as in
    `intensity`.
    """
    polar, azimuth = target
    cosines = np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth)
    along_x, along_y = (intensity(array, axis, float(2 * pi * u / array.period)) for u in cosines)
    pattern = np.outer(along_x, along_y)
    pattern[np.add.outer(axis**2, axis**2) > 1] = np.nan
    return PlanarPattern(axis, target, pattern)


def _dirichlet(psi: Array, n: int) -> Array:
    """``sin(n psi/2) / (n sin(psi/2))``; the reduction keeps both sines consistent next to a lobe."""
    turns = np.rint(psi / (2 * pi))
    half = (psi - 2 * pi * turns) / 2
    sign = 1.0 if n % 2 else np.where(turns % 2 == 0, 1.0, -1.0)
    at_lobe = half == 0
    safe = np.where(at_lobe, 1.0, half)
    return np.asarray(sign * np.where(at_lobe, 1.0, np.sin(n * safe) / (n * np.sin(safe))))
