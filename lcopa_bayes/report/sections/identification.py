"""Identified models of every path, Table 1, and the records with the models over them (Figs. 13 to 17)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lcopa_bayes.model.path import Normalisation
from lcopa_bayes.paper.figures import KINDS, Panel
from lcopa_bayes.paper.identify import Identification
from lcopa_bayes.paper.steptable import PRINTED, Row
from lcopa_bayes.report.decimation import extremes, said
from lcopa_bayes.report.formatting import NONE, OPEN, figures, interval
from lcopa_bayes.report.section import Column, Drawing, Section, Table
from lcopa_bayes.report.theme import CYCLE, HELD_OUT, SEEN, STEADY, blank, label, plain, svg_of

_HEADINGS = ("fractional", "integer", "output error", "integer o. e.")
"""Columns of the `KINDS`."""
_COLOURS = dict(zip(KINDS, (CYCLE[0], CYCLE[1], CYCLE[2], CYCLE[3]), strict=True))


def sections(
    time_unit: str, identified: Sequence[Identification], rows: Sequence[Row], panels: Sequence[Panel]
) -> list[Section]:
    """Models, records, metrics."""
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
                _errors(identified, time_unit),
                *(_coefficients(identified, each) for each in Normalisation),
            ),
        ),
        Section(
            "Records and models",
            (
                "Every response sample with the scanned models and the output-error fits; below it the "
                "residual of each model. A record of several drives is the sum over the paths.",
            ),
            tuple(_drawing(number, panel, time_unit) for number, panel in enumerate(panels, start=1)),
            (_scores(panels),),
        ),
        Section(
            "Step metrics",
            (
                "Metrics of the response to the largest step each path was identified from; rise is 10 to 90 "
                "%, and rise and settling are about the value the response tends to.",
            ),
            tables=(_metrics(rows),),
        ),
    ]


def _errors(identified: Sequence[Identification], time_unit: str) -> Table:
    columns = (
        *(Column("path"), Column("model"), Column("orders", "interval")),
        *(Column(f"delay [{time_unit}]", "number"), Column("steady gain", "number")),
        *(Column("equation error", "number"), Column("output error", "number"), Column("scanned", "number")),
        Column("physical"),
    )
    rows = tuple(
        (
            *(each.data.name, result.method, ", ".join(figures(o) for o in result.model.orders)),
            *(figures(result.model.delay, 4), figures(result.model.steady, 4), figures(result.equation_rmse)),
            *(figures(result.output_rmse), NONE if result.candidates is None else f"{result.candidates}"),
            "yes" if result.model.physical else "no",
        )
        for each in identified
        for result in each.models
    )
    units = ", ".join(dict.fromkeys(f"{e.data.response_unit}/{e.data.drive_unit}" for e in identified))
    caption = (
        "Root mean square errors in the unit of the response; physical: viscosities and k are positive. The "
        f"steady gain is response over drive at rest [{units}]; scanned counts candidates."
    )
    return Table(columns, rows, caption)


def _coefficients(identified: Sequence[Identification], normalisation: Normalisation) -> Table:
    columns = (
        *(Column("path"), Column("model"), Column("gain b", "number")),
        *(Column("viscosities", "interval"), Column("k", "number")),
    )
    rows = []
    for each in identified:
        given = each.stiffness[0][0]
        for result in each.models:
            path = result.model.normalised(normalisation, given)
            etas = ", ".join(figures(eta) for eta in path.etas)
            rows.append(
                (each.data.name, result.method, figures(path.gain, 4), etas, figures(path.stiffness, 4))
            )
    return Table(columns, tuple(rows), f"Coefficients scaled so that: {normalisation.value}.")


def _drawing(number: int, panel: Panel, time_unit: str) -> Drawing:
    where = f"{panel.figure} of the paper shows such a record. " if panel.figure else ""
    level = (
        f"Dashed: the steady value it gives, {figures(panel.printed_level)} {panel.unit}. "
        if panel.printed_level is not None
        else ""
    )
    errors = "; ".join(f"{curve.kind} {figures(curve.rmse)}" for curve in panel.curves)
    use = "held out of the identification" if panel.held_out else "used for identification where it can be"
    caption = (
        f"Record {panel.record}, axis {panel.axis}, {use}. {where}{level}RMSE [{panel.unit}]: {errors}. "
        f"{said(panel.time.size)}"
    )
    stem = f"identify_{number:02d}_{panel.record}_{panel.axis}"
    return Drawing(stem, _drawn(panel, time_unit), caption, mark="held out" if panel.held_out else "")


def _drawn(panel: Panel, time_unit: str) -> str:
    figure = blank(3.9)
    top, below = figure.subplots(2, 1, sharex=True, height_ratios=[2.2, 1.0])
    at = extremes(panel.observed)
    colour = HELD_OUT if panel.held_out else SEEN
    top.plot(panel.time[at], panel.observed[at], ".", ms=2.5, mew=0, color=colour, label="observed")
    for curve in panel.curves:
        at = extremes(curve.response)
        shade, dashed = _COLOURS[curve.kind], (0, (4, 2)) if "," in curve.kind else "-"
        top.plot(panel.time[at], curve.response[at], color=shade, ls=dashed, label=curve.kind)
        residual = panel.observed - curve.response
        if "," not in curve.kind:
            at = extremes(residual)
            below.plot(panel.time[at], residual[at], ".", ms=2.2, mew=0, color=shade)
    if panel.printed_level is not None:
        top.axhline(panel.printed_level, color=STEADY, lw=0.8, ls=(0, (4, 3)), label="steady, as printed")
    below.axhline(0, color="#b0b0b0", lw=0.6, zorder=0)
    where = f" ({panel.figure})" if panel.figure else ""
    top.set_title(plain(f"{panel.record}, {panel.axis}{where}"), loc="left", color=colour)
    top.set_ylabel(label(panel.axis, panel.unit))
    below.set_ylabel(label("residual", panel.unit))
    below.set_xlabel(label("time", time_unit))
    figure.align_ylabels()
    figure.legend(*top.get_legend_handles_labels(), loc="outside upper center", ncols=3, markerscale=2)
    return svg_of(figure)


def _scores(panels: Sequence[Panel]) -> Table:
    columns = (
        *(Column("record"), Column("axis"), Column("figure"), Column("use"), Column("unit")),
        *(Column(heading, "number") for heading in _HEADINGS),
        Column("printed: fract. / int.", "number"),
    )
    rows = tuple(
        (
            *(panel.record, panel.axis, panel.figure or NONE, "held out" if panel.held_out else "fit"),
            *(panel.unit, *(figures(curve.rmse) for curve in panel.curves)),
            " / ".join(curve.printed_rmse for curve in panel.curves[:2]) if panel.figure else NONE,
        )
        for panel in panels
    )
    caption = (
        "RMSE of every model on every record, and what the text prints for such a record. Fractional and "
        "integer: the scan; then the output-error fits with free and with integer orders."
    )
    return Table(columns, rows, caption)


def _metrics(rows: Sequence[Row]) -> Table:
    columns = (
        *(Column("path"), Column("metric"), Column("unit")),
        *(Column(heading, "number") for heading in _HEADINGS),
        Column("Table 1: measured/fract./int.", "number"),
        *(Column("90 % credible", "interval"), Column("grade", "grade")),
    )
    cells = tuple(
        (
            *(row.path, row.metric, row.unit),
            *(_reached(row.values[kind]) for kind in KINDS),
            " / ".join(_printed(row, column) for column in PRINTED) if row.printed else NONE,
            *_credible(row.posterior),
        )
        for row in rows
    )
    if all(row.posterior is None for row in rows):
        columns, cells = columns[:-2], tuple(row[:-2] for row in cells)
    sizes = ", ".join(
        f"{path} {figures(size)}" for path, size in {row.path: row.size for row in rows}.items()
    )
    caption = (
        f"Steps in the unit of the drive: {sizes}. "
        f"{OPEN}: not reached within the record. Printed values are those of Table 1 for the measured and "
        "both modelled responses. The table does not state into which band a response stabilises, so its "
        "single time is shown in both rows."
    )
    return Table(columns, cells, caption)


def _reached(value: float) -> str:
    return OPEN if value == float("inf") else figures(value)


def _printed(row: Row, column: str) -> str:
    if column not in row.printed:
        return NONE
    bound = "> " if (row.metric, column) == ("RMSE", "integer") else ""
    return bound + figures(row.printed[column])


def _credible(estimate: Mapping[str, Any] | None) -> tuple[str, str]:
    if estimate is None:
        return NONE, ""
    lower, upper = estimate["lower"], estimate["upper"]
    spread = abs(upper - lower) / 4 if lower is not None and upper is not None else None
    return interval(lower, upper, spread), str(estimate["grade"])
