"""The page of `identify`: models of every path, Table 1, and records with the models over them (Figs. 13
to 17)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import pandas as pd

from lcopa_bayes.model.path import Normalisation
from lcopa_bayes.paper.steptable import KINDS, PRINTED
from lcopa_bayes.report.formatting import figures, interval
from lcopa_bayes.report.page import Drawings
from lcopa_bayes.report.savedrun import read_tables
from lcopa_bayes.report.theme import (
    CYCLE,
    HELD_OUT,
    SEEN,
    STEADY,
    Drawing,
    blank,
    draw_line,
    extremes_note,
    label,
    legend_above,
    plain,
    svg_of,
)

Values: TypeAlias = Mapping[str, Any]
"""A part of `identify.json`."""
_COLOURS = dict(zip(KINDS, (CYCLE[0], CYCLE[1], CYCLE[2], CYCLE[3]), strict=True))


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
    return Drawing(Path(entry["samples"]).stem, _drawn(entry, samples, time_unit), caption, mark=mark)


def _drawn(entry: Values, samples: pd.DataFrame, time_unit: str) -> str:
    figure = blank(3.9)
    top, below = figure.subplots(2, 1, sharex=True, height_ratios=[2.2, 1.0])
    time, observed = samples["time"].to_numpy(), samples["observed"].to_numpy()
    colour = HELD_OUT if entry["held_out"] else SEEN
    draw_line(top, time, observed, ".", ms=2.5, mew=0, color=colour, label="observed")
    for kind in KINDS:
        response, shade = samples[kind].to_numpy(), _COLOURS[kind]
        dashed: Any = (0, (4, 2)) if "," in kind else "-"
        draw_line(top, time, response, color=shade, ls=dashed, label=kind)
        if "," not in kind:
            draw_line(below, time, observed - response, ".", ms=2.2, mew=0, color=shade)
    if entry["printed_level"] is not None:
        top.axhline(entry["printed_level"], color=STEADY, lw=0.8, ls=(0, (4, 3)), label="steady, as printed")
    below.axhline(0, color="#b0b0b0", lw=0.6, zorder=0)
    where = f" ({entry['figure']})" if entry["figure"] else ""
    top.set_title(plain(f"{entry['record']}, {entry['axis']}{where}"), color=colour)
    top.set_ylabel(label(entry["axis"], entry["unit"]))
    below.set(ylabel=label("residual", entry["unit"]), xlabel=label("time", time_unit))
    figure.align_ylabels()
    legend_above(figure, top, 3, markerscale=2)
    return svg_of(figure)
