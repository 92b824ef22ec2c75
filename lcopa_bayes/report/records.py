"""Each record with the bands the posterior predicts for it, and what the model leaves of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pandas as pd

from lcopa_bayes.plot.records import residual_figure, response_figure
from lcopa_bayes.plot.rundata import RunData
from lcopa_bayes.plot.theme import extremes_note
from lcopa_bayes.report.formatting import figures, percent, probability
from lcopa_bayes.report.page import Drawings
from lcopa_bayes.report.svg import drawing
from lcopa_bayes.results.bands import POINTWISE
from lcopa_bayes.results.residuals import WHITE_P


def drawn(run: RunData) -> Drawings:
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
        figure = response_figure(run, record, axis)
        data.append(drawing(f"data_{number:02d}_{record}_{axis}", figure, caption, "held out" * held))
    for number, (record, axis) in enumerate(run.records("residuals"), start=1):
        rows = run.part("residuals", record, axis)
        held = bool(rows["held_out"].iloc[0])
        caption = _tested(run, record, axis, len(rows), held=held)
        figure = residual_figure(run, record, axis)
        residuals.append(
            drawing(f"residuals_{number:02d}_{record}_{axis}", figure, caption, "held out" * held)
        )
    return {"data": data, "residuals": residuals}


def _described(score: Mapping[str, Any], record: str, axis: str, size: int, *, held: bool) -> str:
    parts = [f"Record {record}, axis {axis}, {'held out of the fit' if held else 'fitted'}."]
    if score:
        parts.append(
            f"RMSE {figures(score['rmse'])} {score['unit']}; {percent(score['coverage_90'])} of the "
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
            parts.append(f"Root mean square {figures(test['rms'])} {unit}.")
            if p is not None:
                judged = "not white" if p < WHITE_P else "no sign that it is not white"
                parts.append(f"Ljung-Box test of the whitened residual: {probability(p)}, {judged}.")
    return " ".join([*parts, *filter(None, [extremes_note(size)])])
