"""Step and frequency responses of each path, and what engineers read off them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from lcopa_bayes.report.formatting import NOT_REACHED, OPEN, interval, to_spread
from lcopa_bayes.report.page import Drawings
from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.theme import (
    BAND,
    STEADY,
    draw_bands,
    draw_line,
    grid,
    label,
    legend_above,
    paged,
    plain,
    svg_of,
)
from lcopa_bayes.results.bands import POINTWISE, SIMULTANEOUS

_STEPS_PER_FIGURE, _BODE_PER_FIGURE = 6, 4
"""Paths on one figure."""
_WORDS = {
    "rise_10_90": "rise time, 10 to 90 %",
    "settling_2": "settling time to 2 %",
    "settling_5": "settling time to 5 %",
    "value_at_end": "value at end of record",
    "steady_state": "steady state",
}
"""Names of metrics that do not read as words."""
_TIMES = ("rise", "settling")


def drawn(run: SavedRun) -> Drawings:
    """Bands of the response to a unit step and the step metrics as they are printed; Bode plots."""
    step, bode = run.tables["step_response"], run.tables["frequency_response"]
    paths, answered = list(dict.fromkeys(step["path"])), list(dict.fromkeys(bode["path"]))
    steps = (
        "Response of the plant to a unit step at time 0, over the longest record: median, "
        f"{POINTWISE} 50 and 90 % bands. Dashed: median and 90 % interval of the steady state it tends to."
    )
    frequency = (
        f"Gain and phase of each path: median, {POINTWISE} 50 and 90 % bands, and the {SIMULTANEOUS} "
        "90 % band (dashed), which holds the whole curve. From one cycle in the longest fit record to one in "
        "two sampling periods."
    )
    return {
        "steps": paged("step", paths, _STEPS_PER_FIGURE, lambda part: _steps(run, step, part), steps),
        "frequency": paged(
            "frequency", answered, _BODE_PER_FIGURE, lambda part: _bode(run, bode, part), frequency
        ),
        "metrics": [_metric(row) for row in run.results["step_metrics"]],
    }


def _metric(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row of the table of step metrics."""
    kind, _, path = str(row["name"]).partition("[")
    never = NOT_REACHED if kind.startswith(_TIMES) else OPEN
    lower, upper = row["lower"], row["upper"]
    ends = interval(lower, upper, row["sd"], nothing=never)
    return {
        **{key: row[key] for key in ("unit", "sd", "grade")},
        "path": path.rstrip("]"),
        "metric": _WORDS.get(kind, kind.replace("_", " ")),
        "median": never if row["value"] is None else to_spread(row["value"], row["sd"]),
        "ends": ends if (lower is None) == (upper is None) else ends.replace(OPEN, never),
        "note": row.get("note", ""),
    }


def _steps(run: SavedRun, curves: pd.DataFrame, paths: Sequence[str]) -> str:
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
    return svg_of(figure)


def _path(panel: Axes, rows: pd.DataFrame) -> None:
    time = rows["time"].to_numpy()
    bands = (("response", "05", "95", BAND, 0.30, "90 %"), ("response", "25", "75", BAND, 0.45, "50 %"))
    draw_bands(panel, time, rows, bands)
    draw_line(panel, time, rows["response_50"].to_numpy(), color=BAND, label="median")
    for quantile, width, name in (("50", 1.1, "steady state"), ("05", 0.7, ""), ("95", 0.7, "")):
        level = float(rows[f"steady_{quantile}"].iloc[0])
        panel.axhline(level, color=STEADY, lw=width, ls=(0, (4, 3)), label=name or None)
    panel.axhline(0.0, color="#b0b0b0", lw=0.6, zorder=0)


def _bode(run: SavedRun, table: pd.DataFrame, paths: Sequence[str]) -> str:
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
    return svg_of(figure)


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
