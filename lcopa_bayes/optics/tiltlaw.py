"""Mean tilt against voltage: the solved curve beside the law fitted in the paper; the numbers of claim S1."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, nextafter
from typing import final

import numpy as np
from numpy.typing import ArrayLike

from lcopa_bayes.core.arrays import Array, Matrix, Vector, frozen
from lcopa_bayes.model.literature import PAPER, StatedOptics
from lcopa_bayes.optics.director import CELLS, Cell, Field, equilibrium, paper_cell


@final
@dataclass(frozen=True)
class DirectorCurve:
    """Equilibria of one cell over a range of voltages: the data of Figs. 10 and 11."""

    field: Field
    voltage: Vector
    """Ascending, (m,) [V]."""
    position: Vector
    """Fraction of the cell thickness, (n,) [-]."""
    tilt: Matrix
    """(m, n) [rad], out of the plates."""
    mean: Vector
    """Spatial mean, (m,) [rad]."""


def director_curve(
    cell: Cell, voltages: ArrayLike, *, field: Field = Field.UNIFORM, cells: int = CELLS
) -> DirectorCurve:
    """`director.equilibrium` of `cell` at ascending `voltages` (m,) [V], continued from the highest down.

    Downwards the previous profile lies on the tilted branch, which the flat state below threshold would not.
    `field` and `cells` go to `equilibrium`, whose errors apply.
    """
    volts, profiles = frozen(voltages, name="voltages"), []
    guess: Vector | None = None
    for volt in volts[::-1]:
        profile = equilibrium(cell, float(volt), field=field, cells=cells, guess=guess)
        profiles.append(profile)
        guess = profile.tilt
    profiles.reverse()
    tilt = frozen([p.tilt for p in profiles], name="tilt", ndim=2)
    mean = frozen([p.mean for p in profiles], name="mean")
    return DirectorCurve(field, volts, profiles[0].position, tilt, mean)


@final
@dataclass(frozen=True)
class TiltLaw:
    """Two straight branches, ``low u`` below the knee and ``high (u - origin) + start`` from it on."""

    low: float
    """[rad/V]."""
    high: float
    """[rad/V]."""
    start: float
    """Value of the upper branch at its origin [rad]."""
    origin: float
    """Voltage from which the upper branch is counted [V]."""
    knee: float
    """First voltage of the upper branch [V]."""

    def __call__(self, voltage: ArrayLike) -> Array:
        """Mean tilt [rad] at voltages [V]."""
        u = np.asarray(voltage, dtype=float)
        return np.asarray(np.where(u < self.knee, self.low * u, self.high * (u - self.origin) + self.start))

    @property
    def jump(self) -> float:
        """Upper minus lower branch at the knee [rad]."""
        return float(self(self.knee)) - self.low * self.knee


def printed_law(optics: StatedOptics = PAPER.optics) -> TiltLaw:
    """Ta et al. 2026, Eq. 24 as printed, ``0.095215 u + 1.2058`` from 3 V on; numbers from `optics`."""
    return _law(optics, 0.0)


def continuous_law(optics: StatedOptics = PAPER.optics) -> TiltLaw:
    """Eq. 24 of `optics`, upper branch counted from the knee, ``0.095215 (u - 3) + 1.2058``: jump 1e-4
    rad."""
    return _law(optics, optics.knee_voltage)


def best_law(curve: DirectorCurve, optics: StatedOptics = PAPER.optics) -> TiltLaw:
    """Least-squares law of the form of Eq. 24 on the solved curve, each branch on its own range of `optics`.

    No other coefficients with this knee have a larger R^2 on these voltages.
    """
    u, mean = curve.voltage, curve.mean
    upper = (u >= optics.knee_voltage) & (u <= optics.largest_voltage)
    lower = u < optics.knee_voltage
    low = float(u[lower] @ mean[lower] / (u[lower] @ u[lower]))
    high, start = np.polyfit(u[upper] - optics.knee_voltage, mean[upper], 1)
    knee = optics.knee_voltage
    return TiltLaw(low=low, high=float(high), start=float(start), origin=knee, knee=knee)


@final
@dataclass(frozen=True)
class FitQuality:
    """How a law follows the solved mean tilt over a range of voltages."""

    lower: float
    """First voltage [V]."""
    upper: float
    """Last voltage [V]."""
    r_squared: float
    """1 - residual over total sum of squares [-]; negative where the mean of the curve does better."""
    largest_relative_error: float
    """Of the solved tilt [-]; infinite where that is zero and the law is not."""
    largest_error: float
    """[rad]."""

    def as_json(self) -> dict[str, float]:
        """What is reported beside the range; every number says its unit."""
        return {
            "r_squared": self.r_squared,
            "largest_relative_error": self.largest_relative_error,
            "largest_error_rad": self.largest_error,
        }


def fit_quality(curve: DirectorCurve, law: TiltLaw, lower: float, upper: float) -> FitQuality:
    """Compare `law` with `curve` at its solved voltages in ``[lower, upper]`` [V]."""
    inside = (curve.voltage >= lower) & (curve.voltage <= upper)
    solved, error = curve.mean[inside], law(curve.voltage[inside]) - curve.mean[inside]
    relative = np.full(error.shape, inf)
    np.divide(np.abs(error), solved, out=relative, where=solved > 0)
    relative[error == 0] = 0.0
    return FitQuality(
        lower=float(curve.voltage[inside][0]),
        upper=float(curve.voltage[inside][-1]),
        r_squared=1 - float(error @ error) / float(((solved - solved.mean()) ** 2).sum()),
        largest_relative_error=float(relative.max()),
        largest_error=float(np.abs(error).max()),
    )


@final
@dataclass(frozen=True)
class TiltLawCheck:
    """Numbers behind claim S1; each tuple runs over `RANGES`."""

    threshold: float
    """Freedericksz voltage [V]; below it the solved tilt is zero."""
    curve: DirectorCurve
    printed: tuple[FitQuality, ...]
    continuous: tuple[FitQuality, ...]
    best: tuple[FitQuality, ...]
    printed_jump: float
    """Of the law as printed at the knee [rad]."""
    solved_change: float
    """Change of the solved mean tilt over 2 mV about the knee [rad]; small when there is no jump."""
    largest_printed_tilt: float
    """[rad]; no mean tilt out of the plates can exceed pi/2."""


RANGES = ("whole", "lower branch", "upper branch", "tilted")
"""``[0, limit]``, ``[0, knee)``, ``[knee, limit]`` and ``(threshold, limit]`` in volts."""


def tilt_law_check(
    optics: StatedOptics = PAPER.optics,
    *,
    field: Field = Field.UNIFORM,
    pretilt: float = 0.0,
    points: int = 501,
    cells: int = CELLS,
) -> TiltLawCheck:
    """Solve the paper's cell at `points` voltages over the range of Eq. 24 and compare (claim S1, Fig. 11).

    `optics` holds the printed numbers; `pretilt` [rad] is not among them. `field` and `cells` set the
    solver. Errors as `director_curve`.
    """
    cell, knee, limit = paper_cell(optics, pretilt=pretilt), optics.knee_voltage, optics.largest_voltage
    curve = director_curve(cell, np.linspace(0.0, limit, points), field=field, cells=cells)
    spans = ((0.0, limit), (0.0, nextafter(knee, 0)), (knee, limit), (nextafter(cell.threshold, inf), limit))

    def judged(law: TiltLaw) -> tuple[FitQuality, ...]:
        return tuple(fit_quality(curve, law, *span) for span in spans)

    printed, continuous = printed_law(optics), continuous_law(optics)
    near = director_curve(cell, [knee - 1e-3, knee + 1e-3], field=field, cells=cells)
    return TiltLawCheck(
        threshold=cell.threshold,
        curve=curve,
        printed=judged(printed),
        continuous=judged(continuous),
        best=judged(best_law(curve, optics)),
        printed_jump=printed.jump,
        solved_change=float(np.diff(near.mean)[0]),
        largest_printed_tilt=float(printed(limit)),
    )


def _law(optics: StatedOptics, origin: float) -> TiltLaw:
    return TiltLaw(
        low=optics.tilt_slope_low,
        high=optics.tilt_slope_high,
        start=optics.tilt_intercept_high,
        origin=origin,
        knee=optics.knee_voltage,
    )
