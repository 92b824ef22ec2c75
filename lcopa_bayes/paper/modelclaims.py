"""Claims M2, M3 and X1 to X3: steady state, settling, crosstalk and two axes of the identified model.

The identified model as printed (Ta et al. 2026, Eq. 65) on the virtual bench, and its integer rival.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import permutations
from math import floor, log10
from typing import final

import numpy as np

from lcopa_bayes.bench.command import step
from lcopa_bayes.bench.device import Bench, Device, truth
from lcopa_bayes.bench.inversion import step_response
from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.model.literature import PAPER, Stated
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.paper.identify import integer_orders, output_error_fit
from lcopa_bayes.paper.intervals import Interval, Scan
from lcopa_bayes.paper.paths import output_rmse, path_data
from lcopa_bayes.paper.scan import scan
from lcopa_bayes.paper.verdict import Evidence, Kind, Verdict
from lcopa_bayes.results.steps import settling

RECORD_LENGTH = 25.0
"""Length of the paper's records [ms]: the axes of Figs. 13 to 17 end between 20 and 25 ms."""
SETTLING_BANDS = (0.02, 0.05)
"""Bands about the steady value in customary use [-]; Table 1 does not state which."""
_LONG = 40.0
"""Record lengths over which a settling time is looked for [-]."""
_POINTS = 40001


@final
@dataclass(frozen=True)
class PrintedModel:
    """The 2 x 2 model of Eq. 65 with the numbers of `stated`."""

    stated: Stated = PAPER

    @cached_property
    def device(self) -> Device:
        """The model on the virtual bench, resting at zero."""
        axes = (Axis("x", "rad"), Axis("y", "rad"))
        return Device(self.stated.plant.paths, axes, axes, (0.0, 0.0))

    def steady(self, drive_x: float, drive_y: float) -> tuple[float, float]:
        """Responses at rest under phases [rad] held for ever, ``sum_j b_ij / k_ij u_j`` [rad]."""
        x, y = self.device.paths
        return (x[0].steady * drive_x + x[1].steady * drive_y, y[0].steady * drive_x + y[1].steady * drive_y)

    def at_end(self, drive_x: float, drive_y: float) -> tuple[float, float]:
        """Responses `RECORD_LENGTH` after a step of both phases [rad], from rest [rad]."""
        response = self.device.response(step([drive_x, drive_y]), [RECORD_LENGTH])[0]
        return float(response[0]), float(response[1])

    @cached_property
    def times(self) -> Vector:
        """Times after the step [ms], 0 first, the end of the record among them."""
        return np.linspace(0.0, _LONG * RECORD_LENGTH, _POINTS)

    @cached_property
    def step_on(self) -> Vector:
        """Response of x at `times` to the step of Fig. 13 [rad]."""
        return np.asarray(self.stated.records.step_drive * step_response(self.device.paths[0][0], self.times))

    def settled(self, level: float, band: float, *, within: float) -> float:
        """Time from which the step of Fig. 13 stays within `band` [-] of `level` [rad], up to `within` [ms].

        Counted from the step [ms]; infinite if it is outside at the end.
        """
        upto = (self.times > 0) & (self.times <= within)
        curve = self.step_on[upto][None] / level
        return float(settling(self.times[upto], curve, band)[0])

    @property
    def record(self) -> Record:
        """Noise-free record of the step of Fig. 13: one drive, one response, the paper's camera."""
        single = Device(
            ((self.device.paths[0][0],),), self.device.drive_axes[:1], self.device.response_axes[:1], (0.0,)
        )
        camera = Bench(camera=1 / self.stated.records.camera_rate)
        drive = step(self.stated.records.step_drive)
        return truth(single, camera, drive, duration=RECORD_LENGTH, name="printed model")


@final
@dataclass(frozen=True)
class Rival:
    """The integer-order model that comes closest to the step response of Eq. 65."""

    model: TransferPath
    steady: float
    """Response at rest under the drive of Fig. 13 [rad]."""
    rmse: float
    """Root mean square distance to the noise-free response over the record [rad]."""


@lru_cache(maxsize=16)
def integer_rival(stated: Stated = PAPER) -> Rival:
    """Output-error fit of the element with integer orders (Section 5.2) to the noise-free record of Eq. 65.

    Orders 2, 1, 1 act as 2, 1; b, etas and a continuous delay are free.
    """
    record = PrintedModel(stated).record
    orders = integer_orders(len(stated.plant.xx.orders))
    settings = ModelSettings(terms=len(orders), orders=orders)
    study = Study("integer rival", None, "ms", 0, (record,), model=settings)
    data = path_data(study)[0]
    plan = Scan(orders=tuple(Interval(order, order) for order in orders), whole_blocks=False)
    start = scan(data.blocks, len(orders), data.span, plan).model
    model = output_error_fit(
        study, data, np.random.default_rng(0), terms=len(orders), orders=orders, start=start, starts=4
    )
    return Rival(model, model.steady * stated.records.step_drive, output_rmse(data.records, model))


