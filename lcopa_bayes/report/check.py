"""The page of a study that was not fitted, drawn from `check.json` and its table alone.

The page of a first look, drawn from `look.json` and its tables alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.axes import Axes

from lcopa_bayes.report import records
from lcopa_bayes.report.page import Drawings, Verdict
from lcopa_bayes.report.records import draw_drives
from lcopa_bayes.report.savedrun import TABLES, SavedRun, read_tables
from lcopa_bayes.report.theme import HELD_OUT, SEEN, Drawing, blank, draw_line, label, plain, svg_of
from lcopa_bayes.results.firstlook import TABLES as SHOWN

_COLUMNS = ("record", "role", "axis", "unit", "time", "value", "held_out")


def checked(folder: Path, values: Mapping[str, Any]) -> Drawings:
    """The records of a check; InputError when its table is missing or cannot be used."""
    paths, unit = {"records": folder / "tables" / "check_records.csv"}, str(values["time_unit"])
    table = read_tables(paths, "check", {"records": _COLUMNS})["records"]
    names = [one["record"] for one in values["records"]]
    pairs = zip(names, values["records"], strict=True)
    records = {name: [_record(one, table[table["record"] == name], unit)] for name, one in pairs}
    return {"verdict": Verdict("", values["verdict"], ""), "records": records}


def looked(folder: Path, values: Mapping[str, Any]) -> Drawings:
    """The records of a first look, their bands and residuals; InputError when a table of it is missing or
    cannot be used."""
    tables = read_tables({name: folder / "tables" / f"look_{name}.csv" for name in SHOWN}, "look", TABLES)
    return records.drawn(SavedRun(values, {}, tables, {}))


def _record(one: Mapping[str, Any], rows: pd.DataFrame, unit: str) -> Drawing:
    held = bool(one["held_out"])
    responses = rows[rows["role"] == "response"]
    units = list(dict.fromkeys(responses["unit"]))
    drives = rows[rows["role"] == "drive"].rename(columns={"value": "drive"})
    figure = blank(1.4 * len(units) + 1.0 * drives["unit"].nunique() + 0.6)
    heights = [1.8] * len(units) + [1.0] * drives["unit"].nunique()
    panels = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights).ravel()
    for panel, own in zip(panels, units, strict=False):
        _responses(panel, responses[responses["unit"] == own], own, HELD_OUT if held else SEEN)
    for panel, own in zip(panels[len(units) :], dict.fromkeys(drives["unit"]), strict=True):
        draw_drives(panel, drives[drives["unit"] == own], own, until=float(rows["time"].max()))
    panels[-1].set_xlabel(label("time", unit))
    figure.align_ylabels()
    return Drawing(f"check_{one['record']}", svg_of(figure), f"Record {one['record']}.")


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
