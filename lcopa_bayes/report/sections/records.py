"""Each record with the bands the posterior predicts for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from lcopa_bayes.report.decimation import draw_band, draw_line, extremes, said
from lcopa_bayes.report.formatting import figures, percent
from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.section import Drawing, Section, Table, score_columns
from lcopa_bayes.report.theme import BAND, CYCLE, HELD_OUT, NOISE, SEEN, blank, label, plain, svg_of
from lcopa_bayes.results.bands import POINTWISE

_BANDS = (
    ("noisy", "05", "95", NOISE, 0.30, "90 % with noise"),
    ("plant", "05", "95", BAND, 0.30, "90 % plant"),
    ("plant", "25", "75", BAND, 0.55, "50 % plant"),
)


def section(run: SavedRun) -> Section:
    """Observed and predicted responses with their drives, fitted records first, and the scores."""
    scores = {
        (row["record"], row["axis"], held): row
        for key, held in (("fit_scores", False), ("held_out", True))
        for row in run.results[key]
    }
    drawings = []
    for number, (record, axis) in enumerate(run.records("bands"), start=1):
        rows = run.part("bands", record, axis)
        held = bool(rows["held_out"].iloc[0])
        score = scores.get((record, axis, held), {})
        drawings.append(
            Drawing(
                f"data_{number:02d}_{record}_{axis}",
                _drawn(run, rows, record, axis, held=held),
                _caption(score, record, axis, len(rows), held=held) + _before(run, rows, record),
                mark="held out" if held else "",
            )
        )
    return Section(
        "Data and bands",
        (
            "The plant bands hold the response without noise, the grey band the samples themselves. "
            f"Bands are {POINTWISE}: each holds at every time by itself; a whole curve leaves it more often. "
            "A correct model has about 50 and 90 % of the samples in its bands with noise.",
        ),
        tuple(drawings),
        (_scores(run),),
    )


def _drawn(run: SavedRun, rows: pd.DataFrame, record: str, axis: str, *, held: bool) -> str:
    drives = run.tables["drives"]
    drives = drives[drives["record"] == record]
    units = list(dict.fromkeys(drives["unit"]))
    figure = blank(2.6 + 0.85 * len(units))
    top, *below = figure.subplots(
        1 + len(units), 1, sharex=True, squeeze=False, height_ratios=[3.2] + [1.0] * len(units)
    ).ravel()
    colour = HELD_OUT if held else SEEN
    _bands(top, rows, colour)
    top.set_ylabel(label(axis, rows["unit"].iloc[0]))
    top.set_title(plain(f"{record}, {axis}: {'held out' if held else 'fit'}"), loc="left", color=colour)
    for panel, unit in zip(below, units, strict=True):
        draw_drives(panel, drives[drives["unit"] == unit], unit, until=float(rows["time"].max()))
    margin = 0.02 * float(np.ptp(rows["time"]))
    top.set_xlim(rows["time"].min() - margin, rows["time"].max() + margin)
    (below[-1] if below else top).set_xlabel(label("time", run.time_unit))
    figure.align_ylabels()
    figure.legend(*top.get_legend_handles_labels(), loc="outside upper center", ncols=5, markerscale=2)
    return svg_of(figure)


def _bands(panel: Axes, rows: pd.DataFrame, marked: str) -> None:
    time = rows["time"].to_numpy()
    draw_bands(panel, rows, _BANDS)
    seen = rows["observed"].to_numpy()
    size = 2.5 if extremes(seen).size > 300 else 3.2
    draw_line(panel, time, seen, ".", ms=size, mew=0, color=marked, label="observed", zorder=3)


def draw_bands(
    panel: Axes, rows: pd.DataFrame, which: Sequence[tuple[str, str, str, str, float, str]]
) -> None:
    """Pointwise bands of a response, by column, ends, colour, opacity and label, and the median."""
    time = rows["time"].to_numpy()
    for column, low, high, colour, alpha, name in which:
        lower, upper = (rows[f"{column}_{POINTWISE}_{end}"].to_numpy() for end in (low, high))
        draw_band(panel, time, lower, upper, color=colour, alpha=alpha, label=name)
    draw_line(panel, time, rows[f"plant_{POINTWISE}_50"].to_numpy(), color=BAND, label="median")


def draw_drives(panel: Axes, drives: pd.DataFrame, unit: str, *, until: float) -> None:
    """Drives of one unit; the last row of each holds on to the time `until`."""
    names = list(dict.fromkeys(drives["axis"]))
    for name, colour in zip(names, CYCLE * len(names), strict=False):
        own = drives[drives["axis"] == name]
        time, drive = own["time"].to_numpy(), own["drive"].to_numpy()
        if until > time[-1]:
            time, drive = np.append(time, until), np.append(drive, drive[-1])
        draw_line(panel, time, drive, drawstyle="steps-post", color=colour, label=plain(name))
    panel.set_ylabel(label(names[0] if len(names) == 1 else "drive", unit))
    panel.margins(y=0.12)
    if len(names) > 1:
        panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def _caption(score: Mapping[str, Any], record: str, axis: str, size: int, *, held: bool) -> str:
    parts = [f"Record {record}, axis {axis}, {'held out of the fit' if held else 'fitted'}."]
    if score:
        parts.append(
            f"RMSE {figures(score['rmse'])} {score['unit']}; {percent(score['coverage_90'])} of the "
            f"{score['samples']} samples lie in the {POINTWISE} 90 % band with noise, "
            f"{percent(score['coverage_50'])} in the 50 % band. Offset: {score['offset_from']}."
        )
    return " ".join([*parts, *filter(None, [said(size)])])


def _before(run: SavedRun, rows: pd.DataFrame, record: str) -> str:
    """A sentence when the drive began long before the samples that are shown."""
    drives = run.tables["drives"]
    begin = drives.loc[drives["record"] == record, "time"].min()
    first, last = rows["time"].min(), rows["time"].max()
    early = begin < first - 0.02 * (last - first)
    return f" The drive from {figures(begin)} {run.time_unit} on is included but not shown." if early else ""


def _scores(run: SavedRun) -> Table:
    rows = [
        row | {"use": use}
        for key, use in (("fit_scores", "fit"), ("held_out", "held out"))
        for row in run.results[key]
    ]
    return Table.of(
        rows,
        ("record", "text", "record"),
        ("axis", "text", "axis"),
        ("use", "text", "use"),
        *score_columns(),
        caption=f"RMSE is against the median of the plant; coverage is by the {POINTWISE} bands with noise. "
        "Where an offset comes from all samples of a held-out record, a constant error is not visible in its "
        "scores.",
    )
