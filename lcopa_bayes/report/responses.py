"""Step and frequency responses of each path, and what engineers read off them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lcopa_bayes.plot.responses import bode_figure, steps_figure
from lcopa_bayes.plot.rundata import RunData
from lcopa_bayes.report.formatting import NOT_REACHED, OPEN, interval, to_spread
from lcopa_bayes.report.page import Drawings
from lcopa_bayes.report.svg import paged
from lcopa_bayes.results.bands import POINTWISE, SIMULTANEOUS

_STEPS_PER_FIGURE, _BODE_PER_FIGURE = 6, 4
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


def drawn(run: RunData) -> Drawings:
    """Bands of the response to a unit step and the step metrics as they are printed; Bode plots."""
    step, bode = run.tables["step_response"], run.tables["frequency_response"]
    paths, answered = list(dict.fromkeys(step["path"])), list(dict.fromkeys(bode["path"]))
    steps = (
        "Response of the plant to a unit step at time 0, over the longest record: median, "
        f"{POINTWISE} 50 and 90 % bands. Dashed: median and 90 % interval of the steady state it tends to."
    )
    frequency = (
        f"Gain and phase of each path: median, {POINTWISE} 50 and 90 % bands, and the {SIMULTANEOUS} "
        "90 % band (dashed), which holds the whole curve. From one cycle in the longest fit record to one in "
        "two sampling periods."
    )
    return {
        "steps": paged(
            "step",
            paths,
            _STEPS_PER_FIGURE,
            lambda part: steps_figure(run, part),
            steps,
            "tables/step_response.csv",
        ),
        "frequency": paged(
            "frequency",
            answered,
            _BODE_PER_FIGURE,
            lambda part: bode_figure(run, part),
            frequency,
            "tables/frequency_response.csv",
        ),
        "metrics": [_metric(row) for row in run.results["step_metrics"]],
    }


def _metric(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row of the table of step metrics."""
    kind, _, path = str(row["name"]).partition("[")
    never = NOT_REACHED if kind.startswith(_TIMES) else OPEN
    lower, upper = row["lower"], row["upper"]
    ends = interval(lower, upper, row["sd"], nothing=never)
    return {
        **{key: row[key] for key in ("unit", "sd", "grade")},
        "path": path.rstrip("]"),
        "metric": _WORDS.get(kind, kind.replace("_", " ")),
        "median": never if row["value"] is None else to_spread(row["value"], row["sd"]),
        "ends": ends,
        "note": row.get("note", ""),
    }
