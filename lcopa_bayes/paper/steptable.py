"""Table 1 of Ta et al. 2026 for identified models: step metrics beside those printed and those of a
posterior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.estimate import plain
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.data.study import Study
from lcopa_bayes.model.literature import PAPER, Stated
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.paper.equation import response_to
from lcopa_bayes.paper.figures import KINDS, model_of, paper_figure
from lcopa_bayes.paper.identify import Identification
from lcopa_bayes.results.steps import crossing, settling
from lcopa_bayes.results.stored import stored_values

METRICS: Mapping[str, tuple[str, str, str]] = {
    "rise": ("time", "rise", "rise_10_90"),
    "settling 2 %": ("time", "settling", "settling_2"),
    "settling 5 %": ("time", "settling", "settling_5"),
    "steady": ("response", "steady", "steady_state"),
    "at end": ("response", "", "value_at_end"),
    "peak": ("response", "peak", ""),
    "overshoot": ("-", "overshoot", "overshoot"),
    "RMSE": ("response", "", ""),
}
"""Rows of the table for each path: kind of unit, column entry of Table 1, and name of the same metric among
those of a posterior; empty where there is none. The text does not say into which band a response settles."""
PRINTED = ("measured", "fractional", "integer")
"""Columns of Table 1."""
_POINTS = 1000


def step_of(model: TransferPath, size: float, span: float) -> dict[str, float]:
    """Metrics of the response to a step of `size` [drive unit] over a record of length `span` [time unit].

    Times count from the step and are infinite when not reached within the record: rise from 10 to 90 %, and
    settling, about the value the response tends to, as for a posterior. Values in response units; the
    overshoot, of the steady value [-], is 0 when the peak stays below it.
    """
    times = np.linspace(0.0, span, _POINTS + 1)[1:]
    curve = response_to(AxisDrive(np.zeros(1), np.full(1, size)), model, times)
    steady = model.steady * size
    part = (curve / steady)[None]
    low, high = (float(crossing(times, part, level)[0]) for level in (0.1, 0.9))
    top = float(part.max())
    return {
        "rise": high - low if high < inf else inf,
        "settling 2 %": float(settling(times, part, 0.02)[0]),
        "settling 5 %": float(settling(times, part, 0.05)[0]),
        "steady": steady,
        "at end": float(curve[-1]),
        "peak": steady * top,
        "overshoot": max(top - 1, 0.0),
    }


def step_table(
    study: Study,
    identified: Sequence[Identification],
    *,
    posterior: Mapping[str, Any] | None = None,
    stated: Stated = PAPER,
) -> list[dict[str, Any]]:
    """Metrics of every path that every model of `KINDS` gives, for the largest step of its records.

    `posterior` is what `fit` saved of the same study (`load_posterior`); its metrics of a unit step are
    scaled to the size.

    Returns: per path and metric its path, step [drive unit], metric, unit; values by model, None where a
    response does not get there within the record; printed, the columns of Table 1, empty where it shows
    none; posterior, value, ends (None is open), level and grade, or None.
    """
    rows: list[dict[str, Any]] = []
    originals = {record.name: record for record in study.fit}
    for each in identified:
        data = each.data
        size = max(float(np.abs(record.blocks.drive.values).max()) for record in data.records)
        models = {kind: model_of(each, kind) for kind in KINDS}
        metrics = {
            kind: step_of(one.model, size, data.span) | {"RMSE": one.output_rmse}
            for kind, one in models.items()
        }
        shown = any(paper_figure(originals[r.record.name], stated) == "Fig. 13" for r in data.records)
        axes = (study.response_axes[data.response].name, study.drive_axes[data.drive].name)
        units = {"time": study.time_unit, "response": data.response_unit}
        for metric, (kind, _, _) in METRICS.items():
            row = {
                "path": data.name,
                "step": size,
                "metric": metric,
                "unit": units.get(kind, kind),
                "values": {name: one[metric] for name, one in metrics.items()},
                "printed": _printed(metric, stated) if shown and axes == ("x", "x") else {},
                "posterior": _from_posterior(posterior, metric, data.name, axes[0], size),
            }
            rows.append(plain(row))
    return rows


def load_posterior(folder: Path, study: Study) -> Mapping[str, Any]:
    """`results.json` of the run folder of a fit of this study; InputError when it is not one."""
    results = stored_values(folder, "fit", ("step_metrics",), file="results.json")
    if results.get("study") != study.name:
        raise InputError(
            f"{folder / 'results.json'}: is of the study {results.get('study')!r}, not {study.name!r}; fit "
            "this study first"
        )
    return results


def _printed(metric: str, stated: Stated) -> dict[str, float]:
    """Columns of Table 1."""
    given, field = stated.records, METRICS[metric][1]
    if metric == "RMSE":
        return {"fractional": given.fractional_rmse, "integer": given.integer_rmse}
    return {column: float(getattr(getattr(given, column), field)) for column in PRINTED} if field else {}


def _from_posterior(
    results: Mapping[str, Any] | None, metric: str, path: str, response: str, size: float
) -> Mapping[str, Any] | None:
    name = METRICS[metric][2]
    if results is None or not name:
        return None
    named = {row["name"]: row for row in results["step_metrics"]}
    row = named.get(f"{name}[{path}]", named.get(f"{name}[{response}]"))
    if row is None:
        return None
    factor = size if metric in ("steady", "at end") else 1.0
    scaled = {k: None if row[k] is None else factor * row[k] for k in ("value", "lower", "upper")}
    return scaled | {"level": row["level"], "grade": row["grade"]}
