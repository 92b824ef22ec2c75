"""The page of a fleet, drawn from its `fleet.json` alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lcopa_bayes.plot.fleet import curves_figure, population_figure
from lcopa_bayes.report.formatting import NONE, figures, percent
from lcopa_bayes.report.page import Drawings
from lcopa_bayes.report.svg import drawing, paged

_PER_FIGURE = 12
"""Most devices on one figure of responses."""
_MOST_ROWS = 400
"""Most rows of the table of all devices and parameters."""
_FITTED = (
    ("differs in:code", "differs_in", str),
    ("outlier, p:number", "p_odd", lambda p: figures(p, 2)),
    ("residual white, p:number", "p_white", lambda p: figures(p, 2)),
    ("RMSE:number", "rmse", figures),
    ("unit", "rmse_unit", str),
    ("in 90 % band:number", "coverage_90", percent),
)
_COLUMNS: Mapping[str, tuple[Any, ...]] = {
    "fit": _FITTED,
    "audit": (
        *_FITTED,
        ("weakly identified:code", "weakly identified", str),
        ("not identified:code", "not identified", str),
    ),
    "loop": (
        ("verdict", "verdict", str),
        ("confidence", "confidence", str),
        ("effects:code", "effects", str),
    ),
    "compare": (("preferred:code", "preferred", str), ("probability:number", "probability", figures)),
}
"""Titles, entries and forms of the columns of devices, by what was done with them."""


def drawn(folder: Path, values: Mapping[str, Any]) -> Drawings:
    """The table of devices, devices against their populations, and the responses of the worst."""
    populations = {
        one["number"]: [
            drawing(
                f"fleet_population_{one['number']}",
                population_figure(one["parameters"]),
                "Lines: 90 % interval of each device by itself, in the order of its median, red where it "
                "does not belong. Dots: the median of the device given all the others. Grey: where 50 and "
                "90 % of the next devices lie, and the mean of the population.",
            )
        ]
        for one in values["groups"]
        if one["parameters"]
    }
    units = {
        device: one["time_unit"] for one in values["groups"] for device in one["devices"] + one["left_out"]
    }
    caption = (
        "The worst devices first: measured response (dots) with the 90 % band with noise, and the residual "
        "below, of the record and axis that the model follows worst."
    )
    curves = [one | {"time_unit": units[one["device"]]} for one in values["curves"]]
    columns = _COLUMNS[values["of"]]
    return {
        "heads": ("device:code", "grade:grade", *(title for title, _, _ in columns), "reason:prose"),
        "devices": [
            (
                row["device"],
                row["grade"],
                *(form(row[key]) if row.get(key) not in (None, "") else NONE for _, key, form in columns),
                NONE if row["grade"] == "reliable" else row["reason"],
            )
            for row in values["devices"]
        ],
        "populations": populations,
        "most": _MOST_ROWS,
        "pairs": sorted(
            (
                (one, row)
                for group in values["groups"]
                for row in group["parameters"]
                for one in row["devices"]
            ),
            key=lambda pair: -float(pair[0]["p_odd"]),
        ),
        "curves": paged("fleet_worst", curves, _PER_FIGURE, curves_figure, caption),
    }
