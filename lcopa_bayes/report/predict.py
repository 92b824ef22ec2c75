"""The page of a prediction, drawn from `predict.json` and its tables alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.axes import Axes

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.report.page import write_graded
from lcopa_bayes.report.section import Drawing, Section, Table, ends, figures, score_columns
from lcopa_bayes.report.sections.records import BANDS as RESPONSE
from lcopa_bayes.report.sections.records import above_drives, draw_response
from lcopa_bayes.report.theme import BAND, HELD_OUT, NOISE, draw_line, legend_above, svg_of
from lcopa_bayes.results.bands import POINTWISE, SIMULTANEOUS
from lcopa_bayes.results.newdrive import BANDS, DRIVES
from lcopa_bayes.results.stored import stored_values

_OUTSIDE = "#faf0e8"
"""Shade of what lies outside the fitted range."""


def write_prediction(folder: Path) -> Path:
    """`predict.html` with bands, drives and what lies outside the fitted range; returns its path.

    InputError when a file of the prediction is missing or cannot be used.
    """
    path = folder / "tables"
    try:
        bands, drives = (
            pd.read_csv(path / name, dtype={"axis": str, "unit": str}) for name in (BANDS, DRIVES)
        )
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); run `predict` to write it") from None
    values = stored_values(folder, "predict", ("drive",))
    return write_graded(
        folder,
        "predict",
        f"response to {values['drive']}",
        lambda values: [_curves(values, bands, drives), _range(values), *_scores(values)],
    )


def _curves(values: Mapping[str, Any], bands: pd.DataFrame, drives: pd.DataFrame) -> Section:
    drawings = tuple(
        Drawing(
            f"predict_{number:02d}_{entry['axis']}",
            _drawn(values, bands[bands["axis"] == str(entry["axis"])], drives),
            f"Response {entry['axis']}, offset: {entry['offset_from']}. {values['draws']} draws.",
        )
        for number, entry in enumerate(values["axes"], start=1)
    )
    table = Table.of(
        values["axes"],
        ("axis", "text", "axis"),
        (f"end [{values['time_unit']}]", "number", "end"),
        ("median there", "number", "value_at_end"),
        ("90 % interval", "interval", ends),
        ("unit", "text", "unit"),
        (f"widest {POINTWISE}", "number", lambda row: figures(row[f"half_width_{POINTWISE}"], 2)),
        (f"widest {SIMULTANEOUS}", "number", lambda row: figures(row[f"half_width_{SIMULTANEOUS}"], 2)),
        ("widest with noise", "number", lambda row: figures(row["half_width_noisy"], 2)),
        caption="Half widths of the 90 % bands where they are widest; only the last column includes noise.",
    )
    text = (
        f"A {POINTWISE} band holds the response at each time by itself; a {SIMULTANEOUS} band holds the "
        "whole curve of its axis, at all times at once. Blue: the plant alone. Grey: samples, with noise.",
    )
    return Section("Predicted response", text, drawings, (table,))


def _drawn(values: Mapping[str, Any], rows: pd.DataFrame, drives: pd.DataFrame) -> str:
    figure, top, below = above_drives(rows, drives, str(values["time_unit"]), height=3.0, ratio=3.4)
    _bands(top, rows, measured=bool(values["measured"]))
    time = rows["time"].to_numpy()
    beyond = time[~rows["inside"].to_numpy(dtype=bool)]
    for panel in (top, *below):
        if beyond.size:
            shade = "outside the fitted range" if panel is top else None
            panel.axvspan(float(beyond[0]), float(time[-1]), color=_OUTSIDE, lw=0, zorder=-1, label=shade)
    legend_above(figure, top, 4, markerscale=2)
    return svg_of(figure)


def _bands(panel: Axes, rows: pd.DataFrame, *, measured: bool) -> None:
    time = rows["time"].to_numpy()
    names = (f"90 % with noise, {POINTWISE}", f"90 % plant, {POINTWISE}", f"50 % plant, {POINTWISE}")
    draw_response(panel, rows, [(*band[:-1], name) for band, name in zip(RESPONSE, names, strict=True)])
    for what, colour, name in (("noisy", NOISE, "with noise"), ("plant", BAND, "plant")):
        for end, text in (("05", f"90 % {name}, {SIMULTANEOUS}"), ("95", None)):
            edge = rows[f"{what}_{SIMULTANEOUS}_{end}"].to_numpy()
            draw_line(panel, time, edge, color=colour, lw=0.7, ls=(0, (4, 3)), label=text)
    if measured:
        seen = rows["observed"].to_numpy()
        draw_line(panel, time, seen, ".", ms=2.5, mew=0, color=HELD_OUT, label="observed", zorder=3)


def _range(values: Mapping[str, Any]) -> Section:
    outside = [str(entry["sentence"]) for entry in values["outside"]]
    inside = "Amplitude, duration and frequencies of the drive lie within those of the fit records."
    return Section("Fitted range", tuple(outside) or (inside,))


def _scores(values: Mapping[str, Any]) -> list[Section]:
    if not values["scores"]:
        return []
    table = Table.of(
        values["scores"],
        ("axis", "text", "axis"),
        *score_columns(),
        caption=f"RMSE is against the median of the plant; coverage is by the {POINTWISE} bands with noise. "
        "The record was not fitted.",
    )
    return [Section("Scores", tables=(table,))]
