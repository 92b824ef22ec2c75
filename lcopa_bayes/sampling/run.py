"""A run of a sampler: its plan, its draws, and whether these are enough."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Array, Index, Matrix
from lcopa_bayes.core.progress import Progress
from lcopa_bayes.data.settings import Method
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.inference.simulation import Simulated
from lcopa_bayes.sampling.convergence import CERTAIN, Quality, drifts, qualities
from lcopa_bayes.sampling.ensemble import Ensemble
from lcopa_bayes.sampling.modes import Modes, modes_of
from lcopa_bayes.sampling.weighted import BATCHES, CHAIN, Weighted

_MEMORY = 0.4
"""Largest memory of a walker at which sampling stops [-]."""
_TREND = 2.0
"""Standard errors below which a drift of the kept draws is taken for chance where the run as a whole drifts
[-]: there chance is the less likely reason, and to go on costs little."""
_THIN = 5
"""Steps per kept draw unless the study says otherwise."""
_DELIVERED = 500
"""Fewest importance draws of a batch that are delivered."""
_PER_WANTED = 10.0
"""Delivered draws per effective draw wanted [-] ..."""
SURPLUS = 1.12
"""... and effective importance draws: 1.12 and 10 times as many are together worth 1.007 times as many."""


@final
@dataclass(frozen=True)
class SamplePlan:
    """How long and how wide to sample."""

    ensembles: int
    """Independent ensembles [-]."""
    walkers: int
    """Walkers per ensemble [-]."""
    steps: int
    """Most steps per ensemble [-]."""
    thin: int
    """Steps per kept draw [-]."""
    target_ess: float
    """Effective sample size that ends sampling [draws]."""
    seed: int
    """Root of all randomness of the run."""
    method: Method = "ensembles"
    """Importance draws where their weights converge, or ensembles in any case."""
    seconds: float | None = None
    """Time after which sampling ends with what it has [s]; None: no limit."""

    @property
    def delivered(self) -> int:
        """Resampled importance draws of each batch [-]."""
        count = max(_DELIVERED, ceil(_PER_WANTED * self.target_ess / BATCHES))
        return count + -count % CHAIN

    @classmethod
    def of(
        cls,
        dimension: int,
        *,
        seed: int,
        ensembles: int = 4,
        walkers: int | None = None,
        steps: int | None = None,
        thin: int | None = None,
        target_ess: float = 400,
        method: Method = "ensembles",
        seconds: float | None = None,
    ) -> SamplePlan:
        """A plan with unset entries chosen from the number of sampled parameters."""
        least = 2 * dimension + 2
        return cls(
            ensembles,
            max(least + least % 2, walkers or max(128, 16 * dimension)),
            steps or 2000 + 400 * dimension,
            thin or _THIN,
            target_ess,
            seed,
            method,
            seconds,
        )


@final
@dataclass(frozen=True, eq=False)
class Run:
    """What sampling gave."""

    ensembles: tuple[Ensemble, ...]
    plan: SamplePlan
    weighted: Weighted | None = None
    """Importance draws, where a proposal gave enough of them."""
    unconfirmed: tuple[str, ...] = ()
    """Parameters with modes that filled while the ensembles ran, whose shares importance draws could not
    confirm."""
    surrogate: Callable[[Matrix], Sequence[Simulated]] | None = None
    """What stands for the responses of a plant with effects where the draws are; None without."""
    stopped_after: float | None = None
    """Time that sampling had taken when its budget ended it [s]; None: it ended by itself."""

    @cached_property
    def chosen(self) -> Index | None:
        """Positions of resampled importance draws with equal weights, (batches, draws); None without any."""
        if self.weighted is None:
            return None
        rng = np.random.default_rng(np.random.SeedSequence(self.plan.seed, spawn_key=(1_001,)))
        return self.weighted.batches(self.plan.delivered, rng)

    @property
    def visited(self) -> Matrix:
        """Where the walkers of the ensembles have been in the last three fifths, (points, dimension)."""
        coordinates = replace(self, weighted=None).kept()[0]
        return coordinates.reshape(-1, coordinates.shape[-1])

    def kept(self) -> tuple[Array, Array]:
        """Draws of equal weight: coordinates (ensembles, walkers, draws, dimension), and log density.

        Of importance draws resampled ones, whose batches take the place of ensembles; of ensembles the last
        three fifths.
        """
        if self.weighted is not None and self.chosen is not None:
            order = self.chosen.reshape(BATCHES, -1, CHAIN)
            return self.weighted.coordinates[order], self.weighted.log_density[order]
        chain = np.stack([ensemble.chain for ensemble in self.ensembles])
        log_density = np.stack([ensemble.log_density for ensemble in self.ensembles])
        first = 2 * chain.shape[1] // 5
        return chain[:, first:].swapaxes(1, 2), log_density[:, first:].swapaxes(1, 2)


def finished(posterior: Posterior, run: Run, bar: Progress | None = None) -> bool:
    """Whether every sampled parameter agrees between ensembles and has its effective sample size, and the
    shares of its modes have.

    Walkers move a little further than a grade requires, so that the linear parameters, which are drawn
    afterwards, have too.
    """
    values = _sampled_values(posterior, run)
    qualities = _qualities(posterior, values)
    if bar is not None:
        ess, rhat = float(np.min([q.ess for q in qualities])), float(np.max([q.rhat for q in qualities]))
        memory = float(np.max([q.memory for q in qualities]))
        acceptance = np.mean([ensemble.acceptance for ensemble in run.ensembles])
        bar.set_postfix(
            acceptance=f"{acceptance:.2f}", ess=f"{ess:.0f}", rhat=f"{rhat:.3f}", memory=f"{memory:.2f}"
        )
    target = run.plan.target_ess
    good = all(q.grade(target).level == "reliable" and q.memory <= _MEMORY for q in qualities)
    return (
        good
        and all(modes.ess >= target for modes in _sampled_modes(posterior, values))
        and _settled(_sampled_values(posterior, run, kept=False), values)
    )


def _settled(whole: Array, kept: Array) -> bool:
    """Whether what drifts over the whole run with certainty shows no trend any more in what is kept of it,
    values (ensembles, walkers, draws, parameters).

    A mode that few walkers had reached at the start fills slowly and in all ensembles alike, so that neither
    their agreement nor the effective sample size of the kept draws shows how much is still missing.
    """
    for column in range(whole.shape[-1]):
        pairs = zip(drifts(whole[..., column]), drifts(kept[..., column]), strict=False)
        for (far, far_error, _), (near, near_error, _) in pairs:
            if abs(far) > CERTAIN * far_error and abs(near) > _TREND * near_error:
                return False
    return True


def sampled_qualities(posterior: Posterior, run: Run) -> tuple[Quality, ...]:
    """Quality of the sampled parameters over the kept part of a run."""
    return _qualities(posterior, _sampled_values(posterior, run))


def _qualities(posterior: Posterior, values: Array) -> tuple[Quality, ...]:
    """Quality of values of the sampled parameters, (ensembles, walkers, draws, parameters)."""
    return qualities([posterior.table.names[k] for k in posterior.sampled], values)


def _sampled_modes(posterior: Posterior, values: Array) -> Iterator[Modes]:
    """Modes of values of the sampled parameters, (ensembles, walkers, draws, parameters)."""
    for column, k in enumerate(posterior.sampled):
        row = posterior.table.rows[k]
        yield modes_of(row.name, row.unit, values[..., column], log_scale=row.log_scale)


def _sampled_values(posterior: Posterior, run: Run, *, kept: bool = True) -> Array:
    """Values of the sampled parameters that are kept, or all, (ensembles, walkers, draws, parameters)."""
    chains = [ensemble.chain for ensemble in run.ensembles]
    coordinates = run.kept()[0] if kept else np.stack(chains).swapaxes(1, 2)
    values = posterior.values(coordinates.reshape(-1, coordinates.shape[-1]))[:, posterior.sampled]
    return values.reshape(*coordinates.shape[:3], -1)


def filling_modes(posterior: Posterior, run: Run) -> tuple[str, ...]:
    """Sampled parameters with several modes that drift over the whole run with certainty."""
    whole = _sampled_values(posterior, run, kept=False)
    return tuple(
        modes.parameter
        for column, modes in enumerate(_sampled_modes(posterior, _sampled_values(posterior, run)))
        if modes.boundaries
        and any(abs(apart) > CERTAIN * error for apart, error, _ in drifts(whole[..., column]))
    )
