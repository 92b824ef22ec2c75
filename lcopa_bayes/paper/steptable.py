"""Table 1 of Ta et al. 2026 for identified models: step metrics beside those printed and those of a
posterior."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any, final

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

METRICS = ("rise", "settling 2 %", "settling 5 %", "steady", "at end", "peak", "overshoot", "RMSE")
"""Rows of the table for each path."""
PRINTED = ("measured", "fractional", "integer")
"""Columns of Table 1."""
_POINTS = 1000
_FROM_POSTERIOR = {
    "rise": "rise_10_90",
    "settling 2 %": "settling_2",
    "settling 5 %": "settling_5",
    "steady": "steady_state",
    "at end": "value_at_end",
    "overshoot": "overshoot",
}
"""Names of the same metrics among those of a posterior."""


@final
@dataclass(frozen=True)
class Step:
    """Response of one model to a step of one size; times count from the step."""

    rise: float
    """10 to 90 % of the steady value [time unit]; infinite when not reached within the record."""
    settling_2: float
    """Into 2 % of the steady value [time unit]; infinite likewise."""
    settling_5: float
    """Into 5 % of the steady value [time unit]; infinite likewise."""
    steady: float
    """Value at rest [response unit]."""
    at_end: float
    """Value at the end of the record [response unit]."""
    peak: float
    """Largest value within the record, in the direction of the steady one [response unit]."""
    overshoot: float
    """Of the steady value [-]; 0 when the peak stays below it."""


def step_of(model: TransferPath, size: float, span: float) -> Step:
    """Metrics of the response to a step of `size` [drive unit] over a record of length `span` [time unit].

    Settling and rise are about the value the response tends to, as for a posterior.
    """
    times = np.linspace(0.0, span, _POINTS + 1)[1:]
    curve = response_to(AxisDrive(np.zeros(1), np.full(1, size)), model, times)
    steady = model.steady * size
    part = (curve / steady)[None]
    low, high = (float(crossing(times, part, level)[0]) for level in (0.1, 0.9))
    top = float(part.max())
    return Step(
        high - low if high < inf else inf,
        float(settling(times, part, 0.02)[0]),
        float(settling(times, part, 0.05)[0]),
        steady,
        float(curve[-1]),
        steady * top,
        max(top - 1, 0.0),
    )


@final
@dataclass(frozen=True, eq=False)
class Row:
    """One metric of one path."""

    path: str
    size: float
    """Step that the row is about [drive unit]."""
    metric: str
    unit: str
    values: Mapping[str, float]
    """By model, in `unit`; infinite where the response does not get there within the record."""
    printed: Mapping[str, float]
    """Columns of Table 1, in `unit`; empty for a path or metric it does not show."""
    posterior: Mapping[str, Any] | None
    """Value, lower and upper end (None is open), level and grade; None without a posterior."""

    def as_json(self) -> dict[str, Any]:
        """Plain values; infinite values become None."""
        fields: dict[str, Any] = plain(
            {
                "path": self.path,
                "step": self.size,
                "metric": self.metric,
                "unit": self.unit,
                "values": self.values,
                "printed": self.printed,
                "posterior": self.posterior,
            }
        )
        return fields


def step_table(
    study: Study,
    identified: Sequence[Identification],
    *,
    posterior: Mapping[str, Any] | None = None,
    stated: Stated = PAPER,
) -> tuple[Row, ...]:
    """Metrics of every path that every model of `KINDS` gives, for the largest step of its records.

    `posterior` is what `fit` saved of the same study (`load_posterior`); its metrics of a unit step are
    scaled to the size.
    """
    rows: list[Row] = []
    for each in identified:
        data = each.data
        largest = max(data.records, key=lambda r: float(np.abs(r.blocks.drive.values).max()))
        size = float(np.abs(largest.blocks.drive.values).max())
        steps = {kind: step_of(model_of(each, kind).model, size, data.span) for kind in KINDS}
        rmse = {kind: model_of(each, kind).output_rmse for kind in KINDS}
        originals = {r.name: r for r in study.fit}
        shown = any(paper_figure(originals[r.record.name], stated) == "Fig. 13" for r in data.records)
        axes = (study.response_axes[data.response].name, study.drive_axes[data.drive].name)
        table_1 = shown and axes == ("x", "x")
        units = _units(study.time_unit, data.response_unit)
        for metric in METRICS:
            values = rmse if metric == "RMSE" else {k: _value(step, metric) for k, step in steps.items()}
            rows.append(
                Row(
                    data.name,
                    size,
                    metric,
                    units[metric],
                    values,
                    _printed(metric, stated) if table_1 else {},
                    _from_posterior(posterior, metric, data.name, axes[0], size),
                )
            )
    return tuple(rows)


def load_posterior(folder: Path, study: Study) -> Mapping[str, Any]:
    """`results.json` of the run folder of a fit of this study; InputError when it is not one."""
    path = folder / "results.json"
    try:
        results: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error}); give the run folder that `fit` wrote") from None
    if not isinstance(results, dict) or "step_metrics" not in results:
        raise InputError(f"{path}: has no step metrics; give the run folder that `fit` wrote")
    if results.get("study") != study.name:
        raise InputError(
            f"{path}: is of the study {results.get('study')!r}, not {study.name!r}; fit this study first"
        )
    return results


def _value(step: Step, metric: str) -> float:
    fields = {"settling 2 %": "settling_2", "settling 5 %": "settling_5", "at end": "at_end"}
    return float(getattr(step, fields.get(metric, metric)))


def _units(time_unit: str, response_unit: str) -> dict[str, str]:
    times = dict.fromkeys(("rise", "settling 2 %", "settling 5 %"), time_unit)
    levels = dict.fromkeys(("steady", "at end", "peak", "RMSE"), response_unit)
    return times | levels | {"overshoot": "-"}


def _printed(metric: str, stated: Stated) -> dict[str, float]:
    """Columns of Table 1; it does not say into which band a response stabilises, nor when it is steady."""
    given = stated.records
    if metric == "RMSE":
        return {"fractional": given.fractional_rmse, "integer": given.integer_rmse}
    field = "settling" if metric.startswith("settling") else metric
    if not hasattr(given.measured, field):
        return {}
    return {column: float(getattr(getattr(given, column), field)) for column in PRINTED}


def _from_posterior(
    results: Mapping[str, Any] | None, metric: str, path: str, response: str, size: float
) -> Mapping[str, Any] | None:
    if results is None or metric not in _FROM_POSTERIOR:
        return None
    name = _FROM_POSTERIOR[metric]
    named = {row["name"]: row for row in results["step_metrics"]}
    row = named.get(f"{name}[{path}]", named.get(f"{name}[{response}]"))
    if row is None:
        return None
    factor = size if metric in ("steady", "at end") else 1.0
    scaled = {k: None if row[k] is None else factor * row[k] for k in ("value", "lower", "upper")}
    return scaled | {"level": row["level"], "grade": row["grade"]}
