"""Claims X1 to X3: what the identified gains say about crosstalk and two-axis steady values."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import permutations
from math import floor, log10

from lcopa_bayes.model.literature import Stated
from lcopa_bayes.paper.printedmodel import RECORD_LENGTH, PrintedModel
from lcopa_bayes.paper.verdict import Evidence, Kind, Verdict

PRINTED_DIGITS = 3
"""Significant digits of the crosstalk gains as printed, 0.00115 and 0.00185 [-]."""
BASIC_AGREEMENT = 0.1
"""Largest relative gap of two crosstalk ratios said to be "basically consistent" [-]: five times the misfit
of the model, whose "fitting degree" is given as 98 %."""
SETTLED_PART = 0.6
"""Part of a record after the stabilisation time of Table 1, 15 of 25 ms [-]."""


def crosstalk_gains(stated: Stated, evidence: Evidence) -> Verdict:
    """X1: which combination of the numbers of Eq. 65 gives the printed crosstalk gains.

    The claim holds when one rule, applied to both coupling paths, gives both numbers to the printed
    digits; the steady gain b / k comes first.
    """
    wanted = stated.records.crosstalk_gains
    rules = crosstalk_rules(stated)
    gaps = {name: _gap(pair, wanted) for name, pair in rules.items()}
    name = min(gaps, key=gaps.__getitem__)
    hit = [rule for rule, pair in rules.items() if _matches(pair, wanted)]
    yx, xy = rules[hit[0] if hit else name]
    how = (
        f"of {len(rules)} rules, {' and '.join(hit) if hit else 'none'} "
        f"reproduce{'s' if len(hit) == 1 or not hit else ''} {wanted[0]:g} and {wanted[1]:g} to "
        f"{PRINTED_DIGITS} digits; {hit[0] if hit else 'the closest, ' + name} gives {yx:.6f} (x to y) and "
        f"{xy:.6f} (y to x), per radian of drive phase though the text prints rad and speaks of a unit "
        "voltage. Number: largest relative gap."
    )
    return Verdict(Kind.of(bool(hit)), gaps[hit[0] if hit else name], "-", how[0].upper() + how[1:])


def crosstalk_rules(stated: Stated) -> Mapping[str, tuple[float, float]]:
    """Candidate readings of "steady-state gain of a coupling term", x to y and y to x.

    The gain alone, over its own stiffness, over that of the direct paths, relative to the direct path, and
    each of these times the drives of Figs. 13 and 16.
    """
    plant, records = stated.plant, stated.records
    coupling = ((plant.yx, plant.xx), (plant.xy, plant.yy))
    by_rule = {
        "b / k": [cross.gain / cross.stiffness for cross, _ in coupling],
        "b": [cross.gain for cross, _ in coupling],
        "b / k of the direct path": [cross.gain / direct.stiffness for cross, direct in coupling],
        "(b / k) over that of the direct path": [
            cross.gain / cross.stiffness / (direct.gain / direct.stiffness) for cross, direct in coupling
        ],
    }
    drives = {
        "": 1.0,
        " times the drive of Fig. 13": records.step_drive,
        " times the drive of Fig. 16": records.single_axis_drive,
    }
    return {
        rule + more: (factor * pair[0], factor * pair[1])
        for more, factor in drives.items()
        for rule, pair in by_rule.items()
    }


def measured_crosstalk(stated: Stated, evidence: Evidence) -> Verdict:
    """X2: the ratio of y to x when x alone is driven, at rest and at the end of the record.

    The reading closer to the measured ratio counts.
    """
    records, model = stated.records, PrintedModel(stated)
    drive = records.single_axis_drive
    ratios = [y / x for x, y in (model.steady(drive, 0.0), model.at_end(drive, 0.0))]
    nearest = min(ratios, key=lambda ratio: abs(ratio - records.crosstalk_measured))
    gap = abs(nearest / records.crosstalk_measured - 1)
    plant = stated.plant
    other = plant.xy.gain / plant.xy.stiffness / (plant.yy.gain / plant.yy.stiffness)
    how = (
        f"With x driven Eq. 65 gives y over x = {ratios[0]:.4f} at rest and {ratios[1]:.4f} after "
        f"{RECORD_LENGTH:g} ms; measured {records.crosstalk_measured:g}: {100 * gap:.0f} % apart, "
        f"agreement would be within {100 * BASIC_AGREEMENT:.0f} %. The other coupling path gives "
        f"{other:.4f}; the mean of the two, {(ratios[0] + other) / 2:.4f}, is not what Fig. 16 measures."
    )
    return Verdict(Kind.of(gap <= BASIC_AGREEMENT), nearest, "-", how)


def two_axis_steady(stated: Stated, evidence: Evidence) -> Verdict:
    """X3: steady values of both axes driven together, at rest and at the end of the record.

    A model that is off by a constant over the settled part f of a record has an RMSE of at least that
    times sqrt(f), so the stated RMSE bounds the offset. The reading that is closer counts.
    """
    records, model = stated.records, PrintedModel(stated)
    readings = (model.steady(*records.two_axis_drive), model.at_end(*records.two_axis_drive))
    gaps = [
        max(abs(a - b) for a, b in zip(reading, records.two_axis_steady, strict=True)) for reading in readings
    ]
    limit = records.fractional_rmse_two_axes / SETTLED_PART**0.5
    said = " and ".join(f"({x:.5f}, {y:.5f})" for x, y in readings)
    how = (
        f"Eq. 65 gives (x, y) = {said} rad at rest and after {RECORD_LENGTH:g} ms; measured "
        f"{records.two_axis_steady} rad. The closer reading is off by {min(gaps):.2g} rad on one axis; an "
        f"RMSE of {records.fractional_rmse_two_axes:g} rad allows {limit:.2g} rad over the settled "
        f"{100 * SETTLED_PART:.0f} % of the record."
    )
    return Verdict(Kind.of(min(gaps) <= limit), min(gaps), "rad", how)


def _gap(pair: tuple[float, float], wanted: tuple[float, float]) -> float:
    return max(abs(a / b - 1) for a, b in zip(pair, wanted, strict=True))


def _matches(pair: tuple[float, float], wanted: tuple[float, float]) -> bool:
    """Whether both numbers round to the printed ones, in either order of printing."""
    return any(
        all(_rounded(a) == _rounded(b) for a, b in zip(pair, order, strict=True))
        for order in permutations(wanted)
    )


def _rounded(value: float) -> float:
    return round(value, PRINTED_DIGITS - 1 - floor(log10(abs(value)))) if value else 0.0
