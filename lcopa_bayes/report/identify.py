"""The page of `identify`: models of every path, Table 1, and records with the models over them (Figs. 13
to 17)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import pandas as pd

from lcopa_bayes.model.path import Normalisation
from lcopa_bayes.paper.steptable import KINDS, PRINTED
from lcopa_bayes.plot.paper import identified_figure
from lcopa_bayes.plot.rundata import read_tables
from lcopa_bayes.plot.theme import extremes_note
from lcopa_bayes.report.formatting import figures, interval
from lcopa_bayes.report.page import Drawings
from lcopa_bayes.report.svg import Drawing, drawing

Values: TypeAlias = Mapping[str, Any]
"""A part of `identify.json`."""


def drawn(folder: Path, values: Values) -> Drawings:
    """The records of an identification; InputError when a table of samples cannot be used."""
    paths, unit = {one["samples"]: folder / one["samples"] for one in values["records"]}, values["time_unit"]
    samples = read_tables(paths, "identify")

    def credible(one: Values) -> str:
        lower, upper = one["lower"], one["upper"]
        return interval(lower, upper, None if None in (lower, upper) else abs(upper - lower) / 4)

    return {
        "verdict": None,
        "records": [_drawing(one, samples[one["samples"]], unit) for one in values["records"]],
        "normalisations": [one.value for one in Normalisation],
        "kinds": KINDS,
        "columns": PRINTED,
        "credible_interval": credible,
    }


def _drawing(entry: Values, samples: pd.DataFrame, time_unit: str) -> Drawing:
    """A record with the models over it: an entry of `identify.json` and its samples."""
    where = f"{entry['figure']} of the paper shows such a record. " if entry["figure"] else ""
    level = (
        f"Dashed: the steady value it gives, {figures(entry['printed_level'])} {entry['unit']}. "
        if entry["printed_level"] is not None
        else ""
    )
    errors = "; ".join(f"{curve['model']} {figures(curve['rmse'])}" for curve in entry["curves"])
    use = "held out of the identification" if entry["held_out"] else "used for identification where it can be"
    caption = (
        f"Record {entry['record']}, axis {entry['axis']}, {use}. {where}{level}RMSE [{entry['unit']}]: "
        f"{errors}. {extremes_note(len(samples))}"
    )
    mark = "held out" if entry["held_out"] else ""
    return drawing(
        Path(entry["samples"]).stem, identified_figure(entry, samples, time_unit), caption, mark=mark
    )
