"""The page of a prediction, drawn from `predict.json` and its tables alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lcopa_bayes.plot.records import prediction_figure
from lcopa_bayes.plot.rundata import read_tables
from lcopa_bayes.report.page import Drawings
from lcopa_bayes.report.records import explored
from lcopa_bayes.report.svg import drawing
from lcopa_bayes.results.newdrive import BANDS, DRIVES


def drawn(folder: Path, values: Mapping[str, Any]) -> Drawings:
    """Bands, drives and what lies outside the fitted range; InputError when a table of the prediction is
    missing or cannot be used."""
    paths = {name: folder / "tables" / name for name in (BANDS, DRIVES)}
    bands, drives = read_tables(paths, "predict").values()
    unit, curves = str(values["time_unit"]), []
    for number, entry in enumerate(values["axes"], start=1):
        rows = bands[bands["axis"] == str(entry["axis"])]
        caption = f"Response {entry['axis']}, offset: {entry['offset_from']}. {values['draws']} draws."
        stem, figure = f"predict_{number:02d}_{entry['axis']}", prediction_figure(rows, drives, unit)
        series = explored(rows, drives, unit)
        curves.append(drawing(stem, figure, caption, data=f"tables/{BANDS}", series=series))
    return {"curves": curves}
