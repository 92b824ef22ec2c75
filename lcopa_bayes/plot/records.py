"""Records with the bands predicted for them, their drives, and what the model leaves of them."""

from __future__ import annotations

from collections.abc import Sequence
from math import log

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lcopa_bayes.core.arrays import Index, Vector
from lcopa_bayes.plot.rundata import RunData
from lcopa_bayes.plot.theme import (
    BAND,
    CYCLE,
    HELD_OUT,
    INK,
    NOISE,
    OUTSIDE,
    SEEN,
    blank,
    dots,
    draw_bands,
    draw_line,
    extremes,
    headed,
    label,
    legend_above,
    plain,
)
from lcopa_bayes.results.bands import POINTWISE, SIMULTANEOUS

BANDS = (
    (f"noisy_{POINTWISE}", "05", "95", NOISE, 0.30, "90 % with noise"),
    (f"plant_{POINTWISE}", "05", "95", BAND, 0.30, "90 % plant"),
    (f"plant_{POINTWISE}", "25", "75", BAND, 0.55, "50 % plant"),
)
"""Pointwise bands of a response: columns, ends, colour, opacity and label."""
_BESIDE = 14
"""Letters that fit beside the panel of a drive; longer names stand above it."""
_ORDINATE_BAND = (-log(0.975), -log(0.025))
"""2.5 and 97.5 % quantiles of the unit exponential law of a periodogram ordinate over its mean [-]."""


def response_figure(run: RunData, record: str, axis: str) -> Figure:
    """A response with its bands, above the drives of its record."""
    rows, drives = run.part("bands", record, axis), run.tables["drives"]
    held = bool(rows["held_out"].iloc[0])
    figure, top, _ = above_drives(
        rows, drives[drives["record"] == record], run.time_unit, height=2.6, ratio=3.2
    )
    draw_response(top, rows, BANDS)
    colour = headed(top, record, axis, held_out=held)
    seen = rows["observed"].to_numpy()
    style = {"ms": dots(seen.size), "mew": 0, "color": colour}
    draw_line(top, rows["time"].to_numpy(), seen, ".", label="observed", zorder=3, **style)
    legend_above(figure, top, 5, markerscale=2)
    return figure


def above_drives(
    rows: pd.DataFrame, drives: pd.DataFrame, time_unit: str, *, height: float, ratio: float
) -> tuple[Figure, Axes, list[Axes]]:
    """A figure with a panel for a response, still empty, and below it one for the drives of each unit.

    `rows` are those of the response, whose times all panels span; `height` [in] is that without drives, and
    `ratio` that of the panel of the response over another's.
    """
    units = list(dict.fromkeys(drives["unit"]))
    figure = blank(height + 0.95 * len(units))
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
    text = label(names[0] if len(names) == 1 else "drive", unit)
    panel.set_ylabel(text) if len(text) <= _BESIDE else panel.set_title(text, fontsize=8.5)
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


def residual_figure(run: RunData, record: str, axis: str) -> Figure:
    """A residual over time, with its autocorrelation and spectrum."""
    rows = run.part("residuals", record, axis)
    held = bool(rows["held_out"].iloc[0])
    figure = blank(3.9)
    panels = figure.subplot_mosaic([["time", "time"], ["lags", "spectrum"]], height_ratios=[1.0, 1.15])
    top = panels["time"]
    colour = headed(top, record, axis, held_out=held)
    top.axhline(0.0, color=NOISE, lw=0.7)
    time, residual = rows["time"].to_numpy(), rows["residual"].to_numpy()
    draw_line(top, time, residual, ".-", ms=dots(time.size), mew=0, lw=0.5, color=colour)
    top.set(xlabel=label("time", run.time_unit), ylabel=label("residual", rows["unit"].iloc[0]))
    _lags(panels["lags"], run.part("autocorrelation", record, axis))
    _spectrum(panels["spectrum"], run.part("spectrum", record, axis), run.time_unit)
    return figure


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


def record_figure(rows: pd.DataFrame, time_unit: str, *, held_out: bool) -> Figure:
    """Responses and drives of a record by unit, as the table of a check lists them."""
    responses = rows[rows["role"] == "response"]
    units = list(dict.fromkeys(responses["unit"]))
    drives = rows[rows["role"] == "drive"].rename(columns={"value": "drive"})
    figure = blank(1.4 * len(units) + 1.1 * drives["unit"].nunique() + 0.6)
    heights = [1.8] * len(units) + [1.0] * drives["unit"].nunique()
    panels = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights).ravel()
    for panel, own in zip(panels, units, strict=False):
        _responses(panel, responses[responses["unit"] == own], own, HELD_OUT if held_out else SEEN)
    for panel, own in zip(panels[len(units) :], dict.fromkeys(drives["unit"]), strict=True):
        draw_drives(panel, drives[drives["unit"] == own], own, until=float(rows["time"].max()))
    panels[-1].set_xlabel(label("time", time_unit))
    figure.align_ylabels()
    return figure


def _responses(panel: Axes, rows: pd.DataFrame, unit: str, colour: str) -> None:
    names = list(dict.fromkeys(rows["axis"]))
    markers = ".x+1234"
    for name, marker in zip(names, markers * len(names), strict=False):
        own = rows[(rows["axis"] == name) & rows["value"].notna()]
        draw_line(
            panel,
            own["time"].to_numpy(),
            own["value"].to_numpy(),
            marker,
            ms=3,
            color=colour,
            label=plain(name),
        )
    panel.set_ylabel(label(names[0] if len(names) == 1 else "response", unit))
    if len(names) > 1:
        panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def prediction_figure(rows: pd.DataFrame, drives: pd.DataFrame, time_unit: str) -> Figure:
    """Bands of a response under a drive, shaded where they are outside the fitted range."""
    figure, top, below = above_drives(rows, drives, time_unit, height=3.0, ratio=3.4)
    _bands(top, rows)
    time = rows["time"].to_numpy()
    beyond = time[~rows["inside"].to_numpy(dtype=bool)]
    for panel in (top, *below):
        if beyond.size:
            shade = "outside the fitted range" if panel is top else None
            panel.axvspan(float(beyond[0]), float(time[-1]), color=OUTSIDE, lw=0, zorder=-1, label=shade)
    legend_above(figure, top, 4, markerscale=2)
    return figure


def _bands(panel: Axes, rows: pd.DataFrame) -> None:
    time = rows["time"].to_numpy()
    names = (f"90 % with noise, {POINTWISE}", f"90 % plant, {POINTWISE}", f"50 % plant, {POINTWISE}")
    draw_response(panel, rows, [(*band[:-1], name) for band, name in zip(BANDS, names, strict=True)])
    for what, colour, name in (("noisy", NOISE, "with noise"), ("plant", BAND, "plant")):
        for end, text in (("05", f"90 % {name}, {SIMULTANEOUS}"), ("95", None)):
            edge = rows[f"{what}_{SIMULTANEOUS}_{end}"].to_numpy()
            draw_line(panel, time, edge, color=colour, lw=0.7, ls=(0, (4, 3)), label=text)
    if rows["observed"].notna().any():
        seen = rows["observed"].to_numpy()
        draw_line(
            panel, time, seen, ".", ms=dots(seen.size), mew=0, color=HELD_OUT, label="observed", zorder=3
        )
