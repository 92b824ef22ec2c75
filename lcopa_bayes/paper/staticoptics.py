"""The verb `optics`: Section 2 and 3.2 of Ta et al. 2026 for a given array and cell (Figs. 3, 5, 10, 11).

What the verb `optics` is asked to compute: array, cell, targets and voltages.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from math import pi
from typing import Annotated, Any, final

import numpy as np
import pandas as pd

from lcopa_bayes.core.estimate import plain
from lcopa_bayes.core.rules import Rule, Ruled, is_number, whole, word_of
from lcopa_bayes.model.literature import PAPER, StatedOptics
from lcopa_bayes.optics.array import (
    LENGTH,
    SHARE,
    LinearArray,
    LinearPatterns,
    PlanarPattern,
    linearisation_error,
    linearised_angle,
    lobes,
    main_lobe,
    paper_array,
    planar_patterns,
    side_lobe_level,
    steered_patterns,
)
from lcopa_bayes.optics.director import PRETILT, Cell, Field, Profile, equilibrium, paper_cell
from lcopa_bayes.optics.tiltlaw import RANGES, TiltLawCheck, continuous_law, printed_law, tilt_law_check

_LIMIT = PAPER.optics.largest_voltage
_ANGLES = Rule(
    "angles between -90 and 90 degrees",
    lambda value: value and all(is_number(goal) and abs(goal) < 90 for goal in value),
)
_VOLTS = Rule(
    f"within the solved range, 0 to {_LIMIT:g} V: leave out the others",
    lambda value: value and all(is_number(volt) and 0 <= volt <= _LIMIT for volt in value),
)


@final
@dataclass(frozen=True)
class OpticsPlan(Ruled):
    """Array, cell and what to look at, by default the paper's; InputError, all problems at once, for what
    cannot be built."""

    elements: Annotated[int, whole(2)] = PAPER.optics.elements
    """Along an axis [-]."""
    pitch: Annotated[float | None, LENGTH] = None
    """Distance of elements [m]; None: as many wavelengths as the paper's."""
    wavelength: Annotated[float, LENGTH] = PAPER.optics.wavelength
    """[m]."""
    fill_factor: Annotated[float, SHARE] = 1.0
    """Element width over pitch [-] of the second column of the lobe table."""
    targets_deg: Annotated[tuple[float, ...], _ANGLES] = PAPER.optics.targets_1d_deg
    """Steering angles [deg]."""
    voltages: Annotated[tuple[float, ...], _VOLTS] = (1.0, 2.0, 3.0, 4.0, 5.0)
    """Increasing [V]; up to the end of Eq. 24."""
    pretilt: Annotated[float, PRETILT] = 0.0
    """Tilt at both plates [rad]."""
    field: Annotated[str, word_of(*(each.value for each in Field))] = Field.UNIFORM.value
    """How the voltage spreads over the cell, by the values of `Field`."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "targets_deg", tuple(self.targets_deg))
        object.__setattr__(self, "voltages", tuple(sorted(set(self.voltages))))
        super().__post_init__()

    def contradictions(self) -> list[str]:
        """A pitch at which Eq. 26 is not real."""
        if 2 * pi * self._pitch >= self.wavelength:
            return []
        least = f"wavelength / (2 pi) = {self.wavelength / 2 / pi:.3g} m"
        return [f"`pitch` must exceed {least}, where Eq. 26 ends; got {self._pitch:.3g} m"]

    @property
    def _pitch(self) -> float:
        return PAPER.optics.pitch_in_wavelengths * self.wavelength if self.pitch is None else self.pitch

    @property
    def optics(self) -> StatedOptics:
        """The paper's optics with the array and targets of the plan."""
        return replace(
            PAPER.optics,
            elements=self.elements,
            wavelength=self.wavelength,
            pitch_in_wavelengths=self._pitch / self.wavelength,
            targets_1d_deg=self.targets_deg,
        )

    @property
    def array(self) -> LinearArray:
        """Elements of the plan, isotropic."""
        return paper_array(self.optics)

    @property
    def cell(self) -> Cell:
        """Liquid crystal of the plan."""
        return paper_cell(self.optics, pretilt=self.pretilt)


_CHAIN_POINTS = 241


@final
@dataclass(frozen=True, eq=False)
class StaticOptics:
    """All that the verb reports and draws."""

    plan: OpticsPlan
    values: Mapping[str, Any]
    """Plain values that are reported; every number says its unit in its name or beside it."""
    check: TiltLawCheck
    profiles: tuple[Profile, ...]
    """One per voltage of the plan."""
    patterns: LinearPatterns
    planar: tuple[PlanarPattern, ...]
    chain: pd.DataFrame
    """Voltage to tilt, phase step and angle over the lower branch of Eq. 24, with the error of Eq. 26 [-]."""


