"""Bode plots: gain and phase of every path over frequency."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.section import Section, paged
from lcopa_bayes.report.theme import BAND, grid, label, log_ticks, plain, svg_of
from lcopa_bayes.results.bands import POINTWISE, SIMULTANEOUS

_PER_FIGURE = 4
"""Paths on one figure."""


def section(run: SavedRun) -> Section:
    """Gain and phase with their bands."""
    table = run.tables["frequency_response"]
    paths = list(dict.fromkeys(table["path"]))
    caption = (
        f"Gain and phase of each path: median, {POINTWISE} 50 and 90 % bands, and the {SIMULTANEOUS} "
        "90 % band (dashed), which holds the whole curve. From one cycle in the longest fit record to one in "
        "two sampling periods."
    )
    drawings = paged("frequency", paths, _PER_FIGURE, lambda part: _drawn(run, table, part), caption)
    return Section("Frequency response", drawings=drawings)


def _drawn(run: SavedRun, table: pd.DataFrame, paths: Sequence[str]) -> str:
    figure, panels = grid(2 * len(paths), columns=2, height=2.0)
    for number, path in enumerate(paths):
        rows = table[table["path"] == path]
        gain, phase = panels[2 * number], panels[2 * number + 1]
        for panel, name in ((gain, "gain"), (phase, "phase")):
            _curve(panel, rows, name)
            panel.set_xscale("log")
            panel.set_xlabel(f"frequency [cycles per {plain(run.time_unit)}]")
        positive = (rows[f"gain_{POINTWISE}_05"] > 0).all()
        if positive:
            gain.set_yscale("log")
            log_ticks(gain.yaxis, *gain.get_ylim())
        gain.set_title(plain(path), loc="left")
        gain.set_ylabel(label("gain", rows["unit"].iloc[0]))
        phase.set_ylabel("phase [deg]")
        low = float(np.floor(rows[f"phase_{POINTWISE}_05"].min() / 90) * 90)
        if low >= -720:
            phase.set_yticks(np.arange(low, 1, 90))
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    return svg_of(figure)


def _curve(panel: Axes, rows: pd.DataFrame, name: str) -> None:
    x = rows["frequency"].to_numpy()
    for low, high, alpha, text in (("05", "95", 0.30, "90 %"), ("25", "75", 0.45, "50 %")):
        lower, upper = (rows[f"{name}_{POINTWISE}_{end}"].to_numpy() for end in (low, high))
        panel.fill_between(x, lower, upper, color=BAND, alpha=alpha, lw=0, label=f"{text} {POINTWISE}")
    for end in ("05", "95"):
        text = f"90 % {SIMULTANEOUS}" if end == "05" else "_"
        edge = rows[f"{name}_{SIMULTANEOUS}_{end}"].to_numpy()
        panel.plot(x, edge, color=BAND, lw=0.7, ls=(0, (4, 3)), label=text)
    panel.plot(x, rows[f"{name}_{POINTWISE}_50"].to_numpy(), color=BAND, label="median")
