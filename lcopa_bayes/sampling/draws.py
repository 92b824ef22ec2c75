"""Posterior draws with names, units, log densities and a grade."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from math import sqrt
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector, digest_of
from lcopa_bayes.core.estimate import Estimate
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.convergence import (
    Grade,
    Level,
    Limitation,
    Quality,
    limited,
    nested_rhat,
    overall,
    qualities,
    shares_grade,
    with_shares,
)
from lcopa_bayes.sampling.modes import Modes, modes_of
from lcopa_bayes.sampling.run import Run, sampled_qualities
from lcopa_bayes.sampling.weighted import Weighted

_MEASURED = 12_000
"""Draws on which the convergence of the linear parameters is measured."""
_PER_ENSEMBLE = 500
"""Draws delivered per ensemble."""
_AT_LEAST = 0.5
"""Least further time that is asked for, over the time taken [-]: enough draws that disagree need more too."""
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
    """Effective sample size wanted [draws]."""
    modes: tuple[Modes, ...] = ()
    """Of the sampled parameters whose marginal has more than one mode."""
    limitations: tuple[Limitation, ...] = ()
    """Conditions under which the intervals hold: each caps the grades of the numbers it concerns."""

    @cached_property
    def grade(self) -> Grade:
        """Grade of the whole run."""
        return limited(self.sampling_grade, self.limitations)

    @cached_property
    def sampling_grade(self) -> Grade:
        """Grade of the sampling alone, whatever limits the numbers beside it."""
        return overall(self.qualities, self.target_ess, self.modes)

    def limited(self, limitations: Sequence[Limitation]) -> Draws:
        """The same draws under further limitations."""
        return replace(self, limitations=(*self.limitations, *limitations))

    def level(self, parameter: str, grade: Grade) -> Level:
        """Level of a number of a parameter graded `grade`, under the limitations that concern it."""
        return limited(
            grade, [limitation for limitation in self.limitations if limitation.concerns(parameter)]
        ).level

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
        shares = {modes.parameter: [shares_grade(modes)] for modes in self.modes}
        return tuple(
            Estimate.of(
                quality.name,
                self.table.rows[self.table.names.index(quality.name)].unit,
                self.column(quality.name),
                ess=quality.ess,
                grade=self.level(
                    quality.name, Grade.worst([quality.grade(self.target_ess), *shares.get(quality.name, [])])
                ),
            )
            for quality in self.qualities
        )


def draws_of(posterior: Posterior, run: Run) -> Draws:
    """The draws of a run (`gather`), limited by what they lack where a budget ended it."""
    draws = gather(posterior, run)
    return draws.limited(shortfall(run, draws))


def shortfall(run: Run, draws: Draws) -> tuple[Limitation, ...]:
    """What the draws of a run that its budget ended lack, and how much more time would give it; nothing where
    they lack nothing."""
    if run.stopped_after is None or draws.sampling_grade.level == "reliable":
        return ()
    target, rhat = run.plan.target_ess, float(np.max([quality.rhat for quality in draws.qualities]))
    more = run.stopped_after * max(target / max(draws.ess, 1.0) - 1.0, _AT_LEAST)
    return (
        Limitation(
            "tentative",
            f"the budget of {run.plan.seconds:.4g} s ended sampling: the smallest effective sample size is "
            f"{draws.ess:.0f} where {target:g} are wanted, the largest R-hat {rhat:.3f}",
            f"give it about {more:.0f} s more by [sampler] seconds",
        ),
    )


def gather(posterior: Posterior, run: Run) -> Draws:
    """Draws of a run with the linear parameters drawn exactly: resampled importance draws, or the kept part
    of the ensembles, thinned evenly."""
    if run.weighted is not None and run.chosen is not None:
        rng = np.random.default_rng(np.random.SeedSequence(run.plan.seed, spawn_key=(1_000,)))
        return _resampled(posterior, run.weighted, run.chosen, rng, run.plan.target_ess)
    coordinates, log_density = run.kept()
    ensembles, walkers, count, _ = coordinates.shape
    stride = max(1, -(-ensembles * walkers * count // _MEASURED))
    coordinates, log_density = (kept[:, :, ::-1][:, :, ::stride] for kept in (coordinates, log_density))
    rng = np.random.default_rng(np.random.SeedSequence(run.plan.seed, spawn_key=(1_000,)))
    flat = coordinates.reshape(-1, coordinates.shape[-1])
    values = _completed(posterior, flat, rng).reshape(*coordinates.shape[:3], -1)
    by_name = {quality.name: quality for quality in sampled_qualities(posterior, run)}
    if posterior.linear:
        names = [posterior.table.names[k] for k in posterior.linear]
        by_name |= {q.name: q for q in qualities(names, values[..., posterior.linear])}
    rows = [(k, posterior.table.rows[k]) for k in posterior.sampled]
    marginals = [modes_of(row.name, row.unit, values[..., k], log_scale=row.log_scale) for k, row in rows]
    multimodal = tuple(marginal for marginal in marginals if marginal.boundaries)
    free = [name for name in posterior.table.names if name in by_name]
    ordered = tuple(with_shares(by_name[name], multimodal) for name in free)
    by_draw = values.swapaxes(1, 2).reshape(ensembles, -1, values.shape[-1])
    densities = log_density.swapaxes(1, 2).reshape(ensembles, -1)
    picked = np.linspace(0, by_draw.shape[1] - 1, min(_PER_ENSEMBLE, by_draw.shape[1])).astype(int)
    return Draws(
        posterior.table,
        by_draw[:, picked],
        densities[:, picked],
        ordered,
        run.plan.target_ess,
        multimodal,
        (*_unconfirmed(run.unconfirmed), *_near(run, len(posterior.sampled))),
    )


def _near(run: Run, dimension: int) -> tuple[Limitation, ...]:
    """Limitation of ensembles that began around optima."""
    if not any(ensemble.near for ensemble in run.ensembles):
        return ()
    return (
        Limitation(
            "tentative",
            f"no search met this posterior of {dimension} sampled parameters: ensembles began around its "
            f"least-squares optima and ended after {run.ensembles[0].steps} steps, and a mode elsewhere is "
            "missed",
            'allow more time ([sampler] seconds), let method = "ensembles" temper them from the prior, which '
            "takes hours, or fix parameters that the record does not determine",
        ),
    )


def _unconfirmed(parameters: tuple[str, ...]) -> tuple[Limitation, ...]:
    """Limitation of parameters whose shares of modes no independent draws confirm."""
    if not parameters:
        return ()
    return (
        Limitation(
            "tentative",
            f"the shares of the modes of {', '.join(parameters)} changed during the run, and independent "
            "draws could not confirm them",
            "allow more steps, or fix parameters that the record does not determine, or narrow their priors",
            parameters,
        ),
    )


def weighted_draws(
    posterior: Posterior, weighted: Weighted, rng: np.random.Generator, *, target_ess: float
) -> Draws:
    """Draws of every parameter from weighted draws, linear parameters drawn exactly, with their grade."""
    return _resampled(posterior, weighted, weighted.batches(_PER_ENSEMBLE, rng), rng, target_ess)


def _resampled(
    posterior: Posterior, weighted: Weighted, chosen: Index, rng: np.random.Generator, target_ess: float
) -> Draws:
    """Draws at positions of weighted draws.

    Effective sample sizes, modes and their shares are those of the weights and of resampling together. Parts
    of the weighted draws take the place of the ensembles of a sampler in R-hat.
    """
    values = _completed(posterior, weighted.coordinates[chosen.ravel()], rng)
    values = values.reshape(*chosen.shape, -1)
    rows, multimodal = posterior.table.rows, []

    added = partial(weighted.resampling_variance, count=chosen.shape[1])
    centre = 1 / (1 / weighted.centre_ess + added(weighted.scores))
    tail = 1 / (1 / weighted.tail_ess + added(weighted.below).max(axis=0))
    for at, k in enumerate(posterior.sampled):
        if edges := weighted.boundaries[at]:
            shares, worth = weighted.shares(at)
            inside = np.searchsorted(edges, weighted.sampled[:, at])[:, None] == np.arange(len(shares))
            errors = np.sqrt(shares * (1 - shares) * (1 / worth + added(inside.astype(float))))
            multimodal.append(Modes(rows[k].name, rows[k].unit, edges, shares[None], errors[None]))
    sizes = {k: (float(centre[at]), float(tail[at])) for at, k in enumerate(posterior.sampled)}
    # of linear parameters, which each draw has of its own, a part varies as others do, the rest by itself
    bulk, ends = (min(*one, weighted.ess, chosen.size) for one in (centre, tail))
    measured = tuple(
        with_shares(
            Quality(
                row.name,
                *(size := sizes.get(k, (float(bulk), float(ends)))),
                nested_rhat(values[..., k], np.arange(len(chosen))),
                scatter=sqrt(len(chosen) / size[0]),
            ),
            multimodal,
        )
        for k, row in enumerate(rows)
        if row.free
    )
    density = weighted.log_density[chosen]
    return Draws(posterior.table, values, density, measured, target_ess, tuple(multimodal))


def _completed(posterior: Posterior, flat: Matrix, rng: np.random.Generator) -> Matrix:
    """Table values of sampled coordinates, linear parameters drawn, (draws, rows)."""
    chunks = np.array_split(flat, max(1, flat.shape[0] // _CHUNK))
    return np.concatenate([posterior.complete(chunk, rng) for chunk in chunks])
