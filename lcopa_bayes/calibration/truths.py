"""Where truths come from: the prior of a study, the posterior of an earlier run, or stated values."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias, final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.errors import InputError, nearest, refuse_if
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.results.savedfit import load_fit

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

    InputError as `load_fit`, when the parameters or their units are others, or the draws are such that the
    priors exclude them.
    """
    draws = load_fit(folder).draws
    free = {row.name: k for k, row in enumerate(table.rows) if row.free}
    units = {row.name: row.unit for row in draws.table.rows if row.free}
    pool = np.tile([row.value for row in table.rows], (len(draws.flat), 1))
    foreign, absent = units.keys() - free, free.keys() - units
    problems = [f"has the parameter {name!r}, which this study does not infer" for name in foreign]
    problems += [f"has no draws of {name!r}, which this study infers" for name in absent]
    for name in free.keys() & units:
        row, pool[:, free[name]] = table.rows[free[name]], draws.column(name)
        if units[name] != row.unit:
            problems.append(f"{name!r} is in {units[name]}, in this study in {row.unit}")
        elif np.isneginf(row.log_prior(draws.column(name))).any():
            problems.append(f"{name!r} has draws that the prior of this study excludes")
    if not problems and not table.supported(pool).all():
        problems.append("has draws whose orders do not decrease, as they must in this study")
    if problems:
        advice = f"{folder}: give the run folder that `fit` wrote for this study"
        raise InputError([*(f"{folder}: {one}" for one in sorted(problems)), advice])
    pool.setflags(write=False)
    return Truths(table, pool, str(folder), draws.grade.level)


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
