"""Each record with the bands the posterior predicts for it, and what the model leaves of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import log
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lcopa_bayes.core.arrays import Index, Vector
from lcopa_bayes.report.formatting import figures, percent, probability
from lcopa_bayes.report.page import Drawings
from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.theme import (
    BAND,
    CYCLE,
    INK,
    NOISE,
    Drawing,
    blank,
    draw_bands,
    draw_line,
    extremes,
    extremes_note,
    headed,
    label,
    legend_above,
    plain,
    svg_of,
)
from lcopa_bayes.results.bands import POINTWISE
from lcopa_bayes.results.residuals import WHITE_P

BANDS = (
    (f"noisy_{POINTWISE}", "05", "95", NOISE, 0.30, "90 % with noise"),
    (f"plant_{POINTWISE}", "05", "95", BAND, 0.30, "90 % plant"),
    (f"plant_{POINTWISE}", "25", "75", BAND, 0.55, "50 % plant"),
)
"""Pointwise bands of a response: columns, ends, colour, opacity and label."""
_ORDINATE_BAND = (-log(0.975), -log(0.025))
"""2.5 and 97.5 % quantiles of the unit exponential law of a periodogram ordinate over its mean [-]."""


def drawn(run: SavedRun) -> Drawings:
    """Observed and predicted responses with their drives, fitted records first, and of each the residual with
    its autocorrelation and spectrum."""
    scores = {
        (row["record"], row["axis"], held): row
        for key, held in (("fit_scores", False), ("held_out", True))
        for row in run.results[key]
    }
    data, residuals = [], []
    for number, (record, axis) in enumerate(run.records("bands"), start=1):
        rows = run.part("bands", record, axis)
        held = bool(rows["held_out"].iloc[0])
        score = scores.get((record, axis, held), {})
        caption = _described(score, record, axis, len(rows), held=held) + _before(run, rows, record)
        svg = _data(run, rows, record, axis, held=held)
        data.append(Drawing(f"data_{number:02d}_{record}_{axis}", svg, caption, "held out" * held))
    for number, (record, axis) in enumerate(run.records("residuals"), start=1):
        rows = run.part("residuals", record, axis)
        held = bool(rows["held_out"].iloc[0])
        caption = _tested(run, record, axis, len(rows), held=held)
        svg = _residual(run, rows, record, axis, held=held)
        residuals.append(Drawing(f"residuals_{number:02d}_{record}_{axis}", svg, caption, "held out" * held))
    return {"data": data, "residuals": residuals}


def _data(run: SavedRun, rows: pd.DataFrame, record: str, axis: str, *, held: bool) -> str:
    drives = run.tables["drives"]
    figure, top, _ = above_drives(
        rows, drives[drives["record"] == record], run.time_unit, height=2.6, ratio=3.2
    )
    draw_response(top, rows, BANDS)
    colour = headed(top, record, axis, held_out=held)
    seen = rows["observed"].to_numpy()
    size = 2.5 if extremes(seen).size > 300 else 3.2
    draw_line(
        top, rows["time"].to_numpy(), seen, ".", ms=size, mew=0, color=colour, label="observed", zorder=3
    )
    legend_above(figure, top, 5, markerscale=2)
    return svg_of(figure)


def above_drives(
    rows: pd.DataFrame, drives: pd.DataFrame, time_unit: str, *, height: float, ratio: float
) -> tuple[Figure, Axes, list[Axes]]:
    """A figure with a panel for a response, still empty, and below it one for the drives of each unit.

    `rows` are those of the response, whose times all panels span; `height` [in] is that without drives, and
    `ratio` that of the panel of the response over another's.
    """
    units = list(dict.fromkeys(drives["unit"]))
    figure = blank(height + 0.85 * len(units))
    top, *below = figure.subplots(
        1 + len(units), 1, sharex=True, squeeze=False, height_ratios=[ratio] + [1.0] * len(units)
    ).ravel()
    first, last = float(rows["time"].min()), float(rows["time"].max())
    for panel, unit in zip(below, units, strict=True):
        draw_drives(panel, drives[drives["unit"] == unit], unit, until=last)
    margin = 0.02 * (last - first) or 0.5 * abs(first) or 1.0  # one sample has no span
    top.set(
        ylabel=label(str(rows["axis"].iloc[0]), str(rows["unit"].iloc[0])),
        xlim=(first - margin, last + margin),
    )
    (below[-1] if below else top).set_xlabel(label("time", time_unit))
    figure.align_ylabels()
    return figure, top, below


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


def draw_response(
    panel: Axes, rows: pd.DataFrame, bands: Sequence[tuple[str, str, str, str, float, str]]
) -> None:
    """Bands of a response and the median of the plant."""
    time = rows["time"].to_numpy()
    draw_bands(panel, time, rows, bands)
    draw_line(panel, time, rows[f"plant_{POINTWISE}_50"].to_numpy(), color=BAND, label="median")


def _described(score: Mapping[str, Any], record: str, axis: str, size: int, *, held: bool) -> str:
    parts = [f"Record {record}, axis {axis}, {'held out of the fit' if held else 'fitted'}."]
    if score:
        parts.append(
            f"RMSE {figures(score['rmse'])} {score['unit']}; {percent(score['coverage_90'])} of the "
            f"{score['samples']} samples lie in the {POINTWISE} 90 % band with noise, "
            f"{percent(score['coverage_50'])} in the 50 % band. Offset: {score['offset_from']}."
        )
    return " ".join([*parts, *filter(None, [extremes_note(size)])])


def _before(run: SavedRun, rows: pd.DataFrame, record: str) -> str:
    """A sentence when the drive began long before the samples that are shown."""
    drives = run.tables["drives"]
    begin = drives.loc[drives["record"] == record, "time"].min()
    first, last = rows["time"].min(), rows["time"].max()
    early = begin < first - 0.02 * (last - first)
    return f" The drive from {figures(begin)} {run.time_unit} on is included but not shown." if early else ""


def _residual(run: SavedRun, rows: pd.DataFrame, record: str, axis: str, *, held: bool) -> str:
    figure = blank(3.9)
    panels = figure.subplot_mosaic([["time", "time"], ["lags", "spectrum"]], height_ratios=[1.0, 1.15])
    top = panels["time"]
    colour = headed(top, record, axis, held_out=held)
    top.axhline(0.0, color=NOISE, lw=0.7)
    time, residual = rows["time"].to_numpy(), rows["residual"].to_numpy()
    draw_line(top, time, residual, ".-", ms=2, mew=0, lw=0.5, color=colour)
    top.set(xlabel=label("time", run.time_unit), ylabel=label("residual", rows["unit"].iloc[0]))
    _lags(panels["lags"], run.part("autocorrelation", record, axis))
    _spectrum(panels["spectrum"], run.part("spectrum", record, axis), run.time_unit)
    return svg_of(figure)


def _lags(panel: Axes, rows: pd.DataFrame) -> None:
    lags, values = rows["lag"].to_numpy(), rows["autocorrelation"].to_numpy()
    if lags.size:
        band = float(rows["white_band_95"].iloc[0])
        panel.axhspan(-band, band, color=NOISE, alpha=0.3, lw=0)
    panel.axhline(0.0, color=INK, lw=0.7)
    panel.vlines(lags, 0.0, values, color=BAND, lw=1.4)
    panel.set(xlabel="lag [samples]", ylabel="autocorrelation [-]")


def _spectrum(panel: Axes, rows: pd.DataFrame, time_unit: str) -> None:
    frequency, power = rows["frequency"].to_numpy(), rows["power_over_white"].to_numpy()
    above = power > 0
    frequency, power = frequency[above], power[above]
    panel.axhspan(*_ORDINATE_BAND, color=NOISE, alpha=0.3, lw=0)
    panel.axhline(1.0, color=INK, lw=0.7)
    at = _shown(power)
    panel.plot(frequency[at], power[at], color=BAND, lw=0.8)
    panel.set(
        xscale="log", yscale="log", xlabel=label("frequency", f"1/{time_unit}"), ylabel="power over white [-]"
    )


def _shown(power: Vector) -> Index:
    """The lowest frequencies, spread wide on a logarithmic axis, singly, and extremes of the rest."""
    few = min(power.size, 200)
    return (
        np.concatenate((np.arange(few), few + extremes(power[few:]))) if few < power.size else np.arange(few)
    )


def _tested(run: SavedRun, record: str, axis: str, size: int, *, held: bool) -> str:
    parts = [f"Record {record}, axis {axis}."]
    for test in run.results["residual_tests"]:
        if (test["record"], test["axis"], test["held_out"]) == (record, axis, held):
            p = test["p_white"]
            unit = run.part("residuals", record, axis)["unit"].iloc[0]
            parts.append(f"Root mean square {figures(test['rms'])} {unit}.")
            if p is not None:
                judged = "not white" if p < WHITE_P else "no sign that it is not white"
                parts.append(f"Ljung-Box test of the whitened residual: {probability(p)}, {judged}.")
    return " ".join([*parts, *filter(None, [extremes_note(size)])])
