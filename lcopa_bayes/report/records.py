"""Each record with the bands the posterior predicts for it, and what the model leaves of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from lcopa_bayes.core.arrays import Index, Vector
from lcopa_bayes.core.units import measured
from lcopa_bayes.plot.records import residual_figure, response_figure
from lcopa_bayes.plot.rundata import RunData
from lcopa_bayes.plot.theme import extremes, extremes_note, label
from lcopa_bayes.report.formatting import figures, percent, probability
from lcopa_bayes.report.page import UNFOLDED, Drawings
from lcopa_bayes.report.svg import drawing
from lcopa_bayes.results.bands import POINTWISE
from lcopa_bayes.results.residuals import WHITE_P


def drawn(run: RunData) -> Drawings:
    """Observed and predicted responses with their drives, and of each the residual with its autocorrelation
    and spectrum: fitted records first, or of many the worst."""
    scores = {
        (row["record"], row["axis"], held): row
        for key, held in (("fit_scores", False), ("held_out", True))
        for row in run.results[key]
    }
    data, residuals = [], []
    for number, (record, axis) in enumerate(_worst_first(run, "bands"), start=1):
        rows = run.part("bands", record, axis)
        held = bool(rows["held_out"].iloc[0])
        score = scores.get((record, axis, held), {})
        caption = _described(score, record, axis, len(rows), held=held) + _before(run, rows, record)
        figure = response_figure(run, record, axis)
        drives = run.tables["drives"]
        series = explored(rows, drives[drives["record"] == record], run.time_unit)
        stem = f"data_{number:02d}_{record}_{axis}"
        data.append(drawing(stem, figure, caption, "held out" * held, "tables/bands.csv", series))
    for number, (record, axis) in enumerate(_worst_first(run, "residuals"), start=1):
        rows = run.part("residuals", record, axis)
        held = bool(rows["held_out"].iloc[0])
        caption = _tested(run, record, axis, len(rows), held=held)
        figure = residual_figure(run, record, axis)
        stem = f"residuals_{number:02d}_{record}_{axis}"
        residuals.append(drawing(stem, figure, caption, "held out" * held, "tables/residuals.csv"))
    return {"data": data, "residuals": residuals}


def _worst_first(run: RunData, table: str) -> list[tuple[str, str]]:
    """Record and axis pairs of a table: of more than a page shows at once, the least white residual first."""
    pairs = run.records(table)
    white = {(row["record"], row["axis"]): row["p_white"] for row in run.results["residual_tests"]}
    return (
        sorted(pairs, key=lambda one: 1.0 if (p := white.get(one)) is None else p)
        if len(pairs) > UNFOLDED
        else pairs
    )


def explored(rows: pd.DataFrame, drives: pd.DataFrame, time_unit: str) -> dict[str, Any]:
    """Panels over time whose values a page shows: a response with its median and 90 % band with noise, what
    the median leaves of it, and the drives of its record."""
    seen, middle = rows["observed"].to_numpy(), rows[f"plant_{POINTWISE}_50"].to_numpy()
    low, high = (rows[f"noisy_{POINTWISE}_{q}"].to_numpy() for q in ("05", "95"))
    at, unit = extremes(seen, middle), str(rows["unit"].iloc[0])
    measured = bool(np.isfinite(seen).any())
    response = [
        *([("observed", "points", "--ink", seen)] if measured else []),
        ("median", "line", "--band", middle),
        ("5 %", "band", "--band", low),
        ("95 %", "band", "--band", high),
    ]
    time = rows["time"].to_numpy()
    panels = [_panel(label(str(rows["axis"].iloc[0]), unit), time, at, response)]
    if measured:
        left = [("residual", "points", "--ink", seen - middle)]
        panels.append(_panel(label("residual", unit), time, at, left))
    for (axis, of), own in drives.groupby(["axis", "unit"], sort=False):
        values = own["drive"].to_numpy()
        drive = [(str(axis), "steps", "--held", values)]
        panels.append(
            _panel(label(f"drive {axis}", str(of)), own["time"].to_numpy(), extremes(values), drive)
        )
    return {"time": label("time", time_unit), "panels": panels}


def _panel(
    title: str, time: Vector, at: Index, curves: Sequence[tuple[str, str, str, Vector]]
) -> dict[str, Any]:
    """One of them, at some positions: name, kind, colour and values of each curve."""

    def short(values: Vector, digits: int) -> list[float | None]:
        return [float(f"{one:.{digits}g}") if np.isfinite(one) else None for one in values[at]]

    series = [
        {"label": name, "kind": kind, "colour": colour, "values": short(values, 5)}
        for name, kind, colour, values in curves
    ]
    return {"title": title, "time": short(time, 8), "series": series}


def _described(score: Mapping[str, Any], record: str, axis: str, size: int, *, held: bool) -> str:
    parts = [f"Record {record}, axis {axis}, {'held out of the fit' if held else 'fitted'}."]
    if score:
        parts.append(
            f"RMSE {measured(figures(score['rmse']), score['unit'])}; {percent(score['coverage_90'])} of the "
            f"{score['samples']} samples lie in the {POINTWISE} 90 % band with noise, "
            f"{percent(score['coverage_50'])} in the 50 % band. Offset: {score['offset_from']}."
        )
    return " ".join([*parts, *filter(None, [extremes_note(size)])])


def _before(run: RunData, rows: pd.DataFrame, record: str) -> str:
    """A sentence when the drive began long before the samples that are shown."""
    drives = run.tables["drives"]
    begin = drives.loc[drives["record"] == record, "time"].min()
    first, last = rows["time"].min(), rows["time"].max()
    early = begin < first - 0.02 * (last - first)
    return f" The drive from {figures(begin)} {run.time_unit} on is included but not shown." if early else ""


def _tested(run: RunData, record: str, axis: str, size: int, *, held: bool) -> str:
    parts = [f"Record {record}, axis {axis}."]
    for test in run.results["residual_tests"]:
        if (test["record"], test["axis"], test["held_out"]) == (record, axis, held):
            p = test["p_white"]
            unit = run.part("residuals", record, axis)["unit"].iloc[0]
            parts.append(f"Root mean square {measured(figures(test['rms']), unit)}.")
            if p is not None:
                judged = "not white" if p < WHITE_P else "no sign that it is not white"
                parts.append(f"Ljung-Box test of the whitened residual: {probability(p)}, {judged}.")
    return " ".join([*parts, *filter(None, [extremes_note(size)])])
