"""Whether the delays of several paths can be distinguished, given which drives moved and when."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy.stats import norm

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.estimate import LEVEL, plain
from lcopa_bayes.data.study import Study
from lcopa_bayes.identifiability.curvature import curvature
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.likelihood import Landscape
from lcopa_bayes.inference.parameters import ParameterTable


@dataclass(frozen=True)
class Separation:
    """Smallest difference of the delays of two paths that the records resolve."""

    pair: tuple[str, str]
    """Names of the paths."""
    smallest: float
    """Smallest difference that a two-sided interval at `LEVEL` keeps apart from 0 [time unit]; infinite
    where the records have no information about one of the two."""


@dataclass(frozen=True)
class Delays:
    """Delay separation at the maximum of the likelihood, every path given a delay of its own."""

    paths: tuple[str, ...]
    sd: tuple[float, ...]
    """Cramer-Rao standard deviation of the delay of each path [time unit]; infinite when unbounded."""
    separations: tuple[Separation, ...]
    time_unit: str
    sentence: str

    def as_json(self) -> dict[str, Any]:
        """Plain values; what is infinite is None."""
        return plain(
            {
                "paths": [
                    {"path": path, "sd": sd, "unit": self.time_unit}
                    for path, sd in zip(self.paths, self.sd, strict=True)
                ],
                "separations": [
                    {"pair": separation.pair, "smallest_difference": separation.smallest, "level": LEVEL}
                    for separation in self.separations
                ],
                "sentence": self.sentence,
            }
        )


def delays(study: Study, table: ParameterTable, values: Vector) -> Delays:
    """Linearised at table values; every path has the delay its slot has there and may leave it."""
    paths = [
        table.layout.path_name(i, j) or "the path"
        for i in range(len(table.layout.responses))
        for j in range(len(table.layout.drives))
    ]
    if len(paths) == 1:
        return Delays((), (), (), study.time_unit, "one path: there are no delays to compare")
    priors = {name: prior for name, prior in study.priors.items() if name.split("_")[0] != "delay"}
    apart = replace(study, model=replace(study.model, delay="path"), priors=priors)
    landscape = Landscape(problem_of(apart).posterior)
    own = landscape.posterior.table
    at = np.empty(len(own.rows))
    for k, row in enumerate(own.rows):
        if row.kind == "delay":
            i, j = divmod(row.place.first, len(own.layout.drives))
            at[k] = values[table.at("delay", table.layout.delay_of[i][j])]
        else:
            at[k] = values[table.names.index(row.name)]
    curved = curvature(landscape, at, np.ones(at.size))
    where = [curved.names.index(f"delay_{path}") for path in paths]
    wide = float(norm.ppf(0.5 + LEVEL / 2))
    separations = []
    for a, b in combinations(range(len(paths)), 2):
        p, q = where[a], where[b]
        both = np.isfinite(curved.sd[[p, q]]).all()
        mixed = 2 * curved.correlations[p, q] * curved.sd[p] * curved.sd[q] if both else 0.0
        spread = np.sqrt(max(curved.sd[p] ** 2 + curved.sd[q] ** 2 - mixed, 0.0)) if both else np.inf
        separations.append(Separation((paths[a], paths[b]), float(wide * spread)))
    sd = tuple(float(curved.sd[p]) for p in where)
    return Delays(
        tuple(paths), sd, tuple(separations), study.time_unit, _sentence(separations, study.time_unit)
    )


def _sentence(separations: list[Separation], unit: str) -> str:
    unresolved = [separation for separation in separations if not np.isfinite(separation.smallest)]
    if len(unresolved) == len(separations):
        return "no two path delays can be distinguished: the records bound at most one of them"
    worst = max(
        (separation for separation in separations if separation not in unresolved),
        key=lambda separation: separation.smallest,
    )
    smallest = f"{worst.pair[0]} and {worst.pair[1]} from a difference of {worst.smallest:.2g} {unit}"
    if unresolved:
        return (
            f"{len(unresolved)} of {len(separations)} pairs of path delays cannot be distinguished; the "
            f"least resolved of the others: {smallest}"
        )
    return f"all path delays can be distinguished, the least resolved pair {smallest}"
