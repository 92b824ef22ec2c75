"""The drive to measure next, and how precise parameters become with bench time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from lcopa_bayes.data.drive import Drive
from lcopa_bayes.plot.records import draw_drives
from lcopa_bayes.plot.theme import BAND, HELD_OUT, INK, blank, grid, label, plain

_CROWDED = 100
"""Changes of a drive beyond which its beginning is drawn too [-]."""
_BEGINNING = 20
"""Changes that are drawn of it [-]."""


def precision_figure(results: Mapping[str, Any]) -> Figure:
    """Expected relative sd of every parameter after the best drive and after the plain step."""
    curve = results["curve"]
    names = list(curve[0]["best"])
    figure, panels = grid(len(names), columns=3, height=1.7)
    times = np.array([row["time"] for row in curve], dtype=float)
    for panel, name in zip(panels, names, strict=True):
        for key, colour, said in (("step", HELD_OUT, "plain step"), ("best", BAND, "best drive")):
            spread = np.array([row[key][name] for row in curve], dtype=float)
            panel.plot(times, spread, color=colour, marker=".", markersize=4, label=said)
        panel.axhline(0.1, color=INK, linewidth=0.7, linestyle=":")
        panel.set(xscale="log", yscale="log")
        panel.set_title(plain(name), fontsize=7.5)
        panel.set(xlabel=label("bench time", results["time_unit"]), ylabel="relative sd [-]")
    panels[0].legend()
    return figure


def drive_figure(drive: Drive) -> Figure:
    """A drive over time, a panel for each unit; beside one of many changes its beginning."""
    frames = [
        pd.DataFrame({"axis": axis, "unit": unit or "-", "time": drive.time, "drive": values})
        for axis, unit, values in zip(drive.axes, drive.units, drive.values.T, strict=True)
    ]
    rows = pd.concat(frames)
    units = list(dict.fromkeys(rows["unit"]))
    figure = blank(0.5 + 1.3 * len(units))
    changes = drive.time[1:][np.any(np.diff(drive.drive, axis=0) != 0, axis=1)]
    ends = [float(drive.time[-1]), *([float(changes[_BEGINNING])] if changes.size > _CROWDED else [])]
    panels = figure.subplots(len(units), len(ends), sharex="col", sharey="row", squeeze=False)
    for column, end in zip(panels.T, ends, strict=True):
        for panel, unit in zip(column, units, strict=True):
            draw_drives(panel, rows[rows["unit"] == unit], unit, until=end)
        column[-1].set_xlabel(label("time", drive.time_unit or "-"))
    for panel in panels[:, 1:].flat:
        panel.set_xlim(float(drive.time[0]), ends[-1])
        panel.set_ylabel("")
    return figure
