"""A finished fit, kept in its run folder and read back without sampling.

`posterior.nc` holds the draws and `fit.json` all else that they rest on: the study with its records, how far
blocks were narrowed, and what its grade rests on. Other files of the folder are not needed.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, final

import numpy as np
import xarray as xr

from lcopa_bayes.core.arrays import Array
from lcopa_bayes.core.errors import InputError, UntrustedError
from lcopa_bayes.core.estimate import plain
from lcopa_bayes.core.files import read_json, writable_folder, write_whole
from lcopa_bayes.core.rules import whole
from lcopa_bayes.data.studywriter import study_from_json, study_to_json
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.results.datatree import POSTERIOR, load_tree, posterior_draws
from lcopa_bayes.results.discretisation import FINEST
from lcopa_bayes.results.predictive import Predictive
from lcopa_bayes.results.runfolder import add_origin, opened, origins, provenance
from lcopa_bayes.sampling.convergence import Limitation, Quality
from lcopa_bayes.sampling.draws import Draws
from lcopa_bayes.sampling.modes import Modes

NAME = "fit.json"
"""The file beside `posterior.nc`."""
_AGAIN = "run `fit` on the study again with this version of lcopa-bayes"
_CUT = "the run was cut short, or files of two runs are mixed; run `fit` again"


@final
@dataclass(frozen=True, eq=False)
class SavedFit(Predictive):
    """A fit that was read from its run folder: it predicts as it did after sampling."""

    problem: Problem
    draws: Draws
    folder: Path
    """The run folder it was read from."""

    @property
    def verdict(self) -> str:
        """What the fit said of itself."""
        return str(self.to_json()["verdict"])

    def to_json(self) -> dict[str, Any]:
        """Every number of the fit as plain values; InputError when its file is missing or cut short."""
        return read_json(self.folder / self.file, _CUT)

    def to_datatree(self) -> xr.DataTree:
        """Draws, data and prior in the ArviZ groups, as `fit` wrote them."""
        return load_tree(self.folder / POSTERIOR)

    def save(self, folder: Path | str) -> Path:
        """Copy the files of the fit into another run folder; returns the folder. InputError as `Fit.save`."""
        origin = origins(self.folder).get(self.verb) or provenance(self.study, self.verb)
        with opened(folder, origin) as path:
            if path.resolve() != self.folder.resolve():
                writable_folder(path / "tables")
                names = [*(f"tables/{one.name}" for one in (self.folder / "tables").glob("*.csv")), POSTERIOR]
                for name in (*names, NAME, self.file):
                    write_whole(path / name, partial(shutil.copyfile, self.folder / name))
                add_origin(path, self.verb, origin)
        return path


def fit_to_json(problem: Problem, draws: Draws) -> dict[str, Any]:
    """What `load_fit` needs beside the draws; infinite numbers are text."""
    return {
        "version": version("lcopa-bayes"),
        "refinement": problem.refinement,
        "draws_sha256": draws.sha256,
        "target_ess": draws.target_ess,
        "qualities": [_texts(asdict(one)) for one in draws.qualities],
        "limitations": [one.as_json() for one in draws.limitations],
        "modes": [plain(asdict(one)) for one in draws.modes],
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
    if not path.is_file():
        raise InputError(
            f"{path}: this file of the run folder is missing: it was written by another version, or "
            f"no fit has finished there; {_AGAIN}"
        )
    values = read_json(path, _CUT)
    given = values.get("version")
    if given != version("lcopa-bayes"):
        known = f"lcopa-bayes {given}" if given else "another version"
        raise InputError(f"{path}: was written by {known}, this is {version('lcopa-bayes')}; {_AGAIN}")
    try:
        study = study_from_json(values["study"])
        problem = problem_of(study)
        refinement = values["refinement"]
        if not whole(1, FINEST).holds(refinement):
            raise ValueError(f"refinement {refinement!r}")
        if refinement > 1:
            problem = problem.refined(refinement)
        parts = (
            tuple(Quality(**_numbers(one)) for one in values["qualities"]),
            float(values["target_ess"]),
            tuple(Modes(**one | {"boundaries": tuple(one["boundaries"])}) for one in values["modes"]),
            tuple(
                Limitation(**one | {"parameters": tuple(one["parameters"])}) for one in values["limitations"]
            ),
        )
        wanted = values["draws_sha256"]
    except UntrustedError as error:
        raise InputError(f"{path}: {error}") from None
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise InputError(f"{path}: does not hold a fit ({type(error).__name__}: {error}); {_AGAIN}") from None
    drawn, density = _draws(folder / POSTERIOR, problem.posterior.table)
    read = Draws(problem.posterior.table, drawn, density, *parts)
    if read.sha256 != wanted:
        raise InputError(f"{folder / POSTERIOR}: does not hold the draws of {path}; {_CUT}")
    return SavedFit(problem, read, folder)


def _draws(path: Path, table: ParameterTable) -> tuple[Array, Array]:
    """Table values (ensembles, draws, rows) and log densities (ensembles, draws)."""
    if not path.is_file():
        raise InputError(f"{path}: this file of the run folder is missing; {_CUT}")
    try:
        columns_read = posterior_draws(path)
        with xr.open_dataset(path, group="sample_stats", engine="h5netcdf") as group:
            density = group["lp"].transpose("chain", "draw").to_numpy()
    except Exception as error:  # whatever a damaged file leads the library to
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
