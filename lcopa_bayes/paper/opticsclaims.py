"""Claims S1 to S4: tilt law, lobes, linearised steering, one geometry."""

from __future__ import annotations

from functools import lru_cache
from math import pi

import numpy as np

from lcopa_bayes.model.literature import PAPER, Stated, StatedOptics
from lcopa_bayes.optics.array import (
    LinearArray,
    implied_array,
    largest_linearisation_error,
    paper_array,
    strongest_grating_lobe,
)
from lcopa_bayes.optics.director import Field
from lcopa_bayes.optics.tiltlaw import TiltLawCheck, tilt_law_check
from lcopa_bayes.paper.verdict import Evidence, Kind, Verdict

PHYSICAL_JUMP = 0.5
"""Part of the law's jump that the solved tilt must show over 2 mV about the knee to be physical [-]."""
FAR_WEAKER = 0.1
"""Relative intensity below which a lobe is far weaker than the main lobe [-]: 10 dB."""
_NOTHING = 1e-12
"""Relative intensity that is zero but for rounding [-]."""
SAME_PITCH = 0.05
"""Largest relative difference of two pitches that are one [-]; the measured angle is printed to 0.2 %."""


def tilt_law(stated: Stated, evidence: Evidence) -> Verdict:
    """S1: R^2 and largest error of Eq. 24 against the solved director, and its jump.

    Eq. 24 is read as printed and as continuous at the knee, the field as uniform and as self-consistent;
    errors count where the director is tilted. The best reading counts; the jump is that of Eq. 24 as
    printed.
    """
    optics = stated.optics
    checks = tilt_checks(optics)
    fits = [fit for check in checks for fit in (check.printed, check.continuous)]
    best = max(fits, key=lambda fit: fit[0].r_squared)
    close, above = (min(fit[k].largest_relative_error for fit in fits) for k in (3, 2))
    printed = max(check.printed[0].r_squared for check in checks)
    attainable = max(check.best[0].r_squared for check in checks)
    jump, solved = checks[0].printed_jump, max(check.solved_change for check in checks)
    physical = abs(jump) <= abs(solved) or solved >= PHYSICAL_JUMP * jump
    fitted = best[0].r_squared > optics.tilt_fit_r_squared and close < optics.tilt_fit_error
    top = checks[0].largest_printed_tilt
    how = (
        f"Over 0 to {optics.largest_voltage:g} V Eq. 24 has R^2 = {printed:.3f} as printed and "
        f"{best[0].r_squared:.3f} in its best reading (stated above {optics.tilt_fit_r_squared:g}; the best "
        f"law of this form reaches {attainable:.3f}). Its largest error in its best reading is "
        f"{100 * close:.0f} % of the tilt over all voltages above the threshold of {checks[0].threshold:.3f} "
        f"V and {100 * above:.1f} % from {optics.knee_voltage:g} V on (stated below "
        f"{100 * optics.tilt_fit_error:g} %). Its "
        f"jump of {jump:.3f} rad at {optics.knee_voltage:g} V compares with a solved change of {solved:.1e} "
        f"rad over 2 mV; at {optics.largest_voltage:g} V it says {top:.3f} rad, and no tilt exceeds "
        f"{pi / 2:.3f} rad."
    )
    return Verdict(Kind.of(fitted and physical), best[0].r_squared, "-", how)


@lru_cache(maxsize=8)
def tilt_checks(optics: StatedOptics = PAPER.optics) -> tuple[TiltLawCheck, TiltLawCheck]:
    """Eq. 24 against the director in a uniform and in a self-consistent field."""
    return tilt_law_check(optics), tilt_law_check(optics, field=Field.SELF_CONSISTENT)


def grating_lobes(stated: Stated, evidence: Evidence) -> Verdict:
    """S2: the strongest grating lobe over the targets of Fig. 3.

    The element, which the paper does not give, is bracketed: isotropic as in Eqs. 2 to 4, and a slit as
    wide as the pitch, which suppresses lobes most. Undecided when the two disagree.
    """
    targets = np.radians(stated.optics.targets_1d_deg)
    points, slits = (strongest_grating_lobe(targets, stated.optics, fill_factor=fill) for fill in (0.0, 1.0))
    weak = [float(heights.max()) < FAR_WEAKER for heights in (points, slits)]
    kind = Kind.of(weak[0]) if weak[0] == weak[1] else Kind.UNDECIDED
    each = ", ".join(
        f"{height:.2g} at {target:g} deg" if height > _NOTHING else f"0 at {target:g} deg"
        for height, target in zip(slits, stated.optics.targets_1d_deg, strict=True)
    )
    how = (
        f"With the isotropic elements of Eqs. 2 to 4 the strongest grating lobe is {points.max():.3g} of the "
        f"main lobe; with elements as wide as the pitch, which suppress it most, {each}. Far weaker would be "
        f"below {FAR_WEAKER:g}. Number: the largest with the widest elements."
    )
    return Verdict(kind, float(slits.max()), "-", how)


def linearised_steering(stated: Stated, evidence: Evidence) -> Verdict:
    """S3: relative error of Eq. 26 over the drives of the experiment, for the geometry it implies.

    Eq. 26 enters the dynamic model only, so the range is that of the records; harmless means below the
    steady-state error the paper claims.
    """
    optics, records = stated.optics, stated.records
    largest = max(records.step_drive, records.single_axis_drive, *records.two_axis_drive)
    used = largest_linearisation_error(implied_array(stated), largest)
    there, beyond = (largest_linearisation_error(paper_array(optics), limit) for limit in (largest, pi))
    limit = records.steady_state_error
    how = (
        f"At the pitch the measured angle implies, Eq. 26 is off by at most {used:.1e} of the angle "
        f"for phases up to {largest:.3f} rad; harmless is below the claimed steady-state error {limit:g}. At "
        f"d = {optics.pitch_in_wavelengths:g} lambda it would be {there:.1e}, and "
        f"{beyond:.1e} up to pi."
    )
    return Verdict(Kind.of(used <= limit), used, "-", how)


def one_geometry(stated: Stated, evidence: Evidence) -> Verdict:
    """S4: the pitch that the measured step implies over the pitch of Section 2."""
    optics, step = stated.optics, stated.records.step_drive
    simulated, pitch = paper_array(optics), implied_array(stated).pitch
    wide = LinearArray(optics.elements, optics.element_width, optics.wavelength)
    ratio = pitch / simulated.pitch
    how = (
        f"By Eq. 5 {step:.4f} rad -> {stated.records.measured.steady:g} rad needs d = "
        f"{pitch / optics.wavelength:.2f} lambda = {1e6 * pitch:.2f} um, where "
        f"Section 2 has {optics.pitch_in_wavelengths:g} lambda, which would deflect by "
        f"{float(simulated.steering_angle(step)):.4f} rad; one geometry would agree within "
        f"{100 * SAME_PITCH:.0f} %. The element width of Eq. 21, {1e6 * optics.element_width:.2f} um, gives "
        f"{float(wide.steering_angle(step)):.4f} rad. Number: implied over simulated pitch."
    )
    return Verdict(Kind.of(abs(ratio - 1) <= SAME_PITCH), ratio, "-", how)
