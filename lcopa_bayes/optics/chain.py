"""The static chain from voltage to tilt, phase and angle, exact and linearised; the numbers of S3 and S4."""

from __future__ import annotations

from dataclasses import dataclass
from math import asin, isfinite, pi, sin
from typing import final

import numpy as np
from numpy.typing import ArrayLike

from lcopa_bayes.core.arrays import Array
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.model.literature import PAPER, Stated, StatedOptics
from lcopa_bayes.optics.array import LinearArray, paper_array
from lcopa_bayes.optics.checks import finite, unless_positive


@final
@dataclass(frozen=True)
class StaticChain:
    """``th_mean = s u`` (Ta et al. 2026, Eq. 24), ``dphi = K u`` (23), angle by the steering law (5, 26).

    Voltages [V] lie in ``[0, voltage_limit)``, the lower branch of Eq. 24; phase and tilt follow. Each method
    takes any shape and raises InputError outside that range, or beyond end-fire.
    """

    array: LinearArray
    phase_per_volt: float
    """K [rad/V]."""
    tilt_per_volt: float
    """s [rad/V]."""
    voltage_limit: float
    """End of the branch, not part of it [V]."""

    def __post_init__(self) -> None:
        problems = unless_positive("phase_per_volt", self.phase_per_volt, "rad/V")
        problems += unless_positive("tilt_per_volt", self.tilt_per_volt, "rad/V")
        problems += unless_positive("voltage_limit", self.voltage_limit, "volts")
        if problems:
            raise InputError(problems)

    def tilt(self, voltage: ArrayLike) -> Array:
        """Mean tilt [rad] at each `voltage` [V], lower branch of Eq. 24."""
        return self.tilt_per_volt * self._volts(voltage)

    def phase(self, voltage: ArrayLike) -> Array:
        """Phase step [rad] at each `voltage` [V], Eq. 23."""
        return self.phase_per_volt * self._volts(voltage)

    def phase_of_tilt(self, tilt: ArrayLike) -> Array:
        """Phase step [rad] at each mean `tilt` [rad], ``(K / s) th_mean`` (Eq. 25)."""
        return self.phase(finite(tilt, name="tilt", unit="rad") / self.tilt_per_volt)

    def angle(self, voltage: ArrayLike) -> Array:
        """Deflection [rad] at each `voltage` [V], exact: ``arcsin(lambda K u / (2 pi d))`` (Eqs. 5, 23)."""
        return self.array.steering_angle(self.phase(voltage))

    def angle_linearised(self, voltage: ArrayLike) -> Array:
        """Deflection [rad] at each `voltage` [V], ``arcsin(lambda / (2 pi d)) K u`` (Eq. 26)."""
        return linearised_angle(self.array, self.phase(voltage))

    def voltage(self, angle: ArrayLike) -> Array:
        """Voltage [V] that deflects to `angle` [rad]; inverse of `angle`."""
        return self._volts(self.array.phase_step(angle) / self.phase_per_volt)

    def voltage_linearised(self, angle: ArrayLike) -> Array:
        """Voltage [V] that by Eq. 26 deflects to `angle` [rad]; inverse of `angle_linearised`."""
        phase = finite(angle, name="angle", unit="rad") / _gain(self.array)
        return self._volts(phase / self.phase_per_volt)

    def _volts(self, voltage: ArrayLike) -> Array:
        volts = finite(voltage, name="voltage", lower=0.0, upper=self.voltage_limit, unit="V")
        if (volts >= self.voltage_limit).any():
            raise InputError(f"voltages must stay below {self.voltage_limit:.6g} V, where this branch ends.")
        return volts


def paper_chain(optics: StatedOptics = PAPER.optics, *, array: LinearArray | None = None) -> StaticChain:
    """Chain of Section 3.2 on `array`, by default that of Section 2; numbers from `optics`."""
    on = paper_array(optics) if array is None else array
    return StaticChain(on, optics.phase_per_volt, optics.tilt_slope_low, optics.knee_voltage)


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


