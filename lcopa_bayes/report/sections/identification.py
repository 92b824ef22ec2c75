"""Identified models of every path, Table 1, and the records with the models over them (Figs. 13 to 17)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import pandas as pd

from lcopa_bayes.model.path import Normalisation
from lcopa_bayes.paper.figures import KINDS
from lcopa_bayes.paper.steptable import PRINTED
from lcopa_bayes.report.decimation import extremes, said
from lcopa_bayes.report.formatting import NONE, OPEN, figures, interval
from lcopa_bayes.report.section import Column, Drawing, Section, Table
from lcopa_bayes.report.theme import CYCLE, HELD_OUT, SEEN, STEADY, blank, label, plain, svg_of

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
            tables=(
                _errors(paths, time_unit),
                *(_coefficients(paths, each.value) for each in Normalisation),
            ),
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


def _errors(paths: Sequence[Values], time_unit: str) -> Table:
    columns = (
        *(Column("path"), Column("model"), Column("orders", "interval")),
        *(Column(f"delay [{time_unit}]", "number"), Column("steady gain", "number")),
        *(Column("equation error", "number"), Column("output error", "number"), Column("scanned", "number")),
        Column("physical"),
    )
    rows = tuple(
        (
            *(path["path"], model["method"], ", ".join(map(figures, model["orders"]))),
            *(figures(model["delay"], 4), figures(model["steady"], 4), figures(model["equation_rmse"])),
            *(
                figures(model["output_rmse"]),
                NONE if model["candidates"] is None else str(model["candidates"]),
            ),
            "yes" if model["physical"] else "no",
        )
        for path in paths
        for model in path["models"]
    )
    units = ", ".join(dict.fromkeys(f"{path['response_unit']}/{path['drive_unit']}" for path in paths))
    caption = (
        "Root mean square errors in the unit of the response; physical: viscosities and k are positive. The "
        f"steady gain is response over drive at rest [{units}]; scanned counts candidates."
    )
    return Table(columns, rows, caption)


def _coefficients(paths: Sequence[Values], normalisation: str) -> Table:
    columns = (
        *(Column("path"), Column("model"), Column("gain b", "number")),
        *(Column("viscosities", "interval"), Column("k", "number")),
    )
    rows = []
    for path in paths:
        for model in path["models"]:
            own = model["coefficients"][normalisation]
            etas = ", ".join(map(figures, own["etas"]))
            rows.append(
                (path["path"], model["method"], figures(own["gain"], 4), etas, figures(own["stiffness"], 4))
            )
    return Table(columns, tuple(rows), f"Coefficients scaled so that: {normalisation}.")


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
    at = extremes(observed)
    colour = HELD_OUT if entry["held_out"] else SEEN
    top.plot(time[at], observed[at], ".", ms=2.5, mew=0, color=colour, label="observed")
    for kind in KINDS:
        response = samples[kind].to_numpy()
        at = extremes(response)
        shade, dashed = _COLOURS[kind], (0, (4, 2)) if "," in kind else "-"
        top.plot(time[at], response[at], color=shade, ls=dashed, label=kind)
        residual = observed - response
        if "," not in kind:
            at = extremes(residual)
            below.plot(time[at], residual[at], ".", ms=2.2, mew=0, color=shade)
    if entry["printed_level"] is not None:
        top.axhline(entry["printed_level"], color=STEADY, lw=0.8, ls=(0, (4, 3)), label="steady, as printed")
    below.axhline(0, color="#b0b0b0", lw=0.6, zorder=0)
    where = f" ({entry['figure']})" if entry["figure"] else ""
    top.set_title(plain(f"{entry['record']}, {entry['axis']}{where}"), loc="left", color=colour)
    top.set_ylabel(label(entry["axis"], entry["unit"]))
    below.set_ylabel(label("residual", entry["unit"]))
    below.set_xlabel(label("time", time_unit))
    figure.align_ylabels()
    figure.legend(*top.get_legend_handles_labels(), loc="outside upper center", ncols=3, markerscale=2)
    return svg_of(figure)


def _scores(records: Sequence[Values]) -> Table:
    columns = (
        *(Column("record"), Column("axis"), Column("figure"), Column("use"), Column("unit")),
        *(Column(heading, "number") for heading in _HEADINGS),
        Column("printed: fract. / int.", "number"),
    )
    rows = tuple(
        (
            *(one["record"], one["axis"], one["figure"] or NONE, "held out" if one["held_out"] else "fit"),
            *(one["unit"], *(figures(curve["rmse"]) for curve in one["curves"])),
            " / ".join(curve["printed_rmse"] for curve in one["curves"][:2]) if one["figure"] else NONE,
        )
        for one in records
    )
    caption = (
        "RMSE of every model on every record, and what the text prints for such a record. Fractional and "
        "integer: the scan; then the output-error fits with free and with integer orders."
    )
    return Table(columns, rows, caption)


def _metrics(rows: Sequence[Values]) -> Table:
    columns = (
        *(Column("path"), Column("metric"), Column("unit")),
        *(Column(heading, "number") for heading in _HEADINGS),
        Column("Table 1: measured/fract./int.", "number"),
        *(Column("90 % credible", "interval"), Column("grade", "grade")),
    )
    cells = tuple(
        (
            *(row["path"], row["metric"], row["unit"]),
            *(_reached(row["values"][kind]) for kind in KINDS),
            " / ".join(_printed(row, column) for column in PRINTED) if row["printed"] else NONE,
            *_credible(row["posterior"]),
        )
        for row in rows
    )
    if all(row["posterior"] is None for row in rows):
        columns, cells = columns[:-2], tuple(row[:-2] for row in cells)
    sizes = ", ".join(
        f"{path} {figures(size)}" for path, size in {row["path"]: row["step"] for row in rows}.items()
    )
    caption = (
        f"Steps in the unit of the drive: {sizes}. "
        f"{OPEN}: not reached within the record. Printed values are those of Table 1 for the measured and "
        "both modelled responses. The table does not state into which band a response stabilises, so its "
        "single time is shown in both rows."
    )
    return Table(columns, cells, caption)


def _reached(value: float | None) -> str:
    return OPEN if value is None else figures(value)


def _printed(row: Values, column: str) -> str:
    if column not in row["printed"]:
        return NONE
    bound = "> " if (row["metric"], column) == ("RMSE", "integer") else ""
    return bound + figures(row["printed"][column])


def _credible(estimate: Mapping[str, Any] | None) -> tuple[str, str]:
    if estimate is None:
        return NONE, ""
    lower, upper = estimate["lower"], estimate["upper"]
    spread = abs(upper - lower) / 4 if lower is not None and upper is not None else None
    return interval(lower, upper, spread), str(estimate["grade"])
