"""A finished fit, kept in its run folder and read back without sampling.

`posterior.nc` holds the draws and `fit.json` all else that they rest on: the study with its records, how far
blocks were narrowed, and what its grade rests on. Other files of the folder are not needed.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, final

import numpy as np
import xarray as xr

from lcopa_bayes.core.arrays import Array
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.studycopy import study_from_json, study_to_json
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.results.predictive import Predictive
from lcopa_bayes.results.provenance import digest_of
from lcopa_bayes.sampling.convergence import Limitation, Quality
from lcopa_bayes.sampling.draws import Draws
from lcopa_bayes.sampling.modes import Ridges

NAME = "fit.json"
"""The file beside `posterior.nc`."""
_AGAIN = "run `fit` again with this version of lcopa-bayes"
_CUT = "the run was cut short, or files of two runs are mixed; run `fit` again"


@final
@dataclass(frozen=True, eq=False)
class SavedFit(Predictive):
    """A fit that was read from its run folder: it predicts as it did after sampling."""

    problem: Problem
    draws: Draws
    folder: Path


def fit_to_json(problem: Problem, draws: Draws) -> dict[str, Any]:
    """What `load_fit` needs beside the draws; infinite numbers are text."""
    return {
        "version": version("lcopa-bayes"),
        "refinement": problem.refinement,
        "draws_sha256": digest_of(_free(draws.table, draws.values)),
        "target_ess": draws.target_ess,
        "qualities": [_texts(asdict(one)) for one in draws.qualities],
        "limitations": [one.as_json() for one in draws.limitations],
        "ridges": [
            {
                "parameter": one.parameter,
                "unit": one.unit,
                "boundaries": list(one.boundaries),
                "shares": one.shares.tolist(),
                "errors": one.errors.tolist(),
            }
            for one in draws.ridges
        ],
        "study": study_to_json(problem.study),
    }


def load_fit(folder: Path | str) -> SavedFit:
    """The fit in a run folder; InputError naming the file where it is missing, cut short or of another
    version.

    Draws, grade and model are those of the fit, so that predictions and scores are too.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such run folder; give the folder `fit` wrote")
    path = folder / NAME
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(
            f"{path}: this file of the run folder is missing: it was written by another version, or "
            f"no fit has finished there; {_AGAIN}"
        ) from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"{path}: cannot be read as JSON ({error}); {_CUT}") from None
    given = values.get("version") if isinstance(values, dict) else None
    if given != version("lcopa-bayes"):
        known = f"lcopa-bayes {given}" if given else "another version"
        raise InputError(f"{path}: was written by {known}, this is {version('lcopa-bayes')}; {_AGAIN}")
    try:
        study = study_from_json(values["study"])
        problem = problem_of(study)
        if values["refinement"] > 1:
            problem = problem.refined(values["refinement"])
        parts = (
            tuple(Quality(**_numbers(one)) for one in values["qualities"]),
            float(values["target_ess"]),
            tuple(Ridges(**one | {"boundaries": tuple(one["boundaries"])}) for one in values["ridges"]),
            tuple(
                Limitation(**one | {"parameters": tuple(one["parameters"])}) for one in values["limitations"]
            ),
        )
        wanted = values["draws_sha256"]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: does not hold a fit ({type(error).__name__}: {error}); {_AGAIN}") from None
    drawn, density = _draws(folder / "posterior.nc", problem.posterior.table)
    if digest_of(_free(problem.posterior.table, drawn)) != wanted:
        raise InputError(f"{folder / 'posterior.nc'}: does not hold the draws of {path}; {_CUT}")
    return SavedFit(problem, Draws(problem.posterior.table, drawn, density, *parts), folder)


def _free(table: ParameterTable, values: Array) -> Array:
    """Draws of the free parameters, (ensembles, draws, free)."""
    return values[..., [k for k, row in enumerate(table.rows) if row.free]]


def _draws(path: Path, table: ParameterTable) -> tuple[Array, Array]:
    """Table values (ensembles, draws, rows) and log densities (ensembles, draws)."""
    if not path.is_file():
        raise InputError(f"{path}: this file of the run folder is missing; {_CUT}")
    try:
        with xr.open_dataset(path, group="posterior", engine="h5netcdf") as group:
            columns_read = {
                str(one.attrs.get("parameter", name)): one.transpose("chain", "draw").to_numpy()
                for name, one in group.data_vars.items()
            }
        with xr.open_dataset(path, group="sample_stats", engine="h5netcdf") as group:
            density = group["lp"].transpose("chain", "draw").to_numpy()
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise InputError(f"{path}: cannot be read as draws ({error}); {_CUT}") from None
    absent = [row.name for row in table.rows if row.free and row.name not in columns_read]
    if absent:
        raise InputError(f"{path}: holds no draws of {', '.join(absent)}; {_CUT}")
    columns = [
        columns_read[row.name] if row.free else np.full(density.shape, float(row.value)) for row in table.rows
    ]
    return np.stack(columns, axis=-1), density


def _texts(values: Mapping[str, Any]) -> dict[str, Any]:
    """Numbers that JSON does not know as text."""
    return {
        key: str(value) if isinstance(value, float) and not np.isfinite(value) else value
        for key, value in values.items()
    }


def _numbers(values: Mapping[str, Any]) -> dict[str, Any]:
    """Text of `_texts` as numbers again."""
    odd = {"inf", "-inf", "nan"}
    return {key: float(value) if value in odd else value for key, value in values.items()}
