"""Figures 13 to 17 of Ta et al. 2026 on given records: what was seen and what identified models say.

Data only. A record is one of the paper's figures when it drives the axes x and y, in radians, as the text
says; any other record has the same curves and no printed numbers beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.data.drive import AxisDrive, axis_drives, first_change
from lcopa_bayes.data.record import Record
from lcopa_bayes.data.study import Study
from lcopa_bayes.model.literature import PAPER, Stated
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.paper.equation import response_to
from lcopa_bayes.paper.identify import Identification, Identified
from lcopa_bayes.paper.paths import resting_level

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
