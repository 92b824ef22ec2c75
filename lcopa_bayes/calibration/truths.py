"""Where truths come from: the prior of a study, or the posterior of an earlier run."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np
import xarray as xr

from lcopa_bayes.arrays import Matrix, Vector
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.problems import InputError


@final
@dataclass(frozen=True, eq=False)
class Truths:
    """A source of truths."""

    table: ParameterTable
    pool: Matrix | None = None
    """Draws of an earlier posterior, (draws, rows); None: the prior."""
    folder: str = ""
    """Run folder the pool comes from."""
    grade: str = ""
    """Grade of the pool."""

    def draw(self, rng: np.random.Generator) -> Vector:
        """One truth: canonical table values, (rows,)."""
        if self.pool is None:
            return np.asarray(self.table.draw(1, rng)[0])
        return np.asarray(self.pool[rng.integers(self.pool.shape[0])])

    @property
    def digest(self) -> str:
        """Hash of the pool; empty for the prior."""
        return (
            "" if self.pool is None else hashlib.sha256(np.ascontiguousarray(self.pool).tobytes()).hexdigest()
        )


def truths_around(folder: Path, table: ParameterTable) -> Truths:
    """Truths from the draws in the run folder of a fit with the parameters and priors of `table`.

    InputError when there is no posterior, its parameters or their units are others, or it has draws
    that the priors exclude.
    """
    path = folder / "posterior.nc"
    advice = "give the run folder that `fit` wrote for this study"
    if not path.is_file():
        raise InputError(f"{folder}: holds no posterior.nc; {advice}")
    try:
        with xr.open_dataset(path, group="posterior", engine="h5netcdf") as posterior:
            found = {
                str(held.attrs.get("parameter", name)): (
                    str(held.attrs.get("units", "")),
                    held.to_numpy().ravel(),
                )
                for name, held in posterior.data_vars.items()
            }
        with xr.open_dataset(path, engine="h5netcdf") as root:
            grade = str(root.attrs.get("grade", ""))
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{path}: cannot be read as draws ({error}); {advice}") from None
    pool = np.tile(
        [row.value for row in table.rows], (max((v.size for _, v in found.values()), default=0), 1)
    )
    free = {row.name: k for k, row in enumerate(table.rows) if row.free}
    problems = [
        f"{path}: has the parameter {name!r}, which this study does not infer" for name in found.keys() - free
    ]
    problems += [f"{path}: has no draws of {name!r}, which this study infers" for name in free.keys() - found]
    for name in free.keys() & found:
        row, (unit, values) = table.rows[free[name]], found[name]
        if unit != row.unit:
            problems.append(f"{path}: {name!r} is in {unit}, in this study in {row.unit}")
        elif values.size != pool.shape[0] or not values.size or np.isneginf(row.log_prior(values)).any():
            problems.append(f"{path}: {name!r} has no draws, or draws that the prior of this study excludes")
        else:
            pool[:, free[name]] = values
    if not problems and not table.supported(pool).all():
        problems.append(f"{path}: has draws whose orders do not decrease, as they must in this study")
    if problems:
        raise InputError([*sorted(problems), f"{folder}: {advice}"])
    pool.setflags(write=False)
    return Truths(table, pool, str(folder), grade)
