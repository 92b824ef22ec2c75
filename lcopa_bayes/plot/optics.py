"""Static optics of the array: far fields, director, tilt law, steering chain."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lcopa_bayes.core.arrays import Matrix
from lcopa_bayes.model.literature import StatedOptics
from lcopa_bayes.optics.tiltlaw import continuous_law, printed_law
from lcopa_bayes.paper.staticoptics import StaticOptics
from lcopa_bayes.plot.theme import CYCLE, HELD_OUT, STEADY, blank, extremes, grid

_FLOOR = -50.0
"""Lowest intensity shown [dB]."""
_MOST = 1600
"""Points of a pattern that are drawn: its nulls are narrow."""


def _decibel(values: Matrix) -> Matrix:
    with np.errstate(divide="ignore"):
        return np.asarray(np.maximum(10 * np.log10(values), _FLOOR))


def far_field_figure(calculated: StaticOptics) -> Figure:
    """Far field of a line of elements steered to each target."""
    patterns = calculated.patterns
    figure, panels = grid(patterns.target.size, columns=1, height=1.25)
    angle = np.degrees(patterns.angle)
    for panel, target, row in zip(panels, patterns.target, patterns.intensity, strict=True):
        level = _decibel(row)
        at = extremes(level, most=_MOST)
        panel.plot(angle[at], level[at], lw=0.7)
        panel.axvline(float(np.degrees(target)), color=HELD_OUT, lw=0.8, ls=(0, (4, 3)))
        panel.set(
            title=f"{np.degrees(target):g} deg",
            ylim=(_FLOOR, 3),
            xlim=(-90, 90),
            xticks=np.arange(-90, 91, 30),
            ylabel="intensity [dB]",
        )
    panels[-1].set_xlabel("angle [deg]")
    return figure


def planar_figure(calculated: StaticOptics) -> Figure:
    """Far field of the square array in direction cosines."""
    figure = blank(3.7)
    panels = figure.subplots(1, len(calculated.planar), squeeze=False)[0]
    for panel, pattern in zip(panels, calculated.planar, strict=True):
        ends = (pattern.axis[0], pattern.axis[-1]) * 2
        shown = panel.imshow(
            _decibel(pattern.intensity).T, origin="lower", extent=ends, vmin=_FLOOR, vmax=0, cmap="viridis"
        )
        polar, azimuth = pattern.target
        panel.plot(
            np.sin(polar) * np.cos(azimuth),
            np.sin(polar) * np.sin(azimuth),
            "o",
            ms=11,
            mfc="none",
            color=HELD_OUT,
        )
        panel.set(
            title=f"polar {np.degrees(polar):g} deg, azimuth {np.degrees(azimuth):g} deg",
            xlabel="direction cosine u [-]",
            ylabel="direction cosine v [-]",
        )
    figure.colorbar(shown, ax=panels, label="intensity [dB]", shrink=0.75)
    return figure


def director_figure(calculated: StaticOptics) -> Figure:
    """Tilt across the cell at several voltages."""
    figure = blank(2.8)
    panel = figure.subplots()
    for profile, colour in zip(calculated.profiles, CYCLE * len(calculated.profiles), strict=False):
        panel.plot(profile.position, profile.tilt, color=colour, label=f"{profile.voltage:g} V")
    panel.axhline(np.pi / 2, color="#b0b0b0", lw=0.7, ls=(0, (4, 3)))
    panel.set(xlabel="position, fraction of the cell [-]", ylabel="tilt [rad]", xlim=(0, 1))
    panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def tilt_figure(calculated: StaticOptics) -> Figure:
    """Mean tilt against voltage, beside Eq. 24."""
    optics, curve = calculated.plan.optics, calculated.check.curve
    figure = blank(3.0)
    panel = figure.subplots()
    panel.plot(curve.voltage, curve.mean, color=CYCLE[0], label="solved")
    draw_laws(panel, optics)
    panel.axhline(np.pi / 2, color="#b0b0b0", lw=0.7)
    panel.annotate("pi/2", (0.02, np.pi / 2), va="bottom", fontsize=7.5)
    panel.set(xlabel="voltage [V]", ylabel="mean tilt [rad]")
    panel.set(xlim=(0, optics.largest_voltage), ylim=(0, None))
    panel.legend(loc="lower right")
    return figure


def draw_laws(panel: Axes, optics: StatedOptics) -> None:
    """Eq. 24 as printed and as continuous, each with its two straight branches."""
    for law, colour, name, style in (
        (printed_law(optics), STEADY, "Eq. 24 as printed", "-"),
        (continuous_law(optics), CYCLE[2], "Eq. 24, continuous", (0, (4, 2))),
    ):
        below = np.array([0.0, np.nextafter(optics.knee_voltage, 0)])
        above = np.array([optics.knee_voltage, optics.largest_voltage])
        panel.plot(below, law(below), color=colour, ls=style, label=name)
        panel.plot(above, law(above), color=colour, ls=style)


def chain_figure(calculated: StaticOptics) -> Figure:
    """Tilt, phase step, angle and error of Eq. 26 against voltage."""
    chain = calculated.chain
    figure = blank(4.2)
    (tilt, phase), (angle, error) = figure.subplots(2, 2, sharex=True)
    tilt.plot(chain["voltage_V"], chain["tilt_rad"])
    tilt.set_ylabel("mean tilt [rad]")
    phase.plot(chain["voltage_V"], chain["phase_rad"])
    phase.set_ylabel("phase step [rad]")
    angle.plot(chain["voltage_V"], np.degrees(chain["angle_rad"]), label="exact")
    angle.plot(
        chain["voltage_V"],
        np.degrees(chain["angle_linearised_rad"]),
        color=HELD_OUT,
        ls=(0, (4, 2)),
        label="linearised",
    )
    angle.set_ylabel("angle [deg]")
    angle.legend(loc="upper left")
    error.plot(chain["voltage_V"], 100 * chain["relative_error"], color=HELD_OUT)
    error.axhline(0, color="#b0b0b0", lw=0.6, zorder=0)
    error.set_ylabel("error of Eq. 26 [%]")
    for panel in (angle, error):
        panel.set_xlabel("voltage [V]")
    return figure
