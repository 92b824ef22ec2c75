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
from lcopa_bayes.report.answers import scatter_at_rest
from lcopa_bayes.report.page import Drawings, Verdict
from lcopa_bayes.report.svg import drawing
from lcopa_bayes.results.firstlook import TABLES as SHOWN

_COLUMNS = ("record", "role", "axis", "unit", "time", "value", "held_out")


def checked(folder: Path, values: Mapping[str, Any]) -> Drawings:
    """The records of a check, the worst first: those with remarks, then by their scatter at rest over the
    range of the response, fitted before held out. InputError when its table is missing or cannot be used."""
    paths, unit = {"records": folder / "tables" / "check_records.csv"}, str(values["time_unit"])
    table = read_tables(paths, "check", {"records": _COLUMNS})["records"]
    records = sorted(values["records"], key=_rank)
    pictures = [
        drawing(
            f"check_{one['record']}",
            record_figure(table[table["record"] == one["record"]], unit, held_out=bool(one["held_out"])),
            f"Record {one['record']}.",
        )
        for one in records
    ]
    return {"verdict": Verdict("", values["verdict"], ""), "records": zip(records, pictures, strict=True)}


def _rank(record: Mapping[str, Any]) -> tuple[bool, bool, float]:
    noisy = max((share for share, _ in scatter_at_rest(record)), default=0.0)
    return not record["remarks"], record["held_out"], -noisy


def looked(folder: Path, values: Mapping[str, Any]) -> Drawings:
    """The records of a first look, their bands and residuals; InputError when a table of it is missing or
    cannot be used."""
    tables = read_tables({name: folder / "tables" / f"look_{name}.csv" for name in SHOWN}, "look", TABLES)
    return records.drawn(RunData(values, {}, tables, {}))
