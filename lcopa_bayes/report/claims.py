"""The page of `claims`: verdicts, and figures of their evidence: step response, crosstalk, delays, tilt,
lobes, steering."""

from __future__ import annotations

from collections.abc import Mapping
from math import pi
from pathlib import Path
from typing import Any

import numpy as np

from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.model.literature import PAPER, Stated
from lcopa_bayes.optics.array import (
    implied_array,
    linearisation_error,
    paper_array,
    strongest_grating_lobe,
)
from lcopa_bayes.paper.modelclaims import (
    RECORD_LENGTH,
    SETTLING_BANDS,
    PrintedModel,
    crosstalk_rules,
    integer_rival,
)
from lcopa_bayes.paper.numericsclaims import delay_costs
from lcopa_bayes.paper.opticsclaims import FAR_WEAKER, tilt_checks
from lcopa_bayes.paper.paths import response_to
from lcopa_bayes.report.formatting import figures
from lcopa_bayes.report.optics import draw_laws
from lcopa_bayes.report.page import Drawings
from lcopa_bayes.report.theme import (
    BAND,
    CYCLE,
    HELD_OUT,
    NOISE,
    STEADY,
    Drawing,
    blank,
    legend_above,
    svg_of,
)

_SHOWN = 100.0
"""Time of the long panel [ms]."""


def drawn(folder: Path, values: Mapping[str, Any]) -> Drawings:
    """A title and a figure for each family of claims."""
    stated = PAPER
    rival, costs = integer_rival(stated), delay_costs(stated)
    shown = (
        (
            "M2, M3: steady state and settling",
            "steady",
            _steady,
            "The step of Fig. 13 through Eq. 65, over a record and beyond it, with 2 and 5 % bands "
            "about the value it tends to; the integer-order model closest to it over the record "
            f"(RMSE {figures(rival.rmse)} rad); the measured steady value.",
        ),
        (
            "X1 to X3: crosstalk and two axes",
            "crosstalk",
            _crosstalk,
            "Left: b / k of the coupling paths against the printed crosstalk gains. Middle: y over x "
            "with x driven, at rest and at the end of the record, against the measured ratio. Right: "
            "steady values of both axes driven together.",
        ),
        (
            "N2: delays in whole blocks",
            "delay",
            _delays,
            "Shift of the other parameters when the delay is held at the nearest camera period, for "
            f"the printed delay of {figures(costs[0].delay, 4)} ms and for the worst delay, "
            f"{figures(costs[1].delay, 4)} ms.",
        ),
        (
            "S1: tilt law",
            "tilt",
            _tilt,
            "Mean tilt in a uniform and a self-consistent field, and Eq. 24; right: about the knee.",
        ),
        (
            "S2 to S4: lobes, linearised steering, geometry",
            "steering",
            _steering,
            "Left: strongest grating lobe over the main lobe. Middle: size of the error of Eq. 26, "
            "and the steady-state error the paper claims. Right: angle by Eq. 5 for the pitch of "
            "Section 2 and for the pitch that the measured step implies.",
        ),
    )
    families = [(title, Drawing(f"claim_{stem}", draw(stated), said)) for title, stem, draw, said in shown]
    return {"verdict": None, "claims": families}


def _steady(stated: Stated) -> str:
    model, rival, given = PrintedModel(stated), integer_rival(stated), stated.records
    steady = model.steady(given.step_drive, 0.0)[0]
    figure = blank(3.2)
    near, far = figure.subplots(1, 2, sharey=True)
    for panel, end in ((near, RECORD_LENGTH), (far, _SHOWN)):
        at = (model.times > 0) & (model.times <= end)
        times = model.times[at]
        for band, shade in zip(sorted(SETTLING_BANDS, reverse=True), (0.15, 0.3), strict=True):
            panel.axhspan(
                steady * (1 - band),
                steady * (1 + band),
                color=BAND,
                alpha=shade,
                lw=0,
                label=f"within {band:.0%}",
            )
        panel.plot(times, model.step_on[at], color=BAND, label="Eq. 65")
        drive = AxisDrive(np.zeros(1), np.full(1, given.step_drive))
        integer = response_to(drive, rival.model, times)
        panel.plot(times, integer, color=CYCLE[1], ls=(0, (4, 2)), label="closest integer order")
        panel.axhline(
            given.measured.steady, color=STEADY, lw=0.8, ls=(0, (1, 1.5)), label="measured steady value"
        )
        panel.axvline(given.fractional.settling, color=NOISE, lw=0.8, label="settling as printed")
        panel.set(xlabel="time [ms]", xlim=(0, end))
    near.set(ylabel="x [rad]", ylim=(0.8 * steady, 1.06 * steady))
    legend_above(figure, near, 3)
    return svg_of(figure)


