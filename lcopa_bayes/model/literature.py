"""The numbers printed in Ta et al. 2026, Fractal Fract. 10(7), 499, doi 10.3390/fractalfract10070499.

One frozen table: a claim is tested against these fields, and a copy with another number
(`dataclasses.replace`) gives another verdict. Nothing here is computed or corrected.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import pi
from typing import final

from lcopa_bayes.model.path import TransferPath

_DELAY = 3.027
"""Of every path [ms]; printed as seconds, yet the whole record is about 25 ms long."""
_XX = TransferPath(0.100008, _DELAY, etas=(16.02, 12.51, 1.0), orders=(1.8, 0.9, 0.6), stiffness=5.57)
_XY = TransferPath(0.005228, _DELAY, etas=(7.3076, 6.9062), orders=(1.8, 0.9), stiffness=2.82)
_YX, _YY = replace(_XY, gain=0.003235), replace(_XX, gain=0.100001)


@final
@dataclass(frozen=True)
class StatedPlant:
    """The identified 2 x 2 model, Eq. 65, in milliseconds and radians; the first letter is the output."""

    xx: TransferPath = _XX
    xy: TransferPath = _XY
    yx: TransferPath = _YX
    yy: TransferPath = _YY

    @property
    def paths(self) -> tuple[tuple[TransferPath, ...], ...]:
        """The four paths, ``[output][drive]``."""
        return ((self.xx, self.xy), (self.yx, self.yy))


@final
@dataclass(frozen=True)
class StatedOptics:
    """Array and liquid crystal, Sections 2, 3.2 and 5.1."""

    wavelength: float = 1064e-9
    """lambda [m]."""
    pitch_in_wavelengths: float = 1.2
    """d / lambda [-], the simulations of Section 2."""
    elements: int = 32
    """N = M [-]."""
    targets_1d_deg: tuple[float, ...] = (0.0, 5.0, 10.0, 15.0, 20.0)
    """Steering angles of Fig. 3 [deg]; the text gives the range 0 to 20."""
    target_2d_deg: tuple[float, float] = (20.0, 10.0)
    """Polar and azimuthal steering angle of Fig. 5b [deg]."""
    k1: float = 11.1e-12
    """Splay constant [N]."""
    k3: float = 17.1e-12
    """Bend constant [N]."""
    permittivity: float = 4.6e-11
    """eps, perpendicular to the director [F/m]."""
    permittivity_anisotropy: float = 1.2e-10
    """deps [F/m]."""
    tilt_slope_low: float = 0.4019
    """Mean tilt per volt below the knee, Eq. 24 [rad/V]."""
    tilt_slope_high: float = 0.095215
    """Mean tilt per volt above the knee, Eq. 24 [rad/V]."""
    tilt_intercept_high: float = 1.2058
    """Mean tilt at the start of the upper branch, Eq. 24 [rad]."""
    knee_voltage: float = 3.0
    """Where Eq. 24 changes branch [V]."""
    largest_voltage: float = 5.0
    """End of the range of Eq. 24 [V]."""
    phase_per_volt: float = 1.257
    """K of Eq. 23 [rad/V]."""
    charge: float = 1.6e-19
    """q of Eq. 21 [C]."""
    element_width: float = 9.8e-6
    """x of Eq. 21 [m]."""
    tilt_fit_r_squared: float = 0.995
    """Claimed lower bound of R^2 of Eq. 24 [-]."""
    tilt_fit_error: float = 0.012
    """Claimed upper bound of the relative error of Eq. 24 [-]."""


@final
@dataclass(frozen=True)
class StepMetrics:
    """A row of Table 1."""

    rise: float
    """[ms]."""
    settling: float
    """"Stabilisation" time [ms]."""
    steady: float
    """[rad]."""
    peak: float
    """[rad]."""
    overshoot: float
    """[-], of the steady value."""


@final
@dataclass(frozen=True)
class StatedRecords:
    """What Section 5 says was measured and how well the models fitted."""

    measured: StepMetrics = StepMetrics(4.0, 10.0, 0.0272, 0.0273, 0.0)
    """Table 1, measured."""
    fractional: StepMetrics = StepMetrics(4.0, 10.0, 0.0272, 0.0273, 0.0)
    """Table 1, fractional-order model."""
    integer: StepMetrics = StepMetrics(4.0, 12.0, 0.0272, 0.0280, 0.03)
    """Table 1, integer-order model."""
    step_drive: float = pi / 2
    """Drive of Figs. 13 and 14 [rad]."""
    fractional_rmse: float = 0.00018
    """Figs. 13, 14 and 16 [rad]."""
    fractional_rmse_two_axes: float = 0.00020
    """Fig. 17 [rad]."""
    integer_rmse: float = 0.0011
    """Lower bound given for the integer-order model [rad]."""
    steady_state_error: float = 0.0015
    """Upper bound given for the relative steady-state error [-]."""
    single_axis_drive: float = pi / 4
    """Drive of Fig. 16 [rad]."""
    single_axis_ideal: float = 0.0136
    """Ideal x response of Fig. 16 [rad]."""
    crosstalk_measured: float = 0.083
    """Response of y over that of x when x alone is driven [-]."""
    crosstalk_gains: tuple[float, float] = (0.00115, 0.00185)
    """Crosstalk gains said to follow from Eq. 65 [-]."""
    two_axis_drive: tuple[float, float] = (pi / 3, pi / 5)
    """Drives of Fig. 17, x and y [rad]."""
    two_axis_steady: tuple[float, float] = (0.0184, 0.0124)
    """Measured steady responses of Fig. 17 [rad]."""
    refresh_rate: float = 1.0
    """Drive refresh [kHz]."""
    camera_rate: float = 10.0
    """Camera [kHz]."""
    dominant_order: float = 1.8
    """Claimed dominant order [-]."""


@final
@dataclass(frozen=True)
class Stated:
    """Everything printed that this package uses or tests."""

    plant: StatedPlant = field(default_factory=StatedPlant)
    optics: StatedOptics = field(default_factory=StatedOptics)
    records: StatedRecords = field(default_factory=StatedRecords)


PAPER = Stated()
