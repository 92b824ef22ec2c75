"""What the model leaves: in time, in correlation and in frequency."""

from __future__ import annotations

from math import log

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from lcopa_bayes.core.arrays import Index, Vector
from lcopa_bayes.report.decimation import draw_line, extremes, said
from lcopa_bayes.report.formatting import figures, probability
from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.section import Drawing, Section
from lcopa_bayes.report.theme import BAND, HELD_OUT, INK, NOISE, SEEN, blank, label, plain, svg_of
from lcopa_bayes.results.residuals import WHITE_P

_ORDINATE_BAND = (-log(0.975), -log(0.025))
"""2.5 and 97.5 % quantiles of the unit exponential law of a periodogram ordinate over its mean [-]."""


def section(run: SavedRun) -> Section:
    """Residual, autocorrelation and spectrum of every axis of every record."""
    drawings = []
    for number, (record, axis) in enumerate(run.records("residuals"), start=1):
        rows = run.part("residuals", record, axis)
        held = bool(rows["held_out"].iloc[0])
        drawings.append(
            Drawing(
                f"residuals_{number:02d}_{record}_{axis}",
                _drawn(run, rows, record, axis, held=held),
                _caption(run, record, axis, len(rows), held=held),
                mark="held out" if held else "",
            )
        )
    text = (
        "The residual is observed minus the median of the plant; the two lower panels show it after the "
        "fitted noise model has whitened it. Grey bands hold 95 % of the points if it is white."
        if drawings
        else "Every record is too short for residuals to be tested."
    )
    return Section("Residuals", (text,), tuple(drawings))


def _drawn(run: SavedRun, rows: pd.DataFrame, record: str, axis: str, *, held: bool) -> str:
    figure = blank(3.9)
    panels = figure.subplot_mosaic([["time", "time"], ["lags", "spectrum"]], height_ratios=[1.0, 1.15])
    time, residual = rows["time"].to_numpy(), rows["residual"].to_numpy()
    colour = HELD_OUT if held else SEEN
    panels["time"].axhline(0.0, color=NOISE, lw=0.7)
    draw_line(panels["time"], time, residual, ".-", ms=2, mew=0, lw=0.5, color=colour)
    panels["time"].set_title(
        plain(f"{record}, {axis}: {'held out' if held else 'fit'}"), loc="left", color=colour
    )
    panels["time"].set_xlabel(label("time", run.time_unit))
    panels["time"].set_ylabel(label("residual", rows["unit"].iloc[0]))
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
    panel.set_xlabel("lag [samples]")
    panel.set_ylabel("autocorrelation [-]")


def _spectrum(panel: Axes, rows: pd.DataFrame, time_unit: str) -> None:
    frequency, power = rows["frequency"].to_numpy(), rows["power_over_white"].to_numpy()
    above = power > 0
    frequency, power = frequency[above], power[above]
    panel.axhspan(*_ORDINATE_BAND, color=NOISE, alpha=0.3, lw=0)
    panel.axhline(1.0, color=INK, lw=0.7)
    at = _shown(power)
    panel.plot(frequency[at], power[at], color=BAND, lw=0.8)
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.set_xlabel(label("frequency", f"1/{time_unit}"))
    panel.set_ylabel("power over white [-]")


def _shown(power: Vector) -> Index:
    """The lowest frequencies, spread wide on a logarithmic axis, singly, and extremes of the rest."""
    few = min(power.size, 200)
    return (
        np.concatenate((np.arange(few), few + extremes(power[few:]))) if few < power.size else np.arange(few)
    )


def _caption(run: SavedRun, record: str, axis: str, size: int, *, held: bool) -> str:
    parts = [f"Record {record}, axis {axis}."]
    for test in run.results["residual_tests"]:
        if (test["record"], test["axis"], test["held_out"]) == (record, axis, held):
            p = test["p_white"]
            unit = run.part("residuals", record, axis)["unit"].iloc[0]
            parts.append(f"Root mean square {figures(test['rms'])} {unit}.")
            if p is not None:
                judged = "not white" if p < WHITE_P else "no sign that it is not white"
                parts.append(f"Ljung-Box test of the whitened residual: {probability(p)}, {judged}.")
    return " ".join([*parts, *filter(None, [said(size)])])
