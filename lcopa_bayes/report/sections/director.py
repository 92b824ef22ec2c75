"""The liquid crystal cell: tilt profiles (Fig. 10), mean tilt against Eq. 24 (Fig. 11), volts to angle."""

from __future__ import annotations

import numpy as np

from lcopa_bayes.optics.tiltlaw import continuous_law, printed_law
from lcopa_bayes.paper.staticoptics import StaticOptics
from lcopa_bayes.report.formatting import NONE, figures
from lcopa_bayes.report.section import Column, Drawing, Section, Table
from lcopa_bayes.report.theme import CYCLE, HELD_OUT, STEADY, blank, svg_of

_LAWS = {"printed": "as printed", "continuous": "continuous", "best": "best of this form"}


def sections(calculated: StaticOptics) -> list[Section]:
    """Director, tilt law and steering chain."""
    plan = calculated.plan
    text = (
        "Tilt counts from the plates; the director lies in one plane and varies across the cell only "
        f"(Eq. 20). Field: {plan.field}; pretilt {figures(plan.pretilt)} rad. Threshold "
        f"pi sqrt(k1 / deps) = {figures(calculated.check.threshold, 4)} V."
    )
    director = Section(
        "Director",
        (text,),
        (
            Drawing("director", _profiles(calculated), "Tilt across the cell at several voltages (Fig. 10)."),
            Drawing(
                "tilt_voltage",
                _curve(calculated),
                "Spatial mean of the solved tilt against voltage, beside Eq. 24 as printed and with its "
                "upper branch counted from the knee (Fig. 11). No tilt exceeds pi/2.",
            ),
        ),
        (_tilts(calculated), _fits(calculated)),
    )
    chain = Section(
        "From volts to angle",
        (
            "The printed lower branch: mean tilt by Eq. 24, phase step by Eq. 23, angle by Eq. 5 and, "
            "linearised, by Eq. 26; as far as the beam propagates.",
        ),
        (Drawing("steering_chain", _chain(calculated), "Tilt, phase step, angle and error of Eq. 26."),),
    )
    return [director, chain]


def _profiles(calculated: StaticOptics) -> str:
    figure = blank(2.8)
    panel = figure.subplots()
    for profile, colour in zip(calculated.profiles, CYCLE * len(calculated.profiles), strict=False):
        panel.plot(profile.position, profile.tilt, color=colour, label=f"{profile.voltage:g} V")
    panel.axhline(np.pi / 2, color="#b0b0b0", lw=0.7, ls=(0, (4, 3)))
    panel.set_xlabel("position, fraction of the cell [-]")
    panel.set_ylabel("tilt [rad]")
    panel.set_xlim(0, 1)
    panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return svg_of(figure)


def _curve(calculated: StaticOptics) -> str:
    optics, curve = calculated.plan.optics, calculated.check.curve
    figure = blank(3.0)
    panel = figure.subplots()
    panel.plot(curve.voltage, curve.mean, color=CYCLE[0], label="solved")
    knee = optics.knee_voltage
    parts = (np.linspace(0, np.nextafter(knee, 0), 50), np.linspace(knee, optics.largest_voltage, 50))
    for law, colour, name, style in (
        (printed_law(optics), STEADY, "Eq. 24 as printed", "-"),
        (continuous_law(optics), CYCLE[2], "Eq. 24, continuous", (0, (4, 2))),
    ):
        for k, part in enumerate(parts):
            panel.plot(part, law(part), color=colour, ls=style, label=name if k == 0 else None)
    panel.axhline(np.pi / 2, color="#b0b0b0", lw=0.7)
    panel.annotate("pi/2", (0.02, np.pi / 2), va="bottom", fontsize=7.5)
    panel.set_xlabel("voltage [V]")
    panel.set_ylabel("mean tilt [rad]")
    panel.set_xlim(0, optics.largest_voltage)
    panel.set_ylim(bottom=0)
    panel.legend(loc="lower right")
    return svg_of(figure)


def _chain(calculated: StaticOptics) -> str:
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
    return svg_of(figure)


def _tilts(calculated: StaticOptics) -> Table:
    columns = (
        *(Column("voltage [V]", "number"), Column("mean tilt [rad]", "number")),
        *(Column("largest tilt [rad]", "number"), Column("Eq. 24 as printed [rad]", "number")),
        Column("Eq. 24, continuous [rad]", "number"),
    )
    rows = tuple(tuple(figures(value, 4) for value in row.values()) for row in calculated.values["mean_tilt"])
    return Table(columns, rows)


def _fits(calculated: StaticOptics) -> Table:
    columns = (
        *(Column("range"), Column("from [V]", "number"), Column("to [V]", "number"), Column("law")),
        *(Column("R²", "number"), Column("largest error [rad]", "number")),
        Column("largest relative error", "number"),
    )
    rows = []
    for entry in calculated.values["tilt_law"]:
        for law, said in _LAWS.items():
            fit, ends = entry[law], (figures(entry["from_V"]), figures(entry["to_V"]))
            relative = fit["largest_relative_error"]
            rows.append(
                (
                    *(entry["range"], *ends, said),
                    *(figures(fit["r_squared"], 4), figures(fit["largest_error_rad"])),
                    NONE if relative is None else f"{100 * relative:.3g} %",
                )
            )
    caption = (
        "A dash: below the threshold the solved tilt is zero and the law is not. Stated: R² above "
        f"{figures(calculated.plan.optics.tilt_fit_r_squared)}, error below "
        f"{100 * calculated.plan.optics.tilt_fit_error:.2g} %."
    )
    return Table(columns, tuple(rows), caption)
