"""Nested sampling of a posterior with dynesty: draws and evidence by a method other than the ensembles.

Independent runs of dynesty (Speagle 2020, MNRAS 493) compress the prior towards high likelihood. New
points travel by `constrainedwalk` instead of dynesty's own proposals, which in narrow curved modes stay
correlated over hundreds of evaluations, and a whole queue moves at once, because the likelihood of a batch
costs a tenth per point.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from dynesty import NestedSampler
from dynesty.internal_samplers import InternalSampler, SamplerArgument, SamplerReturn
from scipy.special import logsumexp

from lcopa_bayes.core.arrays import Index, Matrix, Vector
from lcopa_bayes.core.parallel import workers
from lcopa_bayes.core.progress import Progress
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.constrainedwalk import Walk
from lcopa_bayes.sampling.deadpoints import Strands
from lcopa_bayes.sampling.unitcube import UnitCube

_REMAINDER = 0.01
"""A run ends when the live points can add no more than this to its log evidence [nat]."""
_DRAWS = 4_000
"""Draws delivered."""
_REDRAWN = 100
"""Times the strands are drawn again for errors: these then have an error of 7 %."""
_PROBES = np.linspace(0.05, 0.95, 19)
"""Probabilities at which the errors of the marginals are measured [-]."""
_QUEUE = 128
"""Most points moved at once: a batch of 32 costs twice as much per point, a batch of 512 a fourth less."""
_LATE = 0.5
"""Most points moved at once, of the live points [-]: a fifth of these arrive too late to be used."""
_CHUNK = 128
"""Draws completed at a time."""


@final
@dataclass(frozen=True)
class NestedPlan:
    """How thoroughly to sample."""

    runs: int
    """Independent runs [-]."""
    live: int
    """Live points per run [-]."""
    steps: int
    """Proposals per new point [-]."""
    seed: int
    """Root of all randomness."""

    @classmethod
    def of(cls, dimension: int, *, seed: int, quick: bool = False) -> NestedPlan:
        """A plan for a number of sampled parameters; a quick plan has a quarter of the live points."""
        live = 100 + 50 * dimension
        return cls(8, live // 4 if quick else live, 20 * dimension, seed)


@final
@dataclass(frozen=True, eq=False)
class Nested:
    """What nested sampling gave."""

    table: ParameterTable
    values: Matrix
    """Canonical table values of equally weighted draws, (draws, rows), each in its row's unit."""
    ess: Vector
    """Effective sample size of the marginal of each row, NaN of a fixed parameter, (rows,) [draws]."""
    log_evidence: float
    """Of all runs together [nat]."""
    log_evidence_sd: float
    """Its standard error: the larger of strands drawn again and of the spread of the runs [nat]."""
    run_log_evidences: tuple[float, ...]
    """Of each run alone [nat]."""
    evaluations: int
    """Likelihood evaluations."""


def nested(posterior: Posterior, plan: NestedPlan, *, jobs: int = 1, quiet: bool = True) -> Nested:
    """Sample a posterior by nested sampling; the result depends on posterior and plan alone.

    Effective sample sizes take the larger of the variance from strands drawn again, as if points of
    different strands were independent, and of that between runs, which do not share points.
    """
    *seeds, last = np.random.SeedSequence(plan.seed, spawn_key=(2_000,)).spawn(plan.runs + 1)
    runs, evaluations = [], 0
    with Progress(total=plan.runs, unit="run", quiet=quiet, desc="nested sampling") as bar:
        for strands, spent in _performed(posterior, plan, seeds, min(jobs, plan.runs)):
            runs.append(strands)
            evaluations += spent
            bar.update()
    return _gathered(posterior, runs, evaluations, np.random.default_rng(last))


