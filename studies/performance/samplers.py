"""Effective draws per CPU second of this package's sampler and of others, on the same posteriors.

All are given the same density, which takes batches: emcee, zeus, nautilus, UltraNest and pocoMC use them,
dynesty takes one point at a time. The methods that start from the prior are given it as a unit cube in which
exchangeable terms are in order, so that no mode is there once per permutation. Everything else is a library's
default, or what its documentation recommends; `SETTINGS` says which.

Effective draws are counted twice: stated by the method itself, and shown by the errors of its estimates over
repeated runs (`comparison.shown_by_errors`). The first believes a chain that never left one mode; the second
does not. A run that outlasts `cap` times a run of this package is stopped; nested sampling that was stopped
early, or a population that had not reached the posterior, gives no estimate.
"""

from __future__ import annotations

import logging
import os
import sys
import time
import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import emcee
import numpy as np
from arviz_stats.base import array_stats
from comparison import Estimate, compared

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.data.studyfile import load_study
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.optimum import find_optima
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.results.fit import plan_of
from lcopa_bayes.sampling.nested import NestedPlan, nested
from lcopa_bayes.sampling.run import sampled_qualities
from lcopa_bayes.sampling.sampler import sample
from lcopa_bayes.sampling.unitcube import UnitCube

STUDIES = Path(__file__).parents[1]
POSTERIORS = {
    "one-term": (STUDIES / "calibration" / "one-term", ()),
    "paper-step-x": (
        STUDIES / "paper-step-x",
        (("order_2", ">", 1.3), ("order_1", ">", 1.9), ("order_3", "<", 0.1)),
    ),
}
"""An easy posterior and a hard one; of the second also the shares of modes."""
OURS, NESTED = "this package", "this package, nested (dynesty)"
WALKERS = 32
"""Of emcee and zeus."""
CHUNK = 20
"""Steps between looks at the clock."""
BALL = 1e-4
"""Standard deviation of the starts of emcee and zeus [natural log or parameter unit]."""
QUICK_DRAWS = 100.0
"""Effective draws that a quick run asks of this package."""
SETTINGS = {
    OURS: "as `fit` runs it; evaluations are plants simulated, of which it asks derivatives too",
    NESTED: "as `fit --cross-check` runs it, one run of it",
    "emcee": f"{WALKERS} walkers in a ball of 1e-4 around the best optimum of least squares, as its "
    "documentation does, stretch moves, vectorised, the first half discarded, until the time is used up",
    "zeus": f"{WALKERS} walkers from there too, differential moves, vectorised, the first half discarded, "
    "until the time is used up",
    "dynesty": "static, 500 live points, bounds multi, sample auto, stop at dlogz 0.509",
    "nautilus": "2000 live points, 4 networks, vectorised, stop at 10 000 effective draws",
    "pocoMC": "512 effective and 256 active particles, flow nsf6, vectorised, 4096 draws",
    "UltraNest": "reactive, at least 400 live points, regions of MLFriends, vectorised, stop at its defaults",
}
PACKAGES = {
    "emcee": ("emcee", "emcee"),
    "zeus": ("zeus", "zeus-mcmc"),
    "dynesty": ("dynesty", "dynesty"),
    "nautilus": ("nautilus", "nautilus-sampler"),
    "pocoMC": ("pocomc", "pocomc"),
    "UltraNest": ("ultranest", "ultranest"),
}
"""Module and distribution of each."""


class OutOfTimeError(Exception):
    """The CPU time of a run is used up."""


@dataclass
class Counted:
    """The density of a posterior as a sampler is given it: counts what is asked, ends with the time."""

    posterior: Posterior
    budget: float
    """CPU time [s]."""
    evaluations: int = 0

    def __post_init__(self) -> None:
        self.cpu, self.wall = time.process_time(), time.perf_counter()

    @cached_property
    def cube(self) -> UnitCube:
        return UnitCube(self.posterior)

    @property
    def spent(self) -> float:
        """CPU time since the beginning [s]; each run has a process of one thread."""
        return time.process_time() - self.cpu

    def log_density(self, coordinates: Matrix) -> Vector:
        """Of prior and likelihood, (batch,); does not look at the time."""
        self.evaluations += len(coordinates)
        return self.posterior.log_density(coordinates)

    def log_likelihood(self, coordinates: Matrix) -> Vector:
        """Of coordinates, (batch,); OutOfTimeError once the time is used up."""
        coordinates = np.atleast_2d(coordinates)
        self.evaluations += len(coordinates)
        if self.spent > self.budget:
            raise OutOfTimeError
        return self.cube.log_likelihood(coordinates)

    def coordinates(self, points: Matrix) -> Matrix:
        """Of uniform points of the unit cube, (batch, dimension): draws of the prior."""
        return self.cube.coordinates(ordered(self.posterior, np.atleast_2d(points)))

    def estimate(
        self,
        coordinates: Matrix,
        stated: float,
        quantities: Callable[[Posterior, Matrix], Matrix],
        *,
        weights: Vector | None = None,
        log_evidence: float = np.nan,
        finished: bool = True,
    ) -> Estimate:
        """Of draws, weighted or not; what it takes to compute is not counted."""
        cpu, wall = self.spent, time.perf_counter() - self.wall
        x = quantities(self.posterior, coordinates)
        mean, square = (np.average(power, axis=0, weights=weights) for power in (x, x**2))
        return Estimate(mean, square, stated, cpu, wall, self.evaluations, finished, log_evidence)

    def nothing(self, size: int) -> Estimate:
        """Of a run that was stopped before it had draws of the posterior."""
        empty = np.full(size, np.nan)
        wall = time.perf_counter() - self.wall
        return Estimate(empty, empty, np.nan, self.spent, wall, self.evaluations, finished=False)