def static_optics(plan: OpticsPlan) -> StaticOptics:
    """Solve and evaluate everything; errors as in the optics modules."""
    optics, field = plan.optics, Field(plan.field)
    check = tilt_law_check(optics, field=field, pretilt=plan.pretilt)
    profiles = tuple(equilibrium(plan.cell, volt, field=field) for volt in plan.voltages)
    laws = (law(plan.voltages) for law in (printed_law(optics), continuous_law(optics)))
    chain, rows = _chain(plan), lobe_rows(plan)
    fits = {"printed": check.printed, "continuous": check.continuous, "best": check.best}
    values: dict[str, Any] = {
        "plan": asdict(plan),
        "verdict": _verdict(check, rows),
        "array": {
            "elements": plan.elements,
            "pitch_m": plan.array.pitch,
            "wavelength_m": plan.wavelength,
            "fill_factor": plan.fill_factor,
        },
        "field": plan.field,
        "pretilt_rad": plan.pretilt,
        "threshold_voltage": {"value": check.threshold, "unit": "V"},
        "mean_tilt": [
            {
                "voltage_V": profile.voltage,
                "tilt_rad": profile.mean,
                "largest_tilt_rad": profile.largest,
                "printed_law_rad": printed,
                "continuous_law_rad": continuous,
            }
            for profile, printed, continuous in zip(profiles, *laws, strict=True)
        ],
        "tilt_law": [
            {
                "range": name,
                "from_V": fits["printed"][k].lower,
                "to_V": fits["printed"][k].upper,
                **{law: fit[k].as_json() for law, fit in fits.items()},
            }
            for k, name in enumerate(RANGES)
        ],
        "steering": _steering(plan),
        "grating_lobes": rows,
        "chain": chain.iloc[:: (_CHAIN_POINTS - 1) // 12, :-1].to_dict("records"),
    }
    patterns, planar = steered_patterns(optics), planar_patterns(optics)
    return StaticOptics(plan, plain(values), check, profiles, patterns, planar, chain)


def lobe_rows(plan: OpticsPlan) -> list[dict[str, float]]:
    """All lobes at every target, their intensity over the main lobe of point elements and of the plan's."""
    bare, slit = plan.array, paper_array(plan.optics, fill_factor=plan.fill_factor)
    rows = []
    for target in np.radians(plan.targets_deg):
        step = float(bare.phase_step(target))
        for point, wide in zip(lobes(bare, step), lobes(slit, step), strict=True):
            rows.append(
                {
                    "target_deg": float(np.degrees(target)),
                    "order": point.order,
                    "angle_deg": float(np.degrees(point.angle)),
                    "isotropic": point.intensity,
                    "with_element": wide.intensity,
                }
            )
    return rows


def _steering(plan: OpticsPlan) -> list[dict[str, float]]:
    """The array steered to every target; without a side lobe its height is NaN."""
    rows = []
    for target in np.radians(plan.targets_deg):
        step = float(plan.array.phase_step(target))
        rows.append(
            {
                "target_deg": float(np.degrees(target)),
                "phase_step_rad": step,
                "main_lobe_deg": float(np.degrees(main_lobe(plan.array, step))),
                "side_lobe": side_lobe_level(plan.array, step),
            }
        )
    return rows


def _chain(plan: OpticsPlan) -> pd.DataFrame:
    """Up to the knee of Eq. 24, or to where the phase steers to end-fire."""
    array, optics = plan.array, plan.optics
    end = min(np.nextafter(optics.knee_voltage, 0), 2 * pi / array.period / optics.phase_per_volt)
    voltage = np.linspace(0.0, end, _CHAIN_POINTS)
    phase = optics.phase_per_volt * voltage
    return pd.DataFrame(
        {
            "voltage_V": voltage,
            "tilt_rad": optics.tilt_slope_low * voltage,
            "phase_rad": phase,
            "angle_rad": array.steering_angle(phase),
            "angle_linearised_rad": linearised_angle(array, phase),
            "relative_error": linearisation_error(array, phase),
        }
    )


def _verdict(check: TiltLawCheck, rows: list[dict[str, float]]) -> str:
    """Threshold and strongest grating lobe in a sentence."""
    best = max((row for row in rows if row["order"]), key=lambda row: row["with_element"], default=None)
    said = (
        "no grating lobe propagates"
        if best is None
        else f"the strongest grating lobe has {best['with_element']:.2g} of the main lobe, steered to "
        f"{best['target_deg']:.3g} deg"
    )
    return f"The director tilts above {check.threshold:.4f} V; {said}."