def _crosstalk(stated: Stated) -> str:
    model, given = PrintedModel(stated), stated.records
    figure = blank(2.9)
    gains, ratio, both = figure.subplots(1, 3)
    wide = 0.38
    gains.bar(np.arange(2) - wide / 2, crosstalk_rules(stated)["b / k"], wide, color=BAND, label="Eq. 65")
    gains.bar(np.arange(2) + wide / 2, given.crosstalk_gains, wide, color=STEADY, label="printed")
    gains.set_xticks([0, 1], ["x to y", "y to x"])
    gains.set_ylabel("crosstalk gain [rad/rad]")
    drive = given.single_axis_drive
    values = [y / x for x, y in (model.steady(drive, 0.0), model.at_end(drive, 0.0))]
    ratio.bar([0, 1], values, 0.6, color=BAND)
    ratio.bar([2], [given.crosstalk_measured], 0.6, color=STEADY)
    ratio.set_xticks([0, 1, 2], ["at rest", f"{RECORD_LENGTH:g} ms", "stated"])
    ratio.set_ylabel("y over x, x driven [-]")
    readings = (
        model.steady(*given.two_axis_drive),
        model.at_end(*given.two_axis_drive),
        given.two_axis_steady,
    )
    for k, (values_, colour) in enumerate(zip(readings, (BAND, CYCLE[4], STEADY), strict=True)):
        name = ("at rest", f"{RECORD_LENGTH:g} ms", "stated")[k]
        both.bar(np.arange(2) + 0.27 * (k - 1), values_, 0.27, color=colour, label=name)
    both.set_xticks([0, 1], ["x", "y"])
    both.set_ylabel("both driven [rad]")
    for panel in (gains, both):
        panel.set_ylim(top=panel.get_ylim()[1] * 1.25)
        panel.legend(loc="upper right" if panel is both else "upper left")
    return svg_of(figure)


def _delays(stated: Stated) -> str:
    figure = blank(2.3)
    panel = figure.subplots()
    for k, (cost, colour) in enumerate(zip(delay_costs(stated), (CYCLE[0], CYCLE[1]), strict=True)):
        at = np.arange(len(cost.shifts)) + 0.36 * (k - 0.5)
        sizes = [abs(shift) for shift in cost.shifts.values()]
        panel.bar(at, sizes, 0.36, color=colour, label=f"{cost.delay:g} held at {cost.rounded:g} ms")
    panel.set_xticks(range(len(cost.shifts)), [name.replace("_", " ") for name in cost.shifts])
    panel.set(ylabel="shift [sd]", ylim=(None, panel.get_ylim()[1] * 1.25))
    panel.legend(loc="upper left", ncols=2)
    return svg_of(figure)


def _tilt(stated: Stated) -> str:
    optics = stated.optics
    figure = blank(3.0)
    whole, knee = figure.subplots(1, 2, width_ratios=[2, 1])
    for panel in (whole, knee):
        for check, colour in zip(tilt_checks(optics), (CYCLE[0], CYCLE[4]), strict=True):
            panel.plot(
                check.curve.voltage, check.curve.mean, color=colour, label=f"{check.curve.field.value} field"
            )
        draw_laws(panel, optics)
        panel.axhline(pi / 2, color=NOISE, lw=0.7, label="pi/2")
        panel.set_xlabel("voltage [V]")
    whole.set(ylabel="mean tilt [rad]", ylim=(0, 1.8))
    knee.set(xlim=(optics.knee_voltage - 0.3, optics.knee_voltage + 0.3), ylim=(1.0, 1.7))
    legend_above(figure, whole, 3)
    return svg_of(figure)


def _steering(stated: Stated) -> str:
    optics, records, implied = stated.optics, stated.records, implied_array(stated)
    figure = blank(2.9)
    lobes, error, angle = figure.subplots(1, 3)
    targets = np.linspace(0.0, max(optics.targets_1d_deg), 81)
    for fill, colour, name in ((0.0, HELD_OUT, "point elements"), (1.0, BAND, "elements as wide as d")):
        height = strongest_grating_lobe(np.radians(targets), optics, fill_factor=fill)
        lobes.plot(targets, height, color=colour, label=name)
    lobes.axhline(FAR_WEAKER, color=NOISE, lw=0.8, ls=(0, (4, 3)), label="far weaker")
    lobes.set(xlabel="steering angle [deg]", ylabel="grating lobe over main lobe [-]", ylim=(0, 1.45))
    phases = np.linspace(0.0, pi, 400)
    pitches = (
        (paper_array(optics), HELD_OUT, f"d = {optics.pitch_in_wavelengths:g} wavelengths"),
        (implied, BAND, f"d = {implied.pitch / optics.wavelength:.2f} wavelengths"),
    )
    for array, colour, name in pitches:
        error.semilogy(phases, np.abs(linearisation_error(array, phases)), color=colour, label=name)
        angle.plot(phases, array.steering_angle(phases), color=colour, label=name)
    error.axhline(records.steady_state_error, color=NOISE, lw=0.8, ls=(0, (4, 3)), label="claimed error")
    error.set(ylabel="error of Eq. 26 [-]", ylim=(1e-6, 2.0))
    angle.plot(records.step_drive, records.measured.steady, "o", ms=4, color=STEADY, label="measured")
    angle.set(ylabel="angle [rad]", ylim=(0, 0.65))
    for panel in (error, angle):
        panel.set_xlabel("phase step [rad]")
    for panel in (lobes, error, angle):
        panel.legend(loc="upper left", fontsize=6.5)
    return svg_of(figure)