TIME_ROUNDING = 0.5
"""Table 1 prints whole milliseconds: half of the last digit [ms]."""
OVERSHOOT_ROUNDING = 0.005
"""Table 1 prints whole percents of overshoot: half of the last digit [-]."""


def steady_state(stated: Stated, evidence: Evidence) -> Verdict:
    """M2: the model's steady state against the measured one, and the integer model's against the model's.

    "Steady" is read twice, as the value tended to and as the value at the end of the record; the claim
    is decided when both readings agree, and undecided otherwise. Both models must be within the
    stated error.
    """
    records, model = stated.records, PrintedModel(stated)
    tended, ended = model.steady(records.step_drive, 0.0)[0], model.at_end(records.step_drive, 0.0)[0]
    errors = [abs(value / records.measured.steady - 1) for value in (tended, ended)]
    rival = integer_rival(stated)
    # The integer model decays exponentially: it is at rest long before the record ends.
    rivals = [abs(rival.steady / value - 1) for value in (tended, ended)]
    limit = records.steady_state_error
    holds = [max(pair) < limit for pair in zip(errors, rivals, strict=True)]
    kind = Kind.of(holds[0]) if holds[0] == holds[1] else Kind.UNDECIDED
    how = (
        f"Eq. 65 tends to b u / k = {tended:.5f} rad and is at {ended:.5f} rad after {RECORD_LENGTH:g} ms; "
        f"measured {records.measured.steady:g} rad: errors {_percent(errors[0])} and {_percent(errors[1])}, "
        f"stated below {_percent(limit)}. The closest integer-order model rests at {rival.steady:.5f} rad, "
        f"{_percent(rivals[0])} from what Eq. 65 tends to and {_percent(rivals[1])} from where it is at the "
        "end. Number: the smaller error of Eq. 65."
    )
    return Verdict(kind, min(errors), "-", how)


def settling_time(stated: Stated, evidence: Evidence) -> Verdict:
    """M3: settling into 2 and 5 % of the value the response tends to, counted from the step; overshoot.

    The claim holds if one of the customary bands gives the printed time and there is no overshoot.
    """
    records, model = stated.records, PrintedModel(stated)
    steady = model.steady(records.step_drive, 0.0)[0]
    last = float(model.times[-1])
    times = [model.settled(steady, band, within=last) for band in SETTLING_BANDS]
    within = [
        min(model.settled(level, band, within=RECORD_LENGTH) for band in SETTLING_BANDS)
        for level in (model.at_end(records.step_drive, 0.0)[0], records.measured.steady)
    ]
    overshoot = float(model.step_on.max()) / steady - 1
    stated_time = records.fractional.settling
    nearest = min(times, key=lambda time: abs(time - stated_time))
    in_time = abs(nearest - stated_time) <= TIME_ROUNDING
    none = max(overshoot, 0.0) <= records.fractional.overshoot + OVERSHOOT_ROUNDING
    said = ", ".join(f"{t:.1f} ms into {b:.0%}" for t, b in zip(times, SETTLING_BANDS, strict=True))
    how = (
        f"The step of Fig. 13 through Eq. 65 settles {said} of the value it tends to; Table 1 prints "
        f"{stated_time:g} ms, accepted within {TIME_ROUNDING:g} ms. About the value at the end of the record "
        f"the shortest is {within[0]:.1f} ms, about the measured {records.measured.steady:g} rad "
        f"{within[1]:.1f} ms: the record is too short to show the slow tail. Overshoot "
        f"{_percent(max(overshoot, 0.0))}, printed {_percent(records.fractional.overshoot)}."
    )
    return Verdict(Kind.of(in_time and none), nearest, "ms", how)


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"


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
    gaps = {
        name: max(abs(a / b - 1) for a, b in zip(pair, wanted, strict=True)) for name, pair in rules.items()
    }
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


def _matches(pair: tuple[float, float], wanted: tuple[float, float]) -> bool:
    """Whether both numbers round to the printed ones, in either order of printing."""
    return any(
        all(_rounded(a) == _rounded(b) for a, b in zip(pair, order, strict=True))
        for order in permutations(wanted)
    )


def _rounded(value: float) -> float:
    return round(value, PRINTED_DIGITS - 1 - floor(log10(abs(value)))) if value else 0.0
