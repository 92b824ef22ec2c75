"""Where truths come from: the prior of a study, the posterior of an earlier run, or stated values."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias, final

import numpy as np
import xarray as xr

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.errors import InputError, nearest, refuse_if
from lcopa_bayes.inference.parameters import ParameterTable

Stated: TypeAlias = float | tuple[float, float]
"""A true value, or the ends between which it is drawn evenly."""
_TRIES = 1_000
"""Draws from the prior within which the orders must once decrease beside stated ones."""


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

    stated: Mapping[str, Stated] = field(default_factory=dict)
    """By name, each in its parameter's unit: a value that is the same in every replica, or the two ends
    between which it is drawn evenly."""

    def draw(self, rng: np.random.Generator) -> Vector:
        """One truth: canonical table values, (rows,)."""
        if self.pool is not None:
            return np.asarray(self.pool[rng.integers(self.pool.shape[0])])
        for _ in range(_TRIES if self.stated else 1):
            truth = self.table.draw(1, rng)[0]
            for name, value in self.stated.items():
                drawn = rng.uniform(*value) if isinstance(value, tuple) else value
                truth[self.table.names.index(name)] = drawn
            if self.table.supported(truth[None]).all():
                return np.asarray(truth)
        raise InputError(
            "no draw of the prior has decreasing orders and resolved terms beside what is stated; "
            "state the orders and times of all terms, orders decreasing"
        )

    @property
    def fixed(self) -> bool:
        """Whether every free parameter is stated, so that nothing comes from the prior."""
        return bool(self.stated) and all(row.name in self.stated for row in self.table.rows if row.free)

    @property
    def digest(self) -> str:
        """Hash of the pool or of what is stated; empty for the prior."""
        if self.stated:
            return hashlib.sha256(json.dumps(dict(self.stated), sort_keys=True).encode()).hexdigest()
        return (
            "" if self.pool is None else hashlib.sha256(np.ascontiguousarray(self.pool).tobytes()).hexdigest()
        )


def truths_stated(stated: Mapping[str, Stated], table: ParameterTable) -> Truths:
    """Truths with values or ranges that are stated, the other parameters drawn from the prior.

    InputError for a name that is no free parameter, a value the prior excludes, or orders that do not
    decrease.
    """
    rows = {row.name: row for row in table.rows if row.free}
    problems = [
        f"the truth of {name!r} is stated, but this study does not infer it{nearest(name, set(rows))}"
        for name in stated.keys() - rows.keys()
    ]
    problems += [
        f"the truth {name} = {stated[name]} is excluded by the prior of the study, {rows[name].prior}"
        for name in stated.keys() & rows.keys()
        if not np.isfinite(rows[name].log_prior(np.atleast_1d(np.array(stated[name], dtype=float)))).all()
    ]
    if problems:
        raise InputError(sorted(problems))
    truths = Truths(table, stated={name: stated[name] for name in rows if name in stated})
    truths.draw(np.random.default_rng(0))
    return truths


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
            draws = {
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
        [row.value for row in table.rows], (max((v.size for _, v in draws.values()), default=0), 1)
    )
    free = {row.name: k for k, row in enumerate(table.rows) if row.free}
    problems = [
        f"{path}: has the parameter {name!r}, which this study does not infer" for name in draws.keys() - free
    ]
    problems += [f"{path}: has no draws of {name!r}, which this study infers" for name in free.keys() - draws]
    for name in free.keys() & draws:
        row, (unit, values) = table.rows[free[name]], draws[name]
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


def stated_values(words: Sequence[str]) -> dict[str, Stated]:
    """Values by name from words such as ``delay=1.0``, or ranges such as ``delay=0.9:1.1``; InputError where
    a word is neither or a name occurs twice."""
    out: dict[str, Stated] = {}
    problems = []
    for word in words:
        name, _, value = word.partition("=")
        try:
            ends = [float(end) for end in value.split(":")]
        except ValueError:
            ends = []
        sound = len(ends) in (1, 2) and bool(np.isfinite(ends).all()) and ends == sorted(ends)
        if not (name and sound) or name in out:
            problems.append(f"--truth {word}: give NAME=VALUE or NAME=LOW:HIGH in numbers, each name once")
        elif len(ends) == 1:
            out[name] = ends[0]
        else:
            out[name] = (ends[0], ends[1])
    refuse_if(problems)
    return out