@final
@dataclass(frozen=True)
class LinearisationRow:
    """Largest relative error of linearised steering over ``|dphi| <= phase_limit`` (claim S3)."""

    pitch: float
    """d [m]."""
    phase_limit: float
    """[rad]."""
    angle: float
    """Exact deflection at the limit [rad]."""
    at_rest: float
    """Signed relative error as dphi tends to 0 [-]."""
    at_limit: float
    """Signed relative error at the limit [-]."""
    largest: float
    """Largest size over the range [-]."""
    largest_angle_error: float
    """Largest size of the error in angle over the range [rad]."""


def linearisation_row(array: LinearArray, phase_limit: float, *, points: int = 2001) -> LinearisationRow:
    """Linearised against exact steering of `array` for phases up to `phase_limit` [rad] (claim S3).

    The relative error is largest at an end of the range and exact; the error in angle is taken from `points`
    phases, the ends included.
    """
    if not (isfinite(phase_limit) and phase_limit > 0):
        raise InputError(f"`phase_limit` must be a positive number of radians; got {phase_limit!r}.")
    ends = linearisation_error(array, [0.0, phase_limit])
    phases = np.linspace(0.0, phase_limit, points)
    gap = linearised_angle(array, phases) - array.steering_angle(phases)
    return LinearisationRow(
        array.pitch,
        phase_limit,
        float(array.steering_angle(phase_limit)),
        float(ends[0]),
        float(ends[1]),
        float(np.abs(ends).max()),
        float(np.abs(gap).max()),
    )


def linearisation_table(stated: Stated = PAPER) -> tuple[LinearisationRow, ...]:
    """Claim S3: the pitch of Section 2 and the pitch the experiment implies, each over the ranges in use.

    Ranges: the step pi/2 of Figs. 13-15, the largest phase pi of Section 3.2, and, for the pitch of
    Section 2, the phases that steer to each printed target of Fig. 3 but the normal. Numbers from `stated`.
    """
    simulated = paper_array(stated.optics)
    pitch = geometry_check(stated).implied_pitch
    measured = LinearArray(stated.optics.elements, pitch, stated.optics.wavelength)
    steps = (stated.records.step_drive, pi)
    rows = [linearisation_row(array, limit) for array in (simulated, measured) for limit in steps]
    targets = [float(np.radians(goal)) for goal in stated.optics.targets_1d_deg if goal > 0]
    rows += [linearisation_row(simulated, float(simulated.phase_step(goal))) for goal in targets]
    return tuple(rows)


@final
@dataclass(frozen=True)
class GeometryCheck:
    """Whether one pitch agrees with both the simulation and the experiment (claim S4)."""

    step: float
    """Phase step of the experiment [rad]."""
    measured_angle: float
    """Steady deflection measured at that step [rad]."""
    simulated_pitch: float
    """d of Section 2 [m]."""
    simulated_angle: float
    """Deflection Eq. 5 gives with that pitch [rad]."""
    simulated_angle_linearised: float
    """Deflection Eq. 26 gives with that pitch [rad]."""
    implied_pitch: float
    """Pitch for which Eq. 5 gives the measured angle [m]."""
    implied_pitch_linearised: float
    """Pitch for which Eq. 26 gives the measured angle [m]."""
    implied_pitch_in_wavelengths: float
    """[-]."""
    pitch_ratio: float
    """Implied over simulated pitch [-]; 1 if one geometry agrees with both."""
    angle_ratio: float
    """Simulated over measured angle [-]; 1 if one geometry agrees with both."""
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
    reached = float(simulated.steering_angle(step))
    return GeometryCheck(
        step,
        angle,
        simulated.pitch,
        reached,
        float(linearised_angle(simulated, step)),
        implied,
        optics.wavelength / (2 * pi * sin(angle / step)),
        implied / optics.wavelength,
        implied / simulated.pitch,
        reached / angle,
        optics.element_width,
        float(wide.steering_angle(step)),
    )


def _gain(array: LinearArray) -> float:
    """``arcsin(lambda / (2 pi d))`` [rad of deflection per rad of phase]."""
    return float(array.steering_angle(1.0))
