"""A linear array of phase elements and the law that steers it (Ta et al. 2026, Eq. 5).

Far fields of linear and square arrays in closed form (Ta et al. 2026, Eqs. 2-4, 7-12).

Directions are direction cosines, ``u = sin th cos ph`` and ``v = sin th sin ph`` (``u = sin th`` on one
axis), where a planar pattern is a product of two linear ones. The obliquity factor of Eq. 1 is omitted, as
in Eqs. 2-12; an element of finite width has a constant phase and the factor sinc^2 of a slit.

Main, grating and side lobes of a steered array, and the numbers behind claim S2.

Linearised steering (Ta et al. 2026, Eq. 26), and the geometry of the experiment: claims S3 and S4.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import asin, ceil, floor, nan, pi, sin
from typing import Annotated, final

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq, minimize_scalar
from scipy.special import spherical_jn

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.rules import POSITIVE, Rule, Ruled, is_number, whole
from lcopa_bayes.model.literature import PAPER, Stated, StatedOptics

LENGTH = Rule("a positive number of metres", POSITIVE.holds)
SHARE = Rule("a number from 0 to 1", lambda value: is_number(value) and 0 <= value <= 1)

_ROUNDING = 4 * float(np.finfo(float).eps)
"""A direction cosine beyond 1 by no more than this [-] is end-fire within rounding."""


@final
@dataclass(frozen=True)
class LinearArray(Ruled):
    """Equally spaced elements in a row; InputError for an impossible array, all problems at once."""

    elements: Annotated[int, whole(2)]
    """N [-]; one alone steers nothing."""
    pitch: Annotated[float, LENGTH]
    """d, centre to centre [m]."""
    wavelength: Annotated[float, LENGTH]
    """lambda [m]."""
    fill_factor: Annotated[float, SHARE] = 0.0
    """Width of an element over the pitch [-]; 0 is a point, which radiates isotropically."""

    @property
    def period(self) -> float:
        """Distance between lobes in direction cosine, ``lambda / d`` [-]."""
        return self.wavelength / self.pitch

    def direction_cosine(self, step: ArrayLike) -> Array:
        """``u = sin th_s = lambda dphi / (2 pi d)`` for phase steps [rad] (Ta et al. 2026, Eq. 5).

        Returns: [-], shape of `step`. Raises InputError where ``|u| > 1``: no such wave propagates.
        """
        return _propagating(self.period * np.asarray(step, dtype=float) / (2 * pi))

    def steering_angle(self, step: ArrayLike) -> Array:
        """Angle th_s [rad] of the main lobe for phase steps [rad] between neighbours, exact Eq. 5.

        Shape of `step`. Raises InputError for a phase step that steers beyond end-fire.
        """
        return np.asarray(np.arcsin(self.direction_cosine(step)))

    def phase_step(self, angle: ArrayLike) -> Array:
        """Phase step dphi [rad] that steers to `angle` [rad], ``2 pi d sin(th_s) / lambda`` (Eq. 5).

        Shape of `angle`, within [-pi/2, pi/2]. Not reduced modulo 2 pi.
        """
        return np.asarray(2 * pi * np.sin(angle) / self.period)


def paper_array(optics: StatedOptics = PAPER.optics, *, fill_factor: float = 0.0) -> LinearArray:
    """Array of Section 2: 32 elements, d = 1.2 lambda, lambda = 1064 nm.

    `optics` holds the printed numbers; `fill_factor` [-], which the paper does not give, is free.
    """
    pitch = optics.pitch_in_wavelengths * optics.wavelength
    return LinearArray(optics.elements, pitch, optics.wavelength, fill_factor)


def _propagating(u: Array | np.float64) -> Array:
    """Direction cosines [-] as given, 1 where rounding alone exceeds it; InputError beyond."""
    out = np.asarray(u)
    beyond = np.abs(out) > 1 + _ROUNDING
    if beyond.any():
        raise InputError(
            f"the phase step steers to direction cosine {float(out[beyond].flat[0]):.6g}, beyond +-1: "
            "no such wave propagates; use a smaller phase step or a larger pitch."
        )
    return np.where(np.abs(out) > 1, np.sign(out), out)


def array_factor(array: LinearArray, u: ArrayLike, step: float) -> Array:
    """``sin(N psi/2) / (N sin(psi/2))`` with ``psi = dphi - k d u`` (Ta et al. 2026, Eq. 4).

    `array`; `u` [-] in [-1, 1], any shape; `step` dphi [rad]. Real, signed, exactly +-1 where psi is a
    multiple of 2 pi. The sum of Eq. 3 with ``phi_n = n dphi`` is this times ``exp(j (N-1) psi / 2)``.
    Absolute accuracy about ``elements * 1e-16 * (1 + k d)``, also next to a lobe.
    """
    return _dirichlet(step - 2 * pi / array.period * np.asarray(u, dtype=float), array.elements)


def element_factor(array: LinearArray, u: ArrayLike) -> Array:
    """Intensity ``sinc^2(w u / lambda)`` [-] of one element of `array`, a slit of width ``w = fill_factor
    d``.

    Shape of `u` [-]; 1 at ``u = 0``.
    """
    return np.asarray(np.sinc(array.fill_factor / array.period * np.asarray(u, dtype=float)) ** 2)


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


@final
@dataclass(frozen=True)
class LinearPatterns:
    """Patterns of one linear array steered to several targets: the data of Fig. 3."""

    angle: Vector
    """th, (n,) [rad]."""
    target: Vector
    """th_s, (m,) [rad]."""
    intensity: Matrix
    """(m, n) [-], 1 at each target."""


@final
@dataclass(frozen=True)
class PlanarPattern:
    """Pattern of a square array: the data of one panel of Fig. 5."""

    axis: Vector
    """Direction cosines ``sin th cos ph`` and ``sin th sin ph``, (n,) [-]."""
    target: tuple[float, float]
    """Polar angle and azimuth [rad]."""
    intensity: Matrix
    """(n, n) [-], 1 at the target, NaN outside the unit circle."""


def steered_patterns(optics: StatedOptics = PAPER.optics) -> LinearPatterns:
    """Data of Fig. 3: the array of Section 2 with isotropic elements, steered to each printed target.

    `optics` holds the printed numbers; 4001 angles [rad] from -pi/2 to pi/2.
    """
    array = paper_array(optics)
    angle = np.linspace(-pi / 2, pi / 2, 4001)
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


_PER_LOBE = 16
"""Samples per lobe width ``lambda / (N d)`` [-] in a search; refinement follows."""


@final
@dataclass(frozen=True)
class Lobe:
    """A direction in which all elements add in phase."""

    order: int
    """0 for the main lobe [-]."""
    direction_cosine: float
    """``sin th_s + order lambda / d`` [-]."""
    angle: float
    """[rad]."""
    intensity: float
    """Relative to the main lobe [-]: exactly 1 for isotropic elements; may exceed 1."""


def lobes(array: LinearArray, step: float) -> tuple[Lobe, ...]:
    """Every propagating lobe, by ascending order, of `array` with phase `step` [rad].

    ``u_m = sin th_s + m lambda / d`` with ``|u_m| <= 1`` (the zeros of the denominator of Ta et al. 2026,
    Eq. 4), which does not depend on the element factor; the intensity is that factor over its value at
    the main lobe. Isotropic elements give lobes of equal height. Errors as in `farfield.intensity`.
    """
    start, period = float(array.direction_cosine(step)), array.period
    intensity(array, start, step)  # refuses a main lobe on a zero of the element factor
    edge = 1 + 1e-12  # a lobe at grazing emergence counts despite rounding
    orders = range(ceil((-edge - start) / period), floor((edge - start) / period) + 1)
    visible = []
    for order in orders:
        u = start + order * period
        u = float(np.sign(u)) if abs(u) > 1 else u
        # The array factor is 1 here by construction; evaluating it would only add its rounding.
        height = float(element_factor(array, u)) / float(element_factor(array, start)) if order else 1.0
        visible.append(Lobe(order, u, asin(u), height))
    return tuple(visible)


def main_lobe(array: LinearArray, step: float) -> float:
    """Angle [rad] of the maximum of the pattern around the steered direction, located on the pattern itself.

    For `array` and phase `step` [rad]: a grid over the half period either side of Eq. 5, then the root of the
    derivative of the field, a sum over elements; accurate to 1e-13 rad away from end-fire. Isotropic elements
    peak at the angle of Eq. 5; a slit pulls the peak towards the normal, by less than ``(lambda / (N d))^2``
    up to 20 degrees on the array of Section 2.
    """
    centre, period = float(array.direction_cosine(step)), array.period
    low, high = max(-1.0, centre - period / 2), min(1.0, centre + period / 2)
    grid = np.linspace(low, high, 2 * ceil(_PER_LOBE * array.elements * (high - low) / period / 2) + 3)
    best = int(np.argmax(intensity(array, grid, step)))
    if best in (0, grid.size - 1):  # steered to end-fire: the visible range ends on the lobe
        return asin(float(grid[best]))
    return asin(float(brentq(_slope, grid[best - 1], grid[best + 1], args=(array, step), xtol=1e-16)))


def side_lobe_level(array: LinearArray, step: float) -> float:
    """Largest intensity relative to the main lobe [-] away from every lobe of `array` at phase `step` [rad].

    Away means beyond the first nulls, ``|psi| >= 2 pi / N`` modulo 2 pi. Accuracy about 1e-10. NaN when no
    visible direction is away from the lobes: two elements have no side lobes, nor has a very small array.
    """
    width = array.period / array.elements
    grid = np.linspace(-1.0, 1.0, 2 * ceil(_PER_LOBE / width) + 3)
    mismatch = np.abs(
        np.remainder((grid - float(array.direction_cosine(step))) / array.period + 0.5, 1.0) - 0.5
    )
    level = np.where(mismatch >= 1 / array.elements, intensity(array, grid, step), -1.0)
    best = int(np.argmax(level))
    if array.elements == 2 or level[best] < 0:
        return nan
    if best in (0, grid.size - 1) or min(level[best - 1], level[best + 1]) < 0:
        return float(level[best])
    # A quadratic touch at the peak: bounded search reaches the height to rounding.
    top = minimize_scalar(
        lambda u: -float(intensity(array, u, step)),
        bounds=(grid[best - 1], grid[best + 1]),
        method="bounded",
        options={"xatol": 1e-7 * width},
    )
    return max(-float(top.fun), float(level[best]))


def strongest_grating_lobe(
    targets: Vector, optics: StatedOptics = PAPER.optics, *, fill_factor: float = 1.0
) -> Vector:
    """Largest relative intensity [-] of any lobe but the main one, (n,), at `targets` (n,) [rad].

    Array of `optics`; 0 where no grating lobe propagates; `fill_factor` 0 gives isotropic elements. Serves
    claim S2.
    """
    array = paper_array(optics, fill_factor=fill_factor)
    visible = [lobes(array, float(array.phase_step(goal))) for goal in targets]
    return np.array([max((lobe.intensity for lobe in row if lobe.order), default=0.0) for row in visible])


def _slope(u: float, array: LinearArray, step: float) -> float:
    """Derivative of the field with respect to u [-]; odd about an isotropic lobe without cancellation."""
    number = np.arange(array.elements) - (array.elements - 1) / 2
    psi = step - 2 * pi / array.period * u
    factor, slope = (
        np.cos(number * psi).mean(),
        2 * pi / array.period * (number * np.sin(number * psi)).mean(),
    )
    width = array.fill_factor / array.period
    return float(slope * np.sinc(width * u) - factor * pi * width * spherical_jn(1, pi * width * u))


def linearised_angle(array: LinearArray, step: ArrayLike) -> Array:
    """``arcsin(lambda / (2 pi d)) dphi`` [rad] of `array` per phase `step` [rad] (Ta et al. 2026, Eq. 26).

    Raises InputError when ``lambda > 2 pi d``, where the constant is not real.
    """
    return np.asarray(float(array.steering_angle(1.0)) * np.asarray(step, dtype=float))


def linearisation_error(array: LinearArray, step: ArrayLike) -> Array:
    """``linearised / exact - 1`` [-] of `array` at each phase `step` [rad]; its limit at a step of 0.

    With ``a = lambda / (2 pi d)`` it falls from ``arcsin(a) / a - 1`` at 0 through 0 at 1 rad, so over
    ``|dphi| <= L`` the largest size is at 0 or at L. Errors as in the two laws compared.
    """
    exact, linear = array.steering_angle(step), linearised_angle(array, step)
    at_rest = asin(array.period / (2 * pi)) / (array.period / (2 * pi)) - 1
    zero = exact == 0
    return np.where(zero, at_rest, linear / np.where(zero, 1.0, exact) - 1)


def largest_linearisation_error(array: LinearArray, phase_limit: float) -> float:
    """Largest size of `linearisation_error` [-] for phases up to `phase_limit` [rad] (claim S3)."""
    return float(np.abs(linearisation_error(array, [0.0, phase_limit])).max())


def implied_array(stated: Stated = PAPER) -> LinearArray:
    """The array for which Eq. 5 gives the measured angle (Table 1) at the step of the experiment."""
    optics, records = stated.optics, stated.records
    pitch = optics.wavelength * records.step_drive / (2 * pi * sin(records.measured.steady))
    return LinearArray(optics.elements, pitch, optics.wavelength)
