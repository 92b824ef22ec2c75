"""Posterior draws with names, units, log densities and a grade."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector, digest_of
from lcopa_bayes.core.estimate import Estimate
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.convergence import (
    Grade,
    Level,
    Limitation,
    Quality,
    limited,
    overall,
    qualities,
    shares_grade,
    with_shares,
)
from lcopa_bayes.sampling.modes import Ridges, ridges
from lcopa_bayes.sampling.sampler import Run, sampled_qualities

_MEASURED = 12_000
"""Draws on which the convergence of the linear parameters is measured."""
_PER_ENSEMBLE = 500
"""Draws delivered per ensemble."""
_CHUNK = 128
"""Draws completed at a time."""


@final
@dataclass(frozen=True, eq=False)
class Draws:
    """Draws of every row of the parameter table."""

    table: ParameterTable
    values: Array
    """Canonical table values, (ensembles, draws, rows), each in its row's unit."""
    log_density: Matrix
    """Log posterior density of the sampled coordinates, (ensembles, draws) [nat]."""
    qualities: tuple[Quality, ...]
    """Of every free parameter, in table order."""
    target_ess: float
    """Effective sample size asked for [draws]."""
    ridges: tuple[Ridges, ...] = ()
    """Of the sampled parameters whose marginal has more than one hill."""
    limitations: tuple[Limitation, ...] = ()
    """Conditions under which the intervals hold: each caps the grades of the numbers it concerns."""

    @cached_property
    def grade(self) -> Grade:
        """Grade of the whole run."""
        return limited(self.sampling_grade, self.limitations)

    @cached_property
    def sampling_grade(self) -> Grade:
        """Grade of the sampling alone, whatever limits the numbers beside it."""
        return overall(self.qualities, self.target_ess, self.ridges)

    def limited(self, limitations: Sequence[Limitation]) -> Draws:
        """The same draws under further limitations."""
        return replace(self, limitations=(*self.limitations, *limitations))

    def level(self, parameter: str, grade: Grade) -> Level:
        """Level of a number of a parameter graded `grade`, under the limitations that concern it."""
        return limited(grade, [one for one in self.limitations if one.concerns(parameter)]).level

    @cached_property
    def sha256(self) -> str:
        """Hash of the draws of the free parameters."""
        return digest_of(self.values[..., [k for k, row in enumerate(self.table.rows) if row.free]])

    @property
    def flat(self) -> Matrix:
        """All draws, (ensembles * draws, rows)."""
        return self.values.reshape(-1, self.values.shape[-1])

    @property
    def ess(self) -> float:
        """Smallest effective sample size [draws]."""
        return float(np.min([quality.ess for quality in self.qualities]))

    def thinned(self, count: int) -> Matrix:
        """About `count` draws spread evenly over all of them, (count, rows)."""
        flat = self.flat
        return np.asarray(flat[np.linspace(0, flat.shape[0] - 1, min(count, flat.shape[0])).astype(int)])

    def column(self, name: str) -> Vector:
        """All draws of one parameter."""
        return self.flat[:, self.table.names.index(name)]

    def estimates(self) -> tuple[Estimate, ...]:
        """Median, interval and grade of every free parameter."""
        shares = {found.parameter: [shares_grade(found)] for found in self.ridges}
        return tuple(
            Estimate.of(
                quality.name,
                self.table.rows[self.table.names.index(quality.name)].unit,
                self.column(quality.name),
                ess=quality.ess,
                grade=self.level(
                    quality.name,
                    Grade.worst([quality.grade(self.target_ess), *shares.get(quality.name, [])]),
                ),
            )
            for quality in self.qualities
        )


def gather(posterior: Posterior, run: Run) -> Draws:
    """Draws of a run: the kept part, thinned evenly, with the linear parameters drawn exactly."""
    coordinates, log_density = run.kept()
    ensembles, walkers, count, _ = coordinates.shape
    stride = max(1, -(-ensembles * walkers * count // _MEASURED))
    coordinates, log_density = (kept[:, :, ::-1][:, :, ::stride] for kept in (coordinates, log_density))
    rng = np.random.default_rng(np.random.SeedSequence(run.plan.seed, spawn_key=(1_000,)))
    flat = coordinates.reshape(-1, coordinates.shape[-1])
    chunks = np.array_split(flat, max(1, flat.shape[0] // _CHUNK))
    values = np.concatenate([posterior.complete(chunk, rng) for chunk in chunks])
    values = values.reshape(*coordinates.shape[:3], -1)
    found = {quality.name: quality for quality in sampled_qualities(posterior, run)}
    if posterior.linear:
        names = [posterior.table.names[k] for k in posterior.linear]
        found |= {q.name: q for q in qualities(names, values[..., posterior.linear])}
    rows = [(k, posterior.table.rows[k]) for k in posterior.sampled]
    hills = [ridges(row.name, row.unit, values[..., k], log_scale=row.log_scale) for k, row in rows]
    several = tuple(one for one in hills if one.boundaries)
    free = [name for name in posterior.table.names if name in found]
    ordered = tuple(with_shares(found[name], several) for name in free)
    by_draw = values.swapaxes(1, 2).reshape(ensembles, -1, values.shape[-1])
    densities = log_density.swapaxes(1, 2).reshape(ensembles, -1)
    picked = np.linspace(0, by_draw.shape[1] - 1, min(_PER_ENSEMBLE, by_draw.shape[1])).astype(int)
    return Draws(
        posterior.table, by_draw[:, picked], densities[:, picked], ordered, run.plan.target_ess, several
    )
