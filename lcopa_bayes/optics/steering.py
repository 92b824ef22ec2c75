"""Linearised steering (Ta et al. 2026, Eq. 26), and the geometry of the experiment: claims S3 and S4."""

from __future__ import annotations

from dataclasses import dataclass
from math import asin, isfinite, pi, sin

import numpy as np
from numpy.typing import ArrayLike

from lcopa_bayes.core.arrays import Array
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.model.literature import PAPER, Stated
from lcopa_bayes.optics.array import LinearArray, paper_array
from lcopa_bayes.optics.checks import finite


def linearised_angle(array: LinearArray, step: ArrayLike) -> Array:
    """``arcsin(lambda / (2 pi d)) dphi`` [rad] of `array` per phase `step` [rad] (Ta et al. 2026, Eq. 26).

    Raises InputError when ``lambda > 2 pi d``, where the constant is not real.
    """
    return np.asarray(_gain(array) * finite(step, name="step", unit="rad"))


def linearisation_error(array: LinearArray, step: ArrayLike) -> Array:
    """``linearised / exact - 1`` [-] of `array` at each phase `step` [rad]; its limit at a step of 0.

    With ``a = lambda / (2 pi d)`` it falls from ``arcsin(a) / a - 1`` at 0 through 0 at 1 rad, so over
    ``|dphi| <= L`` the largest size is at 0 or at L. Errors as in the two laws compared.
    """
    phase = finite(step, name="step", unit="rad")
    exact, linear = array.steering_angle(phase), linearised_angle(array, phase)
    at_rest = asin(array.period / (2 * pi)) / (array.period / (2 * pi)) - 1
    zero = exact == 0
    return np.where(zero, at_rest, linear / np.where(zero, 1.0, exact) - 1)


def largest_linearisation_error(array: LinearArray, phase_limit: float) -> float:
    """Largest size of `linearisation_error` [-] for phases up to `phase_limit` [rad] (claim S3)."""
    if not (isfinite(phase_limit) and phase_limit > 0):
        raise InputError(f"`phase_limit` must be a positive number of radians; got {phase_limit!r}.")
    return float(np.abs(linearisation_error(array, [0.0, phase_limit])).max())


@dataclass(frozen=True)
class GeometryCheck:
    """Whether one pitch agrees with both the simulation and the experiment (claim S4)."""

    step: float
    """Phase step of the experiment [rad]."""
    measured_angle: float
    """Steady deflection measured at that step [rad]."""
    simulated_angle: float
    """Deflection Eq. 5 gives with that pitch [rad]."""
    implied_pitch: float
    """Pitch for which Eq. 5 gives the measured angle [m]."""
    implied_pitch_in_wavelengths: float
    """[-]."""
    pitch_ratio: float
    """Implied over simulated pitch [-]; 1 if one geometry agrees with both."""
    element_width: float
    """x of Eq. 21 [m]."""
    angle_at_element_width: float
    """Deflection Eq. 5 gives with a pitch of one element width [rad]."""


def geometry_check(stated: Stated = PAPER) -> GeometryCheck:
    """Claim S4: pitch implied by the measured step (Table 1), pitch of Section 2 and width of Eq. 21.

    All numbers come from `stated`.
    """
    optics, step, angle = stated.optics, stated.records.step_drive, stated.records.measured.steady
    simulated = paper_array(optics)
    implied = optics.wavelength * step / (2 * pi * sin(angle))
    wide = LinearArray(optics.elements, optics.element_width, optics.wavelength)
    return GeometryCheck(
        step,
        angle,
        simulated_angle=float(simulated.steering_angle(step)),
        implied_pitch=implied,
        implied_pitch_in_wavelengths=implied / optics.wavelength,
        pitch_ratio=implied / simulated.pitch,
        element_width=optics.element_width,
        angle_at_element_width=float(wide.steering_angle(step)),
    )


def _gain(array: LinearArray) -> float:
    """``arcsin(lambda / (2 pi d))`` [rad of deflection per rad of phase]."""
    return float(array.steering_angle(1.0))
