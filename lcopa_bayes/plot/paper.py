"""Figures of the evidence on the paper's claims, and of its models over records (Figs. 13 to 17)."""

from __future__ import annotations

from collections.abc import Mapping
from math import pi
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.model.literature import Stated
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
from lcopa_bayes.paper.steptable import KINDS
from lcopa_bayes.plot.optics import draw_laws
from lcopa_bayes.plot.theme import (
    BAND,
    CYCLE,
    HELD_OUT,
    NOISE,
    SEEN,
    STEADY,
    blank,
    draw_line,
    label,
    legend_above,
    plain,
)

_SHOWN = 100.0
"""Time of the long panel [ms]."""


def steady_figure(stated: Stated) -> Figure:
    """Steady state and settling of the step of Fig. 13."""
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
    return figure


def crosstalk_figure(stated: Stated) -> Figure:
    """Crosstalk gains, and both axes driven."""
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
    return figure


def delays_figure(stated: Stated) -> Figure:
    """Bias of a delay held at whole blocks."""
    figure = blank(2.3)
    panel = figure.subplots()
    for k, (cost, colour) in enumerate(zip(delay_costs(stated), (CYCLE[0], CYCLE[1]), strict=True)):
        at = np.arange(len(cost.shifts)) + 0.36 * (k - 0.5)
        sizes = [abs(shift) for shift in cost.shifts.values()]
        panel.bar(at, sizes, 0.36, color=colour, label=f"{cost.delay:g} held at {cost.rounded:g} ms")
    panel.set_xticks(range(len(cost.shifts)), [name.replace("_", " ") for name in cost.shifts])
    panel.set(ylabel="shift [sd]", ylim=(None, panel.get_ylim()[1] * 1.25))
    panel.legend(loc="upper left", ncols=2)
    return figure


def tilt_law_figure(stated: Stated) -> Figure:
    """Mean tilt in both fields beside Eq. 24."""
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
    return figure


def steering_figure(stated: Stated) -> Figure:
    """Grating lobes, linearised steering, and the pitch that the measured step implies."""
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
    return figure


_COLOURS = dict(zip(KINDS, (CYCLE[0], CYCLE[1], CYCLE[2], CYCLE[3]), strict=True))


def identified_figure(entry: Mapping[str, Any], samples: pd.DataFrame, time_unit: str) -> Figure:
    """A record with the models over it, by an entry of `identify.json` and its samples."""
    figure = blank(3.9)
    top, below = figure.subplots(2, 1, sharex=True, height_ratios=[2.2, 1.0])
    time, observed = samples["time"].to_numpy(), samples["observed"].to_numpy()
    colour = HELD_OUT if entry["held_out"] else SEEN
    draw_line(top, time, observed, ".", ms=2.5, mew=0, color=colour, label="observed")
    for kind in KINDS:
        response, shade = samples[kind].to_numpy(), _COLOURS[kind]
        dashed: Any = (0, (4, 2)) if "," in kind else "-"
        draw_line(top, time, response, color=shade, ls=dashed, label=kind)
        if "," not in kind:
            draw_line(below, time, observed - response, ".", ms=2.2, mew=0, color=shade)
    if entry["printed_level"] is not None:
        top.axhline(entry["printed_level"], color=STEADY, lw=0.8, ls=(0, (4, 3)), label="steady, as printed")
    below.axhline(0, color="#b0b0b0", lw=0.6, zorder=0)
    where = f" ({entry['figure']})" if entry["figure"] else ""
    top.set_title(plain(f"{entry['record']}, {entry['axis']}{where}"), color=colour)
    top.set_ylabel(label(entry["axis"], entry["unit"]))
    below.set(ylabel=label("residual", entry["unit"]), xlabel=label("time", time_unit))
    figure.align_ylabels()
    legend_above(figure, top, 3, markerscale=2)
    return figure
