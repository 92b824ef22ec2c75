"""Table 1 of Ta et al. 2026 for identified models: step metrics beside those printed and those of a
posterior.

Figures 13 to 17 of Ta et al. 2026 on given records: what was seen and what identified models say.

Data only. A record is one of the paper's figures when it drives the axes x and y, in radians, as the text
says; any other record has the same curves and no printed numbers beside them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.estimate import plain
from lcopa_bayes.data.drive import AxisDrive, axis_drives, first_change
from lcopa_bayes.data.record import Record
from lcopa_bayes.data.study import Study
from lcopa_bayes.model.literature import PAPER, Stated
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.paper.identify import Identification, Identified
from lcopa_bayes.paper.paths import response_to, resting_level
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
        shown = any(paper_figure(originals[r.record.name]) == "Fig. 13" for r in data.records)
        axes = (study.response_axes[data.response].name, study.drive_axes[data.drive].name)
        units = {"time": study.time_unit, "response": data.response_unit}
        for metric, (kind, _, _) in METRICS.items():
            row = {
                "path": data.name,
                "step": size,
                "metric": metric,
                "unit": units.get(kind, kind),
                "values": {name: one[metric] for name, one in metrics.items()},
                "printed": _printed(metric) if shown and axes == ("x", "x") else {},
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


def _printed(metric: str) -> dict[str, float]:
    """Columns of Table 1."""
    given, field = PAPER.records, METRICS[metric][1]
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


KINDS = ("fractional", "integer", "fractional, output error", "integer, output error")
"""Models that are shown: the paper's scan with free and with integer orders, and the output-error fits."""
_SAME_DRIVE = 1e-3
"""Drives closer than this are the same step [rad]; the text gives fractions of pi."""


def model_of(identified: Identification, kind: str) -> Identified:
    """The identified model of a path of one of the `KINDS`."""
    models = (identified.scan, identified.integer, identified.output_error, identified.integer_output_error)
    return dict(zip(KINDS, models, strict=True))[kind]


def panels(
    study: Study, identified: Sequence[Identification], stated: Stated = PAPER
) -> list[tuple[dict[str, Any], pd.DataFrame]]:
    """Every response axis of every record, fitted records first, with the models of `KINDS`.

    `identified` are the paths of the study. A model of an axis is the sum over the drives that move; its
    resting level is that of the record, as in the identification.

    Returns: for each, plain values (record, axis, unit, held_out; figure of the paper that shows such a
    record, empty when none does; printed_level, the steady response the text gives [response unit] or None;
    curves with model, RMSE [response unit] and what the text prints for it), and a table of the samples:
    time [time unit], observed and each model [response unit].
    """
    out = []
    for held, records in ((False, study.fit), (True, study.held_out)):
        for record in records:
            figure = paper_figure(record, stated)
            for i, axis in enumerate(study.response_axes):
                taken = np.isfinite(record.response[:, i])
                if not (taken.any() and any(drive.moves for drive in axis_drives(record))):
                    continue
                time, seen = record.time[taken], record.response[taken, i]
                models = {kind: _response(study, identified, record, i, kind) for kind in KINDS}
                curves = [
                    {
                        "model": kind,
                        "rmse": float(np.sqrt(np.mean((seen - response) ** 2))),
                        "printed_rmse": _printed_rmse(figure, kind, stated),
                    }
                    for kind, response in models.items()
                ]
                values = {
                    **{"record": record.name, "axis": axis.name, "unit": axis.unit, "held_out": held},
                    **{"figure": figure, "printed_level": _printed_level(figure, axis.name, stated)},
                    "curves": curves,
                }
                out.append((values, pd.DataFrame({"time": time, "observed": seen} | models)))
    return out


def paper_figure(record: Record, stated: Stated = PAPER) -> str:
    """The figure that shows such a record: "Fig. 13" (on), "Fig. 14" (off), "Fig. 16", "Fig. 17" or ""."""
    axes = {axis.name: j for j, axis in enumerate(record.drive_axes) if axis.unit == "rad"}
    if "x" not in axes or len(axes) != len(record.drive_axes) or set(axes) - {"x", "y"}:
        return ""
    first, last = (
        tuple(float(record.drive[row, axes[name]]) if name in axes else 0.0 for name in "xy")
        for row in (0, -1)
    )
    steps = [AxisDrive.of_rows(record.time, record.drive[:, j]).times.size for j in axes.values()]
    if max(steps) > 1:
        return ""
    given, rest = stated.records, (0.0, 0.0)
    known = {
        "Fig. 13": (rest, (given.step_drive, 0.0)),
        "Fig. 14": ((given.step_drive, 0.0), rest),
        "Fig. 16": (rest, (given.single_axis_drive, 0.0)),
        "Fig. 17": (rest, given.two_axis_drive),
    }
    for figure, ends in known.items():
        if np.allclose((first, last), ends, rtol=0, atol=_SAME_DRIVE):
            return figure
    return ""


def _response(
    study: Study, identified: Sequence[Identification], record: Record, response: int, kind: str
) -> Vector:
    taken = np.isfinite(record.response[:, response])
    times, seen = record.time[taken], record.response[taken, response]
    begin = first_change(record)
    out = np.full(times.size, resting_level(times, seen, begin)[0])
    for each in identified:
        drive = AxisDrive.of_rows(record.time, record.drive[:, each.data.drive])
        if each.data.response == response and drive.moves:
            model: TransferPath = model_of(each, kind).model
            out += response_to(drive, model, times, exposure=study.exposure)
    return out


def _printed_rmse(figure: str, kind: str, stated: Stated) -> str:
    given = stated.records
    if not figure or "," in kind:  # the text has no output-error fits
        return ""
    if kind == "integer":
        return f"> {given.integer_rmse:g}"
    two = figure == "Fig. 17"
    return f"{given.fractional_rmse_two_axes if two else given.fractional_rmse:g}"


def _printed_level(figure: str, axis: str, stated: Stated) -> float | None:
    given = stated.records
    x = given.single_axis_ideal
    known = {
        ("Fig. 13", "x"): given.measured.steady,
        ("Fig. 14", "x"): 0.0,
        ("Fig. 16", "x"): x,
        ("Fig. 16", "y"): x * given.crosstalk_measured,
        ("Fig. 17", "x"): given.two_axis_steady[0],
        ("Fig. 17", "y"): given.two_axis_steady[1],
    }
    return known.get((figure, axis))