def ordered(posterior: Posterior, points: Matrix) -> Matrix:
    """Points of the cube whose exchangeable orders decrease, uniform among these, of uniform points.

    Those of an element with m terms become order statistics: the largest is ``u_1^(1/m)``, the next
    ``u_2^(1/(m-1))`` of it, and so on. Its other parameters need identical priors, as they have.
    """
    points = points.copy()
    for columns in UnitCube(posterior)._orders:
        largest = np.ones(len(points))
        for remaining, column in zip(range(len(columns), 0, -1), columns, strict=True):
            largest = points[:, column] = largest * points[:, column] ** (1 / remaining)
    return points


@dataclass(frozen=True)
class Quantities:
    """What is estimated: coordinates in canonical order, and shares of modes."""

    shares: tuple[tuple[str, str, float], ...]

    def names(self, posterior: Posterior) -> list[str]:
        rows = [posterior.table.rows[k] for k in posterior.sampled]
        shares = [f"share of {name} {sign} {at:g}" for name, sign, at in self.shares]
        return [f"mean of {'log ' if row.log_scale else ''}{row.name}" for row in rows] + shares

    def __call__(self, posterior: Posterior, coordinates: Matrix) -> Matrix:
        """Per draw, (draws, quantities)."""
        values = posterior.values(coordinates)
        column = {name: values[:, k] for k, name in enumerate(posterior.table.names)}
        sides = [column[name] > at if sign == ">" else column[name] < at for name, sign, at in self.shares]
        return np.column_stack([posterior.coordinates(values), *(side.astype(float) for side in sides)])


@dataclass(frozen=True)
class Task:
    """One run of a method."""

    method: str
    posterior: str
    seed: int
    budget: float
    """CPU time [s]."""
    quick: bool


def kish(weights: Vector) -> float:
    """Effective number of weighted draws."""
    return float(weights.sum() ** 2 / np.sum(weights**2))


def smallest_ess(posterior: Posterior, chain: Matrix) -> float:
    """Smallest bulk or tail effective sample size of ArviZ, of sampled parameters; chain (steps, walkers,
    dimension)."""
    steps, walkers, dimension = chain.shape
    values = posterior.values(chain.swapaxes(0, 1).reshape(-1, dimension))[:, posterior.sampled]
    walks = values.reshape(walkers, steps, dimension)
    return min(
        float(array_stats.ess(walks[..., k], method=method, prob=prob))
        for k in range(dimension)
        for method, prob in (("bulk", None), ("tail", (0.05, 0.95)))
    )


def ours(task: Task, counted: Counted, quantities: Quantities) -> Estimate:
    problem = problem_of(load_study(POSTERIORS[task.posterior][0]))
    plan = replace(plan_of(problem, quick=task.quick), seed=task.seed)
    if task.quick:
        plan = replace(plan, target_ess=QUICK_DRAWS)
    with counting(counted):
        run = sample(counted.posterior, plan)
    stated = min(quality.ess for quality in sampled_qualities(counted.posterior, run))
    draws, _ = run.kept()
    return counted.estimate(draws.reshape(-1, counted.posterior.dimension), stated, quantities)


def our_nested(task: Task, counted: Counted, quantities: Quantities) -> Estimate:
    plan = NestedPlan.of(counted.posterior.dimension, seed=task.seed, quick=task.quick)
    with counting(counted):
        outcome = nested(counted.posterior, replace(plan, runs=1))
    return counted.estimate(
        counted.posterior.coordinates(outcome.values),
        float(np.nanmin(outcome.ess)),
        quantities,
        log_evidence=outcome.log_evidence,
    )


