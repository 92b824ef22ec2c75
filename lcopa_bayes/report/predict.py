"""The page of a prediction, drawn from `predict.json` and its tables alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.axes import Axes

from lcopa_bayes.report.page import Drawings
from lcopa_bayes.report.records import BANDS as RESPONSE
from lcopa_bayes.report.records import above_drives, draw_response
from lcopa_bayes.report.savedrun import read_tables
from lcopa_bayes.report.theme import BAND, HELD_OUT, NOISE, Drawing, draw_line, legend_above, svg_of
from lcopa_bayes.results.bands import POINTWISE, SIMULTANEOUS
from lcopa_bayes.results.newdrive import BANDS, DRIVES

_OUTSIDE = "#faf0e8"
"""Shade of what lies outside the fitted range."""


def drawn(folder: Path, values: Mapping[str, Any]) -> Drawings:
    """Bands, drives and what lies outside the fitted range; InputError when a table of the prediction is
    missing or cannot be used."""
    paths = {name: folder / "tables" / name for name in (BANDS, DRIVES)}
    bands, drives = read_tables(paths, "predict").values()
    curves = [
        Drawing(
            f"predict_{number:02d}_{entry['axis']}",
            _drawn(values, bands[bands["axis"] == str(entry["axis"])], drives),
            f"Response {entry['axis']}, offset: {entry['offset_from']}. {values['draws']} draws.",
        )
        for number, entry in enumerate(values["axes"], start=1)
    ]
    return {"curves": curves}


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
