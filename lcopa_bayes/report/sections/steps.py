"""Step responses of each path and what engineers read off them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd
from matplotlib.axes import Axes

from lcopa_bayes.report.decimation import draw_band, draw_line
from lcopa_bayes.report.formatting import NOT_REACHED, OPEN, figures, interval, to_spread
from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.section import Section, Table, paged
from lcopa_bayes.report.theme import BAND, STEADY, grid, plain, svg_of
from lcopa_bayes.results.bands import POINTWISE

_PER_FIGURE = 6
"""Paths on one figure."""
_WORDS = {
    "rise_10_90": "rise time, 10 to 90 %",
    "settling_2": "settling time to 2 %",
    "settling_5": "settling time to 5 %",
    "value_at_end": "value at end of record",
    "steady_state": "steady state",
}
"""Names of metrics that do not read as words."""
_TIMES = ("rise", "settling")


def section(run: SavedRun) -> Section:
    """Bands of the response to a unit step, and the table of step metrics."""
    curves = run.tables["step_response"]
    paths = list(dict.fromkeys(curves["path"]))
    caption = (
        "Response of the plant to a unit step at time 0, over the longest record: median, "
        f"{POINTWISE} 50 and 90 % bands. Dashed: median and 90 % interval of the steady state it tends to."
    )
    drawings = paged("step", paths, _PER_FIGURE, lambda part: _drawn(run, curves, part), caption)
    tables = (_metrics(run.results["step_metrics"]),) if run.results["step_metrics"] else ()
    return Section("Step responses", drawings=drawings, tables=tables)


def _drawn(run: SavedRun, curves: pd.DataFrame, paths: Sequence[str]) -> str:
    figure, panels = grid(len(paths), columns=2, height=2.2)
    for panel, path in zip(panels, paths, strict=True):
        rows = curves[curves["path"] == path]
        _path(panel, rows)
        panel.set_title(plain(path), loc="left")
        panel.set_ylabel(f"response [{plain(rows['unit'].iloc[0])}]")
        panel.set_xlabel(f"time [{plain(run.time_unit)}]")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    return svg_of(figure)


def _path(panel: Axes, rows: pd.DataFrame) -> None:
    time = rows["time"].to_numpy()
    for low, high, alpha, name in (("05", "95", 0.30, "90 %"), ("25", "75", 0.45, "50 %")):
        lower, upper = rows[f"response_{low}"].to_numpy(), rows[f"response_{high}"].to_numpy()
        draw_band(panel, time, lower, upper, color=BAND, alpha=alpha, label=name)
    draw_line(panel, time, rows["response_50"].to_numpy(), color=BAND, label="median")
    for quantile, width, name in (("50", 1.1, "steady state"), ("05", 0.7, ""), ("95", 0.7, "")):
        level = float(rows[f"steady_{quantile}"].iloc[0])
        panel.axhline(level, color=STEADY, lw=width, ls=(0, (4, 3)), label=name or None)
    panel.axhline(0.0, color="#b0b0b0", lw=0.6, zorder=0)


def _metrics(metrics: Sequence[Mapping[str, Any]]) -> Table:
    return Table.of(
        metrics,
        ("path", "text", lambda row: _kind(row)[1]),
        ("metric", "text", lambda row: _WORDS.get(_kind(row)[0], _kind(row)[0].replace("_", " "))),
        ("median", "interval", _median),
        ("unit", "text", "unit"),
        ("90 % interval", "interval", _interval),
        ("sd", "number", lambda row: figures(row["sd"], 2)),
        ("grade", "grade", "grade"),
        ("note", "prose", lambda row: str(row.get("note", ""))),
        caption="Times count from the step. Intervals are 90 % equal-tailed credible; where they are open, "
        "the response of that share of the draws does not reach them within the record, or does not remain "
        "there after it.",
    )


def _kind(metric: Mapping[str, Any]) -> tuple[str, str]:
    """Kind and path of a metric."""
    kind, _, where = str(metric["name"]).partition("[")
    return kind, where.rstrip("]")


def _open(metric: Mapping[str, Any]) -> str:
    """Text of an end that no draw bounds."""
    return NOT_REACHED if _kind(metric)[0].startswith(_TIMES) else OPEN


def _median(metric: Mapping[str, Any]) -> str:
    return _open(metric) if metric["value"] is None else to_spread(metric["value"], metric["sd"])


def _interval(metric: Mapping[str, Any]) -> str:
    lower, upper, never = metric["lower"], metric["upper"], _open(metric)
    ends = interval(lower, upper, metric["sd"], nothing=never)
    return ends if (lower is None) == (upper is None) else ends.replace(OPEN, never)