@contextmanager
def counting(counted: Counted) -> Any:
    """Within it plants that are simulated are counted, whoever asks."""
    from lcopa_bayes.model.forward import ForwardModel

    plain = {name: getattr(ForwardModel, name) for name in ("unit_responses", "unit_slopes")}

    def counter(method: Callable[..., Any]) -> Callable[..., Any]:
        def call(model: ForwardModel, dynamics: Any, *more: Any, **named: Any) -> Any:
            counted.evaluations += dynamics.batch
            return method(model, dynamics, *more, **named)

        return call

    try:
        for name, method in plain.items():
            setattr(ForwardModel, name, counter(method))
        yield
    finally:
        for name, method in plain.items():
            setattr(ForwardModel, name, method)


def starts(counted: Counted, seed: int) -> Matrix:
    """Walkers inside the prior around the best optimum, (walkers, dimension); to find it costs, too."""
    posterior, rng = counted.posterior, np.random.default_rng(seed)
    with counting(counted):
        centre = posterior.coordinates(find_optima(posterior, rng)[0].values[None])
    out = np.empty((0, posterior.dimension))
    while len(out) < WALKERS:
        ball = centre + BALL * rng.standard_normal((WALKERS, posterior.dimension))
        out = np.concatenate([out, ball[np.isfinite(posterior.log_prior(ball))]])
    return out[:WALKERS]


def with_emcee(task: Task, counted: Counted, quantities: Quantities) -> Estimate:
    dimension = counted.posterior.dimension
    sampler = emcee.EnsembleSampler(WALKERS, dimension, counted.log_density, vectorize=True)
    sampler.random_state = np.random.RandomState(task.seed).get_state()
    state: Any = starts(counted, task.seed)
    while counted.spent < task.budget:
        state = sampler.run_mcmc(state, CHUNK)
    return of_chain(counted, sampler.get_chain(), quantities)


def with_zeus(task: Task, counted: Counted, quantities: Quantities) -> Estimate:
    zeus = import_module("zeus")
    np.random.seed(task.seed)  # noqa: NPY002 - zeus has no generator of its own
    dimension = counted.posterior.dimension
    sampler = zeus.EnsembleSampler(WALKERS, dimension, counted.log_density, vectorize=True, verbose=False)
    state = starts(counted, task.seed)
    while counted.spent < task.budget:
        sampler.run_mcmc(state, CHUNK, progress=False)
        state = sampler.get_last_sample()
    return of_chain(counted, sampler.get_chain(), quantities)


