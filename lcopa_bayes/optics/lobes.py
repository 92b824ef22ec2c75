"""Main, grating and side lobes of a steered array, and the numbers behind claim S2."""

from __future__ import annotations

from dataclasses import dataclass
from math import asin, ceil, floor, nan, pi

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq, minimize_scalar
from scipy.special import spherical_jn

from lcopa_bayes.core.arrays import Vector, frozen
from lcopa_bayes.model.literature import PAPER, StatedOptics
from lcopa_bayes.optics.array import LinearArray, paper_array
from lcopa_bayes.optics.checks import finite
from lcopa_bayes.optics.farfield import element_factor, intensity

_PER_LOBE = 16
"""Samples per lobe width ``lambda / (N d)`` [-] in a search; refinement follows."""


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
    targets: ArrayLike, optics: StatedOptics = PAPER.optics, *, fill_factor: float = 1.0
) -> Vector:
    """Largest relative intensity [-] of any lobe but the main one, (n,), at `targets` (n,) [rad].

    Array of `optics`; 0 where no grating lobe propagates; `fill_factor` 0 gives isotropic elements. Serves
    claim S2.
    """
    array = paper_array(optics, fill_factor=fill_factor)
    goals = frozen(finite(targets, name="targets", unit="rad"), name="targets")
    visible = [lobes(array, float(array.phase_step(goal))) for goal in goals]
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
