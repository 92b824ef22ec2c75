"""The page of a first look, drawn from `look.json` and its tables alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from lcopa_bayes.core.errors import refuse_if
from lcopa_bayes.report.formatting import interval, to_spread
from lcopa_bayes.report.page import write_graded
from lcopa_bayes.report.savedrun import TABLES, SavedRun, read_table
from lcopa_bayes.report.section import Section, Table
from lcopa_bayes.report.sections import parameters, records
from lcopa_bayes.results.firstlook import TABLES as SHOWN

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
