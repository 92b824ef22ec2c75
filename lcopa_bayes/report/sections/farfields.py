"""Far fields of the array: steered patterns (Figs. 3 and 5), lobes and steering angles."""

from __future__ import annotations

import numpy as np

from lcopa_bayes.core.arrays import Matrix
from lcopa_bayes.paper.staticoptics import StaticOptics
from lcopa_bayes.report.decimation import extremes
from lcopa_bayes.report.formatting import NONE, figures
from lcopa_bayes.report.section import Column, Drawing, Section, Table
from lcopa_bayes.report.theme import HELD_OUT, blank, grid, svg_of

_FLOOR = -50.0
"""Lowest intensity shown [dB]."""
_MOST = 1600
"""Points of a pattern that are drawn: its nulls are narrow."""


def sections(calculated: StaticOptics) -> list[Section]:
    """The far field along one axis and over both."""
    optics = calculated.plan.optics
    array = (
        f"{optics.elements} elements, {figures(1e6 * optics.pitch_in_wavelengths * optics.wavelength)} µm "
        f"= {figures(optics.pitch_in_wavelengths)} wavelengths apart, wavelength "
        f"{figures(1e9 * optics.wavelength, 4)} nm."
    )
    along_axis = Section(
        "Far field along one axis",
        (array, "Intensities are relative to the main lobe; elements in the figure are isotropic."),
        (
            Drawing(
                "farfield_1d",
                _steered(calculated),
                "Far field steered to each target (Ta et al. 2026, Eq. 4, Fig. 3). Dashed: the target.",
            ),
        ),
        (_steering(calculated), _lobes(calculated)),
    )
    both = Section(
        "Far field over both axes",
        drawings=(
            Drawing(
                "farfield_2d",
                _planar(calculated),
                "Far field of the square array in direction cosines (Eq. 12, Fig. 5): along the normal and "
                "steered. Circle: the target; every other bright spot is a grating lobe.",
            ),
        ),
    )
    return [along_axis, both]


def _decibel(values: Matrix) -> Matrix:
    with np.errstate(divide="ignore"):
        return np.asarray(np.maximum(10 * np.log10(values), _FLOOR))


def _steered(calculated: StaticOptics) -> str:
    patterns = calculated.patterns
    figure, panels = grid(patterns.target.size, columns=1, height=1.25)
    angle = np.degrees(patterns.angle)
    for panel, target, row in zip(panels, patterns.target, patterns.intensity, strict=True):
        level = _decibel(row)
        at = extremes(level, most=_MOST)
        panel.plot(angle[at], level[at], lw=0.7)
        panel.axvline(float(np.degrees(target)), color=HELD_OUT, lw=0.8, ls=(0, (4, 3)))
        panel.set_title(f"{np.degrees(target):g} deg", loc="left")
        panel.set_ylim(_FLOOR, 3)
        panel.set_xlim(-90, 90)
        panel.set_xticks(np.arange(-90, 91, 30))
        panel.set_ylabel("intensity [dB]")
    panels[-1].set_xlabel("angle [deg]")
    return svg_of(figure)


def _planar(calculated: StaticOptics) -> str:
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
        panel.set_title(f"polar {np.degrees(polar):g} deg, azimuth {np.degrees(azimuth):g} deg", loc="left")
        panel.set_xlabel("direction cosine u [-]")
        panel.set_ylabel("direction cosine v [-]")
    figure.colorbar(shown, ax=panels, label="intensity [dB]", shrink=0.75)
    return svg_of(figure)


def _steering(calculated: StaticOptics) -> Table:
    columns = (
        *(Column("target [deg]", "number"), Column("phase step [rad]", "number")),
        *(Column("main lobe [deg]", "number"), Column("highest side lobe [dB]", "number")),
    )
    rows = tuple(
        (
            figures(each["target_deg"]),
            figures(each["phase_step_rad"], 4),
            figures(each["main_lobe_deg"], 5),
            NONE if each["side_lobe"] is None else figures(float(10 * np.log10(each["side_lobe"]))),
        )
        for each in calculated.values["steering"]
    )
    return Table(columns, rows, "Steering by sin(angle) = wavelength x phase step / (2 pi pitch), Eq. 5.")


def _lobes(calculated: StaticOptics) -> Table:
    fill = figures(calculated.plan.fill_factor)
    columns = (
        *(Column("target [deg]", "number"), Column("order", "number"), Column("angle [deg]", "number")),
        *(Column("isotropic", "number"), Column(f"fill factor {fill}", "number")),
    )
    rows = tuple(
        (
            figures(row["target_deg"]),
            str(row["order"]),
            figures(row["angle_deg"]),
            figures(row["isotropic"]),
            figures(row["with_element"] if row["with_element"] > 1e-12 else 0.0),
        )
        for row in calculated.values["grating_lobes"]
    )
    return Table(
        columns,
        rows,
        "All lobes; order 0 is the main lobe. Intensity relative to it, for point elements as in Eqs. 2 to 4 "
        f"and for slits that fill {fill} of the pitch.",
    )