def _gathered(
    posterior: Posterior, runs: list[Strands], evaluations: int, rng: np.random.Generator
) -> Nested:
    """Equally weighted draws, evidence and their errors from all strands together."""
    whole = Strands.joined(runs)
    log_weights = whole.log_weights()
    log_evidence = float(logsumexp(log_weights))
    cumulative = np.cumsum(np.exp(log_weights - log_evidence))
    picked = np.searchsorted(cumulative, (np.arange(_DRAWS) + rng.random()) / _DRAWS)
    picked = np.minimum(picked, cumulative.size - 1)
    chunks = np.array_split(whole.coordinates[picked], max(1, _DRAWS // _CHUNK))
    values = np.concatenate([posterior.complete(chunk, rng) for chunk in chunks])
    redrawn = [whole.log_weights(whole.redrawn(rng)) for _ in range(_REDRAWN)]
    error = float(np.std([logsumexp(again) for again in redrawn], ddof=1))
    alone = [run.log_evidence() for run in runs]
    if len(runs) > 1:
        error = max(error, float(np.std(alone, ddof=1)) / np.sqrt(len(runs)))
    ratios = np.array([_normalised((again - log_weights)[picked]) for again in redrawn])
    owner = np.repeat(np.arange(len(runs)), [run.strands for run in runs])[whole.strand[picked]]
    ess = [
        _effective(values[:, k], ratios, owner) if row.free else np.nan
        for k, row in enumerate(posterior.table.rows)
    ]
    return Nested(posterior.table, values, np.array(ess), log_evidence, error, tuple(alone), evaluations)


def _normalised(log_ratios: Vector) -> Vector:
    return np.asarray(np.exp(log_ratios - logsumexp(log_ratios)))


def _effective(draws: Vector, ratios: Matrix, owner: Index) -> float:
    """Independent draws that give the marginal as accurately, at most as many as there are."""
    below = draws[:, None] <= np.quantile(draws, _PROBES)
    share = below.mean(axis=0)
    variance = float(np.mean(np.var(ratios @ below, axis=0, ddof=1)))
    owners = np.unique(owner)
    if owners.size > 1:
        by_run = np.array([below[owner == run].mean(axis=0) for run in owners])
        variance = max(variance, float(np.mean(np.var(by_run, axis=0, ddof=1))) / owners.size)
    independent = float(np.mean(share * (1 - share)))
    return min(float(draws.size), independent / variance) if variance > 0 else float(draws.size)


def _performed(
    posterior: Posterior, plan: NestedPlan, seeds: Sequence[np.random.SeedSequence], jobs: int
) -> Iterator[tuple[Strands, int]]:
    with workers((posterior, plan), jobs=jobs) as crew:
        yield from crew.each(_run, seeds)


def _run(shared: tuple[Posterior, NestedPlan], seed: np.random.SeedSequence) -> tuple[Strands, int]:
    """One run of dynesty: its strands and the number of likelihood evaluations."""
    posterior, plan = shared
    rng, cube = np.random.default_rng(seed), UnitCube(posterior)
    walk = Walk(cube, plan.steps)
    points = cube.draw(plan.live, rng)
    start = cube.coordinates(points)
    sampler = NestedSampler(
        lambda z: float(cube.log_likelihood(z[None])[0]),
        lambda point: cube.coordinates(point[None])[0],
        cube.dimension,
        nlive=plan.live,
        bound="none",
        sample=_ConstrainedSampler(walk=walk, ndim=cube.dimension),
        rstate=rng,
        pool=_Together,
        queue_size=min(_QUEUE, int(_LATE * plan.live)),
        use_pool={"prior_transform": False, "loglikelihood": False, "update_bound": False},
        live_points=(points, start, cube.log_likelihood(start)),
        first_update={"min_ncall": 1, "min_eff": 100.0},
    )
    sampler.run_nested(dlogz=_REMAINDER, print_progress=False, save_bounds=False)
    results = sampler.results
    strands = Strands.of(
        np.array(results.samples),
        np.array(results.logl),
        np.unique(results.samples_id, return_inverse=True)[1],
    )
    return strands, plan.live + int(np.sum(results.ncall))


@final
class _Together:
    """What dynesty takes for its pool of workers: a queue of points is moved as one batch."""

    @staticmethod
    def map(function: Callable[[Any], Any], given: Iterable[Any]) -> list[Any]:
        if function is _ConstrainedSampler.sample:
            return _travelled(list(given))
        return [function(argument) for argument in given]


@final
class _ConstrainedSampler(InternalSampler):  # type: ignore[misc]
    """How dynesty finds new live points; see dynesty.internal_samplers.InternalSampler."""

    def __init__(self, **given: Any) -> None:
        super().__init__(**given)
        self.sampler_kwargs["walk"] = given["walk"]

    def prepare_sampler(self, *, nested_sampler: Any, **given: Any) -> list[SamplerArgument]:
        """One argument per point of the queue, each with the live points as population."""
        self.sampler_kwargs["population"] = nested_sampler.live_v
        return list(super().prepare_sampler(nested_sampler=nested_sampler, **given))

    @staticmethod
    def sample(argument: SamplerArgument) -> SamplerReturn:
        """A new point above `argument.loglstar`."""
        return _travelled([argument])[0]


def _travelled(queue: list[SamplerArgument]) -> list[SamplerReturn]:
    walk: Walk = queue[0].kwargs["walk"]
    start = walk.cube.coordinates(np.array([argument.u for argument in queue]))
    rng = np.random.default_rng(queue[0].rseed)
    z, height, evaluations = walk.travelled(start, queue[0].loglstar, queue[0].kwargs["population"], rng)
    still = np.flatnonzero(height == -np.inf)
    if still.size:
        height[still] = walk.cube.log_likelihood_inside(z[still])
    points = walk.cube.points(z)
    share = -(-(evaluations + still.size) // len(queue))
    return [SamplerReturn(points[k], z[k], height[k], share, [], None, None) for k in range(len(queue))]
