"""Identified models of every path, Table 1, and the records with the models over them (Figs. 13 to 17)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import pandas as pd

from lcopa_bayes.model.path import Normalisation
from lcopa_bayes.paper.steptable import KINDS, PRINTED
from lcopa_bayes.report.section import NONE, OPEN, Cell, Drawing, Kind, Section, Table, figures, interval
from lcopa_bayes.report.theme import (
    CYCLE,
    HELD_OUT,
    SEEN,
    STEADY,
    blank,
    draw_line,
    label,
    legend_above,
    plain,
    said,
    svg_of,
)

Values: TypeAlias = Mapping[str, Any]
"""A part of `identify.json`."""
_HEADINGS = ("fractional", "integer", "output error", "integer o. e.")
"""Columns of the `KINDS`."""
_COLOURS = dict(zip(KINDS, (CYCLE[0], CYCLE[1], CYCLE[2], CYCLE[3]), strict=True))


def sections(values: Values, samples: Sequence[pd.DataFrame]) -> list[Section]:
    """Models, records, metrics of `identify.json`, with the samples of each of its records."""
    time_unit, paths, records = values["time_unit"], values["paths"], values["records"]
    drawings = (_drawing(*one, time_unit) for one in zip(records, samples, strict=True))
    return [
        Section(
            "Identified models",
            (
                "Least squares on the integrated equation inside a scan over orders and delay (Eqs. 59 to "
                "64), and output-error fits beside it; the integer-order rival by the same procedure. A "
                "scale of gain, viscosities and k is a convention: with k given as in Eq. 62, and with the "
                "last viscosity 1 as in Eq. 65.",
            ),
            tables=(_errors(paths, time_unit), *(_coefficients(paths, each.value) for each in Normalisation)),
        ),
        Section(
            "Records and models",
            (
                "Every response sample with the scanned models and the output-error fits; below it the "
                "residual of each model. A record of several drives is the sum over the paths.",
            ),
            tuple(drawings),
            (_scores(records),),
        ),
        Section(
            "Step metrics",
            (
                "Metrics of the response to the largest step each path was identified from; rise is 10 to 90 "
                "%, and rise and settling are about the value the response tends to.",
            ),
            tables=(_metrics(values["step_metrics"]),),
        ),
    ]


def _models(paths: Sequence[Values]) -> list[dict[str, Any]]:
    return [model | {"path": path["path"]} for path in paths for model in path["models"]]


def _errors(paths: Sequence[Values], time_unit: str) -> Table:
    units = ", ".join(dict.fromkeys(f"{path['response_unit']}/{path['drive_unit']}" for path in paths))
    return Table.of(
        _models(paths),
        ("path", "text", "path"),
        ("model", "text", "method"),
        ("orders", "interval", lambda row: ", ".join(map(figures, row["orders"]))),
        (f"delay [{time_unit}]", "number", lambda row: figures(row["delay"], 4)),
        ("steady gain", "number", lambda row: figures(row["steady"], 4)),
        ("equation error", "number", "equation_rmse"),
        ("output error", "number", "output_rmse"),
        ("scanned", "number", "candidates"),
        ("physical", "text", lambda row: "yes" if row["physical"] else "no"),
        caption="Root mean square errors in the unit of the response; physical: viscosities and k are "
        f"positive. The steady gain is response over drive at rest [{units}]; scanned counts candidates.",
    )


def _coefficients(paths: Sequence[Values], normalisation: str) -> Table:
    return Table.of(
        [model | model["coefficients"][normalisation] for model in _models(paths)],
        ("path", "text", "path"),
        ("model", "text", "method"),
        ("gain b", "number", lambda row: figures(row["gain"], 4)),
        ("viscosities", "interval", lambda row: ", ".join(map(figures, row["etas"]))),
        ("k", "number", lambda row: figures(row["stiffness"], 4)),
        caption=f"Coefficients scaled so that: {normalisation}.",
    )


def _drawing(entry: Values, samples: pd.DataFrame, time_unit: str) -> Drawing:
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
        f"{errors}. {said(len(samples))}"
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


def _scores(records: Sequence[Values]) -> Table:
    return Table.of(
        records,
        ("record", "text", "record"),
        ("axis", "text", "axis"),
        ("figure", "text", lambda row: row["figure"] or NONE),
        ("use", "text", lambda row: "held out" if row["held_out"] else "fit"),
        ("unit", "text", "unit"),
        *_by_kind(lambda row, k: figures(row["curves"][k]["rmse"])),
        (
            "printed: fract. / int.",
            "number",
            lambda row: (
                " / ".join(curve["printed_rmse"] for curve in row["curves"][:2]) if row["figure"] else NONE
            ),
        ),
        caption="RMSE of every model on every record, and what the text prints for such a record. Fractional "
        "and integer: the scan; then the output-error fits with free and with integer orders.",
    )


def _by_kind(cell: Callable[[Values, int], str]) -> Iterator[tuple[str, Kind, Cell]]:
    """A column for each of the `KINDS`, filled by its position."""
    for k, heading in enumerate(_HEADINGS):
        yield heading, "number", partial(lambda row, k: cell(row, k), k=k)


def _metrics(rows: Sequence[Values]) -> Table:
    sizes = ", ".join(
        f"{path} {figures(size)}" for path, size in {row["path"]: row["step"] for row in rows}.items()
    )
    credible: tuple[tuple[str, Kind, Cell], ...] = (
        ("90 % credible", "interval", lambda row: _credible(row["posterior"])),
        ("grade", "grade", lambda row: str((row["posterior"] or {"grade": ""})["grade"])),
    )
    return Table.of(
        rows,
        ("path", "text", "path"),
        ("metric", "text", "metric"),
        ("unit", "text", "unit"),
        *_by_kind(lambda row, k: _reached(row["values"][KINDS[k]])),
        (
            "Table 1: measured/fract./int.",
            "number",
            lambda row: " / ".join(_printed(row, column) for column in PRINTED) if row["printed"] else NONE,
        ),
        *(credible if any(row["posterior"] is not None for row in rows) else ()),
        caption=f"Steps in the unit of the drive: {sizes}. "
        f"{OPEN}: not reached within the record. Printed values are those of Table 1 for the measured and "
        "both modelled responses. The table does not state into which band a response stabilises, so its "
        "single time is shown in both rows.",
    )


def _reached(value: float | None) -> str:
    return OPEN if value is None else figures(value)


def _printed(row: Values, column: str) -> str:
    if column not in row["printed"]:
        return NONE
    bound = "> " if (row["metric"], column) == ("RMSE", "integer") else ""
    return bound + figures(row["printed"][column])


def _credible(estimate: Mapping[str, Any] | None) -> str:
    if estimate is None:
        return NONE
    lower, upper = estimate["lower"], estimate["upper"]
    spread = abs(upper - lower) / 4 if lower is not None and upper is not None else None
    return interval(lower, upper, spread)
