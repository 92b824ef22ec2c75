"""Devices of a fleet: where their studies are, and what is kept of each one's result."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from lcopa_bayes.core.arrays import Matrix
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.estimate import attributes
from lcopa_bayes.data.study import Study
from lcopa_bayes.data.studyfile import tables_in
from lcopa_bayes.results.fit import Fit
from lcopa_bayes.results.predictive import Predictive
from lcopa_bayes.results.runfolder import ORIGINS, digest, flat, settings_of

SHARED = ("gain", "time", "order", "delay")
"""Kinds of parameters that have a population."""
_MOST_DRAWS = 1000
"""Draws of a device that the population sees."""
_POINTS = 120
"""Points of the curves that a page shows of a device."""


def studies_in(folder: Path) -> list[Path]:
    """Studies in a folder, by name: folders with a study file or with records alone, and study files.

    InputError for a folder that is not there, is empty, holds none, or is a study itself.
    """
    if not folder.is_dir():
        raise InputError(
            f"{folder}: there is no such folder; give the folder that holds the devices' studies"
        )
    if (folder / "study.toml").exists():
        raise InputError(f"{folder}: is one study, not a fleet; give the folder that holds the studies")
    entries = sorted(folder.glob("[!.]*"))
    if not entries:
        raise InputError(f"{folder}: is empty; put a folder with a study of each device there")
    found = [one for one in entries if _is_study(one)]
    if not found:
        raise InputError(
            f"{folder}: holds no study; each device needs a folder with a study.toml or with records, or a "
            "study file of its own"
        )
    return found


def _is_study(path: Path) -> bool:
    if not path.is_dir():
        return path.suffix.lower() == ".toml"
    run = (path / ORIGINS).exists()
    return not run and ((path / "study.toml").exists() or bool(tables_in(path)))


def basis(study: Study, verb: str, *, quick: bool) -> str:
    """Hash of everything the result of a device depends on."""
    values = {
        "verb": verb,
        "quick": quick,
        "records": [digest(record) for record in (*study.fit, *study.held_out)],
        "settings": settings_of(study),
        "compare": flat(study.compare),
        "candidates": [flat(one) for one in study.candidates],
        "version": version("lcopa-bayes"),
    }
    return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()


def row_of(verb: str, values: Mapping[str, Any], fit: Predictive | None) -> dict[str, Any]:
    """What the table says of a device: its verdict by `verb`, then residual and numbers of its fit."""
    row: dict[str, Any] = {"grade": values.get("grade"), "reason": values.get("grade_reason")}
    if verb == "compare":
        best = [one for one in values["models"] if one["name"] == values["preferred"]]
        row = {
            "grade": best[0]["grade"] if best else "unusable",
            "reason": values["why"],
            "preferred": values["preferred"],
            "probability": best[0]["probability"] if best else None,
        }
    elif verb == "loop":
        row |= {key: values[key] for key in ("verdict", "confidence", "sentence")}
        row["effects"] = "; ".join(effect["name"] for effect in values["effects"])
    elif verb == "audit":
        verdicts: dict[str, list[str]] = {}
        for one in values["parameters"]:
            verdicts.setdefault(one["verdict"], []).append(one["name"])
        row |= {name: "; ".join(named) for name, named in sorted(verdicts.items())}
    if fit is None:
        return row
    numbers = fit.to_json()
    tests, scores = numbers["residual_tests"], [*numbers["fit_scores"], *numbers["held_out"]]
    row["p_white"] = min((one["p_white"] for one in tests), default=None)
    row["coverage_90"] = min(one["coverage_90"] for one in scores)
    worst = max(scores, key=lambda one: one["rmse"])
    row["rmse"], row["rmse_unit"] = worst["rmse"], worst["unit"]
    for one in numbers["parameters"]:
        row |= {one["name"]: one["value"], f"{one['name']}_lower": one["lower"]}
        row[f"{one['name']}_upper"] = one["upper"]
    return row


def plant_of(fit: Predictive) -> tuple[dict[str, Any], Matrix]:
    """Axes and shared parameters of a device, and its draws: the parameters on the scale they are sampled on,
    then the log density of the prior of each there, (draws, 2 parameters)."""
    table, thinned = fit.draws.table, fit.draws.thinned(_MOST_DRAWS)
    kept = [k for k, row in enumerate(table.rows) if row.free and row.kind in SHARED]
    coordinates = [table.rows[k].coordinate(thinned[:, k]) for k in kept]
    densities = [table.rows[k].log_density(x) for k, x in zip(kept, coordinates, strict=True)]
    axes = {
        "drives": [f"{one.name} [{one.unit}]" for one in fit.study.drive_axes],
        "responses": [f"{one.name} [{one.unit}]" for one in fit.study.response_axes],
        "time_unit": fit.study.time_unit,
        "parameters": [
            attributes(table.rows[k], "name", "unit") | {"log": table.rows[k].log_scale} for k in kept
        ],
    }
    columns = np.stack([*coordinates, *densities], axis=1)
    return axes, columns[np.isfinite(columns).all(axis=1)]  # rounding may lead out of a prior's support


def curve_of(fit: Predictive | None) -> dict[str, Any] | None:
    """Response, 90 % bands with noise and residual of the record and axis that are followed worst; None where
    a fit was not made just now or its records are short."""
    tested = [one for one in fit.residuals if not one.held_out] if isinstance(fit, Fit) else []
    if not (isinstance(fit, Fit) and tested):
        return None
    worst = min(tested, key=lambda one: one.p_white)
    band = next(one for one in fit.bands if (one.record, one.axis) == (worst.record, worst.axis))
    at = np.unique(np.linspace(0, band.time.size - 1, _POINTS).astype(int))
    columns = {
        **{"time": band.time, "observed": band.observed, "residual": worst.values},
        **{"lower": band.noisy[0], "median": band.plant[2], "upper": band.noisy[4]},
    }
    values = {key: [float(f"{one:.5g}") for one in column[at]] for key, column in columns.items()}
    return {**attributes(worst, "record", "axis", "unit", "p_white"), **values}
