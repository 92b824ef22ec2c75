"""Step and frequency responses of each path."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lcopa_bayes.plot.rundata import RunData
from lcopa_bayes.plot.theme import BAND, STEADY, draw_bands, draw_line, grid, label, legend_above, plain
from lcopa_bayes.results.bands import POINTWISE, SIMULTANEOUS


def steps_figure(run: RunData, paths: Sequence[str]) -> Figure:
    """Responses of paths to a unit step, with the steady states that they tend to."""
    curves = run.tables["step_response"]
    figure, panels = grid(len(paths), columns=2, height=2.2)
    for panel, path in zip(panels, paths, strict=True):
        rows = curves[curves["path"] == path]
        _path(panel, rows)
        panel.set(
            title=plain(path),
            ylabel=label("response", rows["unit"].iloc[0]),
            xlabel=label("time", run.time_unit),
        )
    legend_above(figure, panels[0], 4)
    return figure


def _path(panel: Axes, rows: pd.DataFrame) -> None:
    time = rows["time"].to_numpy()
    bands = (("response", "05", "95", BAND, 0.30, "90 %"), ("response", "25", "75", BAND, 0.45, "50 %"))
    draw_bands(panel, time, rows, bands)
    draw_line(panel, time, rows["response_50"].to_numpy(), color=BAND, label="median")
    for quantile, width, name in (("50", 1.1, "steady state"), ("05", 0.7, ""), ("95", 0.7, "")):
        level = float(rows[f"steady_{quantile}"].iloc[0])
        panel.axhline(level, color=STEADY, lw=width, ls=(0, (4, 3)), label=name or None)
    panel.axhline(0.0, color="#b0b0b0", lw=0.6, zorder=0)


def bode_figure(run: RunData, paths: Sequence[str]) -> Figure:
    """Gain and phase of paths over frequency."""
    table = run.tables["frequency_response"]
    figure, panels = grid(2 * len(paths), columns=2, height=2.0)
    for number, path in enumerate(paths):
        rows = table[table["path"] == path]
        gain, phase = panels[2 * number], panels[2 * number + 1]
        for panel, name in ((gain, "gain"), (phase, "phase")):
            _curve(panel, rows, name)
            panel.set(xscale="log", xlabel=f"frequency [cycles per {plain(run.time_unit)}]")
        if (rows[f"gain_{POINTWISE}_05"] > 0).all():
            gain.set_yscale("log")
        gain.set(title=plain(path), ylabel=label("gain", rows["unit"].iloc[0]))
        phase.set_ylabel("phase [deg]")
        low = float(np.floor(rows[f"phase_{POINTWISE}_05"].min() / 90) * 90)
        if low >= -720:
            phase.set_yticks(np.arange(low, 1, 90))
    legend_above(figure, panels[0], 4)
    return figure


def _curve(panel: Axes, rows: pd.DataFrame, name: str) -> None:
    x, prefix = rows["frequency"].to_numpy(), f"{name}_{POINTWISE}"
    bands = (
        (prefix, "05", "95", BAND, 0.30, f"90 % {POINTWISE}"),
        (prefix, "25", "75", BAND, 0.45, f"50 % {POINTWISE}"),
    )
    draw_bands(panel, x, rows, bands)
    for end, text in (("05", f"90 % {SIMULTANEOUS}"), ("95", "_")):
        edge = rows[f"{name}_{SIMULTANEOUS}_{end}"].to_numpy()
        panel.plot(x, edge, color=BAND, lw=0.7, ls=(0, (4, 3)), label=text)
    panel.plot(x, rows[f"{prefix}_50"].to_numpy(), color=BAND, label="median")