def of_chain(counted: Counted, chain: Matrix, quantities: Quantities) -> Estimate:
    """The estimate of a chain (steps, walkers, dimension), without its first half."""
    kept = chain[len(chain) // 2 :]
    if len(kept) < 4:
        return counted.nothing(len(quantities.names(counted.posterior)))
    stated = smallest_ess(counted.posterior, kept)
    return counted.estimate(kept.reshape(-1, kept.shape[-1]), stated, quantities)


def with_dynesty(task: Task, counted: Counted, quantities: Quantities) -> Estimate:
    sampler = import_module("dynesty").NestedSampler(
        lambda z: float(counted.log_likelihood(z)[0]),
        lambda point: counted.coordinates(point)[0],
        counted.posterior.dimension,
        rstate=np.random.default_rng(task.seed),
    )
    sampler.run_nested(print_progress=False)
    outcome = sampler.results
    weights = np.exp(outcome.logwt - outcome.logwt.max())
    return counted.estimate(
        np.array(outcome.samples),
        kish(weights),
        quantities,
        weights=weights,
        log_evidence=float(outcome.logz[-1]),
    )


def with_nautilus(task: Task, counted: Counted, quantities: Quantities) -> Estimate:
    sampler = import_module("nautilus").Sampler(
        counted.coordinates,
        counted.log_likelihood,
        n_dim=counted.posterior.dimension,
        vectorized=True,
        seed=task.seed,
    )
    sampler.run(verbose=False)
    points, log_weights, _ = sampler.posterior()
    return counted.estimate(
        points,
        float(sampler.n_eff),
        quantities,
        weights=np.exp(log_weights - log_weights.max()),
        log_evidence=float(sampler.log_z),
    )


def with_pocomc(task: Task, counted: Counted, quantities: Quantities) -> Estimate:
    pocomc, uniform = import_module("pocomc"), import_module("scipy.stats").uniform
    sampler = pocomc.Sampler(
        pocomc.Prior([uniform(0, 1)] * counted.posterior.dimension),
        lambda points: counted.log_likelihood(counted.coordinates(points)),
        vectorize=True,
        random_state=task.seed,
    )
    sampler.run(progress=False)
    points, weights, _, _ = sampler.posterior()
    return counted.estimate(
        counted.coordinates(points),
        kish(weights),
        quantities,
        weights=weights,
        log_evidence=float(sampler.evidence()[0]),
    )


def with_ultranest(task: Task, counted: Counted, quantities: Quantities) -> Estimate:
    np.random.seed(task.seed)  # noqa: NPY002 - UltraNest has no generator of its own
    sampler = import_module("ultranest").ReactiveNestedSampler(
        [f"z{k}" for k in range(counted.posterior.dimension)],
        counted.log_likelihood,
        counted.coordinates,
        vectorized=True,
    )
    logging.getLogger("ultranest").setLevel(logging.ERROR)  # which the constructor sets, too
    outcome = sampler.run(show_status=False, viz_callback=False)
    weighted = outcome["weighted_samples"]
    return counted.estimate(
        np.array(weighted["points"]),
        float(outcome["ess"]),
        quantities,
        weights=np.array(weighted["weights"]),
        log_evidence=float(outcome["logz"]),
    )


METHODS: Mapping[str, Callable[[Task, Counted, Quantities], Estimate]] = {
    OURS: ours,
    NESTED: our_nested,
    "emcee": with_emcee,
    "zeus": with_zeus,
    "dynesty": with_dynesty,
    "nautilus": with_nautilus,
    "pocoMC": with_pocomc,
    "UltraNest": with_ultranest,
}


def performed(task: Task) -> Estimate:
    """One run, in a process of one thread; what a library prints is not shown."""
    folder, shares = POSTERIORS[task.posterior]
    posterior, quantities = problem_of(load_study(folder)).posterior, Quantities(shares)
    if task.method in PACKAGES:
        import_module(PACKAGES[task.method][0])
    start = posterior.table.draw(4, np.random.default_rng(0))
    posterior.log_density(posterior.coordinates(start))  # what is prepared once is there
    counted = Counted(posterior, task.budget)
    with ExitStack() as quiet, warnings.catch_warnings():
        nowhere = quiet.enter_context(Path(os.devnull).open("w"))
        quiet.enter_context(redirect_stdout(nowhere))
        quiet.enter_context(redirect_stderr(nowhere))  # dynesty prints what ends it
        warnings.simplefilter("ignore")
        try:
            return METHODS[task.method](task, counted, quantities)
        except OutOfTimeError:
            return counted.nothing(len(quantities.names(posterior)))


def measured(*, quick: bool, seconds: float = np.inf) -> dict[str, Any]:
    """A comparison per posterior; the methods run in turn, round by round, each in a process of its own.

    Others have `cap` times the CPU time of this package's first run. After `seconds` of wall time no further
    run begins, the first of this package excepted.
    """
    rounds, cap = (2, 1.0) if quick else (8, 12.0)
    absent = {
        method: f"{distribution} is not installed"
        for method, (module, distribution) in PACKAGES.items()
        if find_spec(module) is None
    }
    if quick:
        absent[NESTED] = "not in a quick run"
    end, out = time.perf_counter() + seconds, {}
    with ExitStack() as stack:
        crews = {
            method: stack.enter_context(ProcessPoolExecutor(1, mp_context=get_context("spawn")))
            for method in METHODS
            if method not in absent
        }
        for number, (name, (folder, shares)) in enumerate(POSTERIORS.items()):
            until = time.perf_counter() + (end - time.perf_counter()) / (len(POSTERIORS) - number)
            runs: dict[str, list[Estimate]] = {method: [] for method in crews}
            budget = np.inf
            for seed in range(1, 1 + rounds):
                for method, crew in crews.items():
                    if time.perf_counter() > until and runs[OURS]:
                        continue
                    free = method in (OURS, NESTED)
                    task = Task(method, name, seed, np.inf if free else budget, quick)
                    one = crew.submit(performed, task).result()
                    runs[method].append(one)
                    said = f"{one.cpu:.1f} CPU s, {one.stated:.0f} draws stated"
                    print(f"{name}, {method}: {said}", file=sys.stderr)
                    if method == OURS and seed == 1:
                        budget = one.cpu * cap
            posterior = problem_of(load_study(folder)).posterior
            references = [OURS] if quick else [OURS, NESTED]
            late = {method: "no time in a quick run" for method, own in runs.items() if not own}
            runs = {method: own for method, own in runs.items() if own}
            names = Quantities(shares).names(posterior)
            out[name] = compared(names, runs, references, absent | late) | {
                "dimension": posterior.dimension,
                "cpu_s_allowed": budget,
            }
    return out


def versions() -> dict[str, str]:
    """Of the libraries that are there."""
    return {
        method: version(distribution)
        for method, (module, distribution) in PACKAGES.items()
        if find_spec(module) is not None
    }
