"""The page of a study that was not fitted, drawn from `check.json` and its table alone.

The page of a first look, drawn from `look.json` and its tables alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lcopa_bayes.plot.records import record_figure
from lcopa_bayes.plot.rundata import TABLES, RunData, read_tables
from lcopa_bayes.report import records
from lcopa_bayes.report.page import Drawings, Verdict
from lcopa_bayes.report.svg import drawing
from lcopa_bayes.results.firstlook import TABLES as SHOWN

_COLUMNS = ("record", "role", "axis", "unit", "time", "value", "held_out")


def checked(folder: Path, values: Mapping[str, Any]) -> Drawings:
    """The records of a check; InputError when its table is missing or cannot be used."""
    paths, unit = {"records": folder / "tables" / "check_records.csv"}, str(values["time_unit"])
    table = read_tables(paths, "check", {"records": _COLUMNS})["records"]
    names = [one["record"] for one in values["records"]]
    pairs = zip(names, values["records"], strict=True)
    records = {
        name: [
            drawing(
                f"check_{name}",
                record_figure(table[table["record"] == name], unit, held_out=bool(one["held_out"])),
                f"Record {name}.",
            )
        ]
        for name, one in pairs
    }
    return {"verdict": Verdict("", values["verdict"], ""), "records": records}


def looked(folder: Path, values: Mapping[str, Any]) -> Drawings:
    """The records of a first look, their bands and residuals; InputError when a table of it is missing or
    cannot be used."""
    tables = read_tables({name: folder / "tables" / f"look_{name}.csv" for name in SHOWN}, "look", TABLES)
    return records.drawn(RunData(values, {}, tables, {}))
