"""The page of a study that was not fitted, drawn from `check.json` and its table alone.

The page of a first look, drawn from `look.json` and its tables alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.axes import Axes

from lcopa_bayes.core.errors import refuse_if
from lcopa_bayes.report.page import Verdict, write_graded
from lcopa_bayes.report.savedrun import TABLES, SavedRun, read_table
from lcopa_bayes.report.section import Drawing, Section, Table, figures, interval, to_spread
from lcopa_bayes.report.sections import parameters, records
from lcopa_bayes.report.sections.records import draw_drives
from lcopa_bayes.report.theme import HELD_OUT, SEEN, blank, draw_line, label, plain, svg_of
from lcopa_bayes.results.firstlook import TABLES as SHOWN

_COLUMNS = ("record", "role", "axis", "unit", "time", "value", "held_out")


def write_check(folder: Path) -> Path:
    """`check.html` with the records and what was understood of them, and the priors; returns its path.

    InputError when a file of the check is missing or cannot be used.
    """
    problems: list[str] = []
    path = folder / "tables" / "check_records.csv"
    table = read_table(path, _COLUMNS, problems, verb="check")
    refuse_if(problems)

    def sections(values: Mapping[str, Any]) -> list[Section]:
        unit = str(values["time_unit"])
        return [
            Section("Plant", tuple(values["sentences"])),
            *(_record(one, table[table["record"] == one["record"]], unit) for one in values["records"]),
            _priors(values),
        ]

    return write_graded(folder, "check", "what was understood", sections, box=_box)


def _box(values: Mapping[str, Any]) -> Verdict:
    return Verdict("", str(values["verdict"]), "")


def _record(one: Mapping[str, Any], rows: pd.DataFrame, unit: str) -> Section:
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
    return Section(
        f"Record {one['record']}{', held out' if held else ''}",
        tuple(one["sentences"]),
        (Drawing(f"check_{one['record']}", svg_of(figure), f"Record {one['record']}."),),
    )


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


def _priors(values: Mapping[str, Any]) -> Section:
    table = Table.of(
        values["parameters"],
        ("name", "code", "name"),
        ("before any data", "prose", "words"),
        ("unit", "text", "unit"),
        ("density", "prose", lambda row: row.get("prior") or f"fixed at {figures(row['value'], 6)}"),
        ("from", "text", lambda row: row.get("from") or "study"),
    )
    return Section("Priors", tables=(table,))


_RESIDUAL = (
    "The residual is observed minus the response of the best optimum; the two lower panels show it after the "
    "noise model fitted there has whitened it. Grey bands hold 95 % of the points if it is white."
)


def write_look(folder: Path) -> Path:
    """`look.html` with the records, their bands and residuals, and the parameters; returns its path.

    InputError when a file of the look is missing or cannot be used.
    """
    problems: list[str] = []
    tables = {
        name: read_table(folder / "tables" / f"look_{name}.csv", TABLES[name], problems, verb="look")
        for name in SHOWN
    }
    refuse_if(problems)

    def sections(values: Mapping[str, Any]) -> list[Section]:
        run = SavedRun(values, {}, tables, {})
        left = replace(records.residuals(run), text=(_RESIDUAL,))
        return [records.data(run), left, _parameters(values)]

    return write_graded(folder, "look", "first look", sections)


def _parameters(values: Mapping[str, Any]) -> Section:
    tables = [
        Table.of(
            values["parameters"],
            ("name", "code", "name"),
            ("median", "number", lambda row: to_spread(row["value"], row["sd"])),
            ("unit", "text", "unit"),
            ("90 % interval", "number", lambda row: interval(row["lower"], row["upper"], row["sd"])),
            caption="Intervals are of draws about one optimum; other modes of the posterior are not in them.",
        )
    ]
    if values["fixed"]:
        tables.append(parameters.fixed(values["fixed"]))
    return Section("Parameters", tables=tuple(tables))
