"""The page of a design, drawn from `design.json` and the drive of its run folder alone."""

from __future__ import annotations

from collections.abc import Mapping
from math import inf
from pathlib import Path
from typing import Any

from lcopa_bayes.data.drive import drive_of
from lcopa_bayes.data.record import load_columns
from lcopa_bayes.plot.designs import drive_figure, precision_figure
from lcopa_bayes.report.page import Drawings
from lcopa_bayes.report.svg import Drawing, drawing

_CURVE = (
    "Expected relative standard deviation (median over draws) after the best drive and after the plain step; "
    "dotted: 10 %. A gap: not determined at most draws."
)


def drawn(folder: Path, values: Mapping[str, Any]) -> Drawings:
    """The recommended drive, drives by rank, and precision against bench time of a design."""
    curve, drive = list[Drawing](), list[Drawing]()
    if values["curve"][0]["best"]:
        curve = [drawing("design_curve", precision_figure(values), _CURVE, data="design.json")]
    if values["template"] is not None:
        text = (
            "The drive to play next, one of many changes with its beginning; its rows are in "
            + str(values["template"])
            + "."
        )
        figure = drive_figure(drive_of(load_columns(folder / values["template"], responses=False)))
        drive = [drawing("design_drive", figure, text, data=values["template"])]
    ranked = sorted(values["table"], key=lambda row: -_factor(row))
    return {"curve": curve, "drive": drive, "ranked": ranked}


def _factor(row: Mapping[str, Any]) -> float:
    """How many times better than the step a drive is; infinite, which JSON cannot hold, where only the step
    leaves a parameter open."""
    factor = row["factor_over_step"]
    return inf if factor is None else float(factor)
