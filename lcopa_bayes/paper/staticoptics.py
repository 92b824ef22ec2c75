"""The verb `optics`: Section 2 and 3.2 of Ta et al. 2026 for a given array and cell (Figs. 3, 5, 10, 11)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from math import pi
from typing import Any, final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.estimate import plain
from lcopa_bayes.optics.cell import Field
from lcopa_bayes.optics.director import Profile, equilibrium
from lcopa_bayes.optics.farfield import LinearPatterns, PlanarPattern, planar_patterns, steered_patterns
from lcopa_bayes.optics.lobes import LobeRow, lobe_table, main_lobe, side_lobe_level
from lcopa_bayes.optics.steering import linearisation_error, linearised_angle
from lcopa_bayes.optics.tiltlaw import RANGES, TiltLawCheck, continuous_law, printed_law, tilt_law_check
from lcopa_bayes.paper.opticsplan import OpticsPlan

_CHAIN_POINTS = 241


@final
@dataclass(frozen=True)
class Steered:
    """The array steered to one target."""

    target: float
    """[rad]."""
    phase_step: float
    """[rad]."""
    main_lobe: float
    """Angle of the maximum of the pattern [rad]."""
    side_lobe: float
    """Largest relative intensity away from every lobe [-]; NaN when there is none."""


@final
@dataclass(frozen=True, eq=False)
class ChainCurves:
    """Voltage to tilt, phase and angle over the lower branch of Eq. 24, as far as the beam propagates."""

    voltage: Vector
    """(n,) [V]."""
    tilt: Vector
    """By Eq. 24 [rad]."""
    phase: Vector
    """By Eq. 23 [rad]."""
    angle: Vector
    """By Eq. 5, exact [rad]."""
    linearised: Vector
    """By Eq. 26 [rad]."""
    relative_error: Vector
    """Linearised over exact - 1 [-]."""


@final
@dataclass(frozen=True, eq=False)
class StaticOptics:
    """All results that the verb reports and draws."""

    plan: OpticsPlan
    check: TiltLawCheck
    profiles: tuple[Profile, ...]
    """One per voltage of the plan."""
    patterns: LinearPatterns
    planar: tuple[PlanarPattern, ...]
    steered: tuple[Steered, ...]
    lobes: tuple[LobeRow, ...]
    chain: ChainCurves

    @property
    def laws(self) -> Matrix:
        """Eq. 24 as printed and its continuous reading at the voltages of the plan, (2, n) [rad]."""
        optics = self.plan.optics
        return np.array([law(self.plan.voltages) for law in (printed_law(optics), continuous_law(optics))])

    @property
    def verdict(self) -> str:
        """Threshold and strongest grating lobe in a sentence."""
        aside = [row for row in self.lobes if row.order]
        best = max(aside, key=lambda row: row.with_element, default=None)
        said = (
            "no grating lobe propagates"
            if best is None
            else f"the strongest grating lobe has {best.with_element:.2g} of the main lobe, steered to "
            f"{np.degrees(best.target):.3g} deg"
        )
        return f"The director tilts above {self.check.threshold:.4f} V; {said}."

    def as_json(self) -> dict[str, Any]:
        """Plain values; every number says its unit in its name or beside it."""
        optics, chain = self.plan.optics, self.chain
        fits = zip(RANGES, self.check.printed, self.check.continuous, self.check.best, strict=True)
        fields: dict[str, Any] = plain(
            {
                "plan": asdict(self.plan),
                "verdict": self.verdict,
                "array": {
                    "elements": optics.elements,
                    "pitch_m": optics.pitch_in_wavelengths * optics.wavelength,
                    "wavelength_m": optics.wavelength,
                    "fill_factor": self.plan.fill_factor,
                },
                "field": self.plan.field,
                "pretilt_rad": self.plan.pretilt,
                "threshold_voltage": {"value": self.check.threshold, "unit": "V"},
                "mean_tilt": [
                    {
                        "voltage_V": profile.voltage,
                        "tilt_rad": profile.mean,
                        "largest_tilt_rad": profile.largest,
                        "printed_law_rad": printed,
                        "continuous_law_rad": continuous,
                    }
                    for profile, printed, continuous in zip(self.profiles, *self.laws, strict=True)
                ],
                "tilt_law": [
                    {
                        "range": name,
                        "from_V": a.lower,
                        "to_V": a.upper,
                        **{
                            law: {
                                "r_squared": fit.r_squared,
                                "largest_relative_error": fit.largest_relative_error,
                                "largest_error_rad": fit.largest_error,
                            }
                            for law, fit in (("printed", a), ("continuous", b), ("best", c))
                        },
                    }
                    for name, a, b, c in fits
                ],
                "steering": [
                    {
                        "target_deg": np.degrees(each.target),
                        "phase_step_rad": each.phase_step,
                        "main_lobe_deg": np.degrees(each.main_lobe),
                        "side_lobe": each.side_lobe,
                    }
                    for each in self.steered
                ],
                "grating_lobes": [
                    {
                        "target_deg": np.degrees(row.target),
                        "order": row.order,
                        "angle_deg": np.degrees(row.angle),
                        "isotropic": row.isotropic,
                        "with_element": row.with_element,
                    }
                    for row in self.lobes
                ],
                "chain": [
                    {
                        "voltage_V": chain.voltage[k],
                        "tilt_rad": chain.tilt[k],
                        "phase_rad": chain.phase[k],
                        "angle_rad": chain.angle[k],
                        "angle_linearised_rad": chain.linearised[k],
                    }
                    for k in range(0, chain.voltage.size, (_CHAIN_POINTS - 1) // 12)
                ],
            }
        )
        return fields


def static_optics(plan: OpticsPlan) -> StaticOptics:
    """Solve and evaluate everything; errors as in the optics modules."""
    optics, array = plan.optics, plan.array
    targets = np.radians(optics.targets_1d_deg)
    steered = []
    for target in targets:
        step = float(array.phase_step(target))
        lobe, side = main_lobe(array, step), side_lobe_level(array, step)
        steered.append(Steered(float(target), step, lobe, side))
    return StaticOptics(
        plan,
        tilt_law_check(optics, field=Field(plan.field), pretilt=plan.pretilt),
        tuple(equilibrium(plan.cell, volt, field=Field(plan.field)) for volt in plan.voltages),
        steered_patterns(optics),
        planar_patterns(optics),
        tuple(steered),
        lobe_table(targets, optics, fill_factor=plan.fill_factor),
        _chain(plan),
    )


def _chain(plan: OpticsPlan) -> ChainCurves:
    """Up to the knee of Eq. 24, or to where the phase steers to end-fire."""
    array, optics = plan.array, plan.optics
    end = min(np.nextafter(optics.knee_voltage, 0), 2 * pi / array.period / optics.phase_per_volt)
    voltage = np.linspace(0.0, end, _CHAIN_POINTS)
    phase = optics.phase_per_volt * voltage
    return ChainCurves(
        voltage,
        optics.tilt_slope_low * voltage,
        phase,
        array.steering_angle(phase),
        linearised_angle(array, phase),
        linearisation_error(array, phase),
    )
