"""Claims M2 and M3: steady state, settling and overshoot of the identified model."""

from __future__ import annotations

from lcopa_bayes.model.literature import Stated
from lcopa_bayes.paper.printedmodel import RECORD_LENGTH, SETTLING_BANDS, PrintedModel, integer_rival
from lcopa_bayes.paper.verdict import Evidence, Kind, Verdict

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
